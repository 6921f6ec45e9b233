"""One joint adjustment of a rig: intrinsics, lenses, places of the sensors and of the boards, by the corners of all frames.

Parameters are the intrinsics and free lens coefficients of each camera, the place of each sensor on the rig but the reference's, and the
pose of each board at each instant. A corner depends on one camera and one board, so that boards are eliminated one by one (Schur
complement; Triggs et al. 2000, "Bundle adjustment: a modern synthesis") and a step costs as much as there are corners.
Levenberg-Marquardt, reweighted by a robust loss of the residuals over the standard deviation of their sensor, which is estimated along the
way (median).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from mmsynth.scene.capture.derivatives import project_with_derivatives, projected
from mmsynth.scene.motion import cross_matrix, motion_to_matrix
from mmsynth.sensors.camera import Camera

Loss = Literal["cauchy", "huber"]
_CAUCHY, _HUBER = 2.8, 2.0  # standard deviations of a corner's two coordinates at which the losses begin to give way
_FLOOR = 1e-3  # px: no corner is better
_REST = 1e-8  # relative change of the cost that is none
_MEDIAN = np.sqrt(2 * np.log(2))  # of the length of a pair of normal numbers


@dataclass(frozen=True)
class View:
    """Corners of one board in one frame.

    Attributes:
        sensor, pose: rows of the rig's cameras and of its boards' poses.
        points: (N, 3) metres, on the board. pixels: (N, 2).
        spread: (N,) standard deviations of the pixels, relative to that of a usual corner of the sensor.
    """

    sensor: int
    pose: int
    points: np.ndarray
    pixels: np.ndarray
    spread: np.ndarray


@dataclass(frozen=True)
class RigState:
    """Everything that is adjusted.

    Attributes:
        cameras: one for each sensor; the first is the reference.
        free: the rows of (fx, fy, cx, cy, coefficients) that are adjusted, for each sensor.
        to_sensor: (S, 4, 4) points of the reference camera → of each sensor's.
        boards: (P, 4, 4) points of a board → of the reference camera, for each board at each instant.
    """

    cameras: tuple[Camera, ...]
    free: tuple[np.ndarray, ...]
    to_sensor: np.ndarray
    boards: np.ndarray


@dataclass(frozen=True)
class Adjusted:
    """What an adjustment came to.

    Attributes:
        residuals: (N, 2) px of each view, measured minus modelled.
        sigma: (S,) px, standard deviation of a coordinate of each sensor's usual corners (spread 1).
        covariance: (C, C) of the sensors' parameters: of each sensor its free intrinsics, and but for the reference its motion (rotation
            vector [rad] and translation [m] in the sensor's axes, applied after ``to_sensor``). NaN where they are not determined.
        starts: (S,) where the parameters of each sensor begin in it.
    """

    state: RigState
    residuals: tuple[np.ndarray, ...]
    sigma: np.ndarray
    covariance: np.ndarray
    starts: np.ndarray


def adjust(state: RigState, views: Sequence[View], loss: Loss = "huber", steps: int = 60) -> Adjusted:
    """Adjust a rig to its views. Every pose and every sensor must have views."""
    problem = _Problem(state, views)
    residuals = problem.residuals(state)
    sigma = problem.deviations(residuals, robust=True)
    cost, damping, calm = problem.cost(residuals, sigma, loss), 1e-4, 0
    for _ in range(steps):
        system = problem.normal_equations(state, sigma, loss)
        while damping < 1e10:
            tried = problem.moved(state, *system.step(damping))
            moved = problem.residuals(tried)
            lower = problem.cost(moved, sigma, loss)
            if lower < cost:
                break
            damping *= 8
        else:
            break
        change = (cost - lower) / max(cost, 1e-300)
        state, residuals, damping = tried, moved, max(damping / 10, 1e-12)
        fresh = problem.deviations(residuals, robust=True)
        steady = np.abs(fresh / sigma - 1).max() < 0.01
        sigma = sigma if steady else fresh
        cost = problem.cost(residuals, sigma, loss)
        calm = calm + 1 if change < _REST and steady else 0
        if calm == 2:
            break
    sigma = problem.deviations(residuals, robust=False)
    covariance = problem.normal_equations(state, sigma, loss).covariance()
    cut = np.cumsum([len(view.points) for view in views])[:-1]
    return Adjusted(state, tuple(np.split(residuals, cut)), sigma, covariance, problem.starts)


class _Problem:
    """The views in arrays, ordered as they are given, and where each parameter lies."""

    def __init__(self, state: RigState, views: Sequence[View]) -> None:
        self.sensor = np.concatenate([np.full(len(view.points), view.sensor) for view in views])
        self.pose = np.concatenate([np.full(len(view.points), view.pose) for view in views])
        self.points = np.concatenate([view.points for view in views])
        self.pixels = np.concatenate([view.pixels for view in views])
        self.spread = np.concatenate([view.spread for view in views])
        self.rows = [np.flatnonzero(self.sensor == s) for s in range(len(state.cameras))]
        sizes = [len(free) + (6 if s else 0) for s, free in enumerate(state.free)]
        self.starts = np.concatenate([[0], np.cumsum(sizes)[:-1]])
        self.count = int(sum(sizes))

    def residuals(self, state: RigState) -> np.ndarray:
        """(N, 2) px; where a point has no pixel, as long as the picture: a board that went behind the camera is off, and named as such."""
        out = np.empty((len(self.points), 2))
        for s, rows in enumerate(self.rows):
            camera = state.cameras[s]
            apart = self.pixels[rows] - projected(self._local(state, s), camera)
            lost = ~np.isfinite(apart).all(1, keepdims=True)
            out[rows] = np.where(lost, float(np.hypot(camera.width, camera.height)), apart)
        return out

    def _local(self, state: RigState, s: int) -> np.ndarray:
        motions = state.to_sensor[s] @ state.boards
        own = motions[self.pose[self.rows[s]]]
        return (own[:, :3, :3] @ self.points[self.rows[s]][:, :, None])[..., 0] + own[:, :3, 3]

    def deviations(self, residuals: np.ndarray, robust: bool) -> np.ndarray:
        """(S,) px, of a coordinate: by the median of the lengths, or by the squares within what the loss takes as they are."""
        out = np.empty(len(self.rows))
        for s, rows in enumerate(self.rows):
            length = np.linalg.norm(residuals[rows], axis=1) / self.spread[rows]
            out[s] = max(float(np.median(length[np.isfinite(length)], axis=0)) / _MEDIAN if np.isfinite(length).any() else 1.0, _FLOOR)
            if not robust:
                kept = length[length < 4 * out[s]]
                # each view takes six parameters of its own from its corners; sensors share a pose, so it is an upper bound
                unknown = 6 * len(np.unique(self.pose[rows])) / max(1.0, self._sensors_per_pose())
                out[s] = max(np.sqrt((kept**2).sum() / max(2 * len(kept) - unknown - 10, 0.2 * len(kept), 1.0)), _FLOOR)
        return out

    def _sensors_per_pose(self) -> float:
        pairs = np.unique(np.stack([self.sensor, self.pose]), axis=1)
        return pairs.shape[1] / len(np.unique(self.pose))

    def cost(self, residuals: np.ndarray, sigma: np.ndarray, loss: Loss) -> float:
        if not np.isfinite(residuals).all():
            return float("inf")
        q = (residuals**2).sum(1) / (sigma[self.sensor] * self.spread) ** 2
        if loss == "cauchy":
            return float((_CAUCHY**2 * np.log1p(q / _CAUCHY**2)).sum())
        return float(np.where(q < _HUBER**2, q, 2 * _HUBER * np.sqrt(q) - _HUBER**2).sum())

    def normal_equations(self, state: RigState, sigma: np.ndarray, loss: Loss) -> _System:
        poses = len(state.boards)
        system = _System(
            np.zeros((self.count, self.count)), np.zeros(self.count), np.zeros((poses, 6, 6)), np.zeros((poses, 6)),
            np.zeros((poses, self.count, 6)),
        )  # fmt: skip
        for s, rows in enumerate(self.rows):
            pose, local = self.pose[rows], self._local(state, s)
            seen, by_point, by_camera = project_with_derivatives(local, state.cameras[s])
            lost = ~np.isfinite(seen).all(1)  # nothing says where to
            seen, by_point, by_camera = seen.copy(), by_point.copy(), by_camera.copy()
            seen[lost], by_point[lost], by_camera[lost] = self.pixels[rows][lost], 0.0, 0.0
            error = self.pixels[rows] - seen
            variance = (sigma[s] * self.spread[rows]) ** 2
            weight = _trust((error**2).sum(1) / variance, loss) / variance
            turn = state.to_sensor[s, :3, :3] @ state.boards[:, :3, :3]
            on_board = np.concatenate([-cross_matrix(self.points[rows]), np.broadcast_to(np.eye(3), (len(rows), 3, 3))], 2)
            by_board = by_point @ turn[pose] @ on_board
            parts = [by_camera[:, :, state.free[s]]]
            if s:
                parts.append(by_point @ np.concatenate([-cross_matrix(local), np.broadcast_to(np.eye(3), (len(rows), 3, 3))], 2))
            system.add(
                slice(self.starts[s], self.starts[s] + sum(p.shape[2] for p in parts)),
                pose,
                np.concatenate(parts, 2),
                by_board,
                error,
                weight,
            )
        return system

    def moved(self, state: RigState, cameras: np.ndarray, boards: np.ndarray) -> RigState:
        fresh, to_sensor = [], state.to_sensor.copy()
        for s, (camera, free) in enumerate(zip(state.cameras, state.free, strict=True)):
            step = cameras[self.starts[s] : self.starts[s] + len(free)]
            values = np.concatenate([camera.intrinsics, camera.coefficients])
            values[free] += step
            values[:2] = np.maximum(values[:2], 1.0)
            fresh.append(replace(camera, fx=values[0], fy=values[1], cx=values[2], cy=values[3], distortion=tuple(values[4:])))
            if s:
                at = self.starts[s] + len(free)
                to_sensor[s] = motion_to_matrix(cameras[None, at : at + 6])[0] @ to_sensor[s]
        return replace(state, cameras=tuple(fresh), to_sensor=to_sensor, boards=state.boards @ motion_to_matrix(boards))


def _trust(square: np.ndarray, loss: Loss) -> np.ndarray:
    """Weights by the squared length of residuals over their standard deviation: the slope of the loss."""
    return 1 / (1 + square / _CAUCHY**2) if loss == "cauchy" else np.minimum(1.0, _HUBER / np.sqrt(np.maximum(square, 1e-12)))


@dataclass(frozen=True)
class _System:
    """Normal equations: of the sensors (C, C) and (C,), of the boards (P, 6, 6) and (P, 6), and between them (P, C, 6)."""

    sensors: np.ndarray
    right: np.ndarray
    boards: np.ndarray
    boards_right: np.ndarray
    between: np.ndarray

    def add(self, own: slice, pose: np.ndarray, by_sensor: np.ndarray, by_board: np.ndarray, error: np.ndarray, weight: np.ndarray) -> None:
        weighted = by_sensor * weight[:, None, None]
        self.sensors[own, own] += np.einsum("nic,nid->cd", weighted, by_sensor, optimize=True)
        self.right[own] += np.einsum("nic,ni->c", weighted, error)
        across = weighted.transpose(0, 2, 1) @ by_board
        board = (by_board * weight[:, None, None]).transpose(0, 2, 1)
        np.add.at(self.between[:, own], pose, across)
        np.add.at(self.boards, pose, board @ by_board)
        np.add.at(self.boards_right, pose, (board @ error[:, :, None])[..., 0])

    def step(self, damping: float) -> tuple[np.ndarray, np.ndarray]:
        boards = self.boards + damping * np.einsum("pii->pi", self.boards)[:, :, None] * np.eye(6) + self._ridge()
        scale = 1 / np.sqrt(np.maximum(np.diag(self.sensors), 1e-30))
        inner = np.linalg.solve(boards, self.between.transpose(0, 2, 1))  # (P, 6, C)
        inner_right = np.linalg.solve(boards, self.boards_right[..., None])[..., 0]
        reduced = self.sensors * (1 + damping * np.eye(len(self.sensors))) - np.einsum("pcb,pbd->cd", self.between, inner, optimize=True)
        right = self.right - np.einsum("pcb,pb->c", self.between, inner_right)
        scaled = reduced * np.outer(scale, scale) + 1e-14 * np.eye(len(scale))
        sensors = scale * np.linalg.lstsq(scaled, scale * right, rcond=1e-15)[0]
        return sensors, inner_right - np.einsum("pbc,c->pb", inner, sensors)

    def _ridge(self) -> np.ndarray:
        """What keeps a board whose corners lie on one line from having no inverse."""
        return (1e-12 * np.einsum("pii->p", self.boards) + 1e-12)[:, None, None] * np.eye(6)

    def covariance(self) -> np.ndarray:
        inner = np.linalg.solve(self.boards + self._ridge(), self.between.transpose(0, 2, 1))
        reduced = self.sensors - np.einsum("pcb,pbd->cd", self.between, inner, optimize=True)
        scale = 1 / np.sqrt(np.maximum(np.diag(self.sensors), 1e-30))
        values, vectors = np.linalg.eigh(reduced * np.outer(scale, scale))
        weak = values < 1e-13 * values.max()
        out = (vectors / np.where(weak, np.inf, values)) @ vectors.T
        loose = (vectors[:, weak] ** 2).sum(1) > 1e-3
        out[loose], out[:, loose] = np.nan, np.nan
        return out * np.outer(scale, scale)
