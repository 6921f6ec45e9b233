"""The Middlebury reader."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import HEIGHT, WIDTH, frame_values, ring

from mmsynth.errors import InputError
from mmsynth.scene.image_writers import write_png16
from mmsynth.scene.layouts.middlebury import read_middlebury
from mmsynth.sensors.camera import project

K = np.array([[25.0, 0, 11.7], [0, 26.0, 8.4], [0, 0, 1]])


def write(root: Path, matrix: np.ndarray = K, missing: tuple[int, ...] = ()) -> Path:
    lines = ["5"]
    for view, pose in enumerate(ring(5)):
        to_camera = np.linalg.inv(pose)
        values = [*matrix.ravel(), *to_camera[:3, :3].ravel(), *to_camera[:3, 3]]
        lines.append(f"toy{view:04d}.png " + " ".join(f"{value:.12f}" for value in values))
        if view not in missing:
            write_png16(root / f"toy{view:04d}.png", frame_values(view, 3))
    (root / "toy_par.txt").write_text("\n".join(lines) + "\n")
    return root


def test_projection_is_k_r_t(tmp_path: Path) -> None:
    scene = read_middlebury(write(tmp_path))
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (30, 3))
    for frame, pose in zip(scene.frames, ring(5), strict=True):
        to_camera = np.linalg.inv(pose)
        expected = cv2.projectPoints(points, cv2.Rodrigues(to_camera[:3, :3])[0], to_camera[:3, 3], K, np.zeros(4))[0][:, 0]
        to_camera = np.linalg.inv(frame.camera_to_world)
        np.testing.assert_allclose(project(points @ to_camera[:3, :3].T + to_camera[:3, 3], frame.camera), expected, atol=1e-8)
    assert (scene.frames[0].camera.width, scene.frames[0].camera.height) == (WIDTH, HEIGHT)
    assert scene.black_background is None and list(scene.sensors) == ["rgb"]


def test_bounding_box_of_the_readme(tmp_path: Path) -> None:
    root = write(tmp_path)
    np.testing.assert_allclose(read_middlebury(root).region.centre, 0, atol=1e-6)  # from the cameras
    (root / "README.txt").write_text("The (tight) bounding box for the model is\n(-0.1 0.2 -0.3)\n(0.3 0.4 1e-1)\n")
    region = read_middlebury(root).region
    np.testing.assert_allclose(region.centre, (0.1, 0.3, -0.1))
    assert region.radius == pytest.approx(0.3)


def test_missing_images_are_left_out(tmp_path: Path) -> None:
    scene = read_middlebury(write(tmp_path, missing=(1, 4)))
    assert [frame.view for frame in scene.frames] == [0, 2, 3]
    assert scene.problems == ("2 of 5 frames have no image file and are left out.",)


def test_skew_and_short_lines_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"toy_par\.txt: line 2: K has the skew 0.3"):
        read_middlebury(write(tmp_path, K + [[0, 0.3, 0], [0, 0, 0], [0, 0, 0]]))
    path = write(tmp_path) / "toy_par.txt"
    path.write_text(path.read_text().rsplit(" ", 1)[0])
    with pytest.raises(InputError, match="line 6: 20 numbers"):
        read_middlebury(tmp_path)
