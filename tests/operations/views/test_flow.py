"""Optical flow against closed forms and OpenCV."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from analytic import RGB, AnalyticField, meets_ball, sphere
from conftest import look_at
from scipy.spatial.transform import Rotation

from mmsynth.field import picture
from mmsynth.operations.views.flow import optical_flow
from mmsynth.scene.scene import PosedCamera
from mmsynth.sensors.camera import Camera, ray_map, surface_points

PINHOLE = Camera(64, 48, 70.0, 68.0, 31.0, 24.5)
BROWN = Camera(64, 48, 60.0, 61.0, 31.0, 24.5, (-0.2, 0.08, 0.004, -0.003, 0.01, 0.02, -0.01, 0.005))
BROWN_B = Camera(80, 60, 66.0, 65.0, 38.0, 31.0, (0.05, 0.01, -0.002, 0.001))
FISHEYE = Camera(64, 48, 40.0, 41.0, 31.0, 24.5, (0.05, -0.01, 0.003, -0.001), "kannala_brandt")


def grid(camera: Camera) -> np.ndarray:
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    return np.stack([u, v], -1).astype(float)


def plane(camera: Camera, pose: np.ndarray, normal: np.ndarray, offset: float) -> tuple[np.ndarray, np.ndarray]:
    """Depth (H, W) and normals (H, W, 3) of the plane normal · x = offset, all of which lies before the camera."""
    directions = ray_map(camera)[0] @ pose[:3, :3].T
    depth = (offset - normal @ pose[:3, 3]) / (directions @ normal)
    assert (depth > 0).all()
    return depth.astype(np.float32), np.broadcast_to(normal, (*depth.shape, 3))


def nothing(camera: Camera) -> np.ndarray:
    return np.full((camera.height, camera.width), np.nan, np.float32)


def inside(pixels: np.ndarray, camera: Camera) -> np.ndarray:
    return (np.abs(pixels - [(camera.width - 1) / 2, (camera.height - 1) / 2]) < [camera.width / 2, camera.height / 2]).all(-1)


def test_pure_rotation_is_a_homography() -> None:
    pose_b = np.eye(4)
    pose_b[:3, :3] = Rotation.from_euler("yxz", (0.2, -0.1, 0.3)).as_matrix()
    depth = np.random.default_rng(0).uniform(1, 3, (48, 64)).astype(np.float32)  # whatever is there
    flow, occluded = optical_flow(
        PosedCamera(PINHOLE, np.eye(4)), depth, -ray_map(PINHOLE)[0], PosedCamera(PINHOLE, pose_b), nothing(PINHOLE)
    )
    homography = PINHOLE.matrix @ pose_b[:3, :3].T @ np.linalg.inv(PINHOLE.matrix)
    expected = cv2.perspectiveTransform(grid(PINHOLE).reshape(-1, 1, 2), homography).reshape(48, 64, 2)
    assert flow.dtype == np.float32 and np.abs(flow).max() > 10
    np.testing.assert_allclose(flow, expected - grid(PINHOLE), atol=2e-5)
    assert np.array_equal(occluded, ~inside(expected, PINHOLE)) and 0.1 < occluded.mean() < 0.9


def test_plane_before_a_moving_camera() -> None:
    """Fronto-parallel at 4, the camera moves by (0.5, -0.2, 1): a shift towards the left and a zoom by 4 / 3."""
    pose_b = np.eye(4)
    pose_b[:3, 3] = (0.5, -0.2, 1.0)
    depth, normal = plane(PINHOLE, np.eye(4), np.array([0.0, 0.0, -1.0]), -4.0)
    depth_b, _ = plane(PINHOLE, pose_b, np.array([0.0, 0.0, -1.0]), -4.0)
    flow, occluded = optical_flow(PosedCamera(PINHOLE, np.eye(4)), depth, normal, PosedCamera(PINHOLE, pose_b), depth_b)
    expected = (grid(PINHOLE) - [31.0, 24.5]) * 4 / 3 - np.array([70.0 * 0.5, -68.0 * 0.2]) / 3 + [31.0, 24.5]
    np.testing.assert_allclose(flow, expected - grid(PINHOLE), atol=2e-5)
    assert np.array_equal(occluded, ~inside(expected, PINHOLE))


def test_no_motion_no_flow() -> None:
    pose = look_at((2.0, 1.0, 0.5))
    depth, normal = plane(BROWN, pose, np.array([0.0, 0.0, 1.0]) + pose[:3, 2] * -2, -6.0)
    flow, occluded = optical_flow(PosedCamera(BROWN, pose), depth, normal / np.sqrt(5), PosedCamera(BROWN, pose), depth)
    np.testing.assert_allclose(flow, 0.0, atol=1e-5)
    assert not occluded.any()


@pytest.mark.parametrize("camera_a", [BROWN, FISHEYE], ids=["brown", "fisheye"])
@pytest.mark.parametrize("camera_b", [BROWN_B, FISHEYE], ids=["brown", "fisheye"])
def test_lenses_against_opencv(camera_a: Camera, camera_b: Camera) -> None:
    pose_b = np.eye(4)
    pose_b[:3, :3] = Rotation.from_euler("yxz", (0.1, -0.15, 0.2)).as_matrix()
    pose_b[:3, 3] = (0.3, 0.2, -0.4)
    normal = np.array([0.2, -0.1, -1.0]) / np.linalg.norm([0.2, -0.1, -1.0])
    depth, normals = plane(camera_a, np.eye(4), normal, -2.0)
    flow, _ = optical_flow(PosedCamera(camera_a, np.eye(4)), depth, normals, PosedCamera(camera_b, pose_b), nothing(camera_b))

    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-14)
    flat = grid(camera_a).reshape(-1, 1, 2)
    if camera_a.lens == "kannala_brandt":
        ideal = cv2.fisheye.undistortPoints(flat, camera_a.matrix, camera_a.coefficients, criteria=stop)
    else:
        ideal = cv2.undistortPoints(flat, camera_a.matrix, camera_a.coefficients, criteria=stop)
    rays = np.concatenate([ideal[:, 0], np.ones((len(ideal), 1))], 1)
    points = rays * (-2.0 / (rays @ normal))[:, None]
    turn = cv2.Rodrigues(pose_b[:3, :3].T)[0]
    shift = -pose_b[:3, :3].T @ pose_b[:3, 3]
    project = cv2.fisheye.projectPoints if camera_b.lens == "kannala_brandt" else cv2.projectPoints
    expected = project(points[:, None], turn, shift, camera_b.matrix, camera_b.coefficients)[0].reshape(48, 64, 2)
    assert np.isfinite(flow).all()
    np.testing.assert_allclose(flow, expected - grid(camera_a), atol=1e-4)


def test_hidden_by_a_nearer_ball(monkeypatch: pytest.MonkeyPatch) -> None:
    """A small ball before a big one, from two sides; judged with a ball a little larger and a little smaller than the one there."""
    camera = Camera(160, 120, 170.0, 170.0, 79.5, 59.5)
    big, small, between = 0.6, 0.2, np.array([1.2, 0.0, 0.0])
    field = AnalyticField(lambda p: np.minimum(sphere(big)(p), sphere(small, between)(p)), [RGB])
    pose_a, pose_b = look_at((1.6, 1.9, 0.3)), look_at((2.5, 0.0, 0.1))
    a, b = field.render(camera, pose_a, []), field.render(camera, pose_b, [])
    flow, occluded = optical_flow(PosedCamera(camera, pose_a), a.depth_ray, a.normal, PosedCamera(camera, pose_b), b.depth_ray)
    hit = np.isfinite(a.depth_ray)
    assert np.array_equal(np.isfinite(flow).all(-1), hit) and not occluded[~hit].any()

    points = surface_points(camera, pose_a, a.depth_ray)
    on_big = np.abs(np.linalg.norm(points, axis=-1) - big) < 1e-3
    facing = np.einsum("...i,...i->...", points, pose_b[:3, 3] - points)
    clear = on_big & (facing > 1e-3) & ~meets_ball(points, pose_b[:3, 3], between, 1.05 * small)
    covered = on_big & (facing > 1e-3) & meets_ball(points, pose_b[:3, 3], between, 0.95 * small)
    behind = on_big & (facing < -1e-3)
    assert min(clear.sum(), covered.sum(), behind.sum()) > 200
    monkeypatch.setattr(picture, "_BAND", 160 * 7)  # rows side by side, the last of them cut off
    again = optical_flow(PosedCamera(camera, pose_a), a.depth_ray, a.normal, PosedCamera(camera, pose_b), b.depth_ray)
    np.testing.assert_array_equal(again[0], flow)
    np.testing.assert_array_equal(again[1], occluded)
    assert not occluded[clear].any() and occluded[covered].all() and occluded[behind].all()


def test_points_that_the_other_lens_does_not_see() -> None:
    """Behind the other camera, and beyond the fold of its lens: no flow, and not seen; no surface: no flow, nothing to see."""
    depth, normal = plane(PINHOLE, np.eye(4), np.array([0.0, 0.0, -1.0]), -4.0)
    depth[:10] = np.nan
    behind = np.eye(4)
    behind[:3, 3] = (0.0, 0.0, 5.0)
    flow, occluded = optical_flow(PosedCamera(PINHOLE, np.eye(4)), depth, normal, PosedCamera(PINHOLE, behind), nothing(PINHOLE))
    assert np.isnan(flow).all() and occluded[10:].all() and not occluded[:10].any()
    folded = Camera(64, 48, 70.0, 68.0, 31.0, 24.5, (-1.5, 0.0, 0.0, 0.0))  # r (1 - 1.5 r²) turns back at r = √(2 / 9)
    flow, occluded = optical_flow(PosedCamera(PINHOLE, np.eye(4)), depth, normal, PosedCamera(folded, np.eye(4)), nothing(folded))
    radius = np.linalg.norm((grid(PINHOLE) - [31.0, 24.5]) / [70.0, 68.0], axis=-1)
    expected = (radius < np.sqrt(2 / 9)) & np.isfinite(depth)
    assert np.array_equal(np.isfinite(flow).all(-1), expected) and 0 < expected.sum() < np.isfinite(depth).sum()
    assert occluded[np.isfinite(depth) & ~expected].all()
