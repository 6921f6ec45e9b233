"""Camera paths look at the region with the horizon level; poses files keep their intrinsics."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from analytic import RGB, AnalyticField, ring_pose, scene_of, sphere

from mmsynth.errors import InputError
from mmsynth.operations.trajectories import load_views, look_at, trajectory_views, world_up
from mmsynth.scene.scene import Region
from mmsynth.sensors.camera import Camera

CAMERA = Camera(24, 18, 26.0, 26.0, 11.5, 8.5)
REGION = Region((1.0, 2.0, 3.0), 0.5)


def moved(pose: np.ndarray) -> np.ndarray:
    out = pose.copy()
    out[:3, 3] += REGION.centre
    return out


TRAINING = [moved(ring_pose(i, 8)) for i in range(8)]


def is_rigid(pose: np.ndarray) -> bool:
    return bool(np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-9) and np.linalg.det(pose[:3, :3]) > 0)


@pytest.mark.parametrize("kind", ["orbit", "hemisphere"])
def test_around(kind: str) -> None:
    views = trajectory_views({"trajectory": kind, "views": 24}, REGION, CAMERA, TRAINING)
    assert len(views) == 24 and len({name for _, _, name in views}) == 24
    for camera, pose, _ in views:
        offset = pose[:3, 3] - REGION.centre
        assert camera == CAMERA and is_rigid(pose)
        assert np.linalg.norm(offset) == pytest.approx(np.linalg.norm([2.2, 1.0]))  # as far as the training cameras
        assert pose[:3, 2] == pytest.approx(-offset / np.linalg.norm(offset))  # looks at the centre
        assert pose[2, 0] == pytest.approx(0.0, abs=1e-9) and pose[2, 1] < 0  # level, up is up
        assert kind != "orbit" or offset[2] == pytest.approx(np.linalg.norm(offset) * np.sin(np.radians(25)))


def test_orbit_starts_at_the_first_camera_and_closes() -> None:
    views = trajectory_views({"trajectory": "orbit", "views": 4, "elevation_deg": 0, "radius": 2}, REGION, CAMERA, TRAINING)
    assert [list(np.round(p[:3, 3] - REGION.centre, 9) + 0.0) for _, p, _ in views] == [[2, 0, 0], [0, 2, 0], [-2, 0, 0], [0, -2, 0]]


def test_hemisphere_is_even() -> None:
    views = trajectory_views({"trajectory": "hemisphere", "views": 200, "min_elevation_deg": 0, "radius": 1}, REGION, CAMERA, TRAINING)
    points = np.array([p[:3, 3] - REGION.centre for _, p, _ in views])
    distance = np.linalg.norm(points[:, None] - points[None], axis=-1) + 9 * np.eye(len(points))
    assert points[:, 2].min() > 0
    assert distance.min(1).min() > 0.6 * distance.min(1).max()


def test_interpolate_meets_the_training_poses() -> None:
    views = trajectory_views({"trajectory": "interpolate", "views": 15}, REGION, CAMERA, TRAINING)
    assert all(is_rigid(p) for _, p, _ in views)
    for i, pose in enumerate(TRAINING):
        assert np.allclose(views[2 * i][1], pose)


def test_up_where_cameras_disagree() -> None:
    """A camera rolled to every side has no mean up; the plane of its positions has a normal."""
    poses = []
    for i in range(8):
        roll = np.eye(4)
        roll[:2, :2] = [[np.cos(np.pi * i), -np.sin(np.pi * i)], [np.sin(np.pi * i), np.cos(np.pi * i)]]
        poses.append(ring_pose(i, 8) @ roll)
    assert world_up(poses) == pytest.approx([0, 0, 1], abs=1e-6)
    assert world_up([]) == pytest.approx([0, 0, 1])


def test_look_along_up() -> None:
    pose = look_at(np.array([0.0, 0.0, 2.0]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
    assert is_rigid(pose) and pose[:3, 2] == pytest.approx([0, 0, -1])


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ({"trajectory": "spiral"}, "expected one of orbit, hemisphere, interpolate"),
        ({"trajectory": ["orbit"]}, "expected one of orbit"),
        ({}, "key 'trajectory' is None"),
        ({"trajectory": "orbit", "elevation": 3}, "unknown key 'elevation'"),
        ({"trajectory": "orbit", "views": 0}, "key 'views' is 0"),
        ({"trajectory": "orbit", "views": 2.5}, "whole number"),
        ({"trajectory": "orbit", "views": True}, "key 'views' is True"),
        ({"trajectory": "orbit", "elevation_deg": 91}, "from -90 to 90"),
        ({"trajectory": "orbit", "radius": -1}, "key 'radius' is -1"),
        ({"trajectory": "orbit", "radius": float("nan")}, "key 'radius' is nan"),
        ({"trajectory": "hemisphere", "min_elevation_deg": "low"}, "key 'min_elevation_deg' is 'low'"),
    ],
)
def test_refuses(spec: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        trajectory_views(spec, REGION, CAMERA, TRAINING)


def test_load_views(tmp_path: Path) -> None:
    field = AnalyticField(sphere(), [RGB])
    scene = scene_of(field, tmp_path / "scene", truth=False)
    path = tmp_path / "poses.json"
    path.write_text(json.dumps({"trajectory": "orbit", "views": 3}))
    views = load_views(path, field, scene)  # type: ignore[arg-type]
    assert len(views) == 3 and views[0][0] == field.cameras["rgb"]
    path.write_text(json.dumps({"convention": "OpenCV", "rig": [ring_pose(0, 3).tolist()]}))
    ((camera, pose, _),) = load_views(path, field)  # type: ignore[arg-type]
    assert camera == field.cameras["rgb"] and np.allclose(pose, ring_pose(0, 3))
    path.write_text("[1]")
    with pytest.raises(InputError, match=r"poses\.json"):
        load_views(path, field)  # type: ignore[arg-type]
    path.write_text(json.dumps({"trajectory": "interpolate"}))
    with pytest.raises(InputError, match="0 training poses"):
        load_views(path, field)  # type: ignore[arg-type]
