"""Whether the light of a modality moves with its camera, as a flash does.

A matt surface lit from the camera's place returns light in proportion to cos θ / d², with θ between its normal and the way to the camera,
and d the distance. Two training frames i and j see the same points, so over pixels of one pair, and whatever the paint,

    log(value_i / value_j) = s (log(cos θ_i / d_i²) - log(cos θ_j / d_j²)) + constant

with s = 1 where all light is the camera's, and s = 0 where none is. The constant is the pair's exposure. s is found by least squares within
pairs, robust against highlights (two rounds that leave out what lies farther off than 2.5 standard deviations).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from mmsynth.operations.conversion.warping import warped
from mmsynth.operations.conversion.windows import opened
from mmsynth.scene.scene import Frame, PosedCamera, Scene
from mmsynth.sensors.camera import resized, surface_points
from mmsynth.sensors.mosaic import grey_of

if TYPE_CHECKING:
    from mmsynth.field.field import Field

_MOVES = 0.2  # least s, and at how many standard deviations: errors of the surface make s less than it is
_SURE = 3.0
_PAIRS, _WIDTH = 6, 64
_APART_DEG = 30.0  # of the two ways of looking: less changes too little, and more shares too little
_DARK, _GRAZING = 0.01, 0.2
_LEAST_POINTS = 50


@dataclass(frozen=True)
class MovingLight:
    """s of a modality, and its standard deviation over pairs of frames (jackknife); (0, inf) where too few see the same points."""

    share: float
    sd: float

    @property
    def moves(self) -> bool:
        return self.share > max(_MOVES, _SURE * self.sd)


def moving_light(field: Field, scene: Scene, modality: str) -> MovingLight:
    """Look at a few pairs of training frames of a modality, small."""
    frames = scene.frames_of(modality, scene.split.train)
    centre = np.asarray(field.region.centre)
    ways = np.array([_unit(field.pose_of(frame)[:3, 3] - centre) for frame in frames]).reshape(-1, 3)
    pairs = []
    for one in np.unique(np.linspace(0, len(frames) - 1, _PAIRS).round().astype(int)) if len(frames) > 1 else ():
        apart = np.abs(np.degrees(np.arccos(np.clip(ways @ ways[one], -1.0, 1.0))) - _APART_DEG)
        apart[one] = np.inf
        found = _pair(field, frames[one], frames[int(np.argmin(apart))])
        if found.shape[1] >= _LEAST_POINTS:
            pairs.append(found)
    if len(pairs) < 3:
        return MovingLight(0.0, np.inf)
    left_out = np.array([_slope(pairs[:i] + pairs[i + 1 :]) for i in range(len(pairs))])
    return MovingLight(_slope(pairs), float(np.sqrt((len(pairs) - 1) * np.var(left_out))))


def _slope(pairs: Sequence[np.ndarray]) -> float:
    """s of pairs, each (2, N) differences of log(cos θ / d²) and of log values."""
    x, y = np.concatenate(pairs, 1)
    pair = np.repeat(np.arange(len(pairs)), [found.shape[1] for found in pairs])
    used, slope = np.ones(len(x), bool), 0.0
    for _ in range(3):
        count = np.maximum(np.bincount(pair[used], minlength=len(pairs)), 1)
        mean_x, mean_y = (np.bincount(pair[used], weights=a[used], minlength=len(pairs)) / count for a in (x, y))
        across, left = x - mean_x[pair], y - mean_y[pair]
        slope = float((across * left)[used].sum() / max(float((across**2)[used].sum()), 1e-12))
        left = left - slope * across
        used = np.abs(left) < 2.5 * max(float(np.sqrt(np.mean(left[used] ** 2))), 1e-9)
    return slope


def _unit(a: np.ndarray) -> np.ndarray:
    return np.asarray(a / max(float(np.linalg.norm(a)), 1e-12))


def _pair(field: Field, one: Frame, other: Frame) -> np.ndarray:
    """(2, N): differences of log(cos θ / d²), and of log values, at points of the region that both frames see."""
    layers, views, seens = [], [], []
    for frame in (one, other):
        distance_to = float(np.linalg.norm(field.pose_of(frame)[:3, 3] - np.asarray(field.region.centre)))
        wide = int(np.ceil(2.0 * max(frame.camera.fx, frame.camera.fy) * field.region.radius / max(distance_to, 1e-9)))
        raw, view = opened(field, frame, (max(wide, 8), max(wide, 8)))
        camera = resized(view.camera, min(_WIDTH, view.camera.width))
        view = PosedCamera(camera, view.camera_to_world)
        seen = field.render(view.camera, view.camera_to_world, [], geometry=True)
        sensor = field.sensors[frame.sensor]
        clipped = (raw >= sensor.saturation).astype(np.float32)
        small = lambda a, c=camera: cv2.resize(a.astype(np.float32), (c.width, c.height), interpolation=cv2.INTER_AREA)
        bright, value = (small(grey_of(a, sensor.mosaic)) for a in (clipped, raw))
        points = surface_points(camera, view.camera_to_world, seen.depth_ray)
        away = view.camera_to_world[:3, 3] - points
        distance = np.linalg.norm(away, axis=-1)
        cosine = np.abs(np.sum(seen.normal * away, -1)) / distance
        within = np.linalg.norm(points - np.asarray(field.region.centre), axis=-1) < field.region.radius
        good = within & (cosine > _GRAZING) & (value > _DARK) & (bright == 0) & (seen.opacity > 0.99)
        falls = np.log(np.where(good, cosine, 1.0)) - 2.0 * np.log(np.where(good, distance, 1.0))
        layers.append(np.dstack([np.where(good, falls, 0.0), np.where(good, np.log(np.where(good, value, 1.0)), 0.0), good]))
        views.append(view)
        seens.append(seen)
    arrived, visible = warped(layers[1], seens[1], views[1], seens[0], views[0])
    both = visible & (layers[0][..., 2] > 0.5) & (arrived[..., 2] > 0.99)
    return np.asarray((layers[0] - arrived)[both][:, :2].T)
