"""Calibration against OpenCV's own, against automatic derivatives, and on a rig of five sensors whose truth is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from drawn_rig import BOARD, CHESSBOARD, EVEN, board_poses, five_sensors, seen_corners

from mmsynth.errors import InputError
from mmsynth.scene.capture.adjustment import View
from mmsynth.scene.capture.board import corner_points
from mmsynth.scene.capture.calibrate import Calibration, calibrate_found
from mmsynth.scene.capture.derivatives import project_with_derivatives, projected
from mmsynth.scene.capture.lens_choice import calibrate_alone
from mmsynth.scene.motion import inverse
from mmsynth.sensors.camera import Camera, project_points

NOISE = 0.05


@pytest.mark.parametrize(
    "camera",
    [
        Camera(640, 480, 500.0, 510.0, 320.0, 230.0, (-0.2, 0.1, 1e-3, -2e-3, 0.02, 0.05, -0.01, 0.003)),
        Camera(640, 480, 300.0, 310.0, 320.0, 230.0, (-0.02, 0.01, -0.003, 0.0004), "kannala_brandt"),
    ],
)
def test_derivatives_are_those_of_automatic_differentiation(camera: Camera) -> None:
    random = np.random.default_rng(0)
    points = random.uniform(-0.4, 0.4, (20, 3)) + [0, 0, 1]
    pixels, by_point, by_camera = project_with_derivatives(points, camera)
    np.testing.assert_array_equal(projected(points, camera), pixels)

    def model(p: torch.Tensor, intrinsics: torch.Tensor, coefficients: torch.Tensor) -> torch.Tensor:
        return project_points(p, intrinsics, coefficients, camera.lens)[0]

    arguments = torch.from_numpy(points), torch.from_numpy(camera.intrinsics), torch.from_numpy(camera.coefficients)
    point, intrinsics, coefficients = torch.autograd.functional.jacobian(model, arguments)
    np.testing.assert_allclose(pixels, model(*arguments).numpy(), atol=1e-10)
    np.testing.assert_allclose(by_point, np.stack([point[i, :, i].numpy() for i in range(20)]), rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(by_camera, np.concatenate([intrinsics.numpy(), coefficients.numpy()], 2), rtol=1e-8, atol=1e-8)


def test_one_sensor_is_as_good_as_opencv() -> None:
    rig = {"rgb": five_sensors()["rgb"]}
    frames = seen_corners(rig, {"rgb": board_poses(15, board=CHESSBOARD, distance=0.7)}, CHESSBOARD, NOISE)
    found = [several[0] for several in frames["rgb"].found.values() if several]
    result = calibrate_found(frames, [CHESSBOARD], "boards")
    objects = [corner_points(CHESSBOARD)[d.ids].astype(np.float32) for d in found]
    corners = [d.pixels.astype(np.float32) for d in found]
    rms, matrix, *_ = cv2.calibrateCamera(objects, corners, (640, 480), None, None, flags=cv2.CALIB_FIX_K3)
    camera, deviations = result.rig["rgb"].camera, result.sensors["rgb"].deviations
    assert result.sensors["rgb"].model == "brown4"
    assert result.sensors["rgb"].rms < 1.02 * rms
    for value, other, key in ((camera.fx, matrix[0, 0], "fx"), (camera.fy, matrix[1, 1], "fy"), (camera.cx, matrix[0, 2], "cx")):
        assert abs(value - other) < deviations[key]


@pytest.mark.parametrize("name", ["rgb", "mono", "ms"])
def test_the_model_is_chosen_by_held_out_corners(name: str) -> None:
    sensor = five_sensors()[name]
    rig = {name: sensor}
    poses = board_poses(20, seed=4, distance=0.5 if name != "ms" else 0.22)  # a fisheye shows at wide angles alone
    frames = seen_corners(rig, {name: [sensor.camera_to_reference @ pose for pose in poses]}, BOARD, NOISE)
    found = [several[0] for several in frames[name].found.values() if several]
    views = [View(0, i, corner_points(BOARD)[d.ids], d.pixels, np.ones(len(d.ids))) for i, d in enumerate(found)]
    alone = calibrate_alone(frames[name].size, views)
    assert alone is not None and alone.model == {"rgb": "brown4", "mono": "pinhole", "ms": "fisheye"}[name]
    assert min(alone.scores, key=lambda model: alone.scores[model]) in (alone.model, "brown5", "brown8", "brown4", "fisheye")


@pytest.fixture(scope="module")
def calibrated() -> Calibration:
    rig, poses = five_sensors(), board_poses(25)
    return calibrate_found(seen_corners(rig, dict.fromkeys(rig, poses), noise=NOISE), [BOARD], "boards")


def test_a_rig_of_five_sensors_comes_back(calibrated: Calibration) -> None:
    scores = []
    for name, true in five_sensors().items():
        ours, spread = calibrated.rig[name], calibrated.sensors[name].deviations
        assert abs(calibrated.sensors[name].sigma / NOISE - 1) < 0.15
        for k, key in enumerate(("fx", "fy", "cx", "cy")):
            scores.append((ours.camera.intrinsics[k] - true.camera.intrinsics[k]) / spread[key])
        if name != "rgb":
            scores += list((ours.camera_to_reference - true.camera_to_reference)[:3, 3] / spread["position"])
            turn = (inverse(true.camera_to_reference) @ ours.camera_to_reference)[:3, :3]
            scores += list(np.degrees([turn[2, 1], turn[0, 2], turn[1, 0]]) / spread["rotation"])
            assert np.linalg.norm((ours.camera_to_reference - true.camera_to_reference)[:3, 3]) < 4 * max(spread["position"])
    # 44 errors over their stated deviations: right by a factor of two
    assert 0.5 < np.sqrt(np.mean(np.square(scores))) < 2.0


def test_boards_that_look_the_same_turned_are_labelled_by_the_rig() -> None:
    rig = {name: sensor for name, sensor in five_sensors().items() if name in ("rgb", "nir", "mono")}
    poses = board_poses(14, board=EVEN, distance=1.0)
    frames = seen_corners(rig, dict.fromkeys(rig, poses), EVEN, NOISE)
    for several in list(frames["nir"].found.values())[::2]:  # what a detector would find on a sensor that stands on its head
        for d in several:
            d.pixels[:] = d.pixels[::-1].copy()
    result = calibrate_found(frames, [EVEN], "boards")
    for name, true in rig.items():
        np.testing.assert_allclose(result.rig[name].camera_to_reference, true.camera_to_reference, atol=2e-3)


def test_a_bad_board_is_named_and_left_out() -> None:
    rig = {"rgb": five_sensors()["rgb"]}
    frames = seen_corners(rig, {"rgb": board_poses(10)}, noise=NOISE)
    frames["rgb"].found["004"][0].pixels[:] += np.random.default_rng(3).normal(size=frames["rgb"].found["004"][0].pixels.shape)
    result = calibrate_found(frames, [BOARD], "boards")
    assert [(out.sensor, out.instant) for out in result.left_out] == [("rgb", "004")]
    assert result.sensors["rgb"].rms < 2 * NOISE


def test_sensors_that_share_no_instant_are_refused_by_name() -> None:
    rig = {name: sensor for name, sensor in five_sensors().items() if name in ("rgb", "mono")}
    frames = seen_corners(rig, dict.fromkeys(rig, board_poses(16)))
    for i, instant in enumerate(list(frames["rgb"].found)):
        frames["rgb" if i % 2 else "mono"].found[instant] = []
    with pytest.raises(InputError, match="no overlap between 'mono' and 'rgb'"):
        calibrate_found(frames, [BOARD], "boards")
