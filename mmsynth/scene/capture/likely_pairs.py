"""Which pairs of pictures are worth matching: those whose largest features match (preemptive matching, Wu 2013).

Matching all features of every pair takes most of the time of structure from motion. The largest few hundred tell which pairs overlap, a
hundred times as fast, and do not ask for pictures in order.
"""

from __future__ import annotations

import numpy as np

_LARGEST = 400  # features of a picture that are compared
_RATIO = 0.85  # of the angles to the nearest and the second nearest descriptor: Lowe's test
_ALL = 20  # pictures up to which every pair is likely
_PARTNERS = 12  # of a picture: those with the most matches
_NEXT = 3  # pictures before and after it that are always tried


def likely_pairs(descriptors: list[np.ndarray], scales: list[np.ndarray]) -> list[tuple[int, int]]:
    """Pairs (i, j) of pictures, i < j, in order.

    Args:
        descriptors: (N, 128) each, not negative. scales: (N,) each, sizes of the features.
    """
    count = len(descriptors)
    if count <= _ALL:
        return [(i, j) for i in range(count) for j in range(i + 1, count)]
    chosen = [_unit(d[np.argsort(-s, kind="stable")[:_LARGEST]]) for d, s in zip(descriptors, scales, strict=True)]
    votes = np.zeros((count, count), dtype=np.int64)
    for i in range(count):
        for j in range(i + 1, count):
            votes[i, j] = votes[j, i] = _matches(chosen[i], chosen[j])
    best = np.argsort(-votes, axis=1, kind="stable")[:, :_PARTNERS]
    pairs = {(min(i, int(j)), max(i, int(j))) for i in range(count) for j in best[i] if votes[i, j]}
    pairs |= {(i, i + step) for step in range(1, _NEXT + 1) for i in range(count - step)}
    return sorted(pairs)


def _unit(descriptors: np.ndarray) -> np.ndarray:
    vectors = descriptors.astype(np.float32)
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-9))


def _matches(a: np.ndarray, b: np.ndarray) -> int:
    """How many features of ``a`` are nearest to one of ``b``, clearly and mutually."""
    if min(len(a), len(b)) < 2:
        return 0
    likeness = a @ b.T
    nearest = likeness.argmax(1)
    two = np.arccos(np.clip(np.partition(likeness, -2, axis=1)[:, -2:], -1.0, 1.0))
    mutual = likeness.argmax(0)[nearest] == np.arange(len(a))
    return int(np.count_nonzero(mutual & (two[:, 1] < _RATIO * two[:, 0])))
