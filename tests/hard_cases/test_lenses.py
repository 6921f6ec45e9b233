"""Hard cases of lenses: what the usual inverse does, and the bound that ours keeps."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from small_scenes import HEIGHT, WIDTH, around, write_scene

from mmsynth.scene.load import load_scene
from mmsynth.sensors import lenses
from mmsynth.sensors.camera import Camera, project, ray_map, unproject

Row = Callable[[str, str, str], None]


def _pixels(camera: Camera) -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), -1).reshape(-1, 2).astype(np.float64)


def _wide(k1: float, k2: float, degrees: float = 95.0) -> Camera:
    focal = 80 / np.tan(np.radians(degrees / 2))
    return Camera(161, 121, focal, focal, 80.0, 60.0, (k1, k2, 0.0, 0.0))


def _error(ideal: np.ndarray, camera: Camera) -> np.ndarray:
    """Distance [px] of the pixels from the forward model at their supposed ideal points, by OpenCV, as if f were 1000."""
    points = np.concatenate([ideal, np.ones_like(ideal[:, :1])], 1)
    back = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.matrix, camera.coefficients)[0][:, 0]
    return np.linalg.norm(back - _pixels(camera), axis=1) * 1000 / camera.fx


def _newton(camera: Camera) -> np.ndarray:
    """Ten Newton steps from the distorted point, no residual check: nerfstudio's and MultimodalStudio's."""
    k = torch.from_numpy(camera.coefficients)
    target = (torch.from_numpy(_pixels(camera)) - torch.tensor([camera.cx, camera.cy])) / camera.fx
    point = target.clone()
    for _ in range(10):
        jacobian = lenses.distort_jacobian(point, k)
        safe = torch.linalg.det(jacobian).abs() > 1e-3
        step = torch.linalg.solve(jacobian + 0 * target[:, :, None], (target - lenses.distort(point, k))[..., None])[..., 0]
        point = torch.where(safe[:, None], point + step, point)
    return point.numpy()


@pytest.mark.parametrize(("k1", "k2"), [(-0.28, 0.07), (0.5, 0.0), (-0.5, 0.25)])
def test_undistortion_far_from_the_centre(row: Row, k1: float, k2: float) -> None:
    camera = _wide(k1, k2)
    pixels = _pixels(camera)
    theirs = _error(cv2.undistortPoints(pixels[:, None], camera.matrix, camera.coefficients)[:, 0], camera)
    newton = _error(_newton(camera), camera)
    directions, valid = (x.reshape(len(pixels), -1) for x in ray_map(camera))
    valid = valid[:, 0]
    ours = _error(directions[:, :2] / directions[:, 2:], camera)
    wrong = theirs[valid] > 0.1
    assert wrong.mean() > 0.02  # the usual way is wrong where ours is not
    assert valid.mean() > 0.9 and ours[valid].max() < 1e-3
    row(
        f"undistortion, 95° across, k1 = {k1}, k2 = {k2}",
        f"OpenCV, kornia (5 iterations): {wrong.mean():.0%} of the pixels wrong by more than 0.1 px, up to {theirs[valid].max():.2g} px; "
        f"Newton, 10 steps, unchecked: up to {newton[valid].max():.2g} px",
        f"{ours[valid].max():.1g} px on {valid.mean():.1%} of the pixels, the others masked",
    )


@pytest.mark.parametrize("k1", [-0.4, -0.25])
def test_pixels_beyond_the_fold_of_a_lens(row: Row, k1: float) -> None:
    """No ray reaches them. The usual inverses answer with numbers."""
    camera = Camera(161, 161, 60.0, 60.0, 80.0, 80.0, (k1, 0.0, 0.0, 0.0))
    radius = np.sqrt(-1 / (3 * k1))
    reach = radius + k1 * radius**3
    pixels = _pixels(camera)
    beyond = np.linalg.norm((pixels - 80) / 60, axis=1) > reach
    theirs = cv2.undistortPoints(pixels[:, None], camera.matrix, camera.coefficients)[:, 0]
    off = np.nanmedian(_error(theirs, camera)[beyond])
    _, valid = ray_map(camera)
    assert beyond.mean() > 0.2 and np.isfinite(theirs[beyond]).mean() > 0.5
    assert not valid.reshape(-1)[beyond].any() and valid.reshape(-1)[~beyond].mean() > 0.999
    row(
        f"{beyond.mean():.0%} of the pixels beyond the fold, k1 = {k1}",
        f"OpenCV, kornia: a finite ray for {np.isfinite(theirs[beyond]).mean():.0%} of them, off by {off:.2g} px (median)",
        "all masked, and none but them",
    )


def test_points_behind_the_fold_are_not_seen(row: Row) -> None:
    """A point at 60 degrees falls back into the picture of a lens that folds at 42."""
    camera = Camera(161, 161, 60.0, 60.0, 80.0, 80.0, (-0.4, 0.0, 0.0, 0.0))
    point = np.array([[np.tan(np.radians(60)), 0.0, 1.0]])
    theirs = cv2.projectPoints(point, np.zeros(3), np.zeros(3), camera.matrix, camera.coefficients)[0][0, 0]
    assert (theirs >= 0).all() and (theirs < 161).all()
    assert np.isnan(project(point, camera)).all()
    row("a point at 60° before a lens that folds at 42°", f"projected into the picture, at column {theirs[0]:.0f}", "not seen")


@pytest.mark.parametrize("distortion", [(-0.33, 0.2, -0.15, -0.06), (-0.08, -0.11, 0.08, -0.12, 0.05)])
def test_the_picture_turns_over_on_the_way_to_a_pixel(row: Row, distortion: tuple[float, ...]) -> None:
    """Beyond a fold by tangential terms a lens may be upright again: there a ray comes back to its pixel, and is another one's."""
    camera = Camera(161, 161, 40.0, 40.0, 80.0, 80.0, distortion)

    def turned(ideal: np.ndarray, looks: int) -> np.ndarray:
        k = torch.from_numpy(camera.coefficients)
        found = np.zeros(len(ideal), bool)
        for share in np.linspace(0.0, 1.0, looks + 1)[1:]:  # one at a time: all at once is gigabytes
            along, down = lenses.distort_jacobian(torch.from_numpy(share * ideal), k).unbind(-2)
            found |= (along[:, 0] * down[:, 1] - along[:, 1] * down[:, 0] < -1e-2).numpy()
        return found

    theirs = _newton(camera)
    comes_back = _error(theirs, camera) < 1e-3
    wrong = turned(theirs[comes_back], 1000)
    looked_at = wrong[~turned(theirs[comes_back], 4)].sum()
    directions, valid = ray_map(camera)
    ours = directions[valid]
    assert wrong.sum() > 500 and looked_at > 100
    assert valid.mean() > 0.5 and not turned(ours[:, :2] / ours[:, 2:], 1000).any()
    row(
        f"tangential terms {distortion[2]}, {distortion[3]}",
        f"the residual is 0 at {wrong.sum()} pixels beyond a fold, four looks along the way leave {looked_at}",
        "all masked",
    )


def test_tangential_terms_keep_their_place(row: Row) -> None:
    """File order is k1 k2 p1 p2 k3 k4; read as k1 k2 k3 k4 p1 p2, tangential distortion becomes radial."""
    right = Camera(2592, 1944, 2300.0, 2300.0, 1295.5, 971.5, (-0.1, 0.08, 1e-3, -8e-4, 0.0, 0.0))
    swapped = Camera(2592, 1944, 2300.0, 2300.0, 1295.5, 971.5, (-0.1, 0.08, 0.0, 0.0, 1e-3, -8e-4))
    points = np.random.default_rng(0).uniform((-0.55, -0.42, 1), (0.55, 0.42, 1), (5000, 3))
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), right.matrix, np.array(right.distortion[:4]))[0][:, 0]
    wrong = np.linalg.norm(project(points, swapped) - expected, axis=1).max()
    ours = np.linalg.norm(project(points, right) - expected, axis=1).max()
    assert wrong > 3 and ours < 1e-9
    row("distortion order k1 k2 p1 p2 k3 k4, 5 MP", f"MultimodalStudio reads k1 k2 k3 k4 p1 p2: up to {wrong:.1f} px", f"{ours:.0e} px")


def test_image_rows_go_down(row: Row) -> None:
    """An inverse with y turned up first, with the coefficients as they are, has the tangential terms with the wrong sign."""
    camera = Camera(2592, 1944, 2300.0, 2300.0, 1295.5, 971.5, (-0.1, 0.08, 1e-3, -8e-4, 0.0, 0.0))
    pixels = np.random.default_rng(0).uniform((0, 0), (2591, 1943), (5000, 2))
    distorted = torch.from_numpy((pixels - [camera.cx, camera.cy]) / camera.fx)
    up = torch.tensor([1.0, -1.0], dtype=torch.float64)
    x, y = (up * lenses.undistort(up * distorted, torch.from_numpy(camera.coefficients))[0]).T.numpy()
    back = lambda rays: cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.matrix, camera.coefficients)[0][:, 0]
    wrong = np.linalg.norm(back(np.stack([x, y, np.ones_like(x)], 1)) - pixels, axis=1).max()
    ours = np.linalg.norm(back(unproject(pixels, camera)[0]) - pixels, axis=1).max()
    assert wrong > 3 and ours < 1e-9
    row("rows of the image go down, tangential terms, 5 MP", f"MultimodalStudio turns y first: up to {wrong:.1f} px", f"{ours:.0e} px")


def test_the_middle_of_a_picture(row: Row, tmp_path: Path) -> None:
    """cx = w / 2 counts from the picture's corner, pixels by their centres: half a pixel apart."""
    camera = load_scene(write_scene(tmp_path / "scene", {"rgb": around(6)})).frames[0].camera
    middle = np.array([(WIDTH - 1) / 2, (HEIGHT - 1) / 2])
    usual = np.linalg.norm(middle - [WIDTH / 2, HEIGHT / 2])
    x, y, z = unproject(middle, camera)[0]
    ours = np.hypot(x, y) / z * camera.fx
    assert usual > 0.7 and ours < 1e-12
    row("the axis of a transforms.json with cx = w / 2", f"whole pixels minus cx: {usual:.2f} px off", f"{ours:.0f} px")


def test_a_fisheye_sees_beside_and_behind_itself(row: Row) -> None:
    """At 90 degrees off the axis x / z is infinite, behind it has the wrong sign."""
    camera = Camera(201, 201, 50.0, 50.0, 100.0, 100.0, (0.01, 0.0, 0.0, 0.0), "kannala_brandt")
    directions, valid = ray_map(camera)
    assert valid[100, 0] and directions[100, 0, 2] < 0
    back = project(directions[valid], camera)
    assert np.abs(back - _pixels(camera)[valid.reshape(-1)]).max() < 1e-6
    theirs = cv2.fisheye.undistortPoints(np.array([[[0.0, 100.0]]]), camera.matrix, camera.coefficients)[0, 0]
    ray = np.append(theirs, 1.0) / np.linalg.norm(np.append(theirs, 1.0))
    off = np.degrees(np.arccos(ray @ directions[100, 0]))
    assert off > 10
    row(
        "fisheye, 108° off the axis", f"OpenCV's point before the lens: x / z = {theirs[0]:.3g}, {off:.0f}° from the ray",
        f"a ray with z = {directions[100, 0, 2]:.2f}, back to {np.abs(back - _pixels(camera)[valid.reshape(-1)]).max():.0e} px",
    )  # fmt: skip


def _flat_rays(directions: np.ndarray) -> str:
    """MultimodalStudio's rays: (H, W, 3) squeezed, normalised along the axis that is the second of a list of rays."""
    squeezed = torch.from_numpy(directions).squeeze()
    if squeezed.ndim == 1:
        with pytest.raises(IndexError):
            squeezed.norm(dim=1)
        return "`.squeeze()` leaves (3,): the norm of each ray is an IndexError"
    assert squeezed.ndim == 2 and squeezed.shape != directions.shape
    return f"`.squeeze()`: {tuple(squeezed.shape)}, as of a grey picture {squeezed.shape[1]} wide and {squeezed.shape[0]} high"


@pytest.mark.parametrize("size", [(32, 1), (1, 24), (1, 1)])
def test_pictures_of_one_row_or_column_or_pixel(row: Row, size: tuple[int, int]) -> None:
    camera = Camera(*size, 30.0, 30.0, (size[0] - 1) / 2, (size[1] - 1) / 2, (-0.1, 0.02, 1e-3, 1e-3))
    directions, valid = ray_map(camera)
    usual = _flat_rays(directions.copy())
    assert directions.shape == (size[1], size[0], 3) and valid.all()
    np.testing.assert_allclose(project(directions, camera).reshape(-1, 2), _pixels(camera), atol=1e-9)
    row(f"a picture of {size[0]} x {size[1]}", usual, "its rays, as of any other")
