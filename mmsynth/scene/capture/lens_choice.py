"""One sensor alone: where its boards are, its focal length, and the lens model that predicts corners it was not fitted to.

A focal length is found by trial: for each of many, corners become rays and each board a pose from them (IPPE; Collins and Bartoli 2014),
and the one counts whose boards project best in the median, so that no bad board disturbs it. From there ``adjustment`` fits one model after
the other. A model is worth its coefficients when it lowers the error at corners that were held out by more than the scatter of that gain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from mmsynth.scene.capture.adjustment import Adjusted, RigState, View, adjust
from mmsynth.scene.capture.derivatives import projected
from mmsynth.sensors.camera import Camera, Lens, unproject

MODELS: dict[str, tuple[Lens, tuple[int, ...]]] = {
    "pinhole": ("brown_conrady", ()),
    "brown4": ("brown_conrady", (0, 1, 2, 3)),
    "brown5": ("brown_conrady", (0, 1, 2, 3, 4)),
    "brown8": ("brown_conrady", (0, 1, 2, 3, 4, 5, 6, 7)),
    "fisheye": ("kannala_brandt", (0, 1, 2, 3)),
}
"""Lens models in the order in which they are tried: the lens and its free coefficients."""

_FOCAL = np.geomspace(0.25, 6.0, 28)  # of the longer side: fields of view from 127° down to 10°
_FOLDS = 3
_OUTLIER = 4.0  # standard deviations at which the error of a held-out corner stops to count
_WORTH = 0.005  # of the squared error that more coefficients must take away
_WIDE = 35.0  # degrees off axis from which a lens may well be a fisheye
_AHEAD = 0.1  # cosine of the angle off axis up to which rays lead forward
_TRIALS = 12  # boards that a focal length is tried on


@dataclass(frozen=True)
class Alone:
    """One sensor by itself.

    Attributes:
        model: the name of its lens model. adjusted: fitted to all views, the sensor is the reference.
        scores: root mean square error at held-out corners of each model that could be fitted, px.
    """

    model: str
    adjusted: Adjusted
    scores: dict[str, float]


def calibrate_alone(size: tuple[int, int], views: Sequence[View]) -> Alone | None:
    """Intrinsics and lens of one sensor.

    Args:
        size: width and height [px]. views: of sensor 0, of poses 0, 1, ... in order.
    Returns:
        None where no focal length explains the boards.
    """
    fits: dict[str, Adjusted] = {}
    for lens in ("brown_conrady", "kannala_brandt"):
        camera = _first_camera(size, views, lens)
        poses = None if camera is None else [board_pose(camera, view) for view in views]
        if camera is None or poses is None:
            continue
        boards = np.stack([pose if pose is not None else _somewhere(camera, view) for pose, view in zip(poses, views, strict=True)])
        state = RigState((camera,), (np.arange(0),), np.eye(4)[None], boards)
        for name, (kind, coefficients) in MODELS.items():
            if kind != lens:
                continue
            free = np.array([0, 1, 2, 3, *(4 + k for k in coefficients)])
            adjusted = adjust(replace(state, free=(free,)), views, "cauchy")
            if np.isfinite(adjusted.sigma).all():
                fits[name], state = adjusted, adjusted.state
    if not fits:
        return None
    errors = {name: _held_out(adjusted, views) for name, adjusted in fits.items()}
    sigma = min(adjusted.sigma[0] for adjusted in fits.values())
    capped = {name: np.minimum((error**2).sum(1), 2 * (_OUTLIER * sigma) ** 2) for name, error in errors.items()}
    order = [name for name in MODELS if name in fits]
    wide = "fisheye" in fits and _widest(fits["fisheye"].state.cameras[0], views) > _WIDE
    if wide:
        order.sort(key=("pinhole", "brown4", "fisheye", "brown5", "brown8").index)
    chosen = order[0]
    for name in order:
        gain = capped[chosen] - capped[name]
        # a fisheye has no decentring: where a narrow Brown lens does nearly as well, the principal point would pay for that
        worth = {"fisheye": _WORTH if wide else 0.1, "brown8": 0.03}.get(name, _WORTH)
        if gain.mean() > max(2 * gain.std() / np.sqrt(len(gain)), worth * capped[chosen].mean()):
            chosen = name
    scores = {name: float(np.sqrt(np.median(square) / np.log(4))) for name, square in ((n, (e**2).sum(1)) for n, e in errors.items())}
    return Alone(chosen, fits[chosen], scores)


def plain_camera(camera: Camera, coefficients: tuple[int, ...]) -> Camera:
    """As it is written: plain floats, no coefficients beyond those of the model."""
    count = next(n for n in (0, 4, 5, 8) if len(coefficients) <= n)
    distortion = tuple(float(value) for value in camera.coefficients[:count])
    return replace(
        camera,
        fx=float(camera.fx),
        fy=float(camera.fy),
        cx=float(camera.cx),
        cy=float(camera.cy),
        distortion=distortion if any(distortion) else (),
    )


def _widest(camera: Camera, views: Sequence[View]) -> float:
    """Degrees off axis of the farthest corner, of a fisheye."""
    pixels = np.concatenate([view.pixels for view in views])
    return float(np.degrees(np.linalg.norm((pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy], axis=1).max()))


def board_pose(camera: Camera, view: View) -> np.ndarray | None:
    """(4, 4) points of the board → of the camera; None where there is none in front of it."""
    flat = _ideal(camera, view.pixels)
    ahead = np.isfinite(flat).all(1)
    if ahead.sum() < 4:
        return None
    flat = flat[ahead]
    done, turns, shifts, _ = _ippe(view.points[ahead], flat)
    best, least = None, np.inf
    for k in range(done):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turns[k])[0], np.ravel(shifts[k])
        size = float(np.median(np.minimum(errors_of(camera, view, pose), 1e9)))
        if size < least and np.isfinite(pose).all():  # of corners on one line IPPE makes NaN
            best, least = pose, size
    return best


def _ippe(points: np.ndarray, flat: np.ndarray) -> Any:
    try:
        return cv2.solvePnPGeneric(points[:, None], flat[:, None].copy(), np.eye(3), np.zeros(4), flags=cv2.SOLVEPNP_IPPE)
    except cv2.error:  # corners on one line
        return 0, (), (), None


def _ideal(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """(N, 2) x / z and y / z of the pixels' rays, NaN where they do not lead forward."""
    if any(camera.distortion):
        rays, valid = unproject(pixels, camera)
        ahead = valid & (rays[:, 2] > _AHEAD)
        return np.where(ahead[:, None], rays[:, :2] / np.where(ahead, rays[:, 2], 1.0)[:, None], np.nan)
    image = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    if camera.lens == "brown_conrady":
        return image
    angle = np.maximum(np.linalg.norm(image, axis=1, keepdims=True), 1e-12)
    return np.where(np.cos(angle) > _AHEAD, image * np.tan(angle) / angle, np.nan)


def errors_of(camera: Camera, view: View, pose: np.ndarray) -> np.ndarray:
    """(N,) px; infinite where a corner has no pixel."""
    seen = projected(view.points @ pose[:3, :3].T + pose[:3, 3], camera)
    error = np.linalg.norm(view.pixels - seen, axis=1)
    return np.where(np.isfinite(error), error, np.inf)


def _first_camera(size: tuple[int, int], views: Sequence[View], lens: Lens) -> Camera | None:
    width, height = size
    some = [views[i] for i in np.unique(np.linspace(0, len(views) - 1, _TRIALS).round().astype(int))]
    best, least = None, np.inf
    for share in _FOCAL:
        focal = share * max(size)
        camera = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2, (), lens)
        medians = []
        for view in some:
            pose = board_pose(camera, view)
            medians.append(np.inf if pose is None else float(np.median(errors_of(camera, view, pose))))
        score = float(np.median(medians))
        if score < least:
            best, least = camera, score
    return best


def _somewhere(camera: Camera, view: View) -> np.ndarray:
    """A pose to start from where corners give none: the board faces the camera in the direction of its middle."""
    pose = np.eye(4)
    extent = max(float(np.ptp(view.pixels, axis=0).max()), 1.0)
    depth = camera.fx * float(np.ptp(view.points, axis=0).max()) / extent
    middle = (view.pixels.mean(0) - [camera.cx, camera.cy]) / camera.fx
    pose[:3, 3] = depth * np.array([*middle, 1.0]) - view.points.mean(0)
    return pose


def _held_out(adjusted: Adjusted, views: Sequence[View]) -> np.ndarray:
    """(N, 2) px: the errors at all corners, each by a fit without it."""
    out = []
    for fold in range(_FOLDS):
        kept = [(np.arange(len(view.points)) + k) % _FOLDS != fold for k, view in enumerate(views)]
        fitted = adjust(adjusted.state, [_part(view, keep) for view, keep in zip(views, kept, strict=True)], "cauchy", steps=12)
        camera = fitted.state.cameras[0]
        for view, keep in zip(views, kept, strict=True):
            pose = fitted.state.boards[view.pose]
            seen = projected(view.points[~keep] @ pose[:3, :3].T + pose[:3, 3], camera)
            out.append(np.where(np.isfinite(seen), view.pixels[~keep] - seen, 1e3))
    return np.concatenate(out)


def _part(view: View, keep: np.ndarray) -> View:
    return replace(view, points=view.points[keep], pixels=view.pixels[keep], spread=view.spread[keep])
