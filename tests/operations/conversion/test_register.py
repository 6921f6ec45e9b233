"""A frame without a pose is found by what it shows, and refused where it shows something else."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
import pytest
from analytic import MONO, RGB, ring_pose
from conftest import look_at
from painted_ball import CAMERA, painted_ball, raw_of, scene_of_ball
from scipy.ndimage import map_coordinates

from mmsynth.errors import InputError
from mmsynth.field.field import Field
from mmsynth.operations.conversion.files import convert_files
from mmsynth.operations.conversion.register import Landmarks, landmarks, register
from mmsynth.scene.image_writers import write_png16
from mmsynth.scene.motion import matrix_to_motion, motion_to_matrix
from mmsynth.scene.scene import Frame, Region, Scene, Split
from mmsynth.sensors.camera import Camera, project, ray_map


@pytest.fixture(scope="module")
def field() -> Field:
    return painted_ball(RGB)


@pytest.fixture(scope="module")
def scene(field: Field, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return scene_of_ball(field, tmp_path_factory.mktemp("frames"), 11, 1)


def test_a_frame_is_found_to_a_fraction_of_a_pixel(field: Field, scene: Scene) -> None:
    """Between two training views, nearer and turned; also when it is exposed twice as long."""
    random = np.random.default_rng(0)
    known = landmarks(field, scene, "rgb")
    for exposure in (1.0, 0.5):
        pose = ring_pose(1, 24) @ motion_to_matrix(np.r_[random.normal(0, 0.05, 3), 0.02, -0.03, 0.25][None])[0]
        found = register(field, known, (exposure * raw_of(field, pose, 99)).astype(np.float32), CAMERA, "rgb")
        points = 0.7 * np.array([[0.0, 0.0, 0.0], *np.eye(3), *-np.eye(3)])
        shown = [project((points - p[:3, 3]) @ p[:3, :3], CAMERA) for p in (pose, found.pose)]
        assert np.nanmax(np.linalg.norm(shown[0] - shown[1], axis=1)) < 0.2
        off = matrix_to_motion((np.linalg.inv(pose) @ found.pose)[None])[0]
        assert (np.abs(off) < 6 * np.sqrt(np.diag(found.covariance)) + 1e-5).all()
        assert found.sd_px < 0.1 and found.inliers > 50 and found.exposure == pytest.approx(exposure, rel=0.03)


class BoardField:
    """A ChArUco board that lies on z = 0, from the origin to (0.7, 0.5), on grey: squares that all look alike."""

    region = Region((0.35, 0.25, 0.0), 0.6)
    sensors: ClassVar = {"mono": MONO}
    board = cv2.aruco.CharucoBoard((7, 5), 0.1, 0.075, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100))
    drawn = cv2.GaussianBlur(board.generateImage((700, 500)).astype(np.float32) / 255, (0, 0), 1.5)

    def pose_of(self, frame: Frame) -> np.ndarray:
        return frame.camera_to_world

    def cast(self, directions: np.ndarray, pose: np.ndarray, names: list[str], geometry: bool) -> dict[str, np.ndarray]:
        ray = directions @ pose[:3, :3].T
        depth = np.where(ray[:, 2] < 0, -pose[2, 3] / np.minimum(ray[:, 2], -1e-9), np.nan)
        u, v = ((pose[:2, 3] + depth[:, None] * ray[:, :2]).T * 1000.0).astype(np.float32)
        light = map_coordinates(self.drawn, [499.5 - v, u - 0.5], order=1, mode="constant", cval=0.3)
        return {"mono": light.reshape(-1, 1), "depth": depth / self.region.radius}


def test_markers_tell_squares_that_look_alike_apart(tmp_path: Path) -> None:
    field: Any = BoardField()
    camera = Camera(320, 240, 300.0, 300.0, 159.5, 119.5, (-0.05, 0.01, 0.0, 0.0))
    at = lambda angle: look_at((0.35 + 0.8 * np.cos(angle), 0.25 + 0.8 * np.sin(angle), 0.9), (0.35, 0.25, 0.0))
    shot = lambda pose: field.cast(ray_map(camera)[0].reshape(-1, 3), pose, ["mono"], False)["mono"].reshape(240, 320, 1)
    frames = []
    for view in range(6):
        write_png16(tmp_path / f"{view}.png", shot(at(view)))
        frames.append(Frame("mono", view, tmp_path / f"{view}.png", camera, at(view)))
    known = landmarks(
        field, Scene(tmp_path, "test", field.sensors, tuple(frames), field.region, Split(tuple(range(6)), (), ""), "m"), "mono"
    )
    assert len(known.markers) > 40
    pose = at(2.5) @ motion_to_matrix(np.array([[0.02, -0.03, 0.4, 0.05, 0.0, 0.1]]))[0]
    found = register(field, Landmarks([], known.markers), shot(pose), camera, "mono")
    np.testing.assert_allclose(found.pose, pose, atol=2e-3)
    assert found.inliers > 40
    with pytest.raises(InputError, match="0 features agree"):
        register(field, Landmarks([], {}), shot(pose), camera, "mono")


@pytest.mark.parametrize("what", ["noise", "nothing", "another"])
def test_a_frame_of_something_else_is_refused(field: Field, scene: Scene, what: str) -> None:
    random = np.random.default_rng(1)
    blocks = np.kron(random.random((15, 20)), np.ones((8, 8)))
    raw = {"noise": random.random((120, 160)), "nothing": np.full((120, 160), 0.3), "another": blocks}[what].astype(np.float32)
    with pytest.raises(InputError, match=r"photo\.png: (\d+ features agree|its pose is uncertain|at the best pose)"):
        register(field, landmarks(field, scene, "rgb"), raw, CAMERA, "rgb", name="photo.png")


def test_images_without_a_pose_are_converted(field: Field, scene: Scene, tmp_path: Path) -> None:
    pose = ring_pose(3, 24)
    write_png16(tmp_path / "photo.png", raw_of(field, pose, 5))
    convert_files(field, scene, tmp_path / "out", source="rgb", target="rgb", images=[tmp_path / "photo.png"])
    facts: dict[str, Any] = json.loads((tmp_path / "out/rgb/photo.json").read_text())
    np.testing.assert_allclose(facts["camera"]["camera_to_world"], pose, atol=2e-3)
    assert facts["registration"]["sd_px"] < 0.1 and np.shape(facts["registration"]["covariance"]) == (6, 6)
    write_png16(tmp_path / "other.png", np.random.default_rng(0).random((120, 160)))
    with pytest.raises(InputError, match=r"other\.png: "):
        convert_files(field, scene, tmp_path / "refused", source="rgb", target="rgb", images=[tmp_path / "other.png"])
    assert not (tmp_path / "refused").exists()
    write_png16(tmp_path / "small.png", np.zeros((12, 16)))
    with pytest.raises(InputError, match=r"small\.png: the image is 16x12 pixels, expected 160x120"):
        convert_files(field, scene, tmp_path / "refused", source="rgb", target="rgb", images=[tmp_path / "small.png"])
