"""Projections with their derivatives in closed form, for the normal equations of a calibration.

The lens models are those of ``sensors.lenses``; tests compare with its automatic derivatives.
"""

from __future__ import annotations

import numpy as np

from mmsynth.sensors.camera import Camera


def projected(points: np.ndarray, camera: Camera) -> np.ndarray:
    """(N, 2) px of (N, 3) points in the camera's axes: those of ``project_with_derivatives`` alone, in a third of the time."""
    if camera.lens == "kannala_brandt":
        image = points[:, :2] * _fisheye_share(points, camera.coefficients)[0][:, None]
    else:
        x, y, r2, radial, _, _ = _brown_radial(points, camera.coefficients)
        image = _brown_image(x, y, r2, radial, camera.coefficients)
    return image * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def project_with_derivatives(points: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels of points, with derivatives; points behind a Brown-Conrady camera, which has none, give NaN.

    Args:
        points: (N, 3) in the camera's axes.
    Returns:
        (N, 2) px; (N, 2, 3) by the point; (N, 2, 4 + C) by fx, fy, cx, cy and the lens's coefficients (8 or, of a fisheye, 4).
    """
    image, by_point, by_lens = (_fisheye if camera.lens == "kannala_brandt" else _brown)(points, camera.coefficients)
    focal = np.array([camera.fx, camera.fy])
    by_intrinsics = np.zeros((len(points), 2, 4))
    by_intrinsics[:, 0, 0], by_intrinsics[:, 1, 1] = image.T
    by_intrinsics[:, 0, 2] = by_intrinsics[:, 1, 3] = 1.0
    scale = focal[None, :, None]
    return image * focal + [camera.cx, camera.cy], by_point * scale, np.concatenate([by_intrinsics, by_lens * scale], 2)


def _brown_radial(points: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, ...]:
    """x / z and y / z, the square of their distance from the axis, the radial factor, its denominator, and z: (N,) each."""
    k1, k2, _, _, k3, k4, k5, k6 = k
    z = np.where(points[:, 2] > 0, points[:, 2], np.nan)
    x, y = points[:, 0] / z, points[:, 1] / z
    r2 = x * x + y * y
    top, bottom = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    return x, y, r2, top / bottom, bottom, z


def _brown_image(x: np.ndarray, y: np.ndarray, r2: np.ndarray, radial: np.ndarray, k: np.ndarray) -> np.ndarray:
    p1, p2 = k[2:4]
    return np.stack([x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], -1)


def _brown(points: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    k1, k2, p1, p2, k3, k4, k5, k6 = k
    x, y, r2, radial, bottom, z = _brown_radial(points, k)
    slope = ((k1 + r2 * (2 * k2 + 3 * r2 * k3)) - radial * (k4 + r2 * (2 * k5 + 3 * r2 * k6))) / bottom
    across = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    by_ideal = np.empty((len(points), 2, 2))
    by_ideal[:, 0, 0], by_ideal[:, 0, 1] = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x, across
    by_ideal[:, 1, 0], by_ideal[:, 1, 1] = across, radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    ideal_by_point = np.zeros((len(points), 2, 3))
    ideal_by_point[:, 0, 0] = ideal_by_point[:, 1, 1] = 1 / z
    ideal_by_point[:, 0, 2], ideal_by_point[:, 1, 2] = -x / z, -y / z
    xy = np.stack([x, y], -1)
    powers = np.stack([r2, r2**2, r2**3], -1)
    by_top = xy[:, :, None] * (powers / bottom[:, None])[:, None]
    by_bottom = -xy[:, :, None] * (powers * (radial / bottom)[:, None])[:, None]
    tangential = np.stack([np.stack([2 * x * y, r2 + 2 * x * x], -1), np.stack([r2 + 2 * y * y, 2 * x * y], -1)], 1)
    return (
        _brown_image(x, y, r2, radial, k),
        by_ideal @ ideal_by_point,
        np.concatenate([by_top[..., :2], tangential, by_top[..., 2:], by_bottom], 2),
    )


def _fisheye_share(points: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, ...]:
    """Image over point (N,), the distance from the axis (N,), the angle to it (N,), its third to ninth powers (N, 4)."""
    x, y, z = points.T
    r = np.maximum(np.hypot(x, y), 1e-12 * np.abs(z) + 1e-300)
    angle = np.arctan2(r, z)
    powers = angle[:, None] ** np.array([3, 5, 7, 9])
    return (angle + powers @ k) / r, r, angle, powers


def _fisheye(points: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    share, r, angle, powers = _fisheye_share(points, k)
    slope, z = 1 + (powers / angle[:, None]) @ (k * [3, 5, 7, 9]), points[:, 2]
    square = r * r + z * z
    direction = points[:, :2] / r[:, None]
    by_r = (slope * z / square - share) / r  # of the share
    by_point = np.empty((len(points), 2, 3))
    by_point[:, :, :2] = share[:, None, None] * np.eye(2) + points[:, :2, None] * (by_r[:, None] * direction)[:, None]
    by_point[:, :, 2] = points[:, :2] * (-slope / square)[:, None]
    return points[:, :2] * share[:, None], by_point, direction[:, :, None] * powers[:, None]
