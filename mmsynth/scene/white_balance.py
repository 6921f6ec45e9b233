"""White balance for previews, by the black and white of markers in view (ArUco, ChArUco). Data are never touched by it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from mmsynth.errors import InputError
from mmsynth.scene.capture.boards import markers_in
from mmsynth.scene.encoding import encoding_of
from mmsynth.scene.images import read_native
from mmsynth.scene.scene import Frame, Sensor

_FRAMES, _MARKERS = 6, 6  # that are looked at; that must agree
_AGREE = 0.1  # median relative deviation from the median gain
_SIDE = 10.0  # pixels of a marker (of tiles, in a mosaic)


@dataclass(frozen=True)
class WhiteBalance:
    """Gains of red, green (1) and blue that make a board grey, from how many markers, and by how much these disagree (relative)."""

    gains: tuple[float, float, float]
    markers: int
    spread: float


def white_balance_of(sensor: Sensor, frames: Sequence[Frame]) -> WhiteBalance | None:
    """None: no red, green and blue, values that are not linear, or no boards that agree. Damaged frames are passed over."""
    if [label.upper() for label in sensor.channels] != ["R", "G", "B"] or not frames:
        return None
    spread = sorted({round(i) for i in np.linspace(0, len(frames) - 1, min(_FRAMES, len(frames)))})
    found: list[np.ndarray] = []
    try:
        if encoding_of(sensor, [frames[spread[0]].path]).verdict != "linear":
            return None
        for index in spread:
            found += _steps(_picture(sensor, read_native(frames[index].path)))
    except InputError:
        return None  # whoever needs the picture says so
    if len(found) < _MARKERS:
        return None
    ratios = np.log([step[1] / step for step in found])
    middle = np.median(ratios, 0)
    apart = float(np.median(np.abs(ratios - middle).max(1)))
    red, green, blue = map(float, np.exp(middle))
    return WhiteBalance((red, green, blue), len(found), apart) if apart <= _AGREE else None


def _picture(sensor: Sensor, raw: np.ndarray) -> np.ndarray:
    """(h, w, 3) float64, full scale 1: a mosaic's tiles, else the pixels."""
    values = raw.astype(np.float64) / (np.iinfo(raw.dtype).max if raw.dtype.kind == "u" else 1.0)
    if sensor.mosaic is None:
        return np.asarray(values[..., :3])
    rows, columns = sensor.mosaic.shape
    h, w = raw.shape[0] // rows, raw.shape[1] // columns
    tiles = values[: h * rows, : w * columns].reshape(h, rows, w, columns)
    return np.stack([tiles.transpose(1, 3, 0, 2)[sensor.mosaic == channel].mean(0) for channel in range(3)], -1)


def _steps(picture: np.ndarray) -> list[np.ndarray]:
    """White minus black (3,) of every marker that is lit, large and not clipped: a black that is not black, or stray light, cancels."""
    corners: dict[tuple[int, int], dict[int, np.ndarray]] = defaultdict(dict)
    grey = picture.mean(-1)
    for (dictionary, marker, corner), place in markers_in(grey).items():
        corners[dictionary, marker][corner] = place
    steps = []
    for places in corners.values():
        if len(places) < 4:
            continue
        outline = np.array([places[k] for k in range(4)])
        if np.linalg.norm(outline - np.roll(outline, 1, 0), axis=1).min() < _SIDE:
            continue
        inside = np.zeros(grey.shape, np.uint8)
        cv2.fillConvexPoly(inside, np.round(outline).astype(np.int32), 1)
        pixels, level = picture[inside > 0], grey[inside > 0]
        low, high = np.quantile(level, (0.1, 0.9))
        white, black = pixels[level >= high], pixels[level <= low]
        step = white.mean(0) - black.mean(0)
        if white.max() < 0.98 and high > 2.5 * low and step.min() > 0.01:
            steps.append(step)
    return steps
