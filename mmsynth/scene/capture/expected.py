"""Boards that a sensor did not find by itself, looked for where the rest of the rig sees them.

Markers of a board that is far away have too few pixels to be read; its corners are still crossings of two edges, and a rig that is
calibrated roughly says where they are to a pixel.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from mmsynth.scene.capture.adjustment import RigState
from mmsynth.scene.capture.board import Board, corner_points
from mmsynth.scene.capture.board_frames import SensorFrames
from mmsynth.scene.capture.detection import Detection, find_expected, local_squares
from mmsynth.scene.capture.topology import Key
from mmsynth.scene.images import read_image
from mmsynth.sensors.camera import project

_SQUARE = 5.0  # px: the side of the smallest square whose corners are looked for
_BORDER = 2.0  # px
_APART = 2.0  # px, median distance of the corners from where they are expected


def find_where_expected(
    sensor: SensorFrames,
    s: int,
    state: RigState,
    poses: dict[Key, np.ndarray],
    boards: Sequence[Board],
    known: Collection[Key],
    workers: int = 1,
) -> dict[Key, Detection]:
    """Boards in frames of sensor ``s`` that others see.

    Args:
        poses: (4, 4) points of a board → of the reference camera, by instant and board. known: those that need not be looked for.
    """
    of_instant: dict[str, list[tuple[int, Board, np.ndarray, np.ndarray]]] = {}
    for key, pose in poses.items():
        instant, index = str(key[0]), key[1]
        if key in known or instant not in sensor.files or instant in sensor.same or boards[index].kind == "circles":
            continue
        ids, pixels = _expected_corners(sensor, s, state, boards[index], pose)
        if len(ids) >= 6:
            of_instant.setdefault(instant, []).append((index, boards[index], ids, pixels))

    def look(instant: str) -> list[tuple[Key, Detection]]:
        pattern = None if sensor.tile == (1, 1) else np.zeros(sensor.tile, int)
        found = find_expected(read_image(sensor.files[instant]), of_instant[instant], pattern)
        where = {index: dict(zip(ids, pixels, strict=True)) for index, _, ids, pixels in of_instant[instant]}
        return [((instant, one.board), one) for one in found if _distance(one, where[one.board]) < _APART]

    with ThreadPoolExecutor(workers) as pool:
        return dict(item for several in pool.map(look, of_instant) for item in several)


def _expected_corners(sensor: SensorFrames, s: int, state: RigState, board: Board, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ids (N,) and pixels (N, 2) of the corners in the picture, none where squares are too small."""
    local = state.to_sensor[s] @ pose
    pixels = project(corner_points(board) @ local[:3, :3].T + local[:3, 3], state.cameras[s])
    with np.errstate(invalid="ignore"):
        inside = ((pixels > _BORDER) & (pixels < np.array(sensor.size) - 1 - _BORDER)).all(1)
    ids = np.flatnonzero(inside)
    if len(ids) >= 6 and np.linalg.norm(local_squares(board, ids, pixels[ids]), axis=1).min() >= _SQUARE:
        return ids, pixels[ids]
    return ids[:0], pixels[:0]


def _distance(found: Detection, where: dict[int, np.ndarray]) -> float:
    """Median [px]; infinite where none was expected."""
    apart = [float(np.linalg.norm(pixel - where[i])) for i, pixel in zip(found.ids, found.pixels, strict=True) if i in where]
    return float(np.median(apart)) if apart else float("inf")
