"""Pinhole camera with Brown-Conrady lens: pixels to rays and back.

Symbols: ``u, v`` pixel coordinates (column, row; centre of the top-left pixel = 0, 0); ``x, y`` normalised image
coordinates after the lens (distorted) or before it (ideal). Distortion in OpenCV order k1, k2, p1, p2, k3, k4, k5, k6:

    radial = (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶)
    x_d = x radial + 2 p1 x y + p2 (r² + 2 x²)
    y_d = y radial + p1 (r² + 2 y²) + 2 p2 x y

The inverse is a Newton iteration started on the monotone branch of the radial polynomial and checked by its residual:
OpenCV's and kornia's default five fixed-point iterations do not converge for strong lenses, and beyond the fold of the
polynomial no ray exists at all. Such pixels are masked, never guessed.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from mmsynth.errors import InputError


@dataclass(frozen=True)
class Camera:
    """Intrinsics [px] and Brown-Conrady distortion (0, 4, 5 or 8 coefficients, OpenCV order). Hashable."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if len(self.distortion) not in (0, 4, 5, 6, 8):
            raise InputError(
                f"distortion: {len(self.distortion)} coefficients, expected 0, 4, 5, 6 or 8 in the order k1 k2 p1 p2 k3 k4 k5 k6."
            )
        if self.width < 1 or self.height < 1:
            raise InputError(f"camera: size {self.width}x{self.height}, expected at least 1x1 pixel.")
        values = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        if not all(np.isfinite(values)) or self.fx <= 0 or self.fy <= 0:
            raise InputError(
                f"camera: fx={self.fx}, fy={self.fy}, cx={self.cx}, cy={self.cy}, expected finite numbers and positive focal lengths."
            )

    @property
    def matrix(self) -> np.ndarray:
        """(3, 3) intrinsic matrix K."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def coefficients(self) -> np.ndarray:
        """(8,) distortion, zero-padded."""
        return np.array(self.distortion + (0.0,) * (8 - len(self.distortion)))


def _radial(coefficients: np.ndarray, r2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Radial factor and its derivative with respect to r²."""
    k1, k2, _, _, k3, k4, k5, k6 = coefficients
    top = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    bottom = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    d_top = k1 + r2 * (2 * k2 + r2 * 3 * k3)
    d_bottom = k4 + r2 * (2 * k5 + r2 * 3 * k6)
    return top / bottom, (d_top * bottom - top * d_bottom) / bottom**2


def distort(xy: np.ndarray, coefficients: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ideal → distorted normalised coordinates.

    Args:
        xy: (..., 2). coefficients: (8,).
    Returns:
        distorted (..., 2) and Jacobian (..., 2, 2), d distorted[i] / d ideal[j].
    """
    _, _, p1, p2, *_ = coefficients
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial, slope = _radial(coefficients, r2)
    out = np.stack([x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], -1)
    jacobian = np.empty((*xy.shape, 2))
    jacobian[..., 0, 0] = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    jacobian[..., 0, 1] = jacobian[..., 1, 0] = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    jacobian[..., 1, 1] = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    return out, jacobian


@functools.lru_cache(maxsize=256)
def fold_radius(distortion: tuple[float, ...]) -> float:
    """Ideal radius at which the radial polynomial stops growing (inf: never, up to 80 degrees off axis).

    Beyond it two ideal points share a distorted one, so the lens model has no inverse there.
    """
    coefficients = np.array(distortion + (0.0,) * (8 - len(distortion)))
    r = np.linspace(0.0, np.tan(np.radians(80.0)), 20001)
    radial, slope = _radial(coefficients, r * r)
    falling = np.flatnonzero(radial + 2 * r * r * slope <= 0)
    return float(r[falling[0] - 1]) if falling.size else float("inf")


def undistort(xy_distorted: np.ndarray, coefficients: np.ndarray, tolerance: float = 1e-10) -> tuple[np.ndarray, np.ndarray]:
    """Distorted → ideal normalised coordinates, with a validity mask.

    The start is the inverse of the monotone radial profile (tabulated), so Newton begins on the right branch.

    Args:
        xy_distorted: (..., 2) float64.
    Returns:
        ideal (..., 2) and valid (...) bool: residual below ``tolerance``, inside the fold, orientation kept.
    """
    target = np.asarray(xy_distorted, dtype=np.float64)
    if not np.any(coefficients):
        return target.copy(), np.asarray(np.isfinite(target).all(-1))
    limit = min(fold_radius(tuple(coefficients)), np.tan(np.radians(80.0)))
    radii = np.linspace(0.0, limit, 4097)
    profile = radii * _radial(coefficients, radii * radii)[0]
    r_distorted = np.linalg.norm(target, axis=-1)
    r_start = np.interp(r_distorted, profile, radii)
    xy = target * (r_start / np.maximum(r_distorted, 1e-300))[..., None]
    for _ in range(20):
        value, jacobian = distort(xy, coefficients)
        residual = target - value
        determinant = jacobian[..., 0, 0] * jacobian[..., 1, 1] - jacobian[..., 0, 1] * jacobian[..., 1, 0]
        safe = np.where(np.abs(determinant) > 1e-6, determinant, np.inf)  # at the fold: no step, the residual mask tells
        step = np.stack([
            (jacobian[..., 1, 1] * residual[..., 0] - jacobian[..., 0, 1] * residual[..., 1]) / safe,
            (jacobian[..., 0, 0] * residual[..., 1] - jacobian[..., 1, 0] * residual[..., 0]) / safe,
        ], -1)  # fmt: skip
        length = np.linalg.norm(step, axis=-1, keepdims=True)
        xy = xy + step * np.minimum(1.0, 0.25 / np.maximum(length, 1e-300))  # trust region: stay on this branch
        if not np.any(length > 1e-14):
            break
    value, jacobian = distort(xy, coefficients)
    determinant = jacobian[..., 0, 0] * jacobian[..., 1, 1] - jacobian[..., 0, 1] * jacobian[..., 1, 0]
    valid = (np.linalg.norm(target - value, axis=-1) < tolerance) & (determinant > 0) & (np.linalg.norm(xy, axis=-1) <= limit)
    return xy, valid


def project(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Camera-frame points (..., 3) → pixels (..., 2). Points at or behind the camera give NaN."""
    z = points[..., 2:3]
    xy = points[..., :2] / np.where(z > 0, z, np.nan)
    xy = distort(xy, camera.coefficients)[0]
    return xy * np.array([camera.fx, camera.fy]) + np.array([camera.cx, camera.cy])


def unproject(pixels: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (..., 2) → camera-frame directions (..., 3) with z = 1, and a validity mask (...)."""
    xy = (np.asarray(pixels, dtype=np.float64) - np.array([camera.cx, camera.cy])) / np.array([camera.fx, camera.fy])
    ideal, valid = undistort(xy, camera.coefficients)
    return np.concatenate([ideal, np.ones_like(ideal[..., :1])], -1), valid


@functools.lru_cache(maxsize=64)
def ray_map(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Directions of all photosites, computed once per camera in float64.

    Returns:
        (H, W, 3) float64 unit vectors in the camera frame and (H, W) bool validity. Do not write to them: they are shared.
    """
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    directions, valid = unproject(np.stack([u, v], -1).astype(np.float64), camera)
    directions = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    directions.setflags(write=False)
    valid.setflags(write=False)
    return directions, valid
