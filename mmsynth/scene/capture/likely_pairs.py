"""Which pairs of pictures are worth matching: those whose largest features match (preemptive matching, Wu 2013).

Matching all features of every pair takes most of the time of structure from motion. The largest few hundred tell which pairs overlap, a
hundred times as fast, and do not ask for pictures in order.
"""

from __future__ import annotations

import numpy as np

from mmsynth.scene.capture.nearest import mutual_matches

_LARGEST = 400  # features of a picture that are compared
_RATIO = 0.85  # larger than for matches: few features tell
_ALL = 20  # pictures up to which every pair is likely
_PARTNERS = 12  # of a picture: those with the most matches
_NEXT = 3  # pictures before and after it that are always tried


def likely_pairs(descriptors: list[np.ndarray], scales: list[np.ndarray]) -> list[tuple[int, int]]:
    """Pairs (i, j) of pictures, i < j, in order.

    Args:
        descriptors: (N, 128) uint8 each. scales: (N,) each, sizes of the features.
    """
    count = len(descriptors)
    if count <= _ALL:
        return [(i, j) for i in range(count) for j in range(i + 1, count)]
    chosen = [d[np.argsort(-s, kind="stable")[:_LARGEST]] for d, s in zip(descriptors, scales, strict=True)]
    votes = np.zeros((count, count), dtype=np.int64)
    for i in range(count):
        for j in range(i + 1, count):
            votes[i, j] = votes[j, i] = len(mutual_matches(chosen[i], chosen[j], _RATIO, farthest=np.inf))
    best = np.argsort(-votes, axis=1, kind="stable")[:, :_PARTNERS]
    pairs = {(min(i, int(j)), max(i, int(j))) for i in range(count) for j in best[i] if votes[i, j]}
    pairs |= {(i, i + step) for step in range(1, _NEXT + 1) for i in range(count - step)}
    return sorted(pairs)
