"""Lattices of evenly coloured squares in a picture, seen in perspective: the patches of a colour chart, the squares of a chessboard.

Nothing random: the same picture gives the same lattice.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from scipy.spatial import KDTree

_STEPS = (0.02, 0.04, 0.08, 0.16)  # in cube roots of values: what counts as an edge, in clean pictures and in noisy ones
_SMALLEST, _LARGEST = 6.0, 0.2  # side of an even square: pixels, of the shorter side of the picture
_FILLED = 0.7  # of the least rectangle around a square
_MOST = 400  # even patches that are looked at, at one size of the picture
_NEAR = 0.22  # of the distance between two squares: how far one may lie from its place
_REACH = 7  # squares to each side of the first one
_LEAST = 10  # squares that make a lattice
_MIDDLE = 0.5  # of a square, in each direction, that is averaged
CLIPPED = 0.98  # of full scale
_LEAST_SIDE = 60  # pixels of a picture


@dataclass(frozen=True)
class Lattice:
    """Attributes: to_pixels (3, 3): homography from the lattice, on which squares have their middles at whole numbers, to pixels.
    cells (N, 2) int: column and row of the squares that were seen."""

    to_pixels: np.ndarray
    cells: np.ndarray


def find_lattices(picture: np.ndarray) -> list[Lattice]:
    """Lattices in a picture (H, W, C) of any scale of values, ten squares and more, at several sizes of the picture; most squares first."""
    top = np.quantile(picture, 0.99, axis=(0, 1))
    if not (top > 0).all():
        return []
    small = np.cbrt((picture / top).clip(0, 1)).astype(np.float32)
    out = []
    scale = 1.0
    while min(small.shape[:2]) >= _LEAST_SIDE:
        shrunk = np.array([[scale, 0, (scale - 1) / 2], [0, scale, (scale - 1) / 2], [0, 0, 1]])
        out += [Lattice(shrunk @ found.to_pixels, found.cells) for found in _lattices_of(*_even_patches(small))]
        small = cv2.pyrDown(small).reshape(-(-small.shape[0] // 2), -(-small.shape[1] // 2), -1)
        scale *= 2
    return sorted(out, key=lambda lattice: -len(lattice.cells))


def _even_patches(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Middles (N, 2) px and sides (N,) px of patches without an edge that are nearly rectangles, nearly as wide as high."""
    smooth = cv2.GaussianBlur(picture, (0, 0), 1.0).reshape(picture.shape)
    kernel = np.ones((3, 3), np.uint8)
    step = np.max([cv2.dilate(channel, kernel) - cv2.erode(channel, kernel) for channel in np.moveaxis(smooth, -1, 0)], 0)
    largest = _LARGEST * min(picture.shape[:2])
    middles, sides = [], []
    for threshold in _STEPS:
        contours, _ = cv2.findContours((step < threshold).astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
        for contour in contours:
            area = cv2.contourArea(contour)
            if not _SMALLEST**2 <= area <= largest**2:
                continue
            middle, (width, height), _ = cv2.minAreaRect(contour)
            if min(width, height) > 0.5 * max(width, height) and area > _FILLED * width * height:
                middles.append(middle)
                sides.append(np.sqrt(area))
    return _distinct(np.array(middles).reshape(-1, 2), np.array(sides))


def _distinct(middles: np.ndarray, sides: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of patches seen at several thresholds the largest."""
    from scipy.spatial import KDTree  # half a second to import: a fit without a chart begins without

    kept: list[int] = []
    tree = KDTree(middles)
    left = np.ones(len(middles), bool)
    for i in np.argsort(-sides, kind="stable"):
        if left[i] and len(kept) < _MOST:
            kept.append(int(i))
            left[tree.query_ball_point(middles[i], 0.3 * sides[i])] = False
    return middles[kept], sides[kept]


def _lattices_of(middles: np.ndarray, sides: np.ndarray) -> list[Lattice]:
    from scipy.spatial import KDTree

    out: list[Lattice] = []
    if len(middles) < _LEAST:
        return out
    tree = KDTree(middles)
    taken = np.zeros(len(middles), bool)
    for start in range(len(middles)):
        if not taken[start]:
            grown = max(_lattices_at(start, middles, sides, tree), key=lambda lattice: len(lattice.cells), default=None)
            if grown is not None:
                places, pitch = to_pixels(grown.to_pixels, grown.cells)
                for place, near in zip(places, _NEAR * pitch, strict=True):
                    taken[tree.query_ball_point(place, near)] = True
                out.append(grown)
    return out


def _lattices_at(start: int, middles: np.ndarray, sides: np.ndarray, tree: KDTree) -> Iterator[Lattice]:
    """Those that grow from one patch and two beside it."""
    first, side = middles[start], sides[start]
    around = [i for i in tree.query_ball_point(first, 2.2 * side) if 0.6 < sides[i] / side < 1.7]
    steps = middles[around] - first
    steps = steps[np.linalg.norm(steps, axis=1) > 0.9 * side]
    lengths = np.linalg.norm(steps, axis=1)
    for i, j in zip(*np.triu_indices(len(steps), 1), strict=True):
        across = abs(steps[i, 0] * steps[j, 1] - steps[i, 1] * steps[j, 0]) / (lengths[i] * lengths[j])
        if across > 0.75 and max(lengths[i], lengths[j]) < 1.35 * min(lengths[i], lengths[j]):
            grown = _grow(first, steps[i], steps[j], middles, tree)
            if grown is not None:
                yield grown


def _grow(first: np.ndarray, u: np.ndarray, v: np.ndarray, middles: np.ndarray, tree: KDTree) -> Lattice | None:
    """From three squares outwards, ring by ring, each ring placed by those within."""
    matrix = np.array([[u[0], v[0], first[0]], [u[1], v[1], first[1]], [0, 0, 1.0]])
    cells = np.empty((0, 2), np.int64)
    for reach in range(1, _REACH + 1):
        ring = np.stack(np.meshgrid(np.arange(-reach, reach + 1), np.arange(-reach, reach + 1)), -1).reshape(-1, 2)
        places, pitch = to_pixels(matrix, ring)
        away, nearest = tree.query(places)
        near = away < _NEAR * pitch
        if near.sum() < 4 or (reach > 1 and near.sum() == len(cells)):
            break
        cells = ring[near]
        fitted, _ = cv2.findHomography(cells.astype(np.float64), middles[nearest[near]])
        if fitted is None:
            return None
        matrix = np.asarray(fitted)
    # squares in one line leave the homography open
    return Lattice(matrix, cells) if len(cells) >= _LEAST and np.ptp(cells, axis=0).min() >= 2 else None


def to_pixels(matrix: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cells (N, 2) to pixels (N, 2), and the lesser distance (N,) px from each to its neighbours; 0 beyond the horizon."""
    points = np.concatenate([cells, np.ones((len(cells), 1))], 1) @ matrix.T
    front = points[:, 2] > 1e-9
    with np.errstate(divide="ignore", invalid="ignore"):
        places = np.where(front[:, None], points[:, :2] / points[:, 2:], -1e6)
        along = [np.linalg.norm(matrix[:2, k] - places * matrix[2, k], axis=1) / points[:, 2] for k in (0, 1)]
    return places, np.where(front, np.minimum(*along), 0.0)


def mean_of_cell(picture: np.ndarray, lattice: Lattice, cell: np.ndarray) -> np.ndarray:
    """Mean (C,) of the middle of a square (2,), by column and row, in a picture (H, W, C), full scale 1; NaN outside and where clipped."""
    outline = cell + _MIDDLE / 2 * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    pixels, pitch = to_pixels(lattice.to_pixels, outline)
    height, width = picture.shape[:2]
    low, high = np.floor(pixels.min(0)).astype(int), np.ceil(pixels.max(0)).astype(int) + 1
    if not (pitch > 0).all() or (low < 0).any() or high[0] > width or high[1] > height:
        return np.full(picture.shape[2], np.nan)
    window = picture[low[1] : high[1], low[0] : high[0]]
    inside = np.zeros(window.shape[:2], np.uint8)
    cv2.fillConvexPoly(inside, np.round(pixels - low).astype(np.int32), 1)
    values = window[inside > 0]
    return np.asarray(values.mean(0)) if values.max() < CLIPPED else np.full(picture.shape[2], np.nan)
