"""Pose corrections of views and sensors by Gauss-Newton steps on the residuals of rays.

A motion is six numbers: a rotation vector (radians) and a translation (normalised frame), in a camera's own axes, about its own
centre. Every view has one, which all its sensors follow; it is that of the view's *anchor*, its frame of the first sensor.
Every sensor has one, the same in all views; the first sensor is the reference of the rig and has none in the end.
Frames are counted as in batches: through the modalities in their order.

Motions are solved for by Gauss-Newton steps. A rendered ray gives the residual of a number and its derivative to the ray's
origin and direction, so to the six numbers of its frame. Sums of these over the rays of each frame are all that is needed, for
motions of views, of sensors or of both: what moves a view or a sensor moves its frames by a linear map.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mmsynth.scene.motion import cross_matrix, matrix_to_motion, motion_to_matrix
from mmsynth.scene.scene import Frame, Region

SURE = 2.0  # standard errors of what motions save
_HUBER = 0.5  # relative residuals beyond it count by their size and not by their square, as in the loss
# of the region, where displacements in the picture are measured: its middle half
_POINTS = 0.5 * np.array([*np.eye(3), *-np.eye(3), *(np.array(list(np.ndindex(2, 2, 2))) * 2.0 - 1.0) / np.sqrt(3.0)])


@dataclass(frozen=True)
class Layout:
    """F frames of V views and S sensors, in the normalised frame, as the input has them.

    Attributes:
        poses: (F, 4, 4) camera_to_world. view, sensor: (F,) indices of ``views`` (ids) and ``sensors`` (names).
        anchor: (V,) frame whose axes a view's motion has.
        free: (S,) bool, the sensors whose place on the rig the views tell: the reference and all that share a view with it.
        adjoint: (S, 6, 6) a motion of the reference → the same in the axes of the sensor; 0 where a sensor is not free.
        pixels: (F, 6, 6) of a motion m of a frame, mᵀ pixels m is the mean square displacement of the region in its picture.
    """

    poses: np.ndarray
    view: np.ndarray
    sensor: np.ndarray
    views: tuple[int, ...]
    sensors: tuple[str, ...]
    anchor: np.ndarray
    free: np.ndarray
    adjoint: np.ndarray
    pixels: np.ndarray


@dataclass(frozen=True)
class Motions:
    """Motions of views (V, 6) and of sensors (S, 6)."""

    views: np.ndarray
    sensors: np.ndarray


@dataclass(frozen=True)
class NormalEquations:
    """What the rays of F frames say: their weighted squared error is error + 2 vector·m + mᵀ matrix m when a frame moves by m.

    Attributes:
        matrix: (..., F, 6, 6). vector: (..., F, 6). error, weight: (..., F), the weight is the sum over the rays.
    """

    matrix: np.ndarray
    vector: np.ndarray
    error: np.ndarray
    weight: np.ndarray

    def of(self, *halves: int) -> NormalEquations:
        """Of one or both of the halves that ``normal_equations`` keeps apart."""
        return NormalEquations(*(x[list(halves)].sum(0) for x in self.parts))

    def and_of(self, others: NormalEquations) -> NormalEquations:
        """Of these rays and of others."""
        return NormalEquations(*(a + b for a, b in zip(self.parts, others.parts, strict=True)))

    @property
    def usable(self) -> bool:
        """Whether anything can be said by them."""
        return bool(np.isfinite(self.matrix).all()) and float(self.error.sum()) > 0

    @property
    def parts(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        return self.matrix, self.vector, self.error, self.weight


@dataclass(frozen=True)
class Saved:
    """What a step saves of the error of rays that it was not learned from, as shares of the error of all: in each frame (F,)."""

    frames: np.ndarray

    @property
    def share(self) -> float:
        """In all."""
        return float(self.frames.sum())

    @property
    def unsure(self) -> float:
        """Its standard error, by how much frames differ."""
        return float(self.frames.std(ddof=1) * len(self.frames) ** 0.5)


@dataclass(frozen=True)
class RayJacobian:
    """R rays, in float64: their frame (R,) int64, residual (R,), its derivatives to origins and directions (R, 3), directions (R, 3)."""

    frame: Tensor
    residual: Tensor
    by_origin: Tensor
    by_direction: Tensor
    directions: Tensor


def layout_of(frames: list[Frame], sensors: tuple[str, ...], region: Region) -> Layout:
    """Who moves with whom.

    Args:
        frames: in the order of batches. sensors: the first is the reference.
    """
    poses = np.stack([f.camera_to_world for f in frames])
    poses[:, :3, 3] = (poses[:, :3, 3] - np.array(region.centre)) / region.radius
    views = tuple(sorted({f.view for f in frames}))
    view, sensor = np.array([views.index(f.view) for f in frames]), np.array([sensors.index(f.sensor) for f in frames])
    anchor = np.array([min(np.flatnonzero(view == v), key=lambda f: sensor[f]) for v in range(len(views))])
    adjoint = np.zeros((len(sensors), 6, 6))
    for f in reversed(range(len(frames))):
        if sensor[anchor[view[f]]] == 0:
            adjoint[sensor[f]] = _adjoint(poses[f], poses[anchor[view[f]]])
    focal = np.array([0.5 * (f.camera.fx + f.camera.fy) for f in frames])
    return Layout(poses, view, sensor, views, sensors, anchor, np.any(adjoint != 0, axis=(1, 2)), adjoint, _pixels(poses, focal))


def in_world(layout: Layout, motions: Motions) -> np.ndarray:
    """(V, 4, 4) motions of the views, in the normalised frame and no longer in the axes of their anchors."""
    anchors = layout.poses[layout.anchor]
    return anchors @ motion_to_matrix(motions.views) @ np.linalg.inv(anchors)


def moved(layout: Layout, motions: Motions) -> np.ndarray:
    """(F, 4, 4) camera_to_world of all frames after the motions of their views and sensors."""
    return in_world(layout, motions)[layout.view] @ layout.poses @ motion_to_matrix(motions.sensors)[layout.sensor]


def derivative(rows: RayJacobian, rotations: Tensor) -> Tensor:
    """Of the residuals to the motions of their frames: (R, 6); rotations: (R, 3, 3) camera to world.

    A small rotation ω of a frame R moves a direction d by R ω × d, and gᵀ (R ω × d) = ωᵀ Rᵀ (d × g).
    """
    turned = torch.linalg.cross(rows.directions, rows.by_direction)
    return torch.cat([torch.einsum("nij,ni->nj", rotations, g) for g in (turned, rows.by_origin)], 1)


def normal_equations(parts: Iterable[RayJacobian], poses: np.ndarray) -> NormalEquations:
    """Sums over rays, in two halves (2, F, ...); poses: (F, 4, 4) as they are now."""
    frames = len(poses)
    rotations = torch.from_numpy(poses[:, :3, :3])
    sums = torch.zeros(2 * frames, 36 + 6 + 2, dtype=torch.float64)
    for rows in parts:
        r = rows.residual
        j = derivative(rows, rotations[rows.frame])
        weight = _HUBER / r.abs().clamp(min=_HUBER)
        products = [(j[:, :, None] * j[:, None, :]).flatten(1), j * r[:, None], (r * r)[:, None], torch.ones_like(r)[:, None]]
        half = torch.arange(len(r)) % 2
        sums.index_add_(0, rows.frame + frames * half, weight[:, None] * torch.cat(products, 1))
    matrix, vector, error, weight = sums.reshape(2, frames, -1).split([36, 6, 1, 1], -1)
    return NormalEquations(matrix.reshape(2, frames, 6, 6).numpy(), vector.numpy(), error[..., 0].numpy(), weight[..., 0].numpy())


def solve(equations: NormalEquations, layout: Layout, motions: Motions, views: bool, rig: bool, prior: float) -> Motions:
    """The Gauss-Newton step of the motions of views, of all free sensors, or both: the reference moves, too (see ``fix_reference``).

    Args:
        equations: (F, ...). motions: as they are. prior: standard deviation of each of the six numbers; what no ray tells stays 0.
    """
    now = moved(layout, motions)
    here = _adjoint(now, now[layout.anchor][layout.view])
    back = np.swapaxes(here, 1, 2)
    precision = float(equations.error.sum() / equations.weight.sum()) / prior**2
    own = precision * np.eye(6)
    to_sensor = np.zeros_like(motions.sensors)
    free = np.flatnonzero(layout.free & rig)
    # of the views: block diagonal; of the sensors, after the views are eliminated: small and dense
    matrix_v = _grouped(back @ equations.matrix @ here, layout.view, len(layout.views)) + own
    vector_v = _grouped(_times(back, equations.vector), layout.view, len(layout.views)) + precision * motions.views
    matrix_s = _grouped(equations.matrix, layout.sensor, len(layout.sensors)) + own
    vector_s = _grouped(equations.vector, layout.sensor, len(layout.sensors)) + precision * motions.sensors
    if not views:
        to_sensor[free] = -_solved(matrix_s[free], vector_s[free])
        return Motions(np.zeros_like(motions.views), to_sensor)
    pairs = np.zeros((len(layout.views), len(layout.sensors), 6, 6))
    np.add.at(pairs, (layout.view, layout.sensor), back @ equations.matrix)
    cross = pairs[:, free].swapaxes(1, 2).reshape(len(layout.views), 6, 6 * len(free))
    blocks = np.zeros((len(free), 6, len(free), 6))
    blocks[range(len(free)), :, range(len(free))] = matrix_s[free]
    dense = blocks.reshape(6 * len(free), 6 * len(free)) - np.einsum("via,vib->ab", cross, np.linalg.solve(matrix_v, cross))
    right = vector_s[free].ravel() - np.einsum("via,vi->a", cross, _solved(matrix_v, vector_v))
    of_sensors = -np.linalg.solve(dense, right)
    to_sensor[free] = of_sensors.reshape(-1, 6)
    return Motions(-_solved(matrix_v, vector_v + cross @ of_sensors), to_sensor)


def cross_validated_step(
    equations: NormalEquations, layout: Layout, motions: Motions, views: bool, rig: bool, prior: float
) -> tuple[Motions, Saved]:
    """The step of ``solve``, as long as rays that it was not learned from confirm, and the share of their error that it saves.

    Each half of the rays (2, F, ...) is solved for alone. The factors of the motions of views and of sensors at which the error of
    the other half is least are signal / (signal + noise); all rays together have half the noise. Noise alone has a factor of 0, give
    or take: the field learns from where cameras are put, so what is taken for a signal half of the time makes them walk off. A step
    is shorter the less is sure to be saved, and none where that is less than ``SURE`` standard errors.
    """
    quadratic, linear = _judged(equations, layout, motions, views, rig, prior)
    factor = np.clip(-np.linalg.lstsq(quadratic.sum(0), linear.sum(0), rcond=1e-9)[0], 0.0, 1.0)
    saved = Saved(-(2.0 * linear @ factor + np.einsum("k,fkl,l->f", factor, quadratic, factor)) / float(equations.error.sum()))
    factor = 2.0 * factor / (1.0 + factor) * (max(0.0, 1.0 - (SURE * saved.unsure / saved.share) ** 2) if saved.share > 0 else 0.0)
    step = solve(equations.of(0, 1), layout, motions, views, rig, prior)
    return Motions(factor[0] * step.views, factor[1] * step.sensors), saved


def step_of_each_view(equations: NormalEquations, layout: Layout, motions: Motions, prior: float) -> Motions:
    """The step of ``solve`` of views alone, each as long as the other half of its own rays confirms; see ``cross_validated_step``."""
    quadratic, linear = _judged(equations, layout, motions, True, False, prior)
    curved, slope = (_grouped(of_frames, layout.view, len(layout.views)) for of_frames in (quadratic[:, 0, 0], linear[:, 0]))
    factor = np.clip(np.divide(-slope, curved, out=np.zeros_like(slope), where=curved > 0), 0.0, 1.0)
    step = solve(equations.of(0, 1), layout, motions, True, False, prior)
    return Motions((2.0 * factor / (1.0 + factor))[:, None] * step.views, step.sensors)


def _judged(
    equations: NormalEquations, layout: Layout, motions: Motions, views: bool, rig: bool, prior: float
) -> tuple[np.ndarray, np.ndarray]:
    """By how much the steps of either half change the error of the other, in each frame: aᵀ Q a + 2 l·a, where motions of views and of
    sensors have factors a; Q (F, 2, 2) and l (F, 2)."""
    now = moved(layout, motions)
    here = _adjoint(now, now[layout.anchor][layout.view])
    quadratic, linear = np.zeros((len(now), 2, 2)), np.zeros((len(now), 2))
    for learned, other in ((0, 1), (1, 0)):
        step = solve(equations.of(learned), layout, motions, views, rig, prior)
        of_frames = np.stack([_times(here, step.views[layout.view]), step.sensors[layout.sensor]])
        judge = equations.of(other)
        quadratic += np.einsum("kfi,fij,lfj->fkl", of_frames, judge.matrix, of_frames)
        linear += np.einsum("kfi,fi->fk", of_frames, judge.vector)
    return quadratic, linear


def fix_reference(layout: Layout, step: Motions, views: bool) -> Motions:
    """The same step for the sensors relative to each other, with the reference at rest; its part goes to the views, if they move.

    The reference is solved for like every sensor and taken out after: what all of them want in common is that the surface that
    was learned so far lies elsewhere, which is no matter of the rig.
    """
    shared = layout.adjoint @ step.sensors[0]
    sensors = step.sensors - shared
    sensors[0] = 0.0  # not only up to rounding
    return Motions(step.views + shared[layout.sensor[layout.anchor]] * views, sensors)


def follow(motions: Motions, step: Motions) -> Motions:
    """Motions followed by a step."""
    parts = (motions.views, step.views), (motions.sensors, step.sensors)
    return Motions(*(matrix_to_motion(motion_to_matrix(done) @ motion_to_matrix(next_one)) for done, next_one in parts))


def advance(layout: Layout, motions: Motions, step: Motions) -> Motions:
    """Motions followed by a step, without the similarity in which all that moved agree.

    Views that all turn, shift and spread as one see the same in a scene that does so, too. Of all such ways to say it, motions
    have the one with the least displacement in the pictures (least squares over the region), so that the scene stays in the
    frame of the input, where views are that are not learned from. A view that never moved stays.
    """
    followed = follow(motions, step)
    views = followed.views
    some = np.flatnonzero(np.any(views != 0, axis=1))
    if len(some):
        anchors = layout.poses[layout.anchor[some]]
        turn, centre = np.swapaxes(anchors[:, :3, :3], 1, 2), anchors[:, :3, 3]
        similarity = np.zeros((len(some), 6, 7))
        similarity[:, :3, :3], similarity[:, 3:, 3:6] = turn, turn
        similarity[:, 3:, :3] = -turn @ cross_matrix(centre)
        similarity[:, 3:, 6] = _times(turn, centre)
        metric = layout.pixels[layout.anchor[some]]
        normal = np.einsum("vai,vab,vbj->ij", similarity, metric, similarity)
        right = np.einsum("vai,vab,vb->i", similarity, metric, views[some])
        views[some] -= similarity @ np.linalg.lstsq(normal, right, rcond=1e-9)[0]
    return Motions(views, followed.sensors)


def _pixels(poses: np.ndarray, focal: np.ndarray) -> np.ndarray:
    """``Layout.pixels`` of poses (F, 4, 4) and focal lengths (F,); a point within one radius of a camera counts as one away."""
    seen = np.einsum("fji,fqj->fqi", poses[:, :3, :3], _POINTS - poses[:, None, :3, 3])
    away = np.maximum(np.linalg.norm(seen, axis=-1), 1.0)[..., None]
    ray = seen / away
    shift = np.concatenate([-cross_matrix(ray), np.eye(3) / away[..., None]], -1)
    shift -= ray[..., :, None] * (ray[..., None, :] @ shift)
    return focal[:, None, None] ** 2 * np.einsum("fqai,fqaj->fij", shift, shift) / len(_POINTS)


def _adjoint(to: np.ndarray, of: np.ndarray) -> np.ndarray:
    """(..., 6, 6) a small motion of the camera ``of`` → the same of a camera ``to`` that it carries along: poses (..., 4, 4)."""
    back, turn = np.swapaxes(to[..., :3, :3], -1, -2), of[..., :3, :3]
    out = np.zeros((*to.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = back @ turn
    out[..., 3:, :3] = -back @ cross_matrix(to[..., :3, 3] - of[..., :3, 3]) @ turn
    return out


def _grouped(values: np.ndarray, group: np.ndarray, count: int) -> np.ndarray:
    out = np.zeros((count, *values.shape[1:]))
    np.add.at(out, group, values)
    return out


def _times(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    return (matrix @ vector[..., None])[..., 0]


def _solved(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    return np.linalg.solve(matrix, vector[..., None])[..., 0]
