"""Where the sensors of a rig are, from boards that two of them saw at one instant: a star around the reference, through chains of sensors.

Of a board that looks the same when turned no single picture tells which end is which. The place of a sensor on the rig is the same at every
instant, and only the right labels agree on it.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mmsynth.scene.capture.board import Board, corner_points, turns
from mmsynth.scene.motion import inverse

_CAPPED = 0.2  # distance of two places, in depths of the board and in radians, from which they do not agree at all
_CLEAR = 2.0  # how much better the right labels must agree than any others

Key = tuple[Hashable, int]
"""An instant and a board."""


@dataclass(frozen=True)
class Placed:
    """Attributes:
    to_reference: (4, 4) of each sensor. boards: (4, 4) of each board at each instant, in the reference camera.
    turned: which of its ``turns`` a sensor's board has, where it is not the first.
    apart: sensors that no chain of boards joins to the reference.
    unclear: sensors for which boards turned otherwise agree as well.
    """

    to_reference: dict[str, np.ndarray]
    boards: dict[Key, np.ndarray]
    turned: dict[tuple[str, Key], int]
    apart: tuple[str, ...]
    unclear: tuple[str, ...]


def place_sensors(poses: Mapping[str, Mapping[Key, np.ndarray]], reference: str, boards: Sequence[Board]) -> Placed:
    """Chain sensors to the reference, those first that share most boards with what is placed already.

    Args:
        poses: of each sensor, (4, 4) points of a board → of its camera.
    """
    to_reference = {reference: np.eye(4)}
    known = dict(poses[reference])
    turned: dict[tuple[str, Key], int] = {}
    unclear: list[str] = []
    while len(to_reference) < len(poses):
        shared = {name: [key for key in own if key in known] for name, own in poses.items() if name not in to_reference}
        name = max(shared, key=lambda n: len(shared[n]))
        if not shared[name]:
            return Placed(to_reference, known, turned, tuple(shared), tuple(unclear))
        options = [[known[key] @ inverse(poses[name][key] @ back) for back in _symmetries(boards[key[1]])] for key in shared[name]]
        depth = float(np.median([abs(poses[name][key][2, 3]) for key in shared[name]]))
        candidates = [place for several in options for place in several]
        scores = np.array([sum(min(_apart(c, o, depth) for o in several) for several in options) for c in candidates])
        best = candidates[int(scores.argmin())]
        others = [score for score, c in zip(scores, candidates, strict=True) if _apart(c, best, depth) >= _CAPPED]
        # a candidate always agrees with its own instant
        if max(map(len, options)) > 1 and (len(options) < 2 or (others and min(others) < _CLEAR * scores.min() + 1e-3)):
            unclear.append(name)
        to_reference[name] = best
        for key, several in zip(shared[name], options, strict=True):
            turn = int(np.argmin([_apart(best, o, depth) for o in several]))
            if turn:
                turned[name, key] = turn
        for key, pose in poses[name].items():
            known.setdefault(key, best @ pose)
    return Placed(to_reference, known, turned, (), tuple(unclear))


def relabelled(board: Board, ids: np.ndarray, turn: int) -> np.ndarray:
    """Ids after a turn that looks the same."""
    onto, same = turns(board)
    return np.asarray(onto[same][turn][ids])


def _symmetries(board: Board) -> list[np.ndarray]:
    """(4, 4) each: points by their ids after a turn → points by the ids as found."""
    onto, same = turns(board)
    points = corner_points(board)
    middle = points.mean(0)
    out = []
    for labels in onto[same]:
        # the rotation in the plane that brings points[labels] onto points
        a, b = points[labels, :2] - middle[:2], points[:, :2] - middle[:2]
        angle = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
        back = np.eye(4)
        back[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        back[:3, 3] = middle - back[:3, :3] @ middle
        out.append(back)
    return out


def _apart(a: np.ndarray, b: np.ndarray, depth: float) -> float:
    turn = a[:3, :3].T @ b[:3, :3]
    angle = np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))
    return min(_CAPPED, float(angle + np.linalg.norm(a[:3, 3] - b[:3, 3]) / depth))
