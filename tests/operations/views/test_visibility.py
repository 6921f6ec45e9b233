"""Depth maps as witnesses: a surface does not hide itself, and hides what is behind it."""

from __future__ import annotations

import numpy as np
import pytest

from mmsynth.operations.views.visibility import SAME_SURFACE, hidden, inside, towards
from mmsynth.sensors.camera import Camera, project, ray_map, surface_points, unproject

CAMERA = Camera(40, 30, 35.0, 35.0, 19.5, 14.5)


@pytest.mark.parametrize("slant", [0.0, 45.0, 85.0])
def test_a_plane_hides_what_is_behind_it_and_not_itself(slant: float) -> None:
    """Seen at up to 5° between the pixels of a coarse map, where depth changes by a multiple of the tolerance."""
    normal = np.array([np.sin(np.radians(slant)), 0.0, -np.cos(np.radians(slant))])
    directions, _ = ray_map(CAMERA)
    towards_plane = directions @ normal < -0.03
    depth = np.where(towards_plane, -2.0 / np.where(towards_plane, directions @ normal, -1.0), np.nan).astype(np.float32)
    pixels = np.random.default_rng(0).uniform(0, [39, 29], (5000, 2))
    rays, _ = unproject(pixels, CAMERA)
    below = rays @ normal
    meets = below < -0.06  # all four pixels around it meet the plane, too
    distance = -2.0 / below[meets]
    assert meets.sum() > 500
    assert not hidden(distance, pixels[meets], depth).any()
    # far behind: the farthest of the four pixels is nearer than that
    steepest = np.abs(np.diff(depth, axis=1))[np.isfinite(np.diff(depth, axis=1))].max()
    assert hidden((distance + 2 * steepest) * (1 + 2 * SAME_SURFACE), pixels[meets], depth).all()


def test_no_surface_hides_nothing_and_an_edge_less_than_a_pixel() -> None:
    depth = np.full((30, 40), np.nan, np.float32)
    depth[:, :20] = 1.0
    pixels = np.array([[18.9, 5.0], [19.5, 5.0], [30.0, 5.0], [-0.4, -0.4]])
    assert hidden(np.full(4, 3.0), pixels, depth).tolist() == [True, False, False, True]
    stack = np.stack([depth, np.full_like(depth, 4.0)])
    assert hidden(np.full(4, 3.0), pixels, stack, np.array([1, 0, 0, 1])).tolist() == [False] * 4
    assert hidden(np.array([1.01, 1.03]), np.full((2, 2), 5.0), depth).tolist() == [False, True]


def test_points_go_back_to_their_pixels() -> None:
    depth = np.random.default_rng(0).uniform(1, 2, (30, 40)).astype(np.float32)
    depth[3, 4] = np.nan
    pose = np.eye(4)
    pose[:3] = [[0, 0, 1, 5], [1, 0, 0, -2], [0, 1, 0, 3]]
    points = surface_points(CAMERA, pose, depth)
    assert np.isnan(points[3, 4]).all() and np.isnan(points).sum() == 3
    np.testing.assert_allclose(np.linalg.norm(points - pose[:3, 3], axis=-1), depth, rtol=1e-12)
    pixels = project((points - pose[:3, 3]) @ pose[:3, :3], CAMERA)
    np.testing.assert_allclose(pixels[10, 20], (20, 10), atol=1e-9)


def test_normals_of_the_side_that_is_seen() -> None:
    normals = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
    points = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    np.testing.assert_array_equal(towards(normals, points, np.zeros(3)), [[0, 0, -1], [0, 0, 1]])


def test_inside() -> None:
    pixels = np.array([[-0.5, -0.5], [39.4, 29.4], [39.5, 0.0], [0.0, 29.5], [np.nan, 0.0]])
    assert inside(pixels, CAMERA).tolist() == [True, True, False, False, False]
