"""Fewer triangles by collapsing edges at the least quadric error (Garland and Heckbert 1997)."""

from __future__ import annotations

import numpy as np

from mmsynth.operations.marching import Distance


def decimate(
    vertices: np.ndarray, faces: np.ndarray, sdf: Distance, cell: float, count: int | None, max_error: float | None
) -> tuple[np.ndarray, np.ndarray]:
    raise NotImplementedError
