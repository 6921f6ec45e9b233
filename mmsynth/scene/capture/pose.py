"""From a capture without poses to a scene: structure from motion, its unit, a region of interest, an MMS-DATA scene of the raw frames."""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mmsynth.errors import InputError
from mmsynth.files import write_json
from mmsynth.scene.capture.board import Board
from mmsynth.scene.capture.matching import Picture, Shot, focal_length_of, load_pycolmap
from mmsynth.scene.capture.matching_picture import matching_picture
from mmsynth.scene.capture.metric import BoardScale, scale_of_boards
from mmsynth.scene.capture.source import Capture, check_size, pictures_of
from mmsynth.scene.capture.structure import Structure, reconstruct, scaled
from mmsynth.scene.image_writers import write_png
from mmsynth.scene.images import read_native
from mmsynth.scene.layouts.mmsdata import meta_content
from mmsynth.scene.region import region_from_cameras, region_from_points
from mmsynth.scene.scene import Frame, PosedCamera, Region
from mmsynth.sensors.camera import Camera

_FOCAL = 1.2  # of the longer side, where nothing is known: 45 degrees

Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class PosedCapture:
    """A capture and where its pictures were taken.

    Attributes:
        structure: in the frame and unit that are stated here.
        unit: "m" or "input unit"; unit_from: how it is known, a sentence.
        lost: why a picture has no pose, by sensor and view. notes: what else is to be said.
    """

    capture: Capture
    structure: Structure
    region: Region
    unit: str
    unit_from: str
    lost: dict[Shot, str]
    notes: tuple[str, ...]


def pose_capture(capture: Capture, boards: Sequence[Board] = (), *, progress: Progress | None = None) -> PosedCapture:
    """Find the pose of every picture.

    Sensors that are calibrated keep their intrinsics and lens, and with places on a rig of several sensors one pose is found for each
    instant, in metres. Other cameras are found with the poses.

    Args:
        boards: that stand in the scene, from which the unit is found; on a calibrated rig they only check its baselines.
    Raises:
        InputError: as ``reconstruct``, or a picture that cannot be read or has not the size that the calibration says.
    """
    load_pycolmap()
    rig = {s.sensor.name: s.camera_to_reference for s in capture.sensors if s.camera_to_reference is not None}
    as_rig = capture.calibrated and len(capture.sensors) > 1
    with tempfile.TemporaryDirectory(prefix="mmsynth_pose_") as temporary:
        folder, work = Path(temporary) / "pictures", Path(temporary) / "work"
        work.mkdir()
        pictures, lost = _prepare(capture, folder, progress)
        structure = reconstruct(folder, work, pictures, rig if as_rig else None, str(capture.root))
    baselines = [float(np.linalg.norm(place[:3, 3])) for place in rig.values()] if as_rig else []
    notes = [*capture.notes, *structure.notes]
    unit, unit_from = "input unit", "the reconstruction's own unit, because neither a board nor a rig's baselines were given"
    found = _board_scale(capture, structure, boards) if boards else None
    if any(baselines):
        unit, unit_from = "m", f"metres, from the rig's {len(baselines) - 1} baselines of up to {max(baselines):.3g} m"
        if found:
            apart = 1.0 / found.scale - 1.0
            notes.append(f"By the boards' {found.corners} corners lengths are {apart:+.3%} off (± {found.deviation:.3%}); the rig's count.")
    elif found:
        structure = scaled(structure, found.scale)
        seen_by = f"{found.corners} corners of {found.boards_seen} boards seen in {found.frames} frames"
        unit, unit_from = "m", f"metres, from {seen_by}, to {found.deviation:.2%}"
    shots = structure.registered.values()
    seen = region_from_cameras([shot.camera for shot in shots], [shot.camera_to_world for shot in shots])
    region = region_from_points(structure.points, seen, np.stack([shot.camera_to_world[:3, 3] for shot in shots]))
    return PosedCapture(capture, structure, region, unit, unit_from, {**lost, **structure.lost}, tuple(notes))


def _board_scale(capture: Capture, structure: Structure, boards: Sequence[Board]) -> BoardScale:
    """By the first sensor that sees boards."""
    problems = []
    for captured in capture.sensors:
        name = captured.sensor.name
        shots = {view: shot for (of, view), shot in structure.registered.items() if of == name}
        frames = [Frame(name, v, captured.files[v], shot.camera, shot.camera_to_world) for v, shot in shots.items()]
        try:
            return scale_of_boards(frames, captured.sensor, boards, str(capture.root))
        except InputError as error:
            problems.append(error)
    raise problems[0]


def _prepare(capture: Capture, folder: Path, progress: Progress | None) -> tuple[list[Picture], dict[Shot, str]]:
    """Write the pictures for matching; those that are bit-identical to one before are left out."""
    total = sum(len(captured.files) for captured in capture.sensors)
    pictures: list[Picture] = []
    lost: dict[Shot, str] = {}
    for captured in capture.sensors:
        seen: dict[bytes, Path] = {}
        for view, path in captured.files.items():
            if progress:
                progress(len(pictures) + len(lost), 2 * total, "pictures")
            name = captured.sensor.name
            image = read_native(path)
            height, width = image.shape[:2]
            if captured.camera is not None:
                check_size(captured.camera, image, path)
            grey = matching_picture(image, captured.sensor)
            first = seen.setdefault(hashlib.sha256(grey.tobytes()).digest(), path)
            if first is not path:
                lost[name, view] = f"the same picture as {first.name}"
                continue
            file = f"{name}/{view:09d}.png"
            write_png(folder / file, grey)
            stated = None if captured.camera else focal_length_of(path)
            camera = captured.camera or _guess(width, height, stated or _FOCAL)
            pictures.append(Picture(name, view, file, camera, captured.camera is not None, stated is not None))
        if len(captured.files) > 1 and len(seen) == 1:
            raise InputError(f"{capture.root}: all {len(captured.files)} pictures of '{name}' are the same, expected a camera that moves.")
    if len(pictures) < 3:
        raise InputError(f"{capture.root}: {len(pictures)} pictures, expected at least 3.")
    return pictures, lost


def _guess(width: int, height: int, focal: float) -> Camera:
    length = focal * max(width, height)
    return Camera(width, height, length, length, (width - 1) / 2, (height - 1) / 2)


def write_posed(posed: PosedCapture, out: Path) -> Path:
    """Write the scene: ``meta_data.json``, the frames as they are below ``modalities/``, and COLMAP's model below ``sparse/0``.

    Frames are linked where the file system can, else copied. Gives the folder.

    Raises:
        InputError: it is the capture's own folder, or cannot be written.
    """
    out = Path(out)
    root = posed.capture.root.resolve()
    if out.resolve() == root:
        raise InputError(f"{out}: is the capture itself, expected another folder for the scene.")
    frames: dict[str, dict[int, PosedCamera]] = {}
    names: dict[Shot, str] = {}
    for captured, view, path in pictures_of(posed.capture):
        shot = posed.structure.registered.get((captured.sensor.name, view))
        if shot is None:
            continue
        frames.setdefault(captured.sensor.name, {})[view] = PosedCamera(shot.camera, shot.camera_to_world, path.name)
        names[captured.sensor.name, view] = f"{captured.sensor.name}/{path.name}"
        _link(path, out / "modalities" / captured.sensor.name / path.name)
    sensors = [captured.sensor for captured in posed.capture.sensors if captured.sensor.name in frames]
    content = meta_content(out, sensors, frames, posed.region, posed.unit, own_cameras=True)
    _write_model(posed.structure.model, out / "sparse" / "0", names)
    write_json(out / "meta_data.json", content)
    return out


def _link(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    with suppress(FileNotFoundError):
        target.unlink()
    try:
        os.link(source.resolve(), target)
    except OSError:
        try:
            shutil.copyfile(source, target)
        except OSError as error:
            raise InputError(f"{target}: could not be written ({error.strerror or error}).") from error


def _write_model(model: Any, folder: Path, names: dict[Shot, str]) -> None:
    """COLMAP's binary model, its pictures named as they lie below ``modalities``."""
    for image in model.images.values():
        sensor, view = image.name.removesuffix(".png").rsplit("/", 1)
        image.name = names.get((sensor, int(view)), image.name)
    folder.mkdir(parents=True, exist_ok=True)
    model.write_binary(folder)
