"""Hard cases of calibration: what an ordinary calibration makes of them, and what ours says or does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from drawn_rig import BOARD, board_poses, drawn, five_sensors, pose_of, seen_corners

from mmsynth.errors import InputError
from mmsynth.scene.capture.board import Board, corner_points
from mmsynth.scene.capture.calibrate import calibrate, calibrate_found
from mmsynth.scene.capture.detection import find_boards
from mmsynth.scene.image_writers import write_png16
from mmsynth.scene.layouts.calibration import RigSensor
from mmsynth.sensors.camera import Camera, project

Row = Callable[[str, str, str], None]


def _alone(camera: Camera) -> dict[str, RigSensor]:
    return {"mono": RigSensor(camera, np.eye(4), {}, "mono")}


def test_boards_all_frontal(row: Row) -> None:
    rig = _alone(five_sensors()["mono"].camera)
    frames = seen_corners(rig, {"mono": board_poses(8, tilt=1.0, distance=0.6)})
    found = [several[0] for several in frames["mono"].found.values() if several]
    objects = [corner_points(BOARD)[d.ids].astype(np.float32) for d in found]
    matrix = cv2.calibrateCamera(objects, [d.pixels.astype(np.float32) for d in found], (640, 480), None, None)[1]
    try:
        result = calibrate_found(frames, [BOARD], "boards")
    except InputError as error:
        assert "all face it" in str(error)
        said = "refused: distance and focal length cannot be told apart"
    else:
        spread = result.sensors["mono"].deviations["fx"]
        assert spread > 9.0 and abs(result.rig["mono"].camera.fx - 900.0) < 4 * spread
        assert any("focal length" in problem for problem in result.problems)
        said = f"f = {result.rig['mono'].camera.fx:.0f} ± {spread:.0f} px, and says so"
    row("boards that all face the camera, f = 900 px", f"OpenCV: f = {matrix[0, 0]:.0f} px, no deviation", said)


def test_one_board_only(tmp_path: Path, row: Row) -> None:
    camera = Camera(320, 240, 340.0, 340.0, 160.0, 119.0)
    (tmp_path / "mono").mkdir()
    write_png16(tmp_path / "mono" / "0.png", drawn(BOARD, board_poses(1, distance=0.4)[0], camera))
    with pytest.raises(InputError, match="sees 1 board in 1 frames, expected at least 4: 3 more"):
        calibrate(tmp_path, [BOARD], workers=1)
    row("one board only", "cv2.calibrateCamera: some focal length", "refused, with how many more")


def test_corners_near_the_fold_of_a_lens(row: Row) -> None:
    camera = Camera(640, 480, 420.0, 420.0, 318.0, 242.0, (-0.3, 0.06, 0.0, 0.0))
    rig = _alone(camera)
    frames = seen_corners(rig, {"mono": board_poses(30, distance=0.22, tilt=30)}, noise=0.05)
    ours = calibrate_found(frames, [BOARD], "boards").rig["mono"].camera
    v, u = np.mgrid[0:480:40, 0:640:40]
    directions = np.stack([(u - 318.0) / 420, (v - 242.0) / 420, np.ones_like(u, float)], -1).reshape(-1, 3)
    apart = np.linalg.norm(project(directions, ours) - project(directions, camera), axis=1)
    assert np.nanmax(apart) < 0.5
    row("a lens near its fold, k1 = -0.3", "corners beyond the fold fold back", f"the picture to {np.nanmax(apart):.2f} px")


def test_rolled_and_upside_down_sensors(row: Row) -> None:
    camera = Camera(480, 360, 500.0, 500.0, 239.0, 181.0)
    pose = board_poses(1, seed=2, tilt=25, distance=0.42)[0]
    worst = 0.0
    for roll in (0.0, 90.0, 180.0, 270.0):
        local = pose_of((0, 0, roll), (0, 0, 0)) @ pose
        found = find_boards(drawn(BOARD, local, camera), [BOARD])
        true = project(corner_points(BOARD)[found[0].ids] @ local[:3, :3].T + local[:3, 3], camera)
        worst = max(worst, float(np.linalg.norm(found[0].pixels - true, axis=1).max()))
        assert len(found[0].ids) >= 20
    assert worst < 0.15
    row("sensors rolled by 90°, 180° and 270°", "labels by the picture's own up: another corner first", f"the same labels, {worst:.2f} px")


def test_a_sensor_that_sees_no_board_with_the_reference(row: Row) -> None:
    rig = {name: sensor for name, sensor in five_sensors().items() if name in ("rgb", "nir", "mono")}
    frames = seen_corners(rig, dict.fromkeys(rig, board_poses(24)))
    for i, instant in enumerate(frames["rgb"].found):
        frames["rgb" if i % 2 else "mono"].found[instant] = []
    ours = calibrate_found(frames, [BOARD], "boards").rig["mono"].camera_to_reference
    error = np.linalg.norm(ours - rig["mono"].camera_to_reference)
    assert error < 3e-3
    row(
        "a sensor that sees no board with the reference",
        "stereoCalibrate needs boards in common",
        f"through a third sensor: {1000 * error:.2f} mm",
    )


def test_a_board_of_which_one_line_of_corners_is_seen(row: Row) -> None:
    rig = {name: sensor for name, sensor in five_sensors().items() if name in ("rgb", "nir")}
    frames = seen_corners(rig, dict.fromkeys(rig, board_poses(12)))
    for sensor in frames.values():
        one = sensor.found["003"][0]
        line = one.ids % BOARD.grid[0] == 1
        sensor.found["003"] = [replace(one, ids=one.ids[line], pixels=one.pixels[line], deviation=one.deviation[line])]
    ours = calibrate_found(frames, [BOARD], "boards").rig["nir"].camera_to_reference
    error = np.linalg.norm(ours - rig["nir"].camera_to_reference)
    assert error < 3e-3
    row("a board of which one line of corners is seen", "solvePnP: NaN, and all that is solved with it", f"{1000 * error:.2f} mm")


def test_pictures_of_a_mirror(tmp_path: Path, row: Row) -> None:
    camera = Camera(320, 240, 340.0, 340.0, 160.0, 119.0)
    (tmp_path / "mono").mkdir()
    for i, pose in enumerate(board_poses(2, distance=0.4)):
        write_png16(tmp_path / "mono" / f"{i}.png", drawn(BOARD, pose, camera)[:, ::-1])
    with pytest.raises(InputError, match="is mirrored"):
        calibrate(tmp_path, [BOARD], workers=1)
    row("mirrored frames", "no board found", "said")


def test_a_board_of_another_size(tmp_path: Path, row: Row) -> None:
    camera = Camera(320, 240, 340.0, 340.0, 160.0, 119.0)
    board = Board(kind="chessboard", squares=(7, 6), square=0.03)
    (tmp_path / "mono").mkdir()
    for i, pose in enumerate(board_poses(2, distance=0.4, tilt=15, board=board)):
        write_png16(tmp_path / "mono" / f"{i}.png", drawn(board, pose, camera))
    with pytest.raises(InputError, match="shows a chessboard of"):
        calibrate(tmp_path, [board.model_copy(update={"squares": (9, 8)})], workers=1)
    row("a chessboard of 7x6 squares stated as 9x8", "no board found", "the size that is seen is said")


def test_instants_that_are_not_synchronous(row: Row) -> None:
    rig = {name: sensor for name, sensor in five_sensors().items() if name in ("rgb", "mono")}
    poses = board_poses(1, tilt=30) * 20
    step = [
        pose_of((1.0 * np.sin(i / 2), 15 * np.cos(i / 3), 0), (0.05 * np.sin(i), 0.04 * np.cos(1.3 * i), 0.02 * np.sin(i / 3)))
        for i in range(20)
    ]
    there = [s @ p for s, p in zip(step, poses, strict=True)]
    late = []
    for i, pose in enumerate(there):
        following = there[min(i + 1, 19)].copy()
        moved = pose.copy()
        moved[:3, 3] = 0.8 * pose[:3, 3] + 0.2 * following[:3, 3]  # a fifth of the way to the next instant
        late.append(moved)
    with pytest.raises(InputError, match="are not those of the other sensors"):
        calibrate_found(seen_corners(rig, {"rgb": there, "mono": late}), [BOARD], "boards")
    row("a sensor that is late by a fifth of an instant", "some rig, a residual of pixels", "refused by name, with the cause")


def test_a_fisheye_by_a_model_without_one(row: Row) -> None:
    true = replace(five_sensors()["ms"], camera_to_reference=np.eye(4))
    frames = seen_corners({"ms": true}, {"ms": board_poses(20, distance=0.25, tilt=30)})
    result = calibrate_found(frames, [BOARD], "boards")
    pinhole, ours = result.sensors["ms"].held_out["pinhole"], result.sensors["ms"].sigma
    assert result.sensors["ms"].model == "fisheye" and pinhole > 2 * ours
    row("a fisheye, boards at its rim", f"a pinhole: {pinhole:.2f} px at held-out corners", f"seen as a fisheye: {ours:.2f} px")
