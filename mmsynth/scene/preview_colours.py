"""Colours of previews, by a chart of 24 patches in view (``colour_chart``), or by the black and white of a board (squares, markers).

Data are never touched by it.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from mmsynth.errors import InputError
from mmsynth.scene.capture.boards import markers_in
from mmsynth.scene.colour_chart import ChartColours, chart_colours
from mmsynth.scene.encoding import encoding_of
from mmsynth.scene.images import read_native
from mmsynth.scene.lattice import CLIPPED, Lattice, find_lattices, mean_of_cell
from mmsynth.scene.scene import Frame, Scene, Sensor

_FRAMES, _LEAST = 6, 6  # that are looked at; black and white of a board that must agree
_DARK = 0.4  # of white: the most that is black
_STEP = 0.01  # of full scale, from black to white
_AGREE = 0.1  # median relative deviation from the median gain
_SIDE = 10.0  # pixels of a marker (of tiles, in a mosaic)


@dataclass(frozen=True)
class PreviewColours:
    """How linear red, green and blue are shown.

    Attributes:
        matrix: rows of a 3x3 matrix that takes them to linear sRGB; by a board, gains on its diagonal that make the board grey.
        seen: "chart" or "board". count: charts, or pairs of black and white. spread: of the patches of the best chart, rms as displayed;
            of the gains of a board, the median relative deviation.
    """

    matrix: tuple[tuple[float, float, float], ...]
    seen: Literal["chart", "board"]
    count: int
    spread: float


def preview_colours_of(sensor: Sensor, frames: Sequence[Frame]) -> PreviewColours | None:
    """None: no red, green and blue, values that are not linear, or nothing in view that agrees. Damaged frames are passed over."""
    if [label.upper() for label in sensor.channels] != ["R", "G", "B"] or not frames:
        return None
    spread = sorted({round(i) for i in np.linspace(0, len(frames) - 1, min(_FRAMES, len(frames)))})
    charts: list[ChartColours] = []
    steps: list[np.ndarray] = []
    try:
        if encoding_of(sensor, [frames[spread[0]].path]).verdict != "linear":
            return None
        for index in spread:
            picture = _picture(sensor, read_native(frames[index].path))
            lattices = find_lattices(picture)
            steps += _steps_of_markers(picture) or _steps_of_squares(picture, lattices)
            chart = chart_colours(picture, lattices)
            charts += [] if chart is None else [chart]
    except InputError:
        return None  # whoever needs the picture says so
    return _by_charts(charts) or _by_board(steps)


def preview_colours(scene: Scene) -> dict[str, PreviewColours]:
    """``preview_colours_of`` every sensor of a scene that has any."""
    found = {name: preview_colours_of(sensor, scene.frames_of(name)) for name, sensor in scene.sensors.items()}
    return {name: colours for name, colours in found.items() if colours is not None}


def _by_charts(charts: Sequence[ChartColours]) -> PreviewColours | None:
    if not charts:
        return None
    best = min(charts, key=lambda chart: chart.spread)
    first, second, third = ((float(row[0]), float(row[1]), float(row[2])) for row in best.matrix)
    return PreviewColours((first, second, third), "chart", len(charts), best.spread)


def _by_board(steps: Sequence[np.ndarray]) -> PreviewColours | None:
    if len(steps) < _LEAST:
        return None
    ratios = np.log([step[1] / step for step in steps])
    middle = np.median(ratios, 0)
    apart = float(np.median(np.abs(ratios - middle).max(1)))
    red, green, blue = map(float, np.exp(middle))
    diagonal = ((red, 0.0, 0.0), (0.0, green, 0.0), (0.0, 0.0, blue))
    return PreviewColours(diagonal, "board", len(steps), apart) if apart <= _AGREE else None


def _picture(sensor: Sensor, raw: np.ndarray) -> np.ndarray:
    """(h, w, 3) float64, full scale 1: a mosaic's tiles, else the pixels."""
    values = raw.astype(np.float64) / (np.iinfo(raw.dtype).max if raw.dtype.kind == "u" else 1.0)
    if sensor.mosaic is None:
        return np.asarray(values[..., :3])
    rows, columns = sensor.mosaic.shape
    h, w = raw.shape[0] // rows, raw.shape[1] // columns
    tiles = values[: h * rows, : w * columns].reshape(h, rows, w, columns)
    return np.stack([tiles.transpose(1, 3, 0, 2)[sensor.mosaic == channel].mean(0) for channel in range(3)], -1)


def _steps_of_markers(picture: np.ndarray) -> list[np.ndarray]:
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
        if white.max() < CLIPPED and low < _DARK * high and step.min() > _STEP:
            steps.append(step)
    return steps


def _steps_of_squares(picture: np.ndarray, lattices: Sequence[Lattice]) -> list[np.ndarray]:
    """White minus black (3,) of neighbours on a chessboard; none where bright and dark squares do not take turns."""
    if not lattices:
        return []
    lattice = lattices[0]
    colours = {(int(cell[0]), int(cell[1])): mean_of_cell(picture, lattice, cell) for cell in lattice.cells}
    colours = {cell: colour for cell, colour in colours.items() if np.isfinite(colour).all()}
    sides = [[float(colour.mean()) for cell, colour in colours.items() if sum(cell) % 2 == side] for side in (0, 1)]
    if min(map(len, sides)) < _LEAST:
        return []
    dark = int(np.median(sides[0]) > np.median(sides[1]))
    steps = []
    for (i, j), black in colours.items():
        around = [colours[cell] for cell in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)) if cell in colours]
        if (i + j) % 2 == dark and around:
            white = np.mean(around, 0)
            steps.append((black.mean() < _DARK * white.mean(), white - black))
    # a finger may lie on one
    return [step for _, step in steps if step.min() > _STEP] if np.mean([fair for fair, _ in steps]) > 0.9 else []
