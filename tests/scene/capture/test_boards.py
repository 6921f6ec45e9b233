"""Boards that OpenCV drew, seen by cameras whose poses are known."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import OPENCV_TO_OPENGL, look_at

from mmsynth.scene.capture.boards import board_points
from mmsynth.scene.image_writers import write_png16
from mmsynth.scene.layouts.nerfstudio import read_nerfstudio
from mmsynth.scene.scene import Frame
from mmsynth.sensors.camera import Camera

CAMERA = Camera(320, 240, 300.0, 300.0, 159.5, 119.5)
SQUARE, PIXELS = 0.1, 60  # metres and pixels of the drawing
BOARD = cv2.aruco.CharucoBoard((7, 5), SQUARE, 0.075, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100))


def _frames(folder: Path, views: int, board: bool = True, size: int = 1) -> list[Frame]:
    """The board lies on z = 0, from the origin to (0.7, 0.5), on grey."""
    drawn = BOARD.generateImage((7 * PIXELS, 5 * PIXELS)).astype(np.float32) / 255
    frames = []
    for i in range(views):
        angle = 2 * np.pi * i / views
        pose = look_at((0.35 + 0.8 * np.cos(angle), 0.25 + 0.8 * np.sin(angle), 0.9), (0.35, 0.25, 0.0))
        to_camera = np.linalg.inv(pose)
        matrix = np.array([[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1]])
        # the drawing's pixel (u, v) is (u + 0.5) / PIXELS squares to the right, and as many of v down
        pixel = SQUARE / PIXELS
        place = np.array([[pixel, 0, 0.5 * pixel], [0, -pixel, 5 * SQUARE - 0.5 * pixel], [0, 0, 1]])
        homography = matrix @ to_camera[:3][:, [0, 1, 3]] @ place
        grow = np.array([[size, 0, 0.5 * size - 0.5], [0, size, 0.5 * size - 0.5], [0, 0, 1]])
        shape = (CAMERA.width * size, CAMERA.height * size)
        picture = np.full(shape[::-1], 0.3, np.float32)
        if board:
            cv2.warpPerspective(drawn, grow @ homography, shape, dst=picture, flags=cv2.INTER_AREA, borderMode=cv2.BORDER_TRANSPARENT)
        path = folder / f"{i}.png"
        write_png16(path, picture)
        camera = Camera(*shape, CAMERA.fx * size, CAMERA.fy * size, size * (CAMERA.cx + 0.5) - 0.5, size * (CAMERA.cy + 0.5) - 0.5)
        frames.append(Frame("mono", i, path, camera, pose))
    return frames


@pytest.mark.parametrize(("views", "size"), [(6, 1), (20, 1), (6, 5)])
def test_corners_of_a_board_are_where_they_lie(tmp_path: Path, views: int, size: int) -> None:
    points = board_points(_frames(tmp_path, views, size=size))
    assert len(points) > 40 and len(points) <= 4 * 17
    true = np.concatenate(BOARD.getObjPoints()).reshape(-1, 3).astype(np.float64)
    true[:, 1] = 5 * SQUARE - true[:, 1]
    nearest = np.linalg.norm(points[:, None] - true, axis=2).min(1)
    assert nearest.max() < 0.006, nearest.max()  # a pixel of the small pictures is 4 mm, and contours are not refined


def test_a_board_gives_the_region_of_a_scene_that_states_none(tmp_path: Path) -> None:
    for name, board in (("with", True), ("without", False)):
        folder = tmp_path / name
        frames = [
            {"file_path": frame.path.name, "transform_matrix": (frame.camera_to_world @ OPENCV_TO_OPENGL).tolist()}
            for frame in _frames(folder, 6, board=board)
        ]
        intrinsics = {"w": 320, "h": 240, "fl_x": 300.0, "fl_y": 300.0, "cx": 160.0, "cy": 120.0}
        (folder / "transforms.json").write_text(json.dumps({**intrinsics, "frames": frames}))
    plain, fitted = (read_nerfstudio(tmp_path / name).region for name in ("without", "with"))
    assert plain.radius > 0.5 > fitted.radius > 0.3  # half the board's diagonal is 0.43
    np.testing.assert_allclose(fitted.centre, (0.35, 0.25, 0.0), atol=0.06)


def test_pictures_without_a_board_and_views_that_do_not_agree_give_nothing(tmp_path: Path) -> None:
    assert board_points(_frames(tmp_path, 6, board=False)).shape == (0, 3)
    assert len(board_points(_frames(tmp_path, 2))) == 0
    frames = _frames(tmp_path, 6)
    random = np.random.default_rng(0)
    for frame in frames:  # poses of another scene
        frame.camera_to_world[:3, 3] += random.normal(size=3)
    assert len(board_points(frames)) == 0
    frames[0].path.unlink()
    assert board_points(frames[:1]).shape == (0, 3)
