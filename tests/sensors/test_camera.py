"""Cameras against OpenCV and kornia, on the whole range of lenses that are promised."""

from itertools import pairwise
from typing import Any

import cv2
import kornia
import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mmsynth.errors import InputError
from mmsynth.sensors import camera as cameras
from mmsynth.sensors import lenses
from mmsynth.sensors.camera import (
    Camera,
    Lens,
    every_nth,
    project,
    project_points,
    ray_map,
    rays_of_pixels,
    round_trip_error,
    unproject,
    unproject_points,
)

RIG = Camera(160, 120, 171.8, 171.5, 80.1, 58.9, (-0.118, 0.092, 0.0006, -0.0009, 0.01, 0.0))
RATIONAL = Camera(160, 120, 120.0, 121.0, 80.1, 58.9, (0.2, -0.1, 0.0006, -0.0009, 0.01, 0.4, -0.05, 0.02))
FISHEYE = Camera(160, 120, 60.0, 61.0, 80.1, 58.9, (-0.03, 0.01, -0.004, 0.0006), "kannala_brandt")


def _points(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform((-0.5, -0.5, 1.0), (0.5, 0.5, 3.0), (count, 3))


def _wide(k1: float, k2: float = 0.0, p1: float = 0.0, p2: float = 0.0) -> Camera:
    """120 degrees across 101 pixels before the lens."""
    return Camera(101, 81, 50 / np.tan(np.radians(60)), 50 / np.tan(np.radians(60)), 50.0, 40.0, (k1, k2, p1, p2))


def _pixels(camera: Camera) -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), -1)


# --- forward


@pytest.mark.parametrize("count", [0, 4, 5, 8])
def test_projection_equals_opencv(count: int) -> None:
    camera = Camera(160, 120, 171.8, 171.5, 80.1, 58.9, RATIONAL.distortion[:count])
    points = _points(200)
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.matrix, camera.coefficients)
    np.testing.assert_allclose(project(points, camera), expected[:, 0], atol=1e-9, rtol=0)


def test_fisheye_projection_equals_opencv() -> None:
    points = np.random.default_rng(1).uniform((-4, -4, 0.2), (4, 4, 3.0), (300, 3))
    points[:3] = [[0, 0, 1], [1e-7, 0, 1], [3e-5, -4e-5, 1]]  # on the axis and about it
    expected, _ = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), FISHEYE.matrix, FISHEYE.coefficients)
    np.testing.assert_allclose(project(points, FISHEYE), expected[:, 0], atol=1e-9, rtol=0)


def test_distortion_equals_kornia() -> None:
    points, k = torch.rand(3, 50, 2, dtype=torch.float64) - 0.5, torch.randn(3, 8, dtype=torch.float64) * 0.05
    identity = torch.eye(3, dtype=torch.float64).expand(3, 3, 3)
    torch.testing.assert_close(
        lenses.distort(points, k), kornia.geometry.calibration.distort_points(points, identity, k), atol=1e-12, rtol=0
    )
    angles = torch.rand(40, dtype=torch.float64)
    plane = torch.stack([torch.tan(angles), torch.zeros_like(angles)], -1)
    coefficients = torch.from_numpy(FISHEYE.coefficients)
    camera = torch.cat([torch.tensor([1.0, 1.0, 0.0, 0.0]), coefficients])
    theirs = kornia.geometry.camera.distort_points_kannala_brandt(plane, camera)
    torch.testing.assert_close(lenses.fisheye_radius(angles, coefficients), theirs[:, 0], atol=1e-12, rtol=0)


@pytest.mark.parametrize("camera", [RIG, RATIONAL])
def test_the_jacobian_is_that_of_autograd(camera: Camera) -> None:
    k, xy = torch.from_numpy(camera.coefficients), torch.rand(20, 2, dtype=torch.float64) - 0.5
    expected = torch.stack([torch.autograd.functional.jacobian(lambda p: lenses.distort(p[None], k)[0], p) for p in xy])
    torch.testing.assert_close(lenses.distort_jacobian(xy, k), expected, atol=1e-12, rtol=0)


def test_what_a_lens_does_not_see_has_no_pixel() -> None:
    behind = np.array([[0.1, 0.0, -1.0], [0.0, 0.0, 0.0], [0.1, 0.2, 0.0]])
    assert np.isnan(project(behind, RIG)).all()
    folding = _wide(-0.4)
    fold = np.sqrt(1 / 1.2)  # d/dr (r - 0.4 r³) = 0
    seen = project(np.array([[fold * 0.999, 0.0, 1.0], [fold * 1.001, 0.0, 1.0], [30.0, 0.0, 1.0]]), folding)
    assert np.isfinite(seen[0]).all() and np.isnan(seen[1:]).all()
    sideways = project(
        np.array([[1.0, 0.0, 0.0], [1.0, 0.0, -0.3], [0.0, 0.0, -1.0]]), Camera(9, 9, 2.0, 2.0, 4.0, 4.0, (), "kannala_brandt")
    )
    np.testing.assert_allclose(sideways[:2], [[4 + np.pi, 4.0], [4 + 2 * (np.pi / 2 + np.arctan(0.3)), 4.0]])


# --- backward


@settings(max_examples=60, deadline=None)
@given(k1=st.floats(-0.5, 0.5), k2=st.floats(-0.1, 0.2), p1=st.floats(-0.01, 0.01), p2=st.floats(-0.01, 0.01))
def test_valid_rays_are_projected_by_opencv_onto_their_pixels(k1: float, k2: float, p1: float, p2: float) -> None:
    """120 degrees; the bound that is promised is 1e-3 pixels, here of an image 20 times as wide."""
    camera = _wide(k1, k2, p1, p2)
    directions, valid = ray_map(camera)
    assert valid[40, 50]
    back, _ = cv2.projectPoints(directions[valid], np.zeros(3), np.zeros(3), camera.matrix, camera.coefficients)
    np.testing.assert_allclose(back[:, 0], _pixels(camera)[valid], atol=1e-3 / 20, rtol=0)
    assert np.isfinite(directions).all() and (directions[~valid] == [0, 0, 1]).all()


@settings(max_examples=30, deadline=None)
@given(k1=st.floats(-0.5, 0.5), k2=st.floats(-0.1, 0.2))
def test_a_pixel_is_valid_where_a_ray_of_the_rising_branch_reaches_it_and_nowhere_else(k1: float, k2: float) -> None:
    """Against a scan of the radial profile, 200 000 radii up to 80 degrees."""
    camera = _wide(k1, k2)
    radii = np.tan(np.linspace(0, lenses.STEEPEST, 200_001))
    profile = radii * (1 + k1 * radii**2 + k2 * radii**4)
    falls = np.flatnonzero(np.diff(profile) <= 0)
    reach = profile[falls[0]] if falls.size else profile[-1]
    distance = np.hypot(*(np.moveaxis(_pixels(camera), -1, 0) - np.array([50.0, 40.0])[:, None, None])) / camera.fx
    _, valid = ray_map(camera)
    assert valid[distance < reach - 1e-4].all()
    assert not valid[distance > reach + 1e-4].any()


def test_tangential_terms_fold_a_lens_too() -> None:
    """A valid pixel's ray comes back; and on the way from the axis to it the image never turned over."""
    camera = Camera(101, 101, 30.0, 30.0, 50.0, 50.0, (-0.1, 0.0, 0.15, -0.1))
    directions, valid = ray_map(camera)
    assert 0.2 < valid.mean() < 0.95
    np.testing.assert_allclose(project(directions, camera)[valid], _pixels(camera)[valid], atol=1e-6)
    ideal = torch.from_numpy(directions[valid][:, :2] / directions[valid][:, 2:])
    for share in np.linspace(0.01, 1.0, 100):
        assert (torch.linalg.det(lenses.distort_jacobian(share * ideal, torch.from_numpy(camera.coefficients))) > 0).all()


@settings(max_examples=40, deadline=None)
@given(
    k1=st.floats(-0.1, 0.1), k2=st.floats(-0.05, 0.05), k3=st.floats(-0.01, 0.01), k4=st.floats(-0.002, 0.002), focal=st.floats(10, 60)
)  # fmt: skip
@example(k1=0.0078125, k2=0.0, k3=0.0, k4=0.0, focal=10.0)  # a pixel whose ray is 36 µrad from straight back
def test_fisheyes_come_back_from_up_to_beyond_the_side(k1: float, k2: float, k3: float, k4: float, focal: float) -> None:
    camera = Camera(81, 61, focal, focal, 40.0, 30.0, (k1, k2, k3, k4), "kannala_brandt")
    directions, valid = ray_map(camera)
    assert valid[30, 40] and np.isfinite(directions).all()
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1.0, atol=1e-12)
    np.testing.assert_allclose(project(directions, camera)[valid], _pixels(camera)[valid], atol=1e-6)
    angle = torch.linspace(0, lenses.WIDEST, 100_001, dtype=torch.float64)
    profile = lenses.fisheye_radius(angle, torch.from_numpy(camera.coefficients)).numpy()
    falls = np.flatnonzero(np.diff(profile) <= 0)
    reach = profile[falls[0]] if falls.size else profile[-1]
    distance = np.hypot(*np.moveaxis(_pixels(camera) - np.array([40.0, 30.0]), -1, 0)) / focal
    assert valid[distance < reach - 1e-4].all() and not valid[distance > reach + 1e-4].any()


def test_fisheye_rays_equal_opencv_where_that_converges() -> None:
    pixels = _pixels(FISHEYE).reshape(-1, 1, 2).astype(np.float64)
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    theirs = cv2.fisheye.undistortPoints(pixels, FISHEYE.matrix, FISHEYE.coefficients, criteria=criteria)[:, 0]
    ours, valid = unproject(pixels[:, 0], FISHEYE)
    compare = valid & (ours[:, 2] > 0.1)
    assert compare.mean() > 0.8
    np.testing.assert_allclose(ours[compare, :2] / ours[compare, 2:], theirs[compare], atol=1e-7, rtol=1e-7)


@pytest.mark.parametrize("camera", [RIG, RATIONAL, FISHEYE, _wide(-0.3), Camera(64, 48, 50.0, 50.0, 31.5, 23.5)])
def test_rays_in_single_precision_still_hit_their_pixels(camera: Camera) -> None:
    error, missing = round_trip_error(camera, _pixels(camera).reshape(-1, 2).astype(np.float64))
    assert error < 1e-3 and missing < 1.0


def test_undistorted_camera_is_a_pinhole() -> None:
    camera = Camera(4, 3, 2.0, 4.0, 1.5, 1.0)
    rays, valid = unproject(np.array([[0.0, 0.0], [1.5, 1.0]]), camera)
    assert valid.all()
    np.testing.assert_allclose(rays, np.array([[-0.75, -0.25, 1.0], [0.0, 0.0, 1.0]]) / [[np.sqrt(1 + 0.625)], [1.0]])


def test_a_pinhole_sees_up_to_its_side() -> None:
    camera = Camera(201, 201, 5.0, 5.0, 100.0, 100.0)
    directions, valid = ray_map(camera)
    assert valid.all() and directions[100, 0, 2] < np.cos(np.radians(87))
    np.testing.assert_allclose(project(directions, camera), _pixels(camera), atol=1e-9)
    batch = torch.zeros(2, 8, dtype=torch.float64)
    batch[1, 0] = -0.1  # beside a lens that bends
    ideal, seen = lenses.undistort(torch.tensor([[[20.0, 0.0]], [[0.2, 0.1]]], dtype=torch.float64), batch)
    assert seen.all() and ideal[0, 0].tolist() == [20.0, 0.0]


def test_pixels_that_are_not_finite_have_no_ray() -> None:
    for camera in (RIG, FISHEYE, Camera(4, 3, 2.0, 4.0, 1.5, 1.0)):
        directions, valid = unproject(np.array([[np.nan, 1.0], [np.inf, 0.0], [1.0, 1.0]]), camera)
        assert valid.tolist() == [False, False, True] and np.isfinite(directions).all()


# --- batches, gradients


def _tensors(*cameras: Camera) -> tuple[torch.Tensor, torch.Tensor, Lens]:
    stack = lambda rows: torch.from_numpy(np.stack(rows))
    return stack([c.intrinsics for c in cameras]), stack([c.coefficients for c in cameras]), cameras[0].lens


@pytest.mark.parametrize("cameras", [(RIG, RATIONAL, _wide(-0.4)), (FISHEYE, Camera(9, 9, 60.0, 60.0, 80.0, 60.0, (), "kannala_brandt"))])
def test_a_batch_is_each_camera_alone(cameras: tuple[Camera, ...]) -> None:
    pixels = torch.from_numpy(_pixels(cameras[0])[::9, ::7].reshape(-1, 2).astype(np.float64))
    directions, valid = unproject_points(pixels.expand(len(cameras), *pixels.shape), *_tensors(*cameras))
    back, seen = project_points(directions, *_tensors(*cameras))
    for i, camera in enumerate(cameras):
        one, good = unproject(pixels.numpy(), camera)
        np.testing.assert_array_equal(valid[i].numpy(), good)
        np.testing.assert_allclose(directions[i].numpy(), one, atol=1e-12)
        assert seen[i][valid[i]].all()
        np.testing.assert_allclose(back[i][valid[i]], pixels[valid[i]], atol=1e-6)


@pytest.mark.parametrize("camera", [RIG, RATIONAL, FISHEYE])
def test_gradients_to_points_pixels_intrinsics_and_lens(camera: Camera) -> None:
    intrinsics, coefficients, lens = (t[0] if isinstance(t, torch.Tensor) else t for t in _tensors(camera))
    points = torch.from_numpy(_points(6)).requires_grad_()
    pixels = project_points(points, intrinsics, coefficients, lens)[0].detach().requires_grad_()
    parameters = (intrinsics.requires_grad_(), coefficients.requires_grad_())
    forward = lambda *given: project_points(*given, lens)[0]
    inverse = lambda *given: unproject_points(*given, lens)[0]
    assert torch.autograd.gradcheck(forward, (points, *parameters))
    assert torch.autograd.gradcheck(inverse, (pixels, *parameters), eps=1e-5, atol=1e-6)


@pytest.mark.parametrize("camera", [_wide(-0.4), FISHEYE])
def test_gradients_are_finite_where_nothing_is_seen_and_on_the_axis(camera: Camera) -> None:
    parameters: list[Any] = [t[0].requires_grad_() if isinstance(t, torch.Tensor) else t for t in _tensors(camera)]
    points = torch.tensor([[0.0, 0, 1], [0, 0, -1], [0, 0, 0], [1e30, 0, 1], [1, 0, 0]], dtype=torch.float64).requires_grad_()
    pixels = torch.tensor([[camera.cx, camera.cy], [1e6, 0], [np.nan, 3]], dtype=torch.float64).requires_grad_()
    seen, valid = project_points(points, *parameters)
    rays, has_ray = unproject_points(pixels, *parameters)
    assert valid[0] and not valid[1:3].any() and has_ray.tolist() == [True, False, False]
    (seen[0].sum() + seen[valid].sum() + rays[has_ray].sum()).backward()
    assert all(torch.isfinite(t.grad).all() for t in (points, parameters[0], parameters[1]))
    assert torch.isfinite(pixels.grad[:2]).all()  # type: ignore[index]


def test_bad_intrinsics_are_refused() -> None:
    with pytest.raises(InputError, match="positive focal"):
        Camera(4, 3, -1.0, 1.0, 0.0, 0.0)
    with pytest.raises(InputError, match="coefficients"):
        Camera(4, 3, 1.0, 1.0, 0.0, 0.0, (0.1, 0.2, 0.3))
    with pytest.raises(InputError, match="4 of a fisheye"):
        Camera(4, 3, 1.0, 1.0, 0.0, 0.0, (0.1, 0.2, 0.3, 0.4, 0.5), "kannala_brandt")
    with pytest.raises(InputError, match="lens 'omni'"):
        Camera(4, 3, 1.0, 1.0, 0.0, 0.0, (), "omni")  # type: ignore[arg-type]


def test_rays_of_a_large_camera_are_those_of_its_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    """A map that is made by bands, the last one cut off; one large camera is kept, and it is not written to."""
    monkeypatch.setattr(cameras, "_SMALL", 64)
    camera, other = (Camera(20, 11, 18.0, 18.0, cx, 5.0, (-0.4, 0.05, 0.001, -0.002)) for cx in (9.4, 9.9))
    directions, valid = ray_map(camera)
    v, u = np.mgrid[0:11, 0:20]
    expected, seen = unproject(np.stack([u, v], -1).astype(float), camera)
    np.testing.assert_allclose(directions, expected, atol=1e-14)
    np.testing.assert_array_equal(valid, seen)
    assert ray_map(camera)[0] is directions and not directions.flags.writeable
    ray_map(other)
    assert ray_map(camera)[0] is not directions


def test_rays_made_by_parts_are_those_of_the_map() -> None:
    """Of a lens that has none in the corners, too."""
    for camera in (RIG, FISHEYE, Camera(20, 11, 12.0, 12.0, 9.4, 5.0, (-0.5, 0.1, 0.0, 0.0))):
        directions, valid = ray_map(camera)
        ends = [*range(0, valid.size, 1 + valid.size // 7), valid.size]
        parts = [rays_of_pixels(camera, begin, end) for begin, end in pairwise(ends)]
        np.testing.assert_array_equal(torch.cat([there for there, _ in parts]), valid.ravel())
        np.testing.assert_allclose(torch.cat([rays for _, rays in parts]), directions[valid], atol=1e-14)
    assert not valid.all()


def test_every_nth_photosite_has_the_ray_that_it_had() -> None:
    for camera in (RIG, FISHEYE):
        for n in (1, 3, 7):
            np.testing.assert_allclose(ray_map(every_nth(camera, n))[0], ray_map(camera)[0][::n, ::n], atol=1e-12)
