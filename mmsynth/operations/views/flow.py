"""Optical flow between two views of a field, exact from depth and poses."""

from __future__ import annotations

import numpy as np

from mmsynth.field.picture import bands
from mmsynth.operations.views.visibility import hidden, inside, towards
from mmsynth.parallel import side_by_side
from mmsynth.scene.scene import PosedCamera
from mmsynth.sensors.camera import project, surface_points


def optical_flow(
    a: PosedCamera, depth_ray_a: np.ndarray, normal_a: np.ndarray, b: PosedCamera, depth_ray_b: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where what the pixels of view a see lies in view b, through both lenses; of a scene that stands still.

    Args:
        a, b: the two views, in one world frame and unit.
        depth_ray_a, depth_ray_b: (H, W) of each view, along the ray, in that unit; NaN = no surface.
        normal_a: (H, W, 3) world frame, unit; NaN = no surface. A surface that faces away from b is hidden from it: without normals the
            strip just behind an object's horizon, less than a pixel wide in b and many in a, would pass for seen.
    Returns:
        flow, (H, W, 2) float32 [px]: u to the right, v down, from the centre of a's pixel to b's image of the point, which may be out of
        b's frame. NaN where a sees no surface, and where the point lies behind b or out of its lens' domain.
        occluded, (H, W) bool: a sees a surface here, and b does not see that point, as it is out of b's frame or lens, or faces away, or
        something is nearer to b there, by more than ``visibility.SAME_SURFACE`` of the point's distance. False without a surface.
    """
    points = surface_points(a.camera, a.camera_to_world, depth_ray_a)
    centre_a, centre_b = a.camera_to_world[:3, 3], b.camera_to_world[:3, 3]
    flow, occluded = np.full((*depth_ray_a.shape, 2), np.nan, np.float32), np.zeros(depth_ray_a.shape, bool)

    def of_rows(rows: slice) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of some rows: where there is a surface, what it moves by, and whether b sees it."""
        hit = np.isfinite(depth_ray_a[rows])
        there = points[rows][hit]
        in_b = (there - centre_b) @ b.camera_to_world[:3, :3]
        pixels = project(in_b, b.camera)
        seen = inside(pixels, b.camera)
        seen &= np.einsum("ni,ni->n", towards(normal_a[rows][hit], there, centre_a), centre_b - there) > 0
        seen[seen] = ~hidden(np.linalg.norm(in_b[seen], axis=1), pixels[seen], depth_ray_b)
        return hit, pixels - (np.argwhere(hit)[:, ::-1] + [0, rows.start]), seen

    for rows, (hit, moved, seen) in side_by_side(of_rows, bands(depth_ray_a.shape)):
        flow[rows][hit], occluded[rows][hit] = moved, ~seen
    return flow, occluded
