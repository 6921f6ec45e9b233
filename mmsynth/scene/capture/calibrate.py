"""A rig from frames of calibration boards: ``calibrate`` joins detection, each sensor alone, the rig's topology, and the joint adjustment.

Boards and frames that do not fit are left out and named with the reason; what cannot be calibrated at all is refused in one sentence.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mmsynth.errors import InputError
from mmsynth.scene.capture import diagnosis
from mmsynth.scene.capture.adjustment import Adjusted, RigState, View, adjust
from mmsynth.scene.capture.board import Board, corner_points
from mmsynth.scene.capture.board_frames import SensorFrames, find_in_frames, list_frames
from mmsynth.scene.capture.detection import Detection
from mmsynth.scene.capture.expected import find_where_expected
from mmsynth.scene.capture.lens_choice import MODELS, Alone, board_pose, calibrate_alone, errors_of, plain_camera
from mmsynth.scene.capture.topology import Key, place_sensors, relabelled
from mmsynth.scene.layouts.calibration import Rig, RigSensor
from mmsynth.scene.motion import inverse
from mmsynth.scene.scene import canonical_modality
from mmsynth.sensors.camera import COEFFICIENTS, Camera
from mmsynth.threads import usable_cores

LEAST_BOARDS = 4
_BAD_BOARD, _BAD_SCALE = 3.0, 5.0  # medians of the boards' rms, and standard deviations, beyond which a board is left out
_BAD_CORNER = 5.0  # standard deviations of a corner's two coordinates
_LEAST_DEVIATION = 0.002  # px
_VAGUE, _ENOUGH = 4.0, 6  # spread of a corner that says nothing where there are enough others
_ROUNDS = 4  # of leaving out and adjusting again


@dataclass(frozen=True)
class LeftOut:
    """A board (None: the whole frame) that was not used, and why."""

    sensor: str
    instant: str
    board: int | None
    why: str


@dataclass(frozen=True)
class Seen:
    """A board that was used: what its corners came to.

    Attributes:
        ids: (N,). pixels: (N, 2). residuals: (N, 2) px, measured minus modelled.
    """

    sensor: str
    instant: str
    board: int
    ids: np.ndarray
    pixels: np.ndarray
    residuals: np.ndarray

    @property
    def rms(self) -> float:
        """Root mean square length of the residuals [px], as OpenCV states it."""
        return float(np.sqrt((self.residuals**2).sum(1).mean()))


@dataclass(frozen=True)
class SensorResult:
    """One sensor of a calibrated rig.

    Attributes:
        model: pinhole, brown4, brown5, brown8 or fisheye. held_out: error of each model that was tried at corners it was not fitted to, px.
        rms: px, root mean square length of the residuals. sigma: px, standard deviation of a corner's coordinate.
        deviations: standard deviation of each parameter: fx fy cx cy and coefficients; ``position`` [m] along the reference's axes and
            ``rotation`` [degrees] about the sensor's, three each, of all sensors but the reference.
        frames: how many there are; boards, corners: how many are used.
        coverage: share of the picture's 8x8 fields that hold a corner.
        blind: places (row, column) of the mosaic's tile that hardly tell black from white on the boards.
    """

    model: str
    held_out: Mapping[str, float]
    rms: float
    sigma: float
    deviations: Mapping[str, Any]
    frames: int
    boards: int
    corners: int
    coverage: float
    blind: tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class Calibration:
    """What ``calibrate`` came to.

    Attributes:
        rig: as ``write_calibration`` takes it; the first is the reference.
        sensors: by canonical name. boards: those that were looked for.
        seen: every board that was used. left_out: every one that was not, and every frame without a board.
        poses: (4, 4) points of a board → of the reference's camera, by instant and board.
        problems: one sentence each.
    """

    rig: Rig
    sensors: Mapping[str, SensorResult]
    boards: tuple[Board, ...]
    seen: tuple[Seen, ...]
    left_out: tuple[LeftOut, ...]
    poses: Mapping[Key, np.ndarray]
    problems: tuple[str, ...]


@dataclass(frozen=True)
class _Sight:
    """A board in a frame with the labels that the rig gives it."""

    sensor: str
    key: Key
    ids: np.ndarray
    pixels: np.ndarray
    spread: np.ndarray


def calibrate(
    folder: Path,
    boards: Sequence[Board],
    *,
    reference: str | None = None,
    workers: int | None = None,
    progress: Callable[[int, int], Any] | None = None,
) -> Calibration:
    """Calibrate the sensors of a folder of board frames (``board_frames``).

    Args:
        reference: the sensor whose camera is the rig's frame; None: rgb if there is one, else the first.
        workers: frames looked at at once; None: one for each core.
        progress: called with frames looked at and their number.
    Raises:
        InputError: nothing to calibrate, too few boards (how many more), a board other than stated, sensors that share no boards, frames
            that are the same or mirrored, instants that are not one instant, or boards that leave a focal length open.
    """
    sensors = list_frames(folder)
    names = list(sensors)
    chosen = canonical_modality(reference) if reference else ("rgb" if "rgb" in names else names[0])
    if chosen not in sensors:
        raise InputError(f"{folder}: no sensor '{reference}' to be the reference, expected one of {', '.join(names)}.")
    order = [chosen, *(name for name in names if name != chosen)]
    total, done = sum(len(sensor.files) for sensor in sensors.values()), 0
    count = workers or usable_cores()
    for name in order:
        sensors[name] = find_in_frames(sensors[name], boards, count, progress, done, total)
        done += len(sensors[name].files)
    return calibrate_found({name: sensors[name] for name in order}, boards, str(folder), count)


def calibrate_found(sensors: Mapping[str, SensorFrames], boards: Sequence[Board], where: str, look_again: int = 0) -> Calibration:
    """``calibrate`` from boards that were found already; the first sensor is the reference.

    Args:
        where: begins errors. look_again: frames that are looked at once more at a time, for boards that other sensors see; 0: none.
    """
    diagnosis.check_same_files(sensors, where)
    left_out = _frames_without(sensors)
    usual = {name: _usual_deviation(sensor) for name, sensor in sensors.items()}
    sights = [
        _sight(name, instant, found, usual[name])
        for name, sensor in sensors.items()
        for instant, several in sensor.found.items()
        for found in several
        if instant not in sensor.same
    ]
    alone: dict[str, Alone] = {}
    poses: dict[str, dict[Key, np.ndarray]] = {}
    for name, sensor in sensors.items():
        own = [sight for sight in sights if sight.sensor == name]
        if len(own) < LEAST_BOARDS:
            raise InputError(f"{where}: {_too_few(name, sensor, len(own), boards)}")
        result = calibrate_alone(sensor.size, [_view(sight, 0, i, boards) for i, sight in enumerate(own)])
        if result is None:
            raise InputError(f"{where}: no lens explains the boards of '{name}', expected a board as board.toml states it.")
        alone[name] = result
        bad = _bad_boards(result, own)
        for i, why in bad.items():
            left_out.append(LeftOut(name, str(own[i].key[0]), own[i].key[1], diagnosis.flipped(result, _view(own[i], 0, i, boards)) or why))
        if len(own) - len(bad) < LEAST_BOARDS:
            raise InputError(
                f"{where}: the boards of '{name}' do not agree with each other, {len(bad)} of {len(own)} are off by more than "
                f"{_BAD_BOARD:g} times the median; expected boards that are flat, at rest and as board.toml states them."
            )
        poses[name] = {sight.key: result.adjusted.state.boards[i] for i, sight in enumerate(own) if i not in bad}
    sights = [sight for sight in sights if sight.key in poses[sight.sensor]]
    placed = place_sensors(poses, next(iter(sensors)), boards)
    diagnosis.check_joined(placed.apart, placed.to_reference, placed.unclear, poses, where)
    sights = [
        replace(sight, ids=relabelled(boards[sight.key[1]], sight.ids, turn))
        if (turn := placed.turned.get((sight.sensor, sight.key)))
        else sight
        for sight in sights
    ]
    names = list(sensors)
    state = RigState(
        tuple(alone[name].adjusted.state.cameras[0] for name in names),
        tuple(np.array([0, 1, 2, 3, *(4 + k for k in MODELS[alone[name].model][1])]) for name in names),
        np.stack([inverse(placed.to_reference[name]) for name in names]),
        np.zeros((0, 4, 4)),
    )
    sights, keys, adjusted, dropped = _adjust_rig(names, state, placed.boards, sights, boards, where)
    left_out += dropped
    if look_again and len(names) > 1:
        places = dict(zip(keys, adjusted.state.boards, strict=True))
        known = {(s.sensor, s.key) for s in sights} | {(out.sensor, (out.instant, out.board)) for out in left_out if out.board is not None}
        more = [
            _sight(name, str(key[0]), found, usual[name])
            for s, name in enumerate(names)
            for key, found in find_where_expected(
                sensors[name], s, adjusted.state, places, boards, {key for of, key in known if of == name}, look_again
            ).items()
        ]
        if more:
            sights, keys, adjusted, dropped = _adjust_rig(names, adjusted.state, places, [*sights, *more], boards, where)
            frames = {(sight.sensor, str(sight.key[0])) for sight in more}
            left_out = [out for out in left_out if out.board is not None or (out.sensor, out.instant) not in frames] + dropped
    return _result(sensors, alone, sights, keys, adjusted, left_out, boards, where)


def _view(sight: _Sight, sensor: int, pose: int, boards: Sequence[Board]) -> View:
    return View(sensor, pose, corner_points(boards[sight.key[1]])[sight.ids], sight.pixels, sight.spread)


def _sight(name: str, instant: str, found: Detection, usual: float) -> _Sight:
    """A corner's error has two parts of one size where it is a usual one: what the pixels' scatter says of it, and what it does not."""
    known = np.where(np.isfinite(found.deviation), found.deviation, usual)
    spread = np.sqrt((1 + (known / usual) ** 2) / 2)
    clear = spread < _VAGUE if (spread < _VAGUE).sum() >= _ENOUGH else np.isfinite(spread)
    return _Sight(name, (instant, found.board), found.ids[clear], found.pixels[clear], spread[clear])


def _usual_deviation(sensor: SensorFrames) -> float:
    """Median px of the corners' deviations, by the pixels' scatter."""
    each = [found.deviation for several in sensor.found.values() for found in several]
    known = np.concatenate([np.zeros(0), *each])
    known = known[np.isfinite(known)]
    return max(float(np.median(known)), _LEAST_DEVIATION) if len(known) else 1.0


def _frames_without(sensors: Mapping[str, SensorFrames]) -> list[LeftOut]:
    out = []
    for name, sensor in sensors.items():
        for instant, several in sensor.found.items():
            if instant in sensor.same:
                out.append(LeftOut(name, instant, None, f"the same picture as {sensor.same[instant]}"))
            elif not several:
                others = [other for other, s in sensors.items() if other != name and s.found.get(instant)]
                out.append(LeftOut(name, instant, None, f"no board is seen, but by {', '.join(others)}" if others else "no board is seen"))
    return out


def _too_few(name: str, sensor: SensorFrames, count: int, boards: Sequence[Board]) -> str:
    return diagnosis.why_no_board(sensor, boards) or (
        f"sensor '{name}' sees {count} board{'' if count == 1 else 's'} in {len(sensor.files)} frames, expected at least {LEAST_BOARDS}: "
        f"{LEAST_BOARDS - count} more, at other angles."
    )


def _bad_boards(alone: Alone, sights: Sequence[_Sight]) -> dict[int, str]:
    """Rows of boards most of whose corners disagree with the others of their own sensor."""
    rms = np.array(
        [
            np.sqrt(np.median(((r / s.spread[:, None]) ** 2).sum(1)) / np.log(2))
            for r, s in zip(alone.adjusted.residuals, sights, strict=True)
        ]
    )
    typical, sigma = float(np.median(rms)), float(alone.adjusted.sigma[0])
    limit = max(_BAD_BOARD * typical, 1.4 * min(_BAD_SCALE * sigma, _BAD_SCALE * typical))
    return {
        i: f"its corners are off by {value:.2f} px from the other boards' camera, where {typical:.2f} px are usual"
        for i, value in enumerate(rms)
        if value > limit
    }


def _adjust_rig(
    names: Sequence[str], state: RigState, poses: Mapping[Key, np.ndarray], sights: Sequence[_Sight], boards: Sequence[Board], where: str
) -> tuple[list[_Sight], list[Key], Adjusted, list[LeftOut]]:
    """Adjust, leave out what does not fit, adjust again until nothing is left out; ``state`` and ``poses`` are where it starts."""
    start = dict(poses)
    left_out: list[LeftOut] = []
    sights = list(sights)
    for round_ in range(_ROUNDS):
        keys = sorted({sight.key for sight in sights}, key=str)
        row = {key: i for i, key in enumerate(keys)}
        views = [_view(sight, names.index(sight.sensor), row[sight.key], boards) for sight in sights]
        adjusted = adjust(replace(state, boards=np.stack([start[key] for key in keys])), views, "cauchy" if round_ == 0 else "huber")
        state = adjusted.state
        start.update(zip(keys, adjusted.state.boards, strict=True))
        if round_ == 0 and len(names) > 1:
            diagnosis.check_synchronous(names, [(s.sensor, s.key) for s in sights], views, adjusted, where)
        kept: list[_Sight] = []
        changed = round_ == 0
        limits = _limits(names, sights, adjusted)
        for sight, residuals, view in zip(sights, adjusted.residuals, views, strict=True):
            s = names.index(sight.sensor)
            length = np.linalg.norm(residuals, axis=1)
            even = length / sight.spread
            good = even < _BAD_CORNER * adjusted.sigma[s] * 1.2
            if good.sum() < max(4, 0.5 * len(good)) or np.sqrt((even[good] ** 2).mean()) > limits[s]:
                rms = float(np.sqrt((length**2).mean()))
                own = board_pose(state.cameras[s], view)
                by_itself = float(np.sqrt((errors_of(state.cameras[s], view, own) ** 2).mean())) if own is not None else np.inf
                why = f"its corners are off by {rms:.2f} px"
                why += f", {by_itself:.2f} px by itself: not where the other sensors see it" if by_itself < 0.5 * rms else " even by itself"
                left_out.append(LeftOut(sight.sensor, str(sight.key[0]), sight.key[1], why))
                changed = True
                continue
            if not good.all():
                changed = True
            kept.append(sight if good.all() else _part(sight, good))
        if not changed or round_ == _ROUNDS - 1:
            break
        sights = kept
        for name in names:
            own_count = sum(sight.sensor == name for sight in sights)
            if own_count < LEAST_BOARDS:
                raise InputError(
                    f"{where}: of the boards of '{name}' only {own_count} agree with the other sensors', expected at least {LEAST_BOARDS}."
                )
    return sights, keys, adjusted, left_out


def _part(sight: _Sight, keep: np.ndarray) -> _Sight:
    return replace(sight, ids=sight.ids[keep], pixels=sight.pixels[keep], spread=sight.spread[keep])


def _limits(names: Sequence[str], sights: Sequence[_Sight], adjusted: Adjusted) -> np.ndarray:
    """(S,) px: the rms, of corners brought to one spread, from which a board of a sensor is left out."""
    rms = np.array([np.sqrt(((r / s.spread[:, None]) ** 2).sum(1).mean()) for r, s in zip(adjusted.residuals, sights, strict=True)])
    own = np.array([names.index(sight.sensor) for sight in sights])
    return np.array([max(_BAD_BOARD * float(np.median(rms[own == s])), 3 * adjusted.sigma[s]) for s in range(len(names))])


def _result(
    sensors: Mapping[str, SensorFrames], alone: Mapping[str, Alone], sights: Sequence[_Sight], keys: Sequence[Key], adjusted: Adjusted,
    left_out: Sequence[LeftOut], boards: Sequence[Board], where: str,
) -> Calibration:  # fmt: skip
    names = list(sensors)
    seen = [
        Seen(sight.sensor, str(sight.key[0]), sight.key[1], sight.ids, sight.pixels, residuals)
        for sight, residuals in zip(sights, adjusted.residuals, strict=True)
    ]
    results: dict[str, SensorResult] = {}
    rig: Rig = {}
    problems: list[str] = []
    for s, name in enumerate(names):
        own = [view for view in seen if view.sensor == name]
        camera = plain_camera(adjusted.state.cameras[s], MODELS[alone[name].model][1])
        place = inverse(adjusted.state.to_sensor[s]) if s else np.eye(4)
        rig[name] = RigSensor(camera, place, sensors[name].described, sensors[name].source_name)
        deviations = _deviations(adjusted, s, place, camera)
        residuals = np.concatenate([view.residuals for view in own])
        results[name] = SensorResult(
            alone[name].model, alone[name].scores, float(np.sqrt((residuals**2).sum(1).mean())), float(adjusted.sigma[s]), deviations,
            len(sensors[name].files), len(own), len(residuals), _coverage(sensors[name].size, own), _blind(sensors[name]),
        )  # fmt: skip
        diagnosis.check_focal(name, camera, deviations, where)
        problems += diagnosis.problems_of(name, sensors[name], camera, results[name], own)
    poses = {key: pose for key, pose in zip(keys, adjusted.state.boards, strict=True)}
    return Calibration(rig, results, tuple(boards), tuple(seen), tuple(left_out), poses, tuple(problems))


def _deviations(adjusted: Adjusted, s: int, place: np.ndarray, camera: Camera) -> dict[str, Any]:
    free, start = adjusted.state.free[s], adjusted.starts[s]
    names = ("fx", "fy", "cx", "cy", *COEFFICIENTS[camera.lens])
    spread = np.sqrt(np.diag(adjusted.covariance))
    out: dict[str, Any] = {names[k]: float(spread[start + i]) for i, k in enumerate(free)}
    if s:
        at = start + len(free)
        turned = place[:3, :3]
        position = turned @ adjusted.covariance[at + 3 : at + 6, at + 3 : at + 6] @ turned.T
        out["position"] = [float(x) for x in np.sqrt(np.diag(position))]
        out["rotation"] = [float(x) for x in np.degrees(spread[at : at + 3])]
    return out


def _coverage(size: tuple[int, int], seen: Sequence[Seen]) -> float:
    pixels = np.concatenate([view.pixels for view in seen])
    fields = np.clip((8 * (pixels + 0.5) / size).astype(int), 0, 7)
    return len(np.unique(fields, axis=0)) / 64


def _blind(sensor: SensorFrames) -> tuple[tuple[int, int], ...]:
    """Places of the tile that did not see most of the boards."""
    found = [detection for several in sensor.found.values() for detection in several]
    places = {place for detection in found for place in detection.blind}
    return tuple(sorted(place for place in places if 2 * sum(place in d.blind for d in found) > len(found)))
