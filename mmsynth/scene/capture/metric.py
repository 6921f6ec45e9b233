"""The unit of a reconstruction from calibration boards that stand in the scene: corners triangulated, against their geometry."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mmsynth.errors import InputError
from mmsynth.scene.capture.board import Board, corner_points
from mmsynth.scene.capture.detection import find_boards
from mmsynth.scene.capture.triangulation import Sighting, nearest_point, reprojection_error
from mmsynth.scene.images import read_native
from mmsynth.scene.scene import Frame, Sensor

_MOST = 24  # frames that are searched
_VIEWS = 3  # that must agree on a corner
_APART = 2.0  # pixels by which they may disagree
_LEAST = 6  # corners of a board


@dataclass(frozen=True)
class BoardScale:
    """Metres for one unit of the reconstruction.

    Attributes:
        deviation: relative standard deviation, by how far corners are from the board's shape.
        corners: how many were triangulated, of boards_seen boards. frames: in how many frames.
    """

    scale: float
    deviation: float
    corners: int
    boards_seen: int
    frames: int


def scale_of_boards(frames: Sequence[Frame], sensor: Sensor, boards: Sequence[Board], where: str) -> BoardScale:
    """Find boards in frames whose poses are known, and compare.

    Args:
        frames: of one sensor; up to 24 of them are searched, evenly spread.
        where: what errors begin with.
    Raises:
        InputError: no board of which six corners are seen in three frames that agree.
    """
    chosen = [frames[i] for i in sorted({round(x) for x in np.linspace(0, len(frames) - 1, min(_MOST, len(frames)))})]
    sightings: dict[tuple[int, int], list[Sighting]] = defaultdict(list)
    seen_in = set()
    for frame in chosen:
        for detection in find_boards(read_native(frame.path), boards, sensor.mosaic):
            seen_in.add(frame.view)
            for corner, pixel in zip(detection.ids, detection.pixels, strict=True):
                sightings[detection.board, int(corner)].append((frame, pixel))
    places: dict[int, dict[int, np.ndarray]] = defaultdict(dict)
    for (board, corner), seen in sightings.items():
        point = _triangulated(seen)
        if point is not None:
            places[board][corner] = point
    fits = [_fit(corner_points(boards[board]), found) for board, found in places.items() if len(found) >= _LEAST]
    if not fits:
        most = max((len(found) for found in places.values()), default=0)
        raise InputError(
            f"{where}: boards were seen in {len(seen_in)} of {len(chosen)} frames of '{sensor.name}', and {most} corners of one agree in "
            f"{_VIEWS} or more, expected {_LEAST}: the unit cannot be found from them."
        )
    scales, deviations, counts = (np.array(values) for values in zip(*fits, strict=True))
    weight = 1.0 / np.maximum(deviations, 1e-9) ** 2
    scale = float(scales[np.argsort(scales)[len(scales) // 2]] if len(scales) > 2 else np.average(scales, weights=weight))
    spread = float(np.std(scales) / scale) if len(scales) > 1 else 0.0
    return BoardScale(scale, max(float(1.0 / np.sqrt(weight.sum())), spread), int(counts.sum()), len(fits), len(seen_in))


def _triangulated(seen: Sequence[Sighting]) -> np.ndarray | None:
    """The point (3,) nearest to the rays of a corner, without those that do not agree; None where fewer than three do."""
    kept = list(seen)
    while len(kept) >= _VIEWS:
        point = nearest_point(kept)
        if point is None:
            return None
        apart = np.array([reprojection_error(point, frame, pixel) for frame, pixel in kept])
        if np.nanmax(apart) <= _APART and np.isfinite(apart).all():
            return point
        kept.pop(int(np.argmax(np.where(np.isfinite(apart), apart, np.inf))))
    return None


def _fit(board: np.ndarray, found: dict[int, np.ndarray]) -> tuple[float, float, int]:
    """Metres for a unit by the similarity of corners to the board (Umeyama 1991), its relative deviation, and how many corners."""
    ids = sorted(found)
    a, b = np.stack([found[i] for i in ids]), board[ids]
    a, b = a - a.mean(0), b - b.mean(0)
    u, values, vt = np.linalg.svd(b.T @ a)
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    scale = float((values * np.diag(sign)).sum() / (a**2).sum())
    residual = b - scale * a @ (u @ sign @ vt).T
    sigma = float(np.sqrt((residual**2).sum() / max(3 * len(ids) - 7, 1)))
    return scale, sigma / float(np.sqrt((b**2).sum())), len(ids)
