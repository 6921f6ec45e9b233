"""The region of interest as cameras and points give it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from conftest import look_at, ring

from mmsynth.scene.region import region_from_cameras, region_from_points, region_from_silhouettes
from mmsynth.sensors.camera import Camera, unproject

CAMERA = Camera(24, 18, 25.0, 25.0, 11.5, 8.5)


def test_region_of_a_ring_is_where_the_cameras_look() -> None:
    shift = np.array([1e5, -2e5, 30.0])  # survey coordinates
    poses = [pose.copy() for pose in ring(12)]
    for pose in poses:
        pose[:3, 3] += shift
    region = region_from_cameras([CAMERA] * 12, poses)
    np.testing.assert_allclose(region.centre, shift, atol=1e-6)
    half_view = np.arctan(12 / 25)
    assert region.radius == pytest.approx(np.sqrt(10) * np.sin(half_view), rel=1e-9)


def test_region_leaves_the_nearest_camera_outside() -> None:
    wide = Camera(24, 18, 5.0, 5.0, 11.5, 8.5)
    poses = [*ring(8), look_at((0.0, 1.2, 0.4))]
    region = region_from_cameras([wide] * 9, poses)
    assert min(np.linalg.norm(pose[:3, 3] - region.centre) for pose in poses) > region.radius


def test_sparse_points_fit_the_region_to_what_is_there() -> None:
    random = np.random.default_rng(0)
    poses = ring(12)
    seen = region_from_cameras([CAMERA] * 12, poses)
    positions = np.stack([pose[:3, 3] for pose in poses])
    directions = random.normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    thing = np.array([0.2, -0.1, 0.3]) + 0.5 * directions[:2000]
    walls, strays = 8.0 * directions[2000:], random.uniform(-0.9, 0.9, (40, 3))
    region = region_from_points(np.concatenate([thing, walls, strays]), seen, positions)
    np.testing.assert_allclose(region.centre, (0.2, -0.1, 0.3), atol=0.05)
    assert 0.5 < region.radius < 0.62 < seen.radius


def test_sparse_points_leave_cameras_outside_and_few_say_nothing() -> None:
    poses = ring(12)
    seen = region_from_cameras([CAMERA] * 12, poses)
    positions = np.stack([pose[:3, 3] for pose in poses])
    everywhere = np.random.default_rng(0).uniform(-4, 4, (5000, 3))
    region = region_from_points(everywhere, seen, positions)
    assert region.radius <= seen.radius and np.linalg.norm(positions - region.centre, axis=1).min() > region.radius
    assert region_from_points(everywhere[:40], seen, positions) == seen
    assert region_from_points(np.zeros((100, 3)), seen, positions) == seen  # all in one place: no size


DEGENERATE: dict[str, Callable[[], list[np.ndarray]]] = {
    "one camera": lambda: [look_at((3.0, 0.0, 1.0))],
    "one camera twice": lambda: [look_at((3.0, 0.0, 1.0))] * 2,
    "parallel axes": lambda: [look_at((3.0, y, 0.0), (0.0, y, 0.0)) for y in (0.0, 0.5, 1.0)],
    "looking outwards": lambda: [look_at(pose[:3, 3], 2 * pose[:3, 3]) for pose in ring(8)],
    "panorama": lambda: [look_at((0.0, 0.0, 0.0), (np.cos(a), np.sin(a), 0.0)) for a in np.arange(6)],
}


@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_cameras_give_a_finite_region(name: str) -> None:
    poses = DEGENERATE[name]()
    region = region_from_cameras([CAMERA] * len(poses), poses)
    assert np.isfinite([*region.centre, region.radius]).all() and 0.01 < region.radius < 100
    if name == "one camera":
        ahead = np.linalg.inv(poses[0]) @ [*region.centre, 1.0]
        np.testing.assert_allclose(ahead[:3], (0, 0, 1), atol=1e-12)


def _silhouette(camera: Camera, pose: np.ndarray, centre: np.ndarray, radius: float) -> np.ndarray:
    """(H, W) which pixels see a ball: those whose rays pass its centre within its radius."""
    rows, columns = np.mgrid[: camera.height, : camera.width]
    directions = unproject(np.stack([columns, rows], -1).reshape(-1, 2).astype(float), camera)[0] @ pose[:3, :3].T
    away = centre - pose[:3, 3]
    along = directions @ away
    return ((along > 0) & (away @ away - along**2 < radius**2)).reshape(camera.height, camera.width)


@pytest.mark.parametrize("radius", [0.08, 0.3])
def test_silhouettes_fit_the_region_to_the_object(radius: float) -> None:
    """A small ball off the middle: the region holds it and is hardly larger, with one bad mask in twenty-four and no silhouette at all."""
    camera = Camera(240, 180, 250.0, 250.0, 119.5, 89.5)
    poses = [*ring(12, 3.0, 1.0), *ring(12, 3.0, -2.0)]
    centre = np.array([0.25, -0.1, 0.15])
    seen = region_from_cameras([camera] * 24, poses)
    silhouettes = [_silhouette(camera, pose, centre, radius) for pose in poses]
    silhouettes[5] = np.zeros_like(silhouettes[5])
    region = region_from_silhouettes(silhouettes, [camera] * 24, poses, seen)
    cell = 2 * seen.radius / 48
    assert np.linalg.norm(region.centre - centre) + radius <= region.radius <= radius + 4 * cell
    assert region_from_silhouettes([np.zeros((180, 240), bool)] * 24, [camera] * 24, poses, seen) == seen
    assert region_from_silhouettes([np.ones((180, 240), bool)] * 24, [camera] * 24, poses, seen) == seen
