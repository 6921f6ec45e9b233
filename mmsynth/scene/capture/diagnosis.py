"""What is wrong with frames of calibration boards, in one sentence each."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from mmsynth.errors import InputError
from mmsynth.scene.capture.adjustment import Adjusted, View
from mmsynth.scene.capture.aruco import detect_markers
from mmsynth.scene.capture.board import Board
from mmsynth.scene.capture.board_frames import SensorFrames
from mmsynth.scene.capture.detection import find_boards, level_channels
from mmsynth.scene.capture.lens_choice import Alone, board_pose, errors_of
from mmsynth.scene.images import read_image
from mmsynth.sensors.camera import Camera

_LOOK = 4  # frames that are looked at again
_OPEN, _WIDE = 0.1, 0.01  # relative deviation of a focal length that is refused, and that is said
_APART, _LEAST = 4.0, 0.5  # how much worse boards fit together than by themselves, and px, when they were not at one place
_GROWS = 0.4  # correlation of that with the board's speed
_PATTERN = 0.35  # share of the residuals that a smooth function of the place explains
_BARE = 0.35  # share of the picture's fields below which its corners are empty


def check_same_files(sensors: Mapping[str, SensorFrames], where: str) -> None:
    """Raises InputError: two sensors have the same pictures."""
    seen: dict[str, tuple[str, str]] = {}
    for name, sensor in sensors.items():
        for instant, digest in sensor.digests.items():
            other, when = seen.setdefault(digest, (name, instant))
            if other != name:
                raise InputError(
                    f"{where}: frame {instant} of '{name}' and frame {when} of '{other}' are the same picture, expected those of two."
                )


def why_no_board(sensor: SensorFrames, boards: Sequence[Board]) -> str | None:
    """What a sensor that hardly sees a board sees instead: a mirrored one, another size, another dictionary; None: nothing known."""
    paths = list(sensor.files.values())
    some = [paths[i] for i in np.unique(np.linspace(0, len(paths) - 1, min(_LOOK, len(paths))).round().astype(int))]
    for path in some:
        raw = read_image(path)
        pattern = None if sensor.tile == (1, 1) else np.zeros(sensor.tile, int)
        if not find_boards(raw, boards, pattern):
            if any(board.kind == "charuco" for board in boards) and find_boards(np.ascontiguousarray(raw[:, ::-1]), boards, pattern):
                return f"{path.name} of '{sensor.name}' is mirrored, expected frames as the sensor saw them."
            for board in boards:
                other = find_boards(raw, [board.model_copy(update={"inverted": not board.inverted})], pattern)
                if other:
                    stated = str(not board.inverted).lower()
                    return f"black and white of the {board} in {path.name} of '{sensor.name}' are exchanged, expected inverted = {stated}."
                said = _other_size(raw, sensor, board)
                if said:
                    return f"{path.name} of '{sensor.name}' shows {said}."
    return None


def _other_size(raw: np.ndarray, sensor: SensorFrames, board: Board) -> str | None:
    grey = level_channels(raw.astype(np.float32) if raw.ndim == 2 else raw[..., :3].mean(-1).astype(np.float32), sensor.tile)
    picture = (255 * np.sqrt(np.clip(grey / max(float(np.quantile(grey, 0.995)), 1e-9), 0, 1))).astype(np.uint8)
    if board.inverted:
        picture = 255 - picture
    if board.kind == "chessboard":
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_LARGER
        found, _, meta = cv2.findChessboardCornersSBWithMeta(picture, (3, 3), flags)
        if found:
            rows, columns = (n + 1 for n in np.shape(meta)[:2])
            if sorted((rows, columns)) != sorted(board.squares):
                return f"a chessboard of {columns}x{rows} squares, expected {board.squares[0]}x{board.squares[1]} as board.toml states"
    if board.kind == "charuco":
        names = [n for n in dir(cv2.aruco) if n.startswith("DICT_") and n.endswith(("1000", "ORIGINAL"))]
        found_in = detect_markers(picture, [getattr(cv2.aruco, name) for name in names])
        counts = {name: sorted(marker for marker, _ in found) for name, found in zip(names, found_in, strict=True)}
        name = max(counts, key=lambda n: len(counts[n]))
        if len(counts[name]) >= 4:
            ids, last = counts[name], board.first_id + board.squares[0] * board.squares[1] // 2 - 1
            seen = f"markers {ids[0]} to {ids[-1]} of {name.rsplit('_', 1)[0]}"
            return f"{seen}, expected markers {board.first_id} to {last} of {board.dictionary} as on a {board}"
    return None


def flipped(alone: Alone, view: View) -> str | None:
    """Whether a board that does not fit would if its frame were flipped."""
    camera = alone.adjusted.state.cameras[0]
    usual = float(np.median([np.sqrt((r**2).sum(1).mean()) for r in alone.adjusted.residuals]))
    w, h = camera.width - 1, camera.height - 1
    ways = {"left to right": ([w, 0], [-1, 1]), "top to bottom": ([0, h], [1, -1]), "by half a turn": ([w, h], [-1, -1])}
    for way, (shift, sign) in ways.items():
        # mirrored corners are those of a mirrored board
        points = view.points * [1, np.prod(sign), 1]
        other = replace(view, points=points, pixels=shift + view.pixels * sign)
        pose = board_pose(camera, other)
        if pose is not None and np.sqrt((errors_of(camera, other, pose) ** 2).mean()) < 2 * usual:
            return f"it fits when the frame is flipped {way}"
    return None


def check_joined(
    apart: Sequence[str], placed: Iterable[str], unclear: Sequence[str], poses: Mapping[str, Mapping[Any, np.ndarray]], where: str
) -> None:
    """Raises InputError: sensors that no board joins to the others, or whose place boards that look the same turned leave open."""
    if apart:
        others, first = ", ".join(f"'{n}'" for n in placed), ", ".join(f"'{n}'" for n in apart)
        names = ", ".join(sorted({str(key[0]) for key in poses[apart[0]]})[:3])
        raise InputError(
            f"{where}: no overlap between {first} and {others}: they see no board at the same instant "
            f"(instants of '{apart[0]}': {names}, ...); expected frames of equal names, or each sensor calibrated alone."
        )
    if unclear:
        raise InputError(
            f"{where}: the place of '{unclear[0]}' on the rig is open: its boards look the same when turned, and all leave the same "
            f"choice; expected more instants with the board elsewhere, or a board with an odd and an even side."
        )


def check_synchronous(names: Sequence[str], keys: Sequence[tuple[str, Any]], views: Sequence[View], adjusted: Adjusted, where: str) -> None:
    """Raises InputError: boards of a sensor fit by themselves and not together with the others, the less the faster they move."""
    speed = _speeds(sorted({key for _, key in keys}, key=str), views, adjusted)
    worst: tuple[float, str] | None = None
    for s, name in enumerate(names):
        together, itself, speeds = [], [], []
        for (_, key), view, residuals in zip(keys, views, adjusted.residuals, strict=True):
            if view.sensor != s or sum(v.pose == view.pose for v in views) < 2:
                continue
            camera = adjusted.state.cameras[s]
            pose = board_pose(camera, view)
            if pose is not None and key in speed:
                together.append(float(np.median(np.linalg.norm(residuals, axis=1))))
                itself.append(float(np.median(errors_of(camera, view, pose))))
                speeds.append(speed[key])
        if len(together) < 5:
            continue
        ratio = float(np.median(together)) / max(float(np.median(itself)), 1e-3)
        if ratio > _APART and np.median(together) > _LEAST:
            ranks = [np.argsort(np.argsort(values)) for values in (together, speeds)]
            grows = float(np.corrcoef(ranks[0], ranks[1])[0, 1])
            said = f"grow with the board's speed (correlation {grows:.2f})" if grows > _GROWS else "do not depend on the board's speed"
            text = (
                f"{where}: the instants of '{name}' are not those of the other sensors: its boards are off by {np.median(together):.1f} px "
                f"together with theirs and {np.median(itself):.2f} px by themselves, and the residuals {said}; "
                f"expected frames of equal names taken at one time."
            )
            if worst is None or ratio > worst[0]:
                worst = ratio, text
    if worst is not None:
        raise InputError(worst[1])


def _speeds(keys: Sequence[Any], views: Sequence[View], adjusted: Adjusted) -> dict[Any, float]:
    """How far a board moves from the instants before and after, by key."""
    out: dict[Any, float] = {}
    for board in {key[1] for key in keys}:
        own = [key for key in keys if key[1] == board]
        places = np.stack([adjusted.state.boards[list(keys).index(key)][:3, 3] for key in own])
        steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
        for i, key in enumerate(own):
            around = steps[max(0, i - 1) : i + 1]
            if len(around):
                out[key] = float(around.mean())
    return out


def check_focal(name: str, camera: Camera, deviations: Mapping[str, Any], where: str) -> None:
    """Raises InputError: the boards leave the focal length open, as those that all face the sensor do."""
    share = deviations["fx"] / camera.fx
    if not share < _OPEN:
        said = "is not determined" if not np.isfinite(share) else f"is known to {100 * share:.0f} % only"
        raise InputError(
            f"{where}: the focal length of '{name}' {said}: its boards all face it, and distance and focal length cannot be told apart; "
            f"expected boards tilted by 20 to 50 degrees."
        )


def problems_of(name: str, sensor: SensorFrames, camera: Camera, result: Any, seen: Sequence[Any]) -> list[str]:
    """What a user should know about a sensor that was calibrated."""
    out = []
    share = result.deviations["fx"] / camera.fx
    if share > _WIDE:
        out.append(f"{name}: the focal length is known to {100 * share:.1f} % only; more boards at 20 to 50 degrees of tilt would help.")
    without = sum(not several for several in sensor.found.values())
    if 2 * without > len(sensor.files):
        out.append(f"{name}: no board is seen in {without} of {len(sensor.files)} frames; its band may not tell ink from paper.")
    if result.blind:
        places = ", ".join(f"row {i} column {j}" for i, j in result.blind)
        out.append(f"{name}: the photosites at {places} of the mosaic's tile hardly see the boards and are not used for corners.")
    if result.coverage < _BARE:
        out.append(f"{name}: corners cover {100 * result.coverage:.0f} % of the picture; the lens is extrapolated over the rest.")
    share = pattern_of(camera, seen)
    if share > _PATTERN:
        out.append(
            f"{name}: the residuals follow a pattern over the picture ({100 * share:.0f} % of them): the lens is none of those that were "
            f"tried, or the boards are not flat."
        )
    if "mosaick_pattern" not in sensor.described and sensor.tile != (1, 1):
        out.append(f"{name}: frames are a {sensor.tile[0]}x{sensor.tile[1]} mosaic of unknown channels; add mosaick_pattern to the result.")
    return out


def pattern_of(camera: Camera, seen: Sequence[Any]) -> float:
    """Share of the residuals' squares that a cubic in the place explains, beyond what it would of noise."""
    pixels = np.concatenate([view.pixels for view in seen])
    residuals = np.concatenate([view.residuals for view in seen])
    x, y = ((pixels - [camera.cx, camera.cy]) / max(camera.width, camera.height)).T
    terms = np.stack([x**i * y**j for i in range(6) for j in range(6 - i)], 1)
    if len(terms) < 4 * terms.shape[1]:
        return 0.0
    left = residuals - terms @ np.linalg.lstsq(terms, residuals, rcond=None)[0]
    ratio = (left**2).sum() / max((residuals**2).sum(), 1e-300) / (1 - terms.shape[1] / len(terms))
    return max(0.0, 1 - float(ratio))
