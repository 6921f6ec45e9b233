"""Corners of boards that were drawn: where they are, how well that is stated, and boards that only the rest of the rig leads to."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drawn_rig import BOARD, CHESSBOARD, board_poses, drawn, pose_of

from mmsynth.scene.capture.adjustment import RigState, View, adjust
from mmsynth.scene.capture.board import Board, corner_points
from mmsynth.scene.capture.board_frames import list_frames
from mmsynth.scene.capture.detection import find_boards, find_expected
from mmsynth.scene.capture.expected import find_where_expected
from mmsynth.scene.image_writers import write_png16
from mmsynth.sensors.camera import Camera, project

CAMERA = Camera(320, 240, 343.0, 343.0, 160.0, 118.0, (-0.118, 0.09, 6e-4, -9e-4))


def corners_at(board: Board, pose: np.ndarray) -> np.ndarray:
    return project(corner_points(board) @ pose[:3, :3].T + pose[:3, 3], CAMERA)


@pytest.mark.parametrize(("board", "distance"), [(BOARD, 0.9), (CHESSBOARD, 0.9)])
def test_corners_of_small_squares_are_found_to_a_hundredth_of_a_pixel(board: Board, distance: float) -> None:
    random = np.random.default_rng(0)
    errors, deviations = [], []
    for pose in board_poses(4, board=board, distance=distance, tilt=55):
        true = corners_at(board, pose)
        inside = np.flatnonzero(((true > 4) & (true < [315, 235])).all(1))
        noisy = drawn(board, pose, CAMERA, samples=8) + 0.005 * random.normal(size=(240, 320)).astype(np.float32)
        found = find_expected(noisy, [(0, board, inside, true[inside] + 0.3 * random.normal(size=(len(inside), 2)))])[0]
        errors.append(found.pixels - true[found.ids])
        deviations.append(found.deviation)
    error, deviation = np.concatenate(errors), np.concatenate(deviations)
    assert len(error) > 60
    assert np.sqrt(np.median((error**2).sum(1)) / np.log(4)) < 0.012
    wide = deviation > np.quantile(deviation, 0.9)
    assert board is CHESSBOARD or np.median(np.abs(error[wide])) > 1.2 * np.median(np.abs(error[~wide]))  # what is uncertain says so


def test_a_board_whose_markers_cannot_be_read_is_found_where_the_rig_expects_it(tmp_path: Path) -> None:
    pose = pose_of((35.0, 5.0, 8.0), (-0.1, -0.1, 1.3))
    picture = drawn(BOARD, pose, CAMERA, samples=4)
    assert not find_boards(picture, [BOARD])
    write_png16(tmp_path / "mono" / "000.png", picture)
    sensor = list_frames(tmp_path)["mono"]
    state = RigState((CAMERA,), (np.arange(8),), np.eye(4)[None], np.zeros((0, 4, 4)))
    rough = pose @ pose_of((0.1, -0.1, 0.05), (0.0005, -0.0005, 0.001))
    found = find_where_expected(sensor, 0, state, {("000", 0): rough}, [BOARD], ())
    detection = found["000", 0]
    error = np.linalg.norm(detection.pixels - corners_at(BOARD, pose)[detection.ids], axis=1)
    assert len(error) >= 20 and np.median(error) < 0.05
    assert not find_where_expected(sensor, 0, state, {("000", 0): rough}, [BOARD], [("000", 0)])
    elsewhere = pose @ pose_of((0.0, 0.0, 0.0), (0.5, 0.0, 0.0))  # on plain grey
    assert not find_where_expected(sensor, 0, state, {("000", 0): elsewhere}, [BOARD], ())


def test_an_uncertain_corner_counts_as_little_as_its_spread_says() -> None:
    random = np.random.default_rng(2)
    poses = board_poses(12, distance=0.7)
    spread = np.where(np.arange(24) % 2, 8.0, 1.0)
    views = [
        View(0, i, corner_points(BOARD), corners_at(BOARD, p) + 0.05 * spread[:, None] * random.normal(size=(24, 2)), spread)
        for i, p in enumerate(poses)
    ]
    state = RigState((CAMERA,), (np.arange(8),), np.eye(4)[None], np.stack(poses))
    fitted = adjust(state, views)
    even = adjust(state, [replace(view, spread=np.ones(24)) for view in views])
    certain = adjust(state, [replace(v, points=v.points[::2], pixels=v.pixels[::2], spread=spread[::2]) for v in views])
    assert 0.04 < fitted.sigma[0] < 0.06
    assert abs(fitted.state.cameras[0].fx - certain.state.cameras[0].fx) < 0.5 * np.sqrt(certain.covariance[0, 0])
    assert fitted.covariance[0, 0] < certain.covariance[0, 0] < even.covariance[0, 0]
