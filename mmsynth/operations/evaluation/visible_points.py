"""Surface points that test views see, and how far those of a field are from the true ones."""

from __future__ import annotations

import math

import numpy as np

from mmsynth.sensors.camera import Camera, unproject

_POINTS = 1 << 18  # pixels of a picture whose points are compared


def seen_points(camera: Camera, camera_to_world: np.ndarray, depth_z: np.ndarray, where: np.ndarray) -> np.ndarray:
    """(N, 3) world points that pixels ``where`` see; of a large picture, those of every n-th row and column."""
    step = math.ceil(math.sqrt(max(1.0, depth_z.size / _POINTS)))
    v, u = np.mgrid[0 : depth_z.shape[0] : step, 0 : depth_z.shape[1] : step]
    pixels = np.stack([u, v], -1)[where[::step, ::step]].astype(np.float64)
    rays, _ = unproject(pixels, camera)
    depth = depth_z[::step, ::step][where[::step, ::step]].astype(np.float64)
    forward = np.where(rays[:, 2] > 0, rays[:, 2], np.nan)
    return camera_to_world[:3, 3] + rays @ camera_to_world[:3, :3].T * (depth / forward)[:, None]


def chamfer(ours: list[np.ndarray], true: list[np.ndarray]) -> dict[str, float]:
    """Mean nearest distance between two point clouds, both ways; nothing when one is empty."""
    a, b = (np.concatenate(points) if points else np.empty((0, 3)) for points in (ours, true))
    if not len(a) or not len(b):
        return {}
    from scipy.spatial import cKDTree  # a quarter of a second to import

    return {"chamfer_visible": float(0.5 * (cKDTree(b).query(a)[0].mean() + cKDTree(a).query(b)[0].mean()))}
