"""Cameras against OpenCV."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mmsynth.errors import InputError
from mmsynth.sensors.camera import Camera, project, ray_map, unproject

RIG = Camera(160, 120, 171.8, 171.5, 80.1, 58.9, (-0.118, 0.092, 0.0006, -0.0009, 0.01, 0.0))


def test_project_equals_opencv() -> None:
    points = np.random.default_rng(0).uniform((-0.5, -0.5, 1.0), (0.5, 0.5, 3.0), (200, 3))
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), RIG.matrix, RIG.coefficients)
    np.testing.assert_allclose(project(points, RIG), expected[:, 0], atol=1e-9)


@settings(max_examples=30, deadline=None)
@given(st.floats(-0.5, 0.5), st.floats(-0.1, 0.2), st.floats(-0.002, 0.002), st.floats(-0.002, 0.002))
def test_valid_rays_project_back_onto_their_pixels(k1: float, k2: float, p1: float, p2: float) -> None:
    camera = Camera(81, 61, 35.0, 35.0, 40.0, 30.0, (k1, k2, p1, p2))
    directions, valid = ray_map(camera)
    assert valid[30, 40]
    pixels = np.stack(np.meshgrid(np.arange(81), np.arange(61)), -1)
    np.testing.assert_allclose(project(directions, camera)[valid], pixels[valid], atol=1e-6)


def test_pixels_beyond_the_fold_of_the_lens_are_masked() -> None:
    camera = Camera(201, 201, 100.0, 100.0, 100.0, 100.0, (-0.4, 0.0, 0.0, 0.0))
    radius = np.sqrt(1 / 1.2)  # d/dr (r - 0.4 r³) = 0
    widest = 100.0 * (radius - 0.4 * radius**3)
    _, valid = ray_map(camera)
    distance = np.hypot(*np.mgrid[-100:101, -100:101])
    assert valid[distance < widest - 1].all()
    assert not valid[distance > widest + 1].any()


def test_undistorted_camera_is_a_pinhole() -> None:
    camera = Camera(4, 3, 2.0, 4.0, 1.5, 1.0)
    rays, valid = unproject(np.array([[0.0, 0.0], [1.5, 1.0]]), camera)
    assert valid.all()
    np.testing.assert_allclose(rays, [[-0.75, -0.25, 1.0], [0.0, 0.0, 1.0]])


def test_bad_intrinsics_are_refused() -> None:
    with pytest.raises(InputError, match="positive focal"):
        Camera(4, 3, -1.0, 1.0, 0.0, 0.0)
    with pytest.raises(InputError, match="coefficients"):
        Camera(4, 3, 1.0, 1.0, 0.0, 0.0, (0.1, 0.2, 0.3))
