"""Frames cut into tiles, which are what is counted and drawn: of each its pixels, and, where not all of them are chosen, a bit for each."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import torch

from mmsynth.field import kernels
from mmsynth.field.kernels.constants import WORD

_MOST = 1 << 18  # of a modality
_LOOKS = 8.0  # rays that a tile gets in a fit, at the least: some more than its residual remembers


class Tile(NamedTuple):
    """Of what size, in pixels; powers of two, no fewer than ``WORD`` together."""

    width: int
    height: int

    def down_across(self, height: int, width: int) -> tuple[int, int]:
        """How many there are in a frame; those at its right and lower edges may reach past it."""
        return -(-height // self.height), -(-width // self.width)


class Tiled(NamedTuple):
    """Chosen pixels of frames: ``pixels`` (T,) int32, how many of each tile; ``words``, see ``kernels.Selection``, None: all are chosen."""

    pixels: np.ndarray
    words: np.ndarray | None


def tile_size(pixels: int, rays_to_come: float) -> Tile:
    """The smallest tile of which a modality's pixels make no more than can be counted, and be looked at often enough."""
    most, tile = min(_MOST, max(rays_to_come / _LOOKS, 1.0)), Tile(8, WORD // 8)
    while pixels > most * tile.width * tile.height and tile.width < 1024:
        tile = Tile(tile.width, 2 * tile.height) if tile.height < tile.width else Tile(2 * tile.width, tile.height)
    return tile


def all_pixels(shapes: Iterable[tuple[int, int]], tile: Tile) -> Tiled:
    """All pixels of frames of such (height, width)."""
    counts = []
    for height, width in shapes:
        down, across = tile.down_across(height, width)
        rows = np.minimum(tile.height, height - tile.height * np.arange(down))
        columns = np.minimum(tile.width, width - tile.width * np.arange(across))
        counts.append((rows[:, None] * columns).reshape(-1).astype(np.int32))
    return Tiled(np.concatenate(counts), None)


def some_pixels(chosen: np.ndarray, tile: Tile) -> Tiled:
    """Pixels of a frame, (H, W) bool."""
    down, across = tile.down_across(*chosen.shape)
    filled = np.zeros((down * tile.height, across * tile.width), bool)
    filled[: chosen.shape[0], : chosen.shape[1]] = chosen
    tiles = filled.reshape(down, tile.height, across, tile.width).swapaxes(1, 2).reshape(down * across, -1)
    return Tiled(tiles.sum(1, dtype=np.int32), np.packbits(tiles, axis=1, bitorder="little").view("<i4").reshape(-1))


def joined(frames: Sequence[Tiled]) -> Tiled:
    """Of frames of which each has words."""
    return Tiled(*(np.concatenate(part) for part in zip(*frames, strict=True)))


def selection_of(parts: Sequence[Tiled], first_tile: torch.Tensor) -> kernels.Selection:
    """Each of the chosen pixels of several modalities as often as every other one of its modality."""
    words = [np.empty(0, np.int32) if part.words is None else part.words for part in parts]
    begins = np.cumsum([0, *map(len, words)])[:-1]
    first_word = np.array([-1 if part.words is None else begin for part, begin in zip(parts, begins, strict=True)], np.int64)
    count = torch.from_numpy(np.concatenate([part.pixels for part in parts]))
    ends, weight = kernels.odds(torch.ones(len(count)), count, first_tile, 1.0)
    return kernels.Selection(ends, weight, count, torch.from_numpy(first_word), torch.from_numpy(np.concatenate(words)))
