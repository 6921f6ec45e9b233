"""Some of the pixels of many frames, kept as bits."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

_BLOCK = 64  # pixels that are counted together
_POPULATION = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1).sum(1)  # of each byte


class Pixels:
    """Chosen pixels, numbered through the frames; the k-th is found without a list of them, which would be as large as the frames.

    Attributes:
        counts: of each frame. size: of all frames.
        bits: (blocks, 8) uint8, of each frame its pixels, filled up to a multiple of 64; None where all pixels of all frames are chosen.
    """

    def __init__(self, chosen: Sequence[np.ndarray]) -> None:
        """``chosen``: of each frame (P,) bool; P may differ."""
        self.counts = np.array([np.count_nonzero(frame) for frame in chosen])
        self.size = int(self.counts.sum())
        self.bits: np.ndarray | None = None
        self._ends = np.cumsum(self.counts)
        if self.size < sum(map(len, chosen)):
            filled = [np.pad(frame, (0, -len(frame) % _BLOCK)) for frame in chosen]
            self.bits = np.concatenate([np.packbits(frame).reshape(-1, _BLOCK // 8) for frame in filled])
            self._block_ends = np.cumsum(_POPULATION[self.bits].sum(1, dtype=np.int64))
            self._first_block = np.cumsum([0, *(len(frame) // _BLOCK for frame in filled)])[:-1]

    def at(self, number: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The frame and the pixel in it of each number, (N,) each."""
        frame = np.searchsorted(self._ends, number, side="right")
        if self.bits is None:
            return frame, number - (self._ends[frame] - self.counts[frame])
        block = np.searchsorted(self._block_ends, number, side="right")
        bits = np.unpackbits(self.bits[block], axis=1)
        before = self._block_ends[block] - bits.sum(1, dtype=np.int64)
        within = np.argmax(np.cumsum(bits, axis=1, dtype=np.int64) > (number - before)[:, None], axis=1)
        return frame, (block - self._first_block[frame]) * _BLOCK + within
