"""Coverage against closed forms, on balls."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from analytic import MONO, RGB, AnalyticField, Distance, meets_ball, sphere
from conftest import look_at, ring

from mmsynth.errors import InputError
from mmsynth.operations.views import coverage as coverages
from mmsynth.operations.views.coverage import (
    TrainingRays,
    coverage,
    coverage_of_point,
    covered_views,
    training_rays,
    view_score,
    view_scores,
)
from mmsynth.scene.scene import Frame, PosedCamera, Region, Scene, Split
from mmsynth.sensors.camera import Camera, project, resized, surface_points, unproject

LENS = Camera(121, 91, 130.0, 128.0, 60.0, 45.0, (-0.12, 0.06, 0.002, -0.001))
FISHEYE = Camera(121, 91, 110.0, 110.0, 60.0, 45.0, (0.02, -0.01, 0.0, 0.0), "kannala_brandt")


def scene_with(poses: Sequence[np.ndarray], camera: Camera = LENS, others: Sequence[tuple[np.ndarray, Camera]] = ()) -> Scene:
    """RGB frames at the poses, mono frames at the others; the last RGB frame tests."""
    frames = [Frame("rgb", view, Path(), camera, pose) for view, pose in enumerate(poses)]
    frames += [Frame("mono", 50 + view, Path(), lens, pose) for view, (pose, lens) in enumerate(others)]
    views = [frame.view for frame in frames]
    split = Split(tuple(v for v in views if v != len(poses) - 1), (len(poses) - 1,), "test")
    return Scene(Path("scene"), "test", {"rgb": RGB, "mono": MONO}, tuple(frames), Region((0.0, 0.0, 0.0), 1.0), split, "m")


UNUSED = look_at((0.0, 9.0, 0.0))  # of the test frame


def field_of(distance: Distance) -> Any:
    return AnalyticField(distance, [RGB, MONO])


def rays_of(field: Any, *poses: np.ndarray, camera: Camera = LENS) -> TrainingRays:
    return training_rays(field, scene_with([*poses, UNUSED], camera))


def covered(field: Any, rays: TrainingRays, pose: np.ndarray, camera: Camera = LENS) -> tuple[np.ndarray, np.ndarray]:
    """Coverage (H, W) and points (H, W, 3)."""
    seen = field.render(camera, pose, [])
    out = coverage(rays, PosedCamera(camera, pose), seen.depth_ray, seen.normal)
    assert out.dtype == np.float32 and np.array_equal(np.isnan(out), np.isnan(seen.depth_ray))
    return out, surface_points(camera, pose, seen.depth_ray)


def turned(degrees: float, distance: float = 2.5) -> np.ndarray:
    angle = np.radians(degrees)
    return look_at((distance * np.cos(angle), distance * np.sin(angle), 0.0))


@pytest.mark.parametrize("camera", [LENS, FISHEYE], ids=["brown", "fisheye"])
def test_training_pose_is_covered(camera: Camera) -> None:
    field = field_of(sphere())
    poses = ring(5, 2.2, 0.7)
    rays = rays_of(field, *poses, camera=camera)
    out, _ = covered(field, rays, poses[3], camera)
    hit = np.isfinite(out)
    assert hit.sum() > 1000
    np.testing.assert_array_equal(out[hit], 1.0)
    assert view_score(field, rays, PosedCamera(camera, poses[3])) == 1.0


def test_opposite_side_is_not() -> None:
    field = field_of(sphere())
    rays = rays_of(field, turned(-20), turned(20))
    out, _ = covered(field, rays, turned(180))
    assert np.isfinite(out).sum() > 1000 and np.nanmax(out) == 0.0
    assert view_score(field, rays, PosedCamera(LENS, turned(180))) == 0.0


@pytest.mark.parametrize("degrees", [0.0, 5.0, 20.0, 40.0, 60.0])
def test_angle(degrees: float) -> None:
    """The ball's nearest point: α by plane geometry, seen at θ = 0 from the one camera and at θ = α from the other."""
    field = field_of(sphere(0.5))
    rays = rays_of(field, turned(degrees, 3.0))
    out, points = covered(field, rays, turned(0.0, 2.0))
    np.testing.assert_allclose(points[45, 60], (0.5, 0.0, 0.0), atol=1e-6)
    x, y = 3.0 * np.cos(np.radians(degrees)) - 0.5, 3.0 * np.sin(np.radians(degrees))
    alpha = np.arctan2(y, x)
    expected = (1 - alpha / (np.pi / 2)) * np.sqrt(np.cos(alpha)) * 1.5 / np.hypot(x, y)
    assert out[45, 60] == pytest.approx(expected, abs=1e-6)


def test_falls_with_the_angle() -> None:
    field = field_of(sphere())
    scores = [view_score(field, rays_of(field, turned(0)), PosedCamera(LENS, turned(degrees))) for degrees in range(0, 181, 20)]
    assert scores[0] == 1.0 and scores[-1] == 0.0
    assert all(b < a or a == b == 0.0 for a, b in pairwise(scores))


@pytest.mark.parametrize(("distance", "zoom", "expected"), [(1.0, 1.0, 1.0), (4.5, 1.0, 0.375), (2.0, 0.5, 0.5), (4.5, 4.0, 1.0)])
def test_resolution(distance: float, zoom: float, expected: float) -> None:
    """Seen along the same line: 1.5 from the view, and nearer, farther, with a shorter or a longer lens."""
    field = field_of(sphere(0.5))
    camera = Camera(121, 91, zoom * 100.0, zoom * 100.0, 60.0, 45.0)
    rays = rays_of(field, turned(0.0, distance), camera=camera)
    out, _ = covered(field, rays, turned(0.0, 2.0), Camera(121, 91, 100.0, 100.0, 60.0, 45.0))
    assert out[45, 60] == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("balls", [sphere(), lambda p: np.minimum(sphere(0.6)(p), sphere(0.2, np.array([0.4, 0.8, 0.4]))(p))], ids="12")
@pytest.mark.parametrize("pairs", [4_000_000, 20_000])
def test_best_of_many_is_the_largest_of_each(balls: Distance, pairs: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where a ball hides points from the frames that would see them best, and where points are judged by parts, side by side."""
    monkeypatch.setattr(coverages, "_PAIRS", pairs)
    field = field_of(balls)
    poses = [look_at(p) for p in np.random.default_rng(1).normal(size=(20, 3)) * 3 if np.linalg.norm(p) > 1.5]
    view = look_at((1.0, 2.0, 1.0))
    each = [covered(field, rays_of(field, pose), view)[0] for pose in poses]
    together, _ = covered(field, rays_of(field, *poses), view)
    assert len(poses) > 10 and len({int(i) for i in np.argmax(each, 0)[np.isfinite(together)]}) > 2
    np.testing.assert_array_equal(together, np.max(each, 0))


def test_hidden_by_a_nearer_ball() -> None:
    """A frame on the x axis sees the big ball but for what lies behind the small one; judged with balls a little larger and smaller."""
    big, small, between = 0.6, 0.2, np.array([1.2, 0.0, 0.0])
    field = field_of(lambda p: np.minimum(sphere(big)(p), sphere(small, between)(p)))
    eye = turned(0.0)
    out, points = covered(field, rays_of(field, eye), turned(50.0))
    on_big = np.abs(np.linalg.norm(points, axis=-1) - big) < 1e-3
    up = points / np.linalg.norm(points, axis=-1, keepdims=True)
    facing = np.sum(up * (eye[:3, 3] - points), -1)
    surely = on_big & (facing > 1e-3) & ~meets_ball(points, eye[:3, 3], between, 1.1 * small)
    never = on_big & ((facing < -1e-3) | meets_ball(points, eye[:3, 3], between, 0.9 * small))
    assert surely.sum() > 300 and (never & (facing > 0)).sum() > 50
    assert (out[surely] > 0).all() and (out[never] == 0).all()


def test_out_of_the_frame() -> None:
    """A frame that cuts the ball in two halves covers one of them."""
    field = field_of(sphere())
    camera = Camera(61, 91, 130.0, 130.0, 60.0, 45.0)  # the right half is missing
    out, points = covered(field, rays_of(field, turned(0), camera=camera), turned(10))
    column = project((points - turned(0)[:3, 3]) @ turned(0)[:3, :3], camera)[..., 0]
    faces = np.einsum("...i,...i->...", points, turned(0)[:3, 3] - points) > 0
    assert np.array_equal(out > 0, faces & (column < 60.5))


def test_no_surface_no_coverage() -> None:
    field = field_of(sphere())
    rays = rays_of(field, turned(0))
    out, _ = covered(field, rays, look_at((2.0, 0.0, 0.0), (4.0, 0.0, 0.0)))
    assert np.isnan(out).all()
    assert view_score(field, rays, PosedCamera(LENS, look_at((2.0, 0.0, 0.0), (4.0, 0.0, 0.0)))) == 0.0


def test_far_from_the_origin() -> None:
    """Survey coordinates: the same answer."""
    shift = np.array([4e5, -5e6, 200.0])
    moved = np.eye(4)
    moved[:3, 3] = shift
    near, far = field_of(sphere()), field_of(sphere(0.6, shift))
    out = covered(near, rays_of(near, turned(0), turned(60)), turned(25))[0]
    # the double's own ray steps and normals lose digits there, not coverage: geometry is given
    seen = near.render(LENS, turned(25), [])
    rays = rays_of(far, moved @ turned(0), moved @ turned(60))
    again = coverage(rays, PosedCamera(LENS, moved @ turned(25)), seen.depth_ray, seen.normal)
    np.testing.assert_allclose(again, out, atol=1e-5)


def test_score_is_the_mean_coverage() -> None:
    field = field_of(sphere())
    rays = rays_of(field, turned(0), turned(60))
    views = [PosedCamera(LENS, turned(degrees), str(degrees)) for degrees in (20, 100)]
    ticks: list[tuple[int, int]] = []
    scores = view_scores(field, rays, views, progress=lambda done, total: ticks.append((done, total)))
    for score, view in zip(scores, views, strict=True):
        assert score == pytest.approx(np.nanmean(covered(field, rays, view.camera_to_world)[0]), abs=0.02)
    assert ticks == [(1, 2), (2, 2)]


def test_frames_of_all_or_some_modalities_count() -> None:
    field = field_of(sphere())
    scene = scene_with([turned(0), turned(180)], others=[(turned(90), FISHEYE)])  # the second tests: not a training frame
    scores = lambda rays: [round(view_score(field, rays, PosedCamera(LENS, turned(degrees))), 3) for degrees in (0, 90, 180)]
    assert scores(training_rays(field, scene, modalities=["rgb"]))[0::2] == [1.0, 0.0]
    of_mono, of_all = scores(training_rays(field, scene, modalities=["mono"])), scores(training_rays(field, scene))
    assert of_mono[1] > 0.8 and of_all[0] == 1.0 and of_all[1] == of_mono[1] and of_all[2] < 0.2
    with pytest.raises(InputError, match="modality 'ms': not in this field"):
        training_rays(field, scene, modalities=["ms"])
    with pytest.raises(InputError, match="no training frames of mono"):
        training_rays(field, scene_with([turned(0), turned(180)]), modalities=["mono"])


def test_covered_views() -> None:
    views = [PosedCamera(LENS, turned(degrees), f"{degrees:04d}") for degrees in (0, 50, 180)]
    assert covered_views(views, [1.0, 0.5, 0.0], 0.5) == (views[:2], [("0180", 0.0)])
    assert covered_views(views, [1.0, 0.5, 0.0], 0.0) == (views, [])
    with pytest.raises(InputError, match=r"the best of 3 views has 0\.400, expected one with 0\.5 or more"):
        covered_views(views, [0.4, 0.1, 0.0], 0.5)


def test_resized_camera_sees_the_same() -> None:
    small = resized(LENS, 40, margin=2)
    assert (small.width, small.height) == (44, 34)
    corners = np.array([[-0.5, -0.5], [120.5, -0.5], [120.5, 90.5], [-0.5, 90.5]])
    on_small = np.array([[1.5, 1.5], [41.5, 1.5], [41.5, 31.5], [1.5, 31.5]])
    np.testing.assert_allclose(unproject(corners, LENS)[0], unproject(on_small, small)[0], atol=1e-12)


def test_of_one_point_it_is_that_of_its_pixel() -> None:
    field, poses = field_of(sphere()), ring(5, 2.2, 0.7)
    view = look_at((1.9, 0.8, 0.9))
    out, points = covered(field, rays_of(field, *poses[:3]), view)
    normal = field.render(LENS, view, []).normal
    inner = np.argwhere(np.isfinite(out))
    for row, column in inner[:: len(inner) // 7]:
        point, facing = points[row, column], normal[row, column]
        seeing = [(pose, LENS) for pose in poses[:3] if facing @ (pose[:3, 3] - point) > 0.02]
        found = coverage_of_point(seeing, PosedCamera(LENS, view), point, facing)
        assert found == pytest.approx(out[row, column], abs=0.01)
    assert coverage_of_point([], PosedCamera(LENS, view), points[45, 60], normal[45, 60]) == 0.0
