"""What one camera's surface looks like from another: points, and whether something stands before them.

The test is that of shadow maps (Williams 1978): a point is hidden where the depth along the camera's own rays is less than the
distance of the point. Depth is along the ray, in the scene's unit; NaN = no surface.
"""

from __future__ import annotations

import numpy as np

from mmsynth.sensors.camera import Camera

SAME_SURFACE = 0.02
"""Of the distance: how far a point may lie behind what is seen there and still belong to it. Fields are no more exact than that, and
things nearer together than that (6 cm at 3 m) are not told apart."""


def towards(normal: np.ndarray, points: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Normals (..., 3) of the side of the surface that is seen from a camera's centre (3,).

    Outward normals are so already, but for the errors of a field where its surface is seen at a grazing angle.
    """
    away = np.einsum("...i,...i->...", normal, points - centre) > 0
    return np.where(away[..., None], -normal, normal)


def inside(pixels: np.ndarray, camera: Camera) -> np.ndarray:
    """Whether pixels (..., 2) lie in the frame, half a pixel around the outermost centres included; False for NaN."""
    u, v = pixels[..., 0], pixels[..., 1]
    return (u >= -0.5) & (u < camera.width - 0.5) & (v >= -0.5) & (v < camera.height - 0.5)


def hidden(distance: np.ndarray, pixels: np.ndarray, depth_ray: np.ndarray, image: np.ndarray | None = None) -> np.ndarray:
    """Whether something stands before points.

    The point is compared with the farthest of the four pixels around it, where no surface is infinitely far: what is seen at a slant is
    not taken for its own occluder, and a point within a pixel of an occluder's edge counts as seen.

    Args:
        distance: (N,) of the points from the camera. pixels: (N, 2) where it projects them, within its frame.
        depth_ray: (H, W) of that camera, or (J, H, W) of several. image: (N,) which of the several.
    Returns:
        (N,) bool.
    """
    height, width = depth_ray.shape[-2:]
    left, top = np.floor(pixels).astype(np.int64).T
    farthest = np.zeros(len(distance))
    for i in (0, 1):
        for j in (0, 1):
            row, column = np.clip(top + i, 0, height - 1), np.clip(left + j, 0, width - 1)  # beyond the outermost centres: theirs
            depth = depth_ray[row, column] if image is None else depth_ray[image, row, column]
            farthest = np.maximum(farthest, np.where(np.isnan(depth), np.inf, depth))
    return farthest < (1.0 - SAME_SURFACE) * distance
