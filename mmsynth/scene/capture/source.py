"""A capture without poses as it lies on disk: which pictures belong to which sensor and instant, and what is known of their cameras.

``modalities/<sensor>/<view>.png`` (a source scene of MMS-DATA), one folder for each sensor, or one folder of photographs. Pictures of equal
names are one instant of the rig. An instant's view id is the number that its name is, where all names are numbers, else its place.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mmsynth.errors import InputError
from mmsynth.scene.images import SUFFIXES, read_native
from mmsynth.scene.known_sensors import make_sensor
from mmsynth.scene.layouts.calibration import Rig, read_calibration
from mmsynth.scene.scene import MAX_VIEW, Sensor, canonical_modality
from mmsynth.sensors.camera import Camera

_PHOTOS = ("images", "image", "input", "photos", "pictures")  # a folder of photographs, whose name is no sensor's


@dataclass(frozen=True)
class CapturedSensor:
    """The pictures of one sensor.

    Attributes:
        source_name: its folder.
        files: by view id.
        camera: as calibrated; None: to be found with the poses.
        camera_to_reference: (4, 4) its calibrated place on the rig, metres; None where there is none.
    """

    sensor: Sensor
    source_name: str
    files: dict[int, Path]
    camera: Camera | None = None
    camera_to_reference: np.ndarray | None = None


@dataclass(frozen=True)
class Capture:
    """What ``read_capture`` found: sensors, the reference first; ``notes``: one sentence for what was left out or taken to be."""

    root: Path
    sensors: tuple[CapturedSensor, ...]
    notes: tuple[str, ...] = field(default=())

    @property
    def calibrated(self) -> bool:
        """Whether every sensor has its camera and its place on the rig."""
        return all(s.camera is not None and s.camera_to_reference is not None for s in self.sensors)


def read_capture(root: Path, calibration: Path | None = None, reference: str | None = None) -> Capture:
    """List a capture.

    Args:
        calibration: ``calibration.json`` of the rig; None: the one in the folder, if there is one. Sensors that it lacks are left out.
        reference: the sensor that the others stand by; None: the calibration's first, else rgb, else the first by name.
    Raises:
        InputError: no pictures, unknown reference, a bad calibration, or pictures of another size than it says.
    """
    root = Path(root)
    if not root.is_dir():
        raise InputError(f"{root}: no such folder, expected pictures or a folder of them for each sensor.")
    if calibration is None and (root / "calibration.json").is_file():
        calibration = root / "calibration.json"
    rig = {} if calibration is None else read_calibration(calibration)
    folders, notes = _folders(root, rig)
    if rig:
        unknown = [name for name in folders if name not in rig]
        notes += [f"{folders[name][0].name}: not in {calibration}, its pictures are left out." for name in unknown]
        notes += [f"{name}: in {calibration}, but {root} has no pictures of it." for name in rig if name not in folders]
        folders = {name: folders[name] for name in rig if name in folders}
        if not folders:
            raise InputError(f"{calibration}: has the sensors {', '.join(rig)}, but {root} has pictures of {', '.join(unknown)}.")
    if not folders:
        raise InputError(f"{root}: no pictures ({' '.join(SUFFIXES)}), expected some in it or in a folder for each sensor.")
    names = _reference_first(list(folders), reference, root, calibrated=bool(rig))
    view_of = _view_ids({stem for _, files in folders.values() for stem in files})
    sensors = []
    for name in names:
        folder, files = folders[name]
        known = rig.get(name)
        raw = known is not None and "mosaick_pattern" in known.described
        first = next(iter(files.values()))
        image = read_native(first)
        sensor = make_sensor(name, known.described if known else {}, str(folder), image, raw=raw or (known is not None and image.ndim == 2))
        camera = known.camera if known else None
        if camera is not None:
            check_size(camera, image, first)
        place = np.linalg.inv(rig[names[0]].camera_to_reference) @ known.camera_to_reference if known else None
        ordered = dict(sorted((view_of[stem], path) for stem, path in files.items()))
        sensors.append(CapturedSensor(sensor, folder.name if len(folders) > 1 else name, ordered, camera, place))
    return Capture(root, tuple(sensors), tuple(notes))


def _folders(root: Path, rig: Rig) -> tuple[dict[str, tuple[Path, dict[str, Path]]], list[str]]:
    """By sensor its folder and its pictures by stem, and what is to be said."""
    base = root / "modalities" if (root / "modalities").is_dir() else root
    own, notes = _pictures(base)
    if own:
        name = next(iter(rig)) if len(rig) == 1 else canonical_modality(root.resolve().name) if root.resolve().name in rig else ""
        return {name or _by_channels(next(iter(own.values()))): (base, own)}, notes
    found: dict[str, tuple[Path, dict[str, Path]]] = {}
    for folder in sorted(path for path in base.iterdir() if path.is_dir() and not path.name.startswith(".")):
        files, said = _pictures(folder)
        if not files:
            continue
        notes += said
        name = canonical_modality(folder.name)
        if name in _PHOTOS:
            name = _by_channels(next(iter(files.values())))
        if name in found:
            raise InputError(f"{folder}: a second folder of '{name}' or an alias of it, beside {found[name][0]}, expected one.")
        found[name] = folder, files
    return found, notes


def _by_channels(path: Path) -> str:
    image = read_native(path)
    return "mono" if image.ndim == 2 or image.shape[2] == 2 else "rgb"


def _pictures(folder: Path) -> tuple[dict[str, Path], list[str]]:
    """Pictures of a folder by stem, in natural order; of those with one stem (raw and JPEG of one shot) the first of ``SUFFIXES``."""
    files = [p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and p.is_file() and not p.name.startswith(".")]
    files.sort(key=lambda path: (_natural(path.stem), SUFFIXES.index(path.suffix.lower())))
    kept: dict[str, Path] = {}
    twice = [path for path in files if kept.setdefault(path.stem, path) is not path]
    if not twice:
        return kept, []
    return kept, [
        f"{folder}: {len(twice)} pictures have the name of another but for the suffix, such as {twice[0].name}; they are left out."
    ]


def _natural(name: str) -> list[tuple[bool, int | str]]:
    """2 before 10."""
    return [(part.isdecimal(), int(part) if part.isdecimal() else part) for part in re.split(r"(\d+)", name) if part]


def _view_ids(stems: set[str]) -> Mapping[str, int]:
    ordered = sorted(stems, key=lambda stem: (_natural(stem), stem))
    numbers = [int(stem) if stem.isascii() and stem.isdecimal() else -1 for stem in ordered]
    if len(set(numbers)) == len(numbers) and all(0 <= number <= MAX_VIEW for number in numbers):
        return dict(zip(ordered, numbers, strict=True))
    return {stem: i for i, stem in enumerate(ordered)}


def _reference_first(names: list[str], reference: str | None, root: Path, calibrated: bool) -> list[str]:
    if reference is not None:
        first = canonical_modality(reference)
        if first not in names:
            raise InputError(f"--reference {reference}: {root} has no such sensor, expected one of {', '.join(names)}.")
    else:
        first = "rgb" if not calibrated and "rgb" in names else names[0]
    return [first, *(name for name in names if name != first)]


def check_size(camera: Camera, image: np.ndarray, path: Path) -> None:
    """Raises InputError: the picture has not the size of its calibrated camera."""
    height, width = image.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise InputError(f"{path}: {width}x{height} pixels, expected {camera.width}x{camera.height} as its calibration says.")


def pictures_of(capture: Capture) -> Iterator[tuple[CapturedSensor, int, Path]]:
    """Every picture, with its sensor and view."""
    for captured in capture.sensors:
        for view, path in captured.files.items():
            yield captured, view, path
