"""Which points of two pictures look alike: each other's nearest descriptors, clearly nearer than the second (Lowe's test).

SIFT's descriptors are whole numbers, so their squared distances are exact in single precision, in whatever order they are summed: the
same pictures have the same matches on any number of threads. (COLMAP's own matcher looks in some clusters of descriptors only, which two
threads that begin at once find different ones of, now and then.)
"""

from __future__ import annotations

import numpy as np

_LENGTH = 512.0  # of a descriptor of bytes
_ROWS = 512  # of distances that are looked at together: in the caches


def mutual_matches(a: np.ndarray, b: np.ndarray, ratio: float = 0.8, farthest: float = 0.7) -> np.ndarray:
    """Rows of ``a`` and ``b`` that are each other's nearest, (M, 2) uint32, in the order of ``a``.

    Args:
        a, b: descriptors, (N, 128) and (K, 128) uint8. ratio: of the distances to the nearest and to the second nearest, either way: it is
            smaller. farthest: distance in lengths of a descriptor; defaults are COLMAP's.
    """
    if min(len(a), len(b)) < 2:
        return np.empty((0, 2), np.uint32)
    nearest, clear = _clearly_nearest(a, b, ratio, farthest)
    rows = np.flatnonzero(clear)
    back, clear = _clearly_nearest(b[nearest[rows]], a, ratio, farthest)
    mutual = clear & (back == rows)
    return np.stack([rows[mutual], nearest[rows[mutual]]], axis=1).astype(np.uint32)


def _clearly_nearest(a: np.ndarray, b: np.ndarray, ratio: float, farthest: float) -> tuple[np.ndarray, np.ndarray]:
    """For each row of ``a`` the nearest of ``b``, and whether it is near, and nearer than the second nearest."""
    nearest, best, second = np.empty(len(a), np.int64), np.empty(len(a), np.float32), np.empty(len(a), np.float32)
    of_b = b.astype(np.float32)
    right = np.concatenate([of_b, _squares(of_b), np.ones((len(b), 1), np.float32)], axis=1)
    for begin in range(0, len(a), _ROWS):
        part = slice(begin, begin + _ROWS)
        of_a = a[part].astype(np.float32)
        left = np.concatenate([-2.0 * of_a, np.ones((len(of_a), 1), np.float32), _squares(of_a)], axis=1)
        squared = left @ right.T  # |a|² - 2 a b + |b|²
        rows = np.arange(len(squared))
        nearest[part] = squared.argmin(1)
        best[part] = squared[rows, nearest[part]]
        squared[rows, nearest[part]] = np.inf
        second[part] = squared.min(1)
    return nearest, (best <= (farthest * _LENGTH) ** 2) & (best < ratio**2 * second)


def _squares(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(np.square(vectors).sum(1, keepdims=True))
