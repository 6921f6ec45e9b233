"""Optical flow between two views of a field, exact from depth and poses."""

from __future__ import annotations

import numpy as np

from mmsynth.operations.views.visibility import hidden, inside, towards
from mmsynth.sensors.camera import Camera, project, surface_points


def optical_flow(
    camera_a: Camera,
    pose_a: np.ndarray,
    depth_ray_a: np.ndarray,
    normal_a: np.ndarray,
    camera_b: Camera,
    pose_b: np.ndarray,
    depth_ray_b: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Where what the pixels of view a see lies in view b, through both lenses; of a scene that stands still.

    Args:
        pose_a, pose_b: (4, 4) camera_to_world, OpenCV axes, one world frame and unit.
        depth_ray_a, depth_ray_b: (H, W) of each view, along the ray, in that unit; NaN = no surface.
        normal_a: (H, W, 3) world frame, unit; NaN = no surface. A surface that faces away from b is hidden from it: without normals the
            strip just behind an object's horizon, less than a pixel wide in b and many in a, would pass for seen.
    Returns:
        flow, (H, W, 2) float32 [px]: u to the right, v down, from the centre of a's pixel to b's image of the point, which may be out of
        b's frame. NaN where a sees no surface, and where the point lies behind b or out of its lens' domain.
        occluded, (H, W) bool: a sees a surface here, and b does not see that point, as it is out of b's frame or lens, or faces away, or
        something is nearer to b there, by more than ``visibility.SAME_SURFACE`` of the point's distance. False without a surface.
    """
    points = surface_points(camera_a, pose_a, depth_ray_a)
    hit = np.isfinite(depth_ray_a)
    in_b = (points[hit] - pose_b[:3, 3]) @ pose_b[:3, :3]
    pixels = project(in_b, camera_b)
    seen = inside(pixels, camera_b)
    faces = np.einsum("ni,ni->n", towards(normal_a[hit], points[hit], pose_a[:3, 3]), pose_b[:3, 3] - points[hit]) > 0
    seen &= faces
    seen[seen] = ~hidden(np.linalg.norm(in_b[seen], axis=1), pixels[seen], depth_ray_b)
    flow = np.full((*hit.shape, 2), np.nan, np.float32)
    flow[hit] = pixels - np.argwhere(hit)[:, ::-1]
    occluded = np.zeros(hit.shape, bool)
    occluded[hit] = ~seen
    return flow, occluded
