"""COLMAP scenes: a sparse model (``colmap_model``) and the pictures beside or above it.

* Models are sought in ``sparse/0``, ``sparse``, ``dense/0/sparse``, ``dense/sparse``, ``colmap/sparse/0``, ``colmap/sparse``, ``colmap``
  and the folder itself; of several that to which most pictures belong is taken.
* Pictures are in ``images/`` or ``modalities/`` at the model or in a folder above it, or in these folders themselves. A model made at
  another size than the files has its cameras scaled where both sides have one ratio; a picture of any other size does not belong to it.
* Names with subfolders are sensors of a rig, where ``frames`` say so, or where the folders hold the same names and the rotation from one
  to the other is the same at every name. Else all pictures are of one sensor, however many cameras it has.
* Ids of views count the model's images (or instants) by name. The region of interest is that of the sparse points.
* Test views are those that ``test.txt`` beside the model names, a picture a line. Masks are COLMAP's: ``masks/NAME.png`` beside
  ``images``, NAME with its own suffix, black where nothing is to be learned.
* What COLMAP does not hold may stand in ``mmsynth.json`` in the scene's folder: ``modalities`` (keys of ``known_sensors.make_sensor`` of
  each sensor), ``region`` (``centre`` and ``radius``) and ``unit``. ``mmsynth export`` writes it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from mmsynth.errors import InputError
from mmsynth.files import read_json, read_text
from mmsynth.scene.checks import is_file
from mmsynth.scene.images import SUFFIXES, read_native
from mmsynth.scene.known_sensors import make_sensor, wanted_modalities
from mmsynth.scene.layouts.colmap_model import ModelImage, is_model, missing_of_model, read_model, read_points
from mmsynth.scene.layouts.pictures import Pictures, Resizes
from mmsynth.scene.points import SparsePoints
from mmsynth.scene.region import region_from_cameras, region_from_points, stated_region
from mmsynth.scene.scene import Frame, MaskMeaning, Region, Scene, Sensor, canonical_modality, make_split
from mmsynth.sensors.camera import Camera

BESIDE = "mmsynth.json"
_PLACES = ("sparse/*", "sparse", "dense/*/sparse", "dense/sparse", "colmap/sparse/*", "colmap/sparse", "colmap", ".")
_SAME_ROTATION = 3.0  # degrees, median: what reconstructions of a rig leave


def models_in(root: Path) -> list[Path]:
    """Folders with a model, in the order in which they are preferred."""
    return [folder for folder in _places_in(root) if is_model(folder)]


def halves_in(root: Path) -> list[str]:
    """What folders lack that hold a part of a model, a sentence of each."""
    found = ((folder, missing_of_model(folder)) for folder in _places_in(root))
    return [f"{folder}: a COLMAP model's {missing}, expected both." for folder, missing in found if missing]


def _places_in(root: Path) -> list[Path]:
    return [folder for place in _PLACES for folder in (sorted(root.glob(place)) if place != "." else [root])]


def read_colmap(root: Path, modalities: Sequence[str] | None = None, images: Path | None = None) -> Scene:
    """Read the scene in a folder, as ``load_scene``."""
    taken, problems = _best_model(root, images)
    groups = _sensors_of(taken.listed)
    twice = Counter(groups[image.name] for image in taken.images).most_common(1)[0]
    if twice[1] > 1:
        raise InputError(
            f"{taken.folder}: {twice[1]} images of the sensor '{twice[0][0]}' are of one instant, {twice[0][1]}, expected one."
        )
    sources = list(dict.fromkeys(groups[image.name][0] for image in taken.images))
    first = {source: read_native(next(file for name, file in taken.files.items() if groups[name][0] == source)) for source in sources}
    names = {source: _sensor_name(source, sources, first[source]) for source in sources}
    wanted = wanted_modalities(names.values(), modalities, taken.folder)
    if len(sources) > 1:
        problems.append(f"the folders {', '.join(sources)} in the names of its images are taken as sensors of a rig.")
    order = sorted({view for _, view in groups.values()})
    ids = {view: index for index, view in enumerate(order)}
    sensors: dict[str, Sensor] = {}
    frames: list[Frame] = []
    beside = read_beside(root)
    rank = {name: place for place, name in enumerate(beside.modalities)}
    for source in sorted(sources, key=lambda source: rank.get(names[source], len(rank))):
        name = names[source]
        if name not in wanted:
            continue
        entry = beside.modalities.get(name, {})
        sensors[name] = make_sensor(name, entry, str(root / BESIDE), first[source], raw="mosaick_pattern" in entry)
        own = [image for image in taken.images if groups[image.name][0] == source]
        placed = [
            Frame(
                name, ids[groups[i.name][1]], (file := taken.files[i.name]), taken.cameras[i.name], i.camera_to_world, source,
                _mask(file, i.name),
            )
            for i in own
        ]  # fmt: skip
        frames += sorted(placed, key=lambda frame: frame.view)
    poses = [frame.camera_to_world for frame in frames]
    seen = region_from_cameras([frame.camera for frame in frames], poses)
    points = read_points(taken.folder)
    region = seen if points is None else region_from_points(points.positions, seen, np.stack([pose[:3, 3] for pose in poses]))
    listed = _test_names(taken.folder)
    test = [ids[groups[image.name][1]] for image in taken.images if image.name in listed]
    split = make_split((frame.view for frame in frames), test, "test.txt")
    alpha = any(image.ndim == 3 and image.shape[2] in (2, 4) for image in first.values())
    masks: MaskMeaning = "ignore" if any(frame.mask is not None for frame in frames) else "off"
    return Scene(
        root, "COLMAP", sensors, tuple(frames), beside.region or region, split, beside.unit or "input unit", True if alpha else None,
        masks=masks, problems=tuple(problems),
    )  # fmt: skip


def read_colmap_points(root: Path, images: Path | None = None) -> SparsePoints | None:
    """The sparse points of the model that ``read_colmap`` takes."""
    return read_points(_best_model(root, images)[0].folder)


@dataclass(frozen=True)
class Beside:
    """What ``mmsynth.json`` says: sensors by canonical name, region and unit, None where it does not."""

    modalities: Mapping[str, Mapping[str, Any]]
    region: Region | None = None
    unit: str | None = None


def read_beside(root: Path) -> Beside:
    """Read ``mmsynth.json``, if there is one. Raises InputError: not an object of these keys."""
    path = root / BESIDE
    if not path.is_file():
        return Beside({})
    content = read_json(path)
    described = content.get("modalities", {}) if isinstance(content, dict) else None
    if not isinstance(described, dict) or not all(isinstance(entry, dict) for entry in described.values()):
        raise InputError(f"{path}: expected an object, and in it 'modalities', an object of objects.")
    modalities = {canonical_modality(name): entry for name, entry in described.items()}
    return Beside(modalities, stated_region(content, path), str(content["unit"]) if "unit" in content else None)


def _test_names(folder: Path) -> set[str]:
    path = folder / "test.txt"
    return {line.strip() for line in read_text(path).splitlines()} if path.is_file() else set()


def _mask(file: Path, name: str) -> Path | None:
    """The mask of a picture, which the model calls ``name`` and which lies at ``file``."""
    depth = len(PurePosixPath(name).parts)
    if depth > len(file.parents):  # a picture that lies elsewhere than its name says
        return None
    mask = file.parents[depth - 1].parent / "masks" / f"{name}.png"
    return mask if is_file(mask) else None


# --- the model that belongs to the pictures


@dataclass(frozen=True)
class _Fitting:
    """A model, and the pictures that belong to it: files and cameras by name."""

    folder: Path
    listed: list[ModelImage]
    files: dict[str, Path]
    cameras: dict[str, Camera]
    misfits: list[str]
    resized: list[str]

    @property
    def images(self) -> list[ModelImage]:
        return [image for image in self.listed if image.name in self.files]


def _best_model(root: Path, images: Path | None) -> tuple[_Fitting, list[str]]:
    """The model with the most pictures, and what there is to say of it and of the others."""
    found: list[_Fitting] = []
    refused: dict[Path, str] = {}
    for folder in models_in(root):
        try:
            fitting = _fitting(folder, root, images)
        except InputError as error:
            refused[folder] = str(error)
            continue
        if fitting.files:
            found.append(fitting)
        else:
            count = len(fitting.listed)
            nowhere = f"{folder}: none of its {count} images has a file in {images or root}; --images FOLDER says where they are."
            refused[folder] = fitting.misfits[0] if fitting.misfits else nowhere
    if not found:
        raise InputError(next(iter(refused.values())))
    best = max(found, key=lambda fitting: (len(fitting.files), not fitting.resized))
    name = _within(best.folder, root)
    problems = [f"{name} is read, and not {_within(folder, root)}: {text}" for folder, text in refused.items()]
    others = [f"{_within(fitting.folder, root)} ({len(fitting.files)})" for fitting in found if fitting is not best]
    if others:
        problems.append(f"{name} is read, the model of {len(best.files)} pictures; there are others: {', '.join(others)}.")
    missing = len(best.listed) - len(best.files) - len(best.misfits)
    if missing:
        problems.append(f"{missing} of {len(best.listed)} images of {name} have no file and are left out.")
    if best.misfits:
        problems.append(f"{len(best.misfits)} pictures do not fit their cameras and are left out, the first: {best.misfits[0]}")
    strangers = _not_in_model(best)
    if strangers:
        problems.append(f"{len(strangers)} pictures are not in {name} and are left out, the first is {strangers[0].name}.")
    return best, problems + best.resized


def _within(folder: Path, root: Path) -> str:
    """The model as it is called in notes."""
    return "the model" if folder == root else folder.relative_to(root).as_posix()


def _fitting(folder: Path, root: Path, images: Path | None) -> _Fitting:
    listed = read_model(folder)
    files = _files(listed, folder, root, images)
    resizes = Resizes(_within(folder, root))
    cameras: dict[str, Camera] = {}
    misfits: list[str] = []
    for image in listed:
        if image.name not in files or image.camera is None:
            continue
        try:
            cameras[image.name] = resizes.fitted(image.camera, files[image.name])
        except InputError as error:
            misfits.append(str(error))
    kept = {name: files[name] for name in cameras}
    return _Fitting(folder, listed, kept, cameras, misfits, resizes.problems())


def _files(listed: Sequence[ModelImage], folder: Path, root: Path, images: Path | None) -> dict[str, Path]:
    """The files of a model's images, by name, from the place that has most of them."""
    if images is not None:
        places = [Pictures(folder, images)]
    else:
        levels = [folder, *(parent for parent in folder.parents if parent.is_relative_to(root))]
        places = [Pictures(place) for level in levels for place in (level / "images", level / "modalities", level)]
    best: dict[str, Path] = {}
    for place in places:
        there = {image.name: file for image in listed if (file := place.find(image.name)) is not None}
        best = there if len(there) > len(best) else best
    return best


def _not_in_model(model: _Fitting) -> list[Path]:
    """Pictures in the folders of the model's own, and of their type, that it does not have."""
    known = set(model.files.values())
    types = {file.suffix for file in known} & {suffix for file in known if (suffix := file.suffix).lower() in SUFFIXES}
    beside = (file for folder in sorted({file.parent for file in known}) for file in sorted(folder.iterdir()))
    misfits = {text.split(": ")[0] for text in model.misfits}
    return [file for file in beside if file.suffix in types and file not in known and str(file) not in misfits]


# --- sensors of a rig


def _sensors_of(images: Sequence[ModelImage]) -> Mapping[str, tuple[str, str]]:
    """Name of an image → its sensor, as the model spells it, and its view."""
    folder = {image.name: str(PurePosixPath(image.name).parent) for image in images}
    if any(image.frame is not None for image in images):
        by_camera = {image.camera_id: folder[image.name] for image in images}
        named = len(set(by_camera.values())) == len(by_camera)
        sensor = {image.name: folder[image.name] if named else f"camera{image.camera_id}" for image in images}
        # what is in no frame is an instant of its own
        return {i.name: (sensor[i.name], i.name if i.frame is None else f"{i.frame:012d}") for i in images}
    folders = list(dict.fromkeys(folder.values()))
    stems = {place: {PurePosixPath(i.name).stem: i for i in images if folder[i.name] == place} for place in folders}
    if len(folders) > 1 and all(_on_one_rig(stems[folders[0]], stems[other]) for other in folders[1:]):
        return {image.name: (folder[image.name], PurePosixPath(image.name).stem) for image in images}
    return {image.name: (".", image.name) for image in images}


def _on_one_rig(one: Mapping[str, ModelImage], other: Mapping[str, ModelImage]) -> bool:
    """Whether the images of two folders that are called the same differ by one rotation, and are of different cameras."""
    from scipy.spatial.transform import Rotation  # a second to import

    shared = sorted(one.keys() & other.keys())
    if len(shared) < 2 or {image.camera_id for image in one.values()} & {image.camera_id for image in other.values()}:
        return False
    between = [one[name].camera_to_world[:3, :3].T @ other[name].camera_to_world[:3, :3] for name in shared]
    rotations = Rotation.from_matrix(np.stack(between))
    apart = (rotations * rotations.mean().inv()).magnitude()
    return float(np.degrees(np.median(apart))) < _SAME_ROTATION


def _sensor_name(source: str, sources: Sequence[str], image: np.ndarray) -> str:
    """By the last folder of its names where that is its own; of one sensor alone, by its channels."""
    if len(sources) == 1 or source == ".":
        return "mono" if image.ndim == 2 or image.shape[2] == 2 else "rgb"
    last = Counter(canonical_modality(PurePosixPath(other).name) for other in sources)
    short = canonical_modality(PurePosixPath(source).name)
    return short if last[short] == 1 else source.replace("/", "_").lower()
