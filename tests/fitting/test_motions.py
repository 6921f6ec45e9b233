"""Motions of cameras from residuals of rays, on a scene of known points: no field, no pictures."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from conftest import ring
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from mmsynth.fitting import motions as poses
from mmsynth.fitting.motions import Layout, Motions, RayJacobian
from mmsynth.scene.scene import Frame, Region
from mmsynth.sensors.camera import Camera

VIEWS, SENSORS = 12, ("a", "b", "c")
FOCAL = 100.0
REGION = Region((1.0, -2.0, 0.5), 2.0)


def _layout(views: int = VIEWS, missing: tuple[tuple[str, int], ...] = ()) -> Layout:
    camera = Camera(80, 60, FOCAL, FOCAL, 39.5, 29.5)
    random = np.random.default_rng(0)
    offsets = poses.motion_to_matrix(0.1 * random.normal(size=(len(SENSORS), 6)))
    frames = []
    for s, sensor in enumerate(SENSORS):
        for v, pose in enumerate(ring(views, radius=6.0, height=2.0)):
            moved = pose @ offsets[s]
            moved[:3, 3] += REGION.centre
            if (sensor, v) not in missing:
                frames.append(Frame(sensor, v, Path(), camera, moved))
    return poses.layout_of(frames, SENSORS, REGION)


def _motions(layout: Layout, size: float, views: bool = True, rig: bool = True) -> Motions:
    """Random ones without the similarity that no ray can tell; the reference rests."""
    random = np.random.default_rng(1)
    of_views = size * random.normal(size=(len(layout.views), 6)) * views
    of_sensors = size * random.normal(size=(len(layout.sensors), 6)) * rig
    of_sensors[0] = 0
    return poses.advance(layout, _still(layout), Motions(of_views, of_sensors))


def _still(layout: Layout) -> Motions:
    return Motions(np.zeros((len(layout.views), 6)), np.zeros((len(layout.sensors), 6)))


class Points:
    """A field that knows where N points are: a ray should pass through its own, and its residual is by how much it does not."""

    def __init__(self, layout: Layout, true: np.ndarray, per_frame: int = 40, noise: float = 0.0, seed: int = 2) -> None:
        random = np.random.default_rng(seed)
        self.frame = np.repeat(np.arange(len(true)), per_frame)
        self.points = random.uniform(-0.6, 0.6, (len(self.frame), 3))
        self.across = random.normal(size=(len(self.frame), 3))
        self.noise = noise * random.normal(size=len(self.frame))
        at, turn = true[self.frame, :3, 3], true[self.frame, :3, :3]
        self.away = np.linalg.norm(self.points - at, axis=1, keepdims=True)
        self.in_camera = np.einsum("nji,nj->ni", turn, (self.points - at) / self.away)

    def see(self, now: np.ndarray) -> RayJacobian:
        at, turn = now[self.frame, :3, 3], now[self.frame, :3, :3]
        directions = np.einsum("nij,nj->ni", turn, self.in_camera)
        residual = np.einsum("ni,ni->n", self.across, at + directions * self.away - self.points) + self.noise
        order = np.random.default_rng(3).permutation(len(self.frame))  # both halves see every frame
        rows = (self.frame, residual, self.across, self.across * self.away, directions)
        return RayJacobian(*(torch.from_numpy(x[order]) for x in rows))


def _solved(layout: Layout, field: Points, views: bool, rig: bool, steps: int = 12) -> Motions:
    motions = _still(layout)
    for _ in range(steps):
        now = poses.moved(layout, motions)
        equations = poses.normal_equations([field.see(now)], now)
        step, _ = poses.cross_validated_step(equations, layout, motions, views, rig, prior=1.0)
        motions = poses.advance(layout, motions, poses.fix_reference(layout, step, views))
    return motions


def _off(layout: Layout, motions: Motions, true: np.ndarray) -> float:
    """Root mean square distance of camera centres and of points before them from the truth."""
    now = poses.moved(layout, motions)
    before = np.array([[0, 0, 0, 1], [0.3, 0, 1, 1], [0, 0.3, 1, 1.0]]).T
    return float(np.sqrt(np.square((now - true) @ before).sum(1).mean()))


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-160, 1e-8, 1e-4, 1.0, np.pi, 6.0, 100.0])
def test_rotations_are_scipys(angle: float) -> None:
    motion = np.random.default_rng(0).normal(size=(50, 6))
    motion[:, :3] *= angle / np.linalg.norm(motion[:, :3], axis=1, keepdims=True)
    matrix = poses.motion_to_matrix(motion)
    assert np.abs(matrix[:, :3, :3] - Rotation.from_rotvec(motion[:, :3]).as_matrix()).max() < 1e-15 * max(10.0, 10.0 * angle)
    assert np.array_equal(matrix[:, :3, 3], motion[:, 3:]) and (matrix[:, 3] == [0, 0, 0, 1]).all()


@given(arrays(float, (5, 6), elements=st.floats(-1, 1)))
def test_motions_and_matrices_are_each_others_inverse(motion: np.ndarray) -> None:
    assert poses.matrix_to_motion(poses.motion_to_matrix(motion)) == pytest.approx(motion, abs=1e-12)


def test_the_derivative_is_the_limit_of_differences() -> None:
    layout = _layout()
    field = Points(layout, layout.poses)
    rows = field.see(layout.poses)
    analytic = poses.derivative(rows, torch.from_numpy(layout.poses[:, :3, :3])[rows.frame]).numpy()
    for i in range(6):
        step = np.zeros((len(layout.poses), 6))
        step[:, i] = 1e-5
        there, back = (field.see(layout.poses @ poses.motion_to_matrix(s)).residual.numpy() for s in (step, -step))
        assert analytic[:, i] == pytest.approx((there - back) / 2e-5, abs=1e-8)


@pytest.mark.parametrize(("views", "rig"), [(True, False), (False, True), (True, True)])
def test_known_motions_are_found_again(views: bool, rig: bool) -> None:
    layout = _layout()
    wanted = _motions(layout, 0.02, views, rig)
    true = poses.moved(layout, wanted)
    found = _solved(layout, Points(layout, true), views, rig)
    before = _off(layout, _still(layout), true)
    # the similarity is taken out to first order: what is left of it is of second
    assert _off(layout, found, true) < 0.03 * before
    if not views:
        assert not found.views.any() and found.sensors == pytest.approx(wanted.sensors, abs=1e-3)
    if not rig:
        assert not found.sensors.any()


def test_relative_poses_are_exact_up_to_a_similarity() -> None:
    layout = _layout()
    true = poses.moved(layout, _motions(layout, 0.02))
    now = poses.moved(layout, _solved(layout, Points(layout, true), True, True, steps=25))
    matrix, _, _ = trimesh.registration.procrustes(now[:, :3, 3], true[:, :3, 3])
    aligned = now[:, :3, 3] @ matrix[:3, :3].T + matrix[:3, 3]
    assert np.abs(aligned - true[:, :3, 3]).max() < 2e-3 * np.abs(layout.poses[:, :3, 3] - true[:, :3, 3]).max() + 1e-4


def test_noise_alone_moves_nothing() -> None:
    layout = _layout()
    now = layout.poses
    equations = poses.normal_equations([Points(layout, now, noise=0.05).see(now)], now)
    for views, rig in ((True, False), (False, True), (True, True)):
        step, saved = poses.cross_validated_step(equations, layout, _still(layout), views, rig, prior=1.0)
        assert abs(saved.share) < 0.005 and saved.share <= poses.SURE * saved.unsure
        assert not step.views.any() and not step.sensors.any()


def test_noise_is_seldom_taken_for_a_motion() -> None:
    """As often as a normal number is beyond two standard errors, give or take; least squares always moves."""
    layout = _layout(views=6)
    moved = 0
    for seed in range(100):
        equations = poses.normal_equations([Points(layout, layout.poses, 20, 0.05, seed).see(layout.poses)], layout.poses)
        step, _ = poses.cross_validated_step(equations, layout, _still(layout), True, False, prior=1.0)
        moved += bool(step.views.any())
    assert moved <= 8


def test_looks_that_say_too_little_say_it_together() -> None:
    """A motion that hides in the noise of one look and shows in sixteen."""
    layout = _layout()
    true = poses.moved(layout, _motions(layout, 0.005, rig=False))
    looks = [poses.normal_equations([Points(layout, true, 10, 0.05, s).see(layout.poses)], layout.poses) for s in range(16)]
    together = functools.reduce(lambda a, b: a.and_of(b), looks)
    steps = [poses.cross_validated_step(x, layout, _still(layout), True, False, prior=1.0)[0] for x in (*looks, together)]
    assert sum(bool(s.views.any()) for s in steps[:-1]) <= 4 and steps[-1].views.any()
    assert _off(layout, Motions(steps[-1].views, _still(layout).sensors), true) < 0.8 * _off(layout, _still(layout), true)
    rows = np.stack([x.error for x in looks]).sum(0)
    assert together.error == pytest.approx(rows) and together.matrix.shape == looks[0].matrix.shape


def test_a_motion_beside_noise_is_found_as_far_as_it_stands_out() -> None:
    layout = _layout()
    true = poses.moved(layout, _motions(layout, 0.01))
    field = Points(layout, true, noise=0.02)
    equations = poses.normal_equations([field.see(layout.poses)], layout.poses)
    _, saved = poses.cross_validated_step(equations, layout, _still(layout), True, True, prior=1.0)
    assert 0.05 < saved.share < 1.0 and saved.share > 4.0 * saved.unsure
    assert _off(layout, _solved(layout, field, True, True), true) < 0.5 * _off(layout, _still(layout), true)


def test_a_similarity_of_all_views_is_no_motion() -> None:
    layout = _layout()
    similar = np.eye(4)
    similar[:3, :3] = Rotation.from_rotvec([0.001, -0.002, 0.0015]).as_matrix()
    similar[:3, 3] = 0.002, 0.001, -0.001
    anchors = layout.poses[layout.anchor]
    now = similar @ anchors
    now[:, :3, 3] *= 1.002
    step = poses.matrix_to_motion(np.linalg.inv(anchors) @ now)
    left = poses.advance(layout, _still(layout), Motions(step, np.zeros((3, 6))))
    assert np.abs(left.views).max() < 0.01 * np.abs(step).max()


def test_frames_without_rays_follow_their_view_and_sensor_and_lone_ones_stay() -> None:
    layout = _layout(missing=(("b", 3), ("c", 3)))  # view 3 has one frame
    true = poses.moved(layout, _motions(layout, 0.02))
    field = Points(layout, true)
    lone = int(layout.anchor[3])
    rows = field.see(layout.poses)
    keep = rows.frame != lone
    some = RayJacobian(*(x[keep] for x in (rows.frame, rows.residual, rows.by_origin, rows.by_direction, rows.directions)))
    equations = poses.normal_equations([some], layout.poses)
    step, saved = poses.cross_validated_step(equations, layout, _still(layout), True, True, prior=1.0)
    assert saved.share > 0.5 and np.isfinite(step.views).all() and np.isfinite(step.sensors).all()
    assert not step.views[3].any() and step.views[4].any()


def test_a_sensor_that_shares_no_view_with_the_reference_has_no_place_on_the_rig() -> None:
    layout = _layout(missing=tuple(("c", v) for v in range(6)) + tuple((s, v) for s in "ab" for v in range(6, VIEWS)))
    assert layout.free.tolist() == [True, True, False]
    true = poses.moved(layout, _motions(layout, 0.02))
    assert not _solved(layout, Points(layout, true), True, True).sensors[2].any()


@settings(max_examples=30)
@given(arrays(float, 6, elements=st.floats(-1, 1)))
def test_a_small_motion_of_the_anchor_carries_its_frames(direction: np.ndarray) -> None:
    layout = _layout()
    m = 1e-5 * direction
    frame = 2 * VIEWS + 4  # sensor c, view 4
    anchor = layout.poses[layout.anchor[4]]
    exact = np.linalg.inv(layout.poses[frame]) @ anchor @ poses.motion_to_matrix(m[None])[0] @ np.linalg.inv(anchor) @ layout.poses[frame]
    assert poses.matrix_to_motion(exact[None])[0] == pytest.approx(layout.adjoint[2] @ m, abs=1e-8)


def test_pixels_measure_displacement_in_the_picture() -> None:
    layout = _layout()
    m = 1e-4 * np.random.default_rng(5).normal(size=6)
    ball = np.random.default_rng(6).normal(size=(20000, 3))
    ball *= 0.5 / np.linalg.norm(ball, axis=1, keepdims=True)

    def picture(pose: np.ndarray) -> np.ndarray:
        seen = (ball - pose[:3, 3]) @ pose[:3, :3]
        return FOCAL * seen[:, :2] / seen[:, 2:]

    moved = np.square(picture(layout.poses[0] @ poses.motion_to_matrix(m[None])[0]) - picture(layout.poses[0])).sum(1).mean()
    assert m @ layout.pixels[0] @ m == pytest.approx(moved, rel=0.15)  # of angles, and of fourteen points
