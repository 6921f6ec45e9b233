"""Colour charts of 24 patches (ColorChecker Classic): found in a picture, and the matrix that takes its colours to published ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mmsynth.scene.lattice import Lattice, mean_of_cell

COLUMNS, ROWS = 6, 4
# linear sRGB of the patches, row by row from dark skin to black: the maker's xyY (charts made after November 2014, D50 to D65 by
# Bradford's adaptation); what lies outside sRGB is below 0
PATCHES = np.array(
    [
        [0.174, 0.079, 0.053],
        [0.560, 0.277, 0.211],
        [0.104, 0.189, 0.329],
        [0.106, 0.151, 0.051],
        [0.227, 0.212, 0.426],
        [0.115, 0.507, 0.411],
        [0.746, 0.202, 0.030],
        [0.059, 0.101, 0.388],
        [0.560, 0.080, 0.115],
        [0.109, 0.042, 0.138],
        [0.333, 0.497, 0.043],
        [0.771, 0.358, 0.020],
        [0.021, 0.048, 0.284],
        [0.046, 0.292, 0.061],
        [0.446, 0.036, 0.041],
        [0.842, 0.574, 0.005],
        [0.522, 0.078, 0.289],
        [-0.044, 0.234, 0.377],
        [0.880, 0.885, 0.834],
        [0.584, 0.592, 0.584],
        [0.358, 0.367, 0.365],
        [0.190, 0.191, 0.190],
        [0.086, 0.089, 0.090],
        [0.031, 0.031, 0.032],
    ]
)
_GREYS = slice(18, 24)
_LEAST_SEEN = 12  # patches of a chart that the lattice was made of
_BEYOND = 3  # columns that others may lie beyond it: as many as hold the other twelve
_LEAST = 16  # patches, and greys, that are not clipped
_LEAST_GREYS = 4
_MISFIT = 0.05  # rms over channels of colours as they are displayed (1/2.2), white 1
_ROUNDS = 4  # of matrix and shading


@dataclass(frozen=True)
class ChartColours:
    """Attributes: matrix (3, 3): linear values to linear sRGB, green of a grey kept. spread: rms of what is left of the patches, as
    displayed (values to the power of 1/2.2, white 1)."""

    matrix: np.ndarray
    spread: float


def chart_colours(picture: np.ndarray, lattices: Sequence[Lattice]) -> ChartColours | None:
    """The chart in a picture (H, W, 3), linear, full scale 1, among its lattices; None: no lattice has a chart's colours."""
    found = [chart for lattice in lattices if (chart := _chart_on(lattice, picture)) is not None]
    return min(found, key=lambda chart: chart.spread, default=None)


def _chart_on(lattice: Lattice, picture: np.ndarray) -> ChartColours | None:
    best: ChartColours | None = None
    low = lattice.cells.min(0) - _BEYOND
    columns, rows = lattice.cells.max(0) + _BEYOND + 1 - low
    seen = np.zeros((rows, columns), int)
    seen[tuple((lattice.cells - low).T[::-1])] = 1
    colours = np.array([[mean_of_cell(picture, lattice, low + (i, j)) for i in range(columns)] for j in range(rows)])
    # a chart has no mirror image: its second axis lies to the right of its first as pixels do, whatever the lattice's
    if np.linalg.det(_jacobian(lattice)) < 0:
        seen, colours = seen[:, ::-1], colours[:, ::-1]
    for turn in range(4):
        turned = np.rot90(colours, turn)
        inside = np.lib.stride_tricks.sliding_window_view(np.rot90(seen, turn), (ROWS, COLUMNS)).sum((-1, -2))
        for row, column in np.argwhere(inside >= _LEAST_SEEN):
            fitted = _fit(turned[row : row + ROWS, column : column + COLUMNS].reshape(-1, 3))
            if fitted is not None and fitted[1] <= _MISFIT and (best is None or fitted[1] < best.spread):
                best = ChartColours(*fitted)
    return best


def _jacobian(lattice: Lattice) -> np.ndarray:
    """(2, 2) of pixels by cells in the middle of what was seen."""
    middle = lattice.cells.mean(0)
    x, y, w = lattice.to_pixels @ [*middle, 1.0]
    return np.asarray((lattice.to_pixels[:2, :2] - np.outer([x / w, y / w], lattice.to_pixels[2, :2])) / w)


def _fit(measured: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Matrix (3, 3) and misfit of patches (24, 3): greys give gains and what is added to all (stray light, a black level), colours the
    rest under the condition that greys stay grey; the shading over the chart is a plane of logarithms."""
    known = np.isfinite(measured).all(1)
    if known.sum() < _LEAST or known[_GREYS].sum() < _LEAST_GREYS:
        return None
    grey = PATCHES[_GREYS].mean(1)
    if (np.diff(measured[_GREYS][known[_GREYS]].mean(1)) > 0).any():
        return None
    column, row = np.arange(24) % COLUMNS - (COLUMNS - 1) / 2, np.arange(24) // COLUMNS - (ROWS - 1) / 2
    plane = np.stack([np.ones(24), column, row], 1)
    shade = np.ones(24)
    for _ in range(_ROUNDS):
        use = known[_GREYS]
        # relative errors are alike: a dark grey weighs as much as a light one
        weight = 1 / grey[use]
        design = np.stack([grey[use] * shade[_GREYS][use], np.ones(use.sum())], 1) * weight[:, None]
        (slope, black), *_ = np.linalg.lstsq(design, measured[_GREYS][use] * weight[:, None], rcond=None)
        if slope.min() <= 0:
            return None
        even = (measured[known] - black) / slope / shade[known, None]
        weight = 1 / (PATCHES[known].mean(1) + 0.05)
        matrix = np.empty((3, 3))
        for c in range(3):
            design = (even[:, :2] - even[:, 2:]) * weight[:, None]
            first, *_ = np.linalg.lstsq(design, (PATCHES[known, c] - even[:, 2]) * weight, rcond=None)
            matrix[c] = [*first, 1 - first.sum()]
        ours = even @ matrix.T
        bright, true = ours.mean(1), PATCHES[known].mean(1)
        fair = bright > 0.02
        if fair.sum() < _LEAST:
            return None
        by, *_ = np.linalg.lstsq(plane[known][fair], np.log(bright[fair] / true[fair]), rcond=None)
        if np.abs(by[1:]).max() > 0.1:  # a step from patch to patch that light does not make
            return None
        shade *= np.exp(plane[:, 1:] @ by[1:])
    misfit = float(np.sqrt(np.mean((_shown(ours) - _shown(PATCHES[known])) ** 2)))
    return matrix / slope * slope[1], misfit


def _shown(values: np.ndarray) -> np.ndarray:
    return np.asarray(values.clip(min=0) ** (1 / 2.2))
