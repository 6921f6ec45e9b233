"""Camera paths look at the region with the horizon level; poses files keep their intrinsics."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from analytic import RGB, AnalyticField, ring_pose, scene_of, sphere
from conftest import ring, unpacked
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

from mmsynth.errors import InputError
from mmsynth.operations.views.load import load_views
from mmsynth.operations.views.trajectories import look_at, through, trajectory_views, world_up
from mmsynth.scene.scene import Frame, PosedCamera, Region
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
    assert len(views) == 24 and len({name for _, _, name in unpacked(views)}) == 24
    for camera, pose, _ in unpacked(views):
        offset = pose[:3, 3] - REGION.centre
        assert camera == CAMERA and is_rigid(pose)
        assert np.linalg.norm(offset) == pytest.approx(np.linalg.norm([2.2, 1.0]))  # as far as the training cameras
        assert pose[:3, 2] == pytest.approx(-offset / np.linalg.norm(offset))  # looks at the centre
        assert pose[2, 0] == pytest.approx(0.0, abs=1e-9) and pose[2, 1] < 0  # level, up is up
        assert kind != "orbit" or offset[2] == pytest.approx(np.linalg.norm(offset) * np.sin(np.radians(25)))


def test_orbit_starts_at_the_first_camera_and_closes() -> None:
    views = trajectory_views({"trajectory": "orbit", "views": 4, "elevation_deg": 0, "radius": 2}, REGION, CAMERA, TRAINING)
    assert [list(np.round(p[:3, 3] - REGION.centre, 9) + 0.0) for _, p, _ in unpacked(views)] == [
        [2, 0, 0],
        [0, 2, 0],
        [-2, 0, 0],
        [0, -2, 0],
    ]


def test_hemisphere_is_even() -> None:
    views = trajectory_views({"trajectory": "hemisphere", "views": 200, "min_elevation_deg": 0, "radius": 1}, REGION, CAMERA, TRAINING)
    points = np.array([p[:3, 3] - REGION.centre for _, p, _ in unpacked(views)])
    distance = np.linalg.norm(points[:, None] - points[None], axis=-1) + 9 * np.eye(len(points))
    assert points[:, 2].min() > 0
    assert distance.min(1).min() > 0.6 * distance.min(1).max()


def test_spiral() -> None:
    spec = {"trajectory": "spiral", "views": 9, "turns": 2, "min_elevation_deg": -10, "max_elevation_deg": 70, "radius": 2}
    views = trajectory_views(spec, REGION, CAMERA, TRAINING)
    offsets = np.array([p[:3, 3] - REGION.centre for _, p, _ in unpacked(views)])
    elevation = np.radians(np.arange(-10, 71, 10))
    turn = np.pi / 2 * np.arange(9)  # two turns in eight steps, from the first training camera's side
    expected = 2 * np.stack([np.cos(elevation) * np.cos(turn), np.cos(elevation) * np.sin(turn), np.sin(elevation)], 1)
    np.testing.assert_allclose(offsets, expected, atol=1e-9)
    for (_, pose, _), offset in zip(unpacked(views), offsets, strict=True):
        assert is_rigid(pose) and pose[:3, 2] == pytest.approx(-offset / 2)


def test_interpolate_meets_the_training_poses() -> None:
    views = trajectory_views({"trajectory": "interpolate", "views": 15}, REGION, CAMERA, TRAINING)
    assert all(is_rigid(p) for _, p, _ in unpacked(views))
    for i, pose in enumerate(TRAINING):
        assert np.allclose(views[2 * i].camera_to_world, pose)


def test_interpolate_at_constant_speed() -> None:
    """Gaps of 1 and 3 units; then a turn on the spot by 0.5 rad, seen from 4 units away, is a way of 2."""
    centre = np.array(REGION.centre)
    poses = [np.eye(4), np.eye(4), np.eye(4), np.eye(4)]
    for pose, x in zip(poses, (-1.0, 0.0, 3.0, 3.0), strict=True):
        pose[:3, 3] = centre + [x, 0.0, -np.sqrt(16 - x * x)]  # all as far from the centre as the reach
    chords = [np.linalg.norm(b[:3, 3] - a[:3, 3]) for a, b in pairwise(poses)]
    poses[3][:3, :3] = Rotation.from_euler("y", 0.5).as_matrix()
    views = [p for _, p, _ in unpacked(trajectory_views({"trajectory": "interpolate", "views": 200}, REGION, CAMERA, poses))]
    way = np.array(
        [
            np.hypot(np.linalg.norm(b[:3, 3] - a[:3, 3]), 4 * Rotation.from_matrix(a[:3, :3].T @ b[:3, :3]).magnitude())
            for a, b in pairwise(views)
        ]
    )
    inner = np.sort(way)[2:]  # but for the two steps that cut a corner
    assert inner == pytest.approx(np.full(197, (sum(chords) + 2.0) / 199), rel=1e-6)
    np.testing.assert_allclose(views[-1], poses[3], atol=1e-12)


@pytest.mark.parametrize("repeated", [[0, 0, 1, 2, 2, 2, 3], [0, 1, 1, 2, 3, 3]])
def test_interpolate_does_not_dwell_on_repeated_poses(repeated: list[int]) -> None:
    spec = {"trajectory": "interpolate", "views": 13}
    once = trajectory_views(spec, REGION, CAMERA, TRAINING[:4])
    again = trajectory_views(spec, REGION, CAMERA, [TRAINING[i] for i in repeated])
    np.testing.assert_allclose([p for _, p, _ in unpacked(again)], [p for _, p, _ in unpacked(once)], atol=1e-9)


def test_interpolate_between_equal_poses_stays() -> None:
    views = trajectory_views({"trajectory": "interpolate", "views": 5}, REGION, CAMERA, [TRAINING[0]] * 3)
    assert len(views) == 5 and all(np.array_equal(p, TRAINING[0]) for _, p, _ in unpacked(views))


def perturbed(**keys: Any) -> np.ndarray:
    return np.array([p for _, p, _ in unpacked(trajectory_views({"trajectory": "perturb", **keys}, REGION, CAMERA, TRAINING))])


def test_perturb_has_the_stated_spread() -> None:
    """Motions in the cameras' own axes: normal, of the stated standard deviation, independent of each other."""
    poses = perturbed(per_pose=500, rotation_deg=2, translation=0.03, seed=7)
    motion = np.linalg.inv(np.repeat(TRAINING, 500, axis=0)) @ poses
    turns = np.degrees(Rotation.from_matrix(motion[:, :3, :3]).as_rotvec()) / 2
    shifts = motion[:, :3, 3] / (0.03 * np.linalg.norm([2.2, 1.0]))  # the training cameras' distance to the centre
    deviates = np.concatenate([turns, shifts], 1)
    for column in deviates.T:
        assert kstest(column, "norm").pvalue > 1e-3
    np.testing.assert_allclose(np.cov(deviates.T), np.eye(6), atol=0.08)


def test_perturb_is_a_function_of_seed_and_index() -> None:
    four, two = perturbed(per_pose=4, seed=3), perturbed(per_pose=2, seed=3)
    assert np.array_equal(four.reshape(8, 4, 4, 4)[:, :2], two.reshape(8, 2, 4, 4))
    assert not np.isclose(perturbed(per_pose=2, seed=4), two)[:, :3].all((1, 2)).any()
    np.testing.assert_allclose(perturbed(per_pose=1, rotation_deg=0, translation=0), TRAINING, atol=1e-15)


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
        ({"trajectory": "zigzag"}, "expected one of orbit, hemisphere, spiral, interpolate, perturb"),
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
        ({"trajectory": "spiral", "min_elevation_deg": 70}, "key 'max_elevation_deg' is 60, expected at least 'min_elevation_deg', 70"),
        ({"trajectory": "spiral", "turns": float("inf")}, "key 'turns' is inf"),
        ({"trajectory": "spiral", "per_pose": 2}, "unknown key 'per_pose'"),
        ({"trajectory": "perturb", "views": 2}, "unknown key 'views', expected one of per_pose, rotation_deg, translation, seed"),
        ({"trajectory": "perturb", "per_pose": 0}, "key 'per_pose' is 0"),
        ({"trajectory": "perturb", "seed": 1.5}, "key 'seed' is 1.5, expected a whole number"),
        ({"trajectory": "perturb", "rotation_deg": -1}, "key 'rotation_deg' is -1"),
        ({"trajectory": "perturb", "translation": None}, "key 'translation' is None"),
    ],
)
def test_refuses(spec: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        trajectory_views(spec, REGION, CAMERA, TRAINING)


def test_perturb_needs_training_poses() -> None:
    with pytest.raises(InputError, match="0 training poses, expected at least 1 to perturb"):
        trajectory_views({"trajectory": "perturb"}, REGION, CAMERA, [])


def test_training_poses_are_those_of_the_fit(tmp_path: Path) -> None:
    """Where a fit corrected the input's poses, paths through them go by the corrected ones."""

    class Corrected(AnalyticField):
        def pose_of(self, frame: Frame) -> np.ndarray:
            return moved(frame.camera_to_world)

    field = Corrected(sphere(), [RGB])
    scene = scene_of(field, tmp_path / "scene", truth=False)
    (tmp_path / "path.json").write_text(json.dumps({"trajectory": "perturb", "per_pose": 1, "rotation_deg": 0, "translation": 0}))
    found = [pose for _, pose, _ in unpacked(load_views(tmp_path / "path.json", field, scene))]  # type: ignore[arg-type]
    np.testing.assert_allclose(found, [moved(ring_pose(view, 4)) for view in range(3)], atol=1e-12)


def test_load_views(tmp_path: Path) -> None:
    field = AnalyticField(sphere(), [RGB])
    scene = scene_of(field, tmp_path / "scene", truth=False)
    path = tmp_path / "poses.json"
    path.write_text(json.dumps({"trajectory": "orbit", "views": 3}))
    views = load_views(path, field, scene)  # type: ignore[arg-type]
    assert len(views) == 3 and views[0].camera == field.cameras["rgb"]
    path.write_text(json.dumps({"convention": "OpenCV", "rig": [ring_pose(0, 3).tolist()]}))
    ((camera, pose, _),) = unpacked(load_views(path, field))  # type: ignore[arg-type]
    assert camera == field.cameras["rgb"] and np.allclose(pose, ring_pose(0, 3))
    path.write_text("[1]")
    with pytest.raises(InputError, match=r"poses\.json"):
        load_views(path, field)  # type: ignore[arg-type]
    path.write_text(json.dumps({"trajectory": "interpolate"}))
    with pytest.raises(InputError, match="0 training poses"):
        load_views(path, field)  # type: ignore[arg-type]


def test_a_path_through_keys_meets_them_and_is_smooth() -> None:
    keys = [PosedCamera(CAMERA, pose) for pose in ring(5)[:4]]
    views = through(keys, 301, 1.0)
    assert [view.name for view in views[:2]] == ["0000", "0001"] and len(views) == 301
    poses = np.stack([view.camera_to_world for view in views])
    np.testing.assert_allclose(poses[0], keys[0].camera_to_world, atol=1e-9)
    np.testing.assert_allclose(poses[-1], keys[-1].camera_to_world, atol=1e-9)
    for key in keys:  # met between two of the views
        assert np.abs(poses - key.camera_to_world).max((1, 2)).min() < 0.03
    np.testing.assert_allclose(poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1), np.broadcast_to(np.eye(3), (301, 3, 3)), atol=1e-9)
    steps = np.diff(poses[:, :3, 3], axis=0)
    assert np.abs(np.diff(steps, axis=0)).max() < 0.05 * np.linalg.norm(steps, axis=1).mean()  # no corners at the keys


def test_a_path_may_zoom_and_halt() -> None:
    near = replace(CAMERA, fx=2 * CAMERA.fx, fy=2 * CAMERA.fy)
    first, second = ring(5)[:2]
    keys = [PosedCamera(CAMERA, first), PosedCamera(CAMERA, second), PosedCamera(near, second)]
    views = through(keys, 50, 1.0)
    focal = [view.camera.fy for view in views]
    assert focal[0] == pytest.approx(CAMERA.fy) and focal[-1] == pytest.approx(2 * CAMERA.fy)
    assert all(np.isfinite(view.camera_to_world).all() for view in views)


def test_two_keys_are_joined_by_a_line_and_a_turn() -> None:
    first, second = ring(5)[:2]
    middle = through([PosedCamera(CAMERA, first), PosedCamera(CAMERA, second)], 3, 1.0)[1].camera_to_world
    np.testing.assert_allclose(middle[:3, 3], 0.5 * (first + second)[:3, 3], atol=1e-9)
