"""Rigid motions as six numbers, a rotation vector and a translation, and as matrices."""

from __future__ import annotations

import numpy as np


def motion_to_matrix(motion: np.ndarray) -> np.ndarray:
    """(N, 6) → (N, 4, 4): rotation by the exponential map (Rodrigues' formula), translation as it is."""
    out = np.tile(np.eye(4), (len(motion), 1, 1))
    angle, cross = np.linalg.norm(motion[:, :3], axis=1)[:, None, None], cross_matrix(motion[:, :3])
    # sin a / a and (1 - cos a) / a², which is half the square of the first at half the angle
    out[:, :3, :3] += np.sinc(angle / np.pi) * cross + 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2 * (cross @ cross)
    out[:, :3, 3] = motion[:, 3:]
    return out


def matrix_to_motion(matrix: np.ndarray) -> np.ndarray:
    """The inverse of ``motion_to_matrix``: (N, 4, 4) → (N, 6)."""
    from scipy.spatial.transform import Rotation  # a quarter of a second to import, and 23 MB: most fits move no camera

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
