"""Calibration boards in raw frames: which corners are seen, and where on the photosites.

A mosaic is never demosaicked: a grey board on a mosaic is a picture as soon as the channels are at one level. They are brought there by
a gain for each place of the tile, locally (the light on a polarizer changes over the frame), and where a board was found by its own black
and white. OpenCV finds the boards in that picture; ``corners`` refines them on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from mmsynth.scene.capture.board import Board, corner_points, turns
from mmsynth.scene.capture.corners import refine_saddles
from mmsynth.scene.capture.markers import Markers, chart_corners, find_markers_in

_SMALL, _LARGE = 2_000_000, 9_000_000  # pixels: pictures are made larger up to the first for finding, and smaller down to the second
_LEAST = 6  # corners of a board that count as one
_WINDOW = 12.0  # tiles over which channels are brought to one level
_SEES = 0.12  # contrast of a channel on a board, relative to the best one's, below which it does not see it


@dataclass(frozen=True)
class Detection:
    """One board in one frame.

    Attributes:
        board: which of the boards. ids: (N,) rising, rows of ``corner_points``.
        pixels: (N, 2) float64, the centre of the top-left pixel is (0, 0).
        deviation: (N,) px, standard deviation by the pixels' scatter.
        blind: places (row, column) of the mosaic's tile that hardly tell black from white on it.
    """

    board: int
    ids: np.ndarray
    pixels: np.ndarray
    deviation: np.ndarray
    blind: tuple[tuple[int, int], ...] = ()


def find_boards(raw: np.ndarray, boards: Sequence[Board], pattern: np.ndarray | None = None) -> list[Detection]:
    """Find boards in a frame.

    Args:
        raw: (H, W) a mosaic or grey, or (H, W, C) a picture; linear or not.
        pattern: of the mosaic; only its size counts. None: no mosaic.
    Returns:
        one for each board that is seen, with at least six corners. Of boards that look the same when turned (``turns``) the ids are those
        of one of their turns.
    """
    mosaic, tile = _mosaic(raw, pattern)
    picture = level_channels(mosaic, tile)
    markers: dict[tuple[str, bool], Markers] = {}
    found: list[Detection] = []
    for index, board in enumerate(boards):
        if board.kind == "charuco":
            key = board.dictionary, board.inverted
            if key not in markers:
                markers[key] = _markers(picture, *key)
            guesses = chart_corners(board, markers[key])
        else:
            guess = _find(picture, board)
            if guess is None and tile != (1, 1):  # a coarser picture has no mosaic: each pixel is the mean of a tile
                guess = _find_in_tiles(mosaic, tile, board)
            guesses = [] if guess is None else [guess]
        seen = [one for guess in guesses if (one := _refined(mosaic, picture, tile, index, board, *guess)) is not None]
        found += sorted(seen, key=lambda one: -len(one.ids))[:1]
    return found


def find_expected(
    raw: np.ndarray, expected: Sequence[tuple[int, Board, np.ndarray, np.ndarray]], pattern: np.ndarray | None = None
) -> list[Detection]:
    """``find_boards`` where boards are known to be: corners that no marker led to are found, too.

    Args:
        expected: (index, board, ids (N,), pixels (N, 2)) of each, to a pixel or two.
    """
    mosaic, tile = _mosaic(raw, pattern)
    picture = level_channels(mosaic, tile)
    seen = (_refined(mosaic, picture, tile, *one) for one in expected)
    return [one for one in seen if one is not None]


def _mosaic(raw: np.ndarray, pattern: np.ndarray | None) -> tuple[np.ndarray, tuple[int, int]]:
    """One value for each pixel (H, W) float32, and the rows and columns after which they repeat."""
    if raw.ndim == 3:
        return _grey(raw), (1, 1)
    return np.asarray(raw, dtype=np.float32), (1, 1) if pattern is None else (pattern.shape[0], pattern.shape[1])


def level_channels(mosaic: np.ndarray, tile: tuple[int, int]) -> np.ndarray:
    """A mosaic (H, W) as a picture: a gain for each place of the tile, by its mean in a wide window around, (H, W) float32."""
    h, w = tile
    out = np.array(mosaic, dtype=np.float32)
    if tile == (1, 1) or mosaic.shape[0] < h or mosaic.shape[1] < w:
        return out
    rows, columns = -(-mosaic.shape[0] // h), -(-mosaic.shape[1] // w)
    padded = np.pad(out, ((0, rows * h - out.shape[0]), (0, columns * w - out.shape[1])), mode="symmetric")
    places = [(i, j) for i in range(h) for j in range(w)]
    means = {(i, j): cv2.GaussianBlur(padded[i::h, j::w], (0, 0), _WINDOW, borderType=cv2.BORDER_REFLECT) for i, j in places}
    common = np.mean(list(means.values()), axis=0)
    floor = 1e-3 * float(common.mean()) + 1e-9
    for i, j in places:
        part = out[i::h, j::w]
        gain = (common + floor) / (np.maximum(means[i, j], 0) + floor)
        part *= gain[: part.shape[0], : part.shape[1]]
    return out


def _grey(picture: np.ndarray) -> np.ndarray:
    colours = np.asarray(picture, dtype=np.float32)[..., : 3 if picture.shape[2] in (3, 4) else picture.shape[2]]
    return colours.mean(-1)


_Seen = tuple[np.ndarray, np.ndarray]  # ids (N,), pixels (N, 2)


def _find(picture: np.ndarray, board: Board) -> _Seen | None:
    """The corners of a chessboard or the circles of a grid at the first scale of the picture at which they are found."""
    for scale in _scales(picture.shape):
        grey = _scaled(picture, scale)
        if board.inverted:
            grey = 255 - grey
        seen = _circles(grey, board) if board.kind == "circles" else _chessboard(grey, board)
        if seen is not None:
            return seen[0], unscaled(seen[1], scale)
    return None


def _scales(shape: tuple[int, ...]) -> list[float]:
    size = shape[0] * shape[1]
    if size > _LARGE:
        return [float(np.sqrt(_LARGE / size)), 1.0]
    return [1.0] + [scale for scale in (2.0, 4.0, 6.0) if size * scale**2 <= _SMALL]


def _markers(picture: np.ndarray, dictionary: str, inverted: bool) -> Markers:
    """The corners of markers at all scales; of a marker that is found at several, those of the largest."""
    out: Markers = {}
    for scale in _scales(picture.shape):
        grey = _scaled(picture, scale)
        found = find_markers_in(255 - grey if inverted else grey, dictionary)
        out.update({marker: unscaled(corners, scale) for marker, corners in found.items()})
    return out


def unscaled(pixels: np.ndarray, scale: float) -> np.ndarray:
    """Pixels of a resized picture in the picture itself: OpenCV resizes about the corners, and pixel centres are at +0.5."""
    return (np.asarray(pixels, dtype=np.float64) + 0.5) / scale - 0.5


def _scaled(picture: np.ndarray, scale: float) -> np.ndarray:
    """(H, W) uint8 for a detector: square roots, so that a board in the shade is seen beside a lamp."""
    low, high = np.quantile(picture, 0.001), np.quantile(picture, 0.995)
    level = np.sqrt(np.clip((picture - low) / max(float(high - low), 1e-12), 0.0, 1.0))
    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    level = level if scale == 1 else cv2.resize(level, None, fx=scale, fy=scale, interpolation=way)
    return (255 * np.clip(level, 0, 1) + 0.5).astype(np.uint8)


def _find_in_tiles(mosaic: np.ndarray, tile: tuple[int, int], board: Board) -> _Seen | None:
    h, w = tile
    rows, columns = mosaic.shape[0] // h, mosaic.shape[1] // w
    if min(rows, columns) < 30:
        return None
    seen = _find(mosaic[: rows * h, : columns * w].reshape(rows, h, columns, w).mean((1, 3)), board)
    return None if seen is None else (seen[0], (seen[1] + 0.5) * [w, h] - 0.5)


def _chessboard(grey: np.ndarray, board: Board) -> _Seen | None:
    columns, rows = board.grid
    found, corners = cv2.findChessboardCornersSB(grey, (columns, rows), flags=cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE)
    if not found:
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
        found, corners = cv2.findChessboardCorners(grey, (columns, rows), flags=flags)
    if not found:
        return None
    pixels = _facing(np.reshape(corners, (rows, columns, 2)))
    middles = np.rint((pixels[1:, 1:] + pixels[:-1, :-1] + pixels[1:, :-1] + pixels[:-1, 1:]) / 4).astype(int)
    value = grey[np.clip(middles[..., 1], 0, grey.shape[0] - 1), np.clip(middles[..., 0], 0, grey.shape[1] - 1)].astype(float)
    parity = (-1.0) ** np.add.outer(np.arange(rows - 1), np.arange(columns - 1))
    flat = pixels.reshape(-1, 2)
    onto, same = turns(board)
    # the first square of a board is black where a turn can make it so
    if ((value - value.mean()) * parity).sum() > 0 and not same.all():
        flat = flat[onto[int(np.argmin(same))]]
    return np.arange(rows * columns), flat


def _circles(grey: np.ndarray, board: Board) -> _Seen | None:
    kind = cv2.CALIB_CB_ASYMMETRIC_GRID if board.asymmetric else cv2.CALIB_CB_SYMMETRIC_GRID
    for flags in (kind, kind | cv2.CALIB_CB_CLUSTERING):
        found, centres = cv2.findCirclesGrid(grey, board.grid, flags=flags)
        if found:
            columns, rows = board.grid
            pixels = np.reshape(centres, (rows, columns, 2))
            return np.arange(rows * columns), (pixels if board.asymmetric else _facing(pixels)).reshape(-1, 2)
    return None


def _facing(pixels: np.ndarray) -> np.ndarray:
    """A grid (rows, columns, 2) as it is seen from its front: detectors may begin at any end of it."""
    right, down = np.diff(pixels, axis=1).mean((0, 1)), np.diff(pixels, axis=0).mean((0, 1))
    return pixels if right[0] * down[1] - right[1] * down[0] > 0 else pixels[:, ::-1]


def _refined(
    mosaic: np.ndarray, picture: np.ndarray, tile: tuple[int, int], index: int, board: Board, ids: np.ndarray, pixels: np.ndarray
) -> Detection | None:
    order = np.argsort(ids)
    ids, pixels = ids[order].astype(np.int64), pixels[order].astype(np.float64)
    if board.kind == "circles":
        return Detection(index, ids, pixels, np.full(len(ids), np.nan))
    weight = np.ones_like(picture)
    blind: tuple[tuple[int, int], ...] = ()
    if tile != (1, 1):
        picture, weight, blind = level_on_board(mosaic, tile, pixels)
    known: dict[int, tuple[np.ndarray, float]] = {}
    for round_ in range(2 * max(board.grid)):  # again from where the last has led, with the neighbours of what was found
        if np.linalg.matrix_rank(corner_points(board)[ids, :2] - corner_points(board)[ids[0], :2], tol=1e-9) < 2:
            break  # on one line, nothing tells where the next line is
        fine, deviation, sign = _saddles(picture, weight, board, ids, pixels)
        good = np.isfinite(fine).all(-1)
        # black and white alternate: what has the wrong sign is a corner of something else
        parity = (-1.0) ** (ids // board.grid[0] + ids % board.grid[0]) * sign
        good &= parity == (1.0 if (parity[good] > 0).sum() * 2 > good.sum() else -1.0)
        fresh = {int(i): (place, float(spread)) for i, place, spread in zip(ids[good], fine[good], deviation[good], strict=True)}
        if len(fresh) < 4 or (len(fresh) <= len(known) and known):
            break
        known = fresh
        ids, pixels = _with_neighbours(board, known, picture.shape)
        if len(ids) == len(known) and round_ > 0:
            break
    if len(known) < _LEAST:
        return None
    final = np.array(sorted(known))
    return Detection(index, final, np.stack([known[i][0] for i in final]), np.array([known[i][1] for i in final]), blind)


def _saddles(
    picture: np.ndarray, weight: np.ndarray, board: Board, ids: np.ndarray, pixels: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return refine_saddles(picture, weight, pixels, local_squares(board, ids, pixels), _marker_border(board))


def _marker_border(board: Board) -> tuple[float, float] | None:
    """How far from the edges of its square a marker's black border begins and ends, in squares."""
    if board.marker is None:
        return None
    cells = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary)).markerSize + 2
    begin = (1 - board.marker / board.square) / 2
    return begin, begin + board.marker / board.square / cells


def _with_neighbours(board: Board, known: dict[int, tuple[np.ndarray, float]], shape: tuple[int, ...]) -> _Seen:
    """Known corners and those beside them, where the nearest known ones lead to."""
    columns, rows = board.grid
    ids = np.array(sorted(known))
    pixels = np.stack([known[i][0] for i in ids])
    across = local_squares(board, ids, pixels)
    guesses: dict[int, list[np.ndarray]] = {}
    for i, place, (right, down) in zip(ids, pixels, across.transpose(0, 2, 1), strict=True):
        row, column = divmod(int(i), columns)
        for dr, dc in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            other = (row + dr) * columns + column + dc
            if 0 <= row + dr < rows and 0 <= column + dc < columns and other not in known:
                guesses.setdefault(other, []).append(place + dc * right + dr * down)
    new = {i: np.mean(several, axis=0) for i, several in guesses.items()}
    new = {i: p for i, p in new.items() if 1 <= p[0] < shape[1] - 2 and 1 <= p[1] < shape[0] - 2}
    everything = {**{i: known[i][0] for i in known}, **new}
    order = sorted(everything)
    return np.array(order), np.stack([everything[i] for i in order])


def local_squares(board: Board, ids: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """(N, 2, 2): pixels for one square to the right and one down (in columns) around each corner, by its nearest neighbours."""
    places = corner_points(board)[ids, :2] / board.square
    out = np.empty((len(ids), 2, 2))
    for k, place in enumerate(places):
        near = np.argsort(np.abs(places - place).sum(1), kind="stable")[: min(9, len(ids))]
        matrix = np.concatenate([places[near] - place, np.ones((len(near), 1))], 1)
        if np.linalg.matrix_rank(matrix, tol=1e-6) < 3:
            matrix, near = np.concatenate([places - place, np.ones((len(ids), 1))], 1), np.arange(len(ids))
        out[k] = np.linalg.lstsq(matrix, pixels[near], rcond=None)[0][:2].T
    return out


def level_on_board(
    mosaic: np.ndarray, tile: tuple[int, int], pixels: np.ndarray
) -> tuple[np.ndarray, np.ndarray, tuple[tuple[int, int], ...]]:
    """A mosaic whose channels have one black and one white on a board.

    Args:
        pixels: (N, 2) corners, whose hull is the board.
    Returns:
        the picture (H, W); weights (H, W) of its pixels, by the contrast of their channel; and the tile's places that do not see the board.
    """
    hull = cv2.convexHull(np.rint(pixels).astype(np.int32))
    region = np.zeros(mosaic.shape, np.uint8)
    cv2.fillConvexPoly(region, hull, 1)
    h, w = tile
    picture, weight = np.array(mosaic, dtype=np.float32), np.ones(mosaic.shape, np.float32)
    levels = {}
    for i in range(h):
        for j in range(w):
            values = mosaic[i::h, j::w][region[i::h, j::w] > 0]
            if len(values) >= 20:
                levels[i, j] = np.quantile(values, [0.15, 0.85])
    best = max((float(white - black) for black, white in levels.values()), default=0.0)
    blind = []
    for (i, j), (black, white) in levels.items():
        contrast = float(white - black) / max(best, 1e-12)
        if contrast < _SEES:
            blind.append((i, j))
        picture[i::h, j::w] = (picture[i::h, j::w] - black) / max(float(white - black), 1e-12)
        # noise grows less than the signal does, and at most as it
        weight[i::h, j::w] = 0.0 if contrast < _SEES else contrast
    if not levels:
        return level_channels(mosaic, tile), weight, ()
    return picture, weight, tuple(blind)
