"""More sensors in a layout made for one, and ``scene.toml``, which says of a folder what its own files do not.

A sensor is a folder with pictures that are called as those of the scene's first sensor, with any suffix:

* ``FOLDER``: the same camera at the same place; pictures of another size have that camera scaled.
* ``FOLDER:calibration.json``: its own camera at its own place on the rig (``layouts.calibration``), which also holds the first sensor.

``scene.toml`` beside the data, every key optional; folders are relative to it::

    layout = "Blender"           # of several in the folder, the one to read
    images = "viewer_cache/rgba" # where the pictures are, whatever the metadata say
    [also]
    nir = "viewer_cache/nir_rgba"
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
from pydantic import BaseModel, ConfigDict

from mmsynth.errors import InputError
from mmsynth.scene.images import read_native
from mmsynth.scene.known_sensors import make_sensor, wanted_modalities
from mmsynth.scene.layouts.calibration import RigSensor, read_calibration
from mmsynth.scene.layouts.pictures import Pictures, Resizes
from mmsynth.scene.scene import Frame, Layout, Scene, SceneSource, canonical_modality
from mmsynth.toml import read_toml


class _SceneFile(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    layout: str | None = None
    images: str | None = None
    also: dict[str, str] = {}


def stated_source(path: Path, layout: str | None, images: Path | str | None, also: Mapping[str, str] | None) -> SceneSource:
    """What is asked for, and what ``scene.toml`` adds to it; ``path`` as it is given, the others absolute.

    Raises:
        InputError: no such file or folder, a bad ``scene.toml``, no such layout, or a folder of pictures that is not there.
    """
    if not path.exists():
        raise InputError(f"{path}: no such file or folder.")
    path = path.parent if path.name == "scene.toml" else path
    root = path if path.is_dir() else path.parent
    file = root / "scene.toml"
    beside = read_toml(file, _SceneFile) if file.is_file() else _SceneFile()
    known: dict[str, Layout] = {name.lower(): name for name in get_args(Layout)}
    named = layout if layout is not None else beside.layout
    if named is not None and named.lower() not in known:
        where = "--layout" if layout is not None else f"{file}: layout"
        raise InputError(f"{where} {named!r}: no such layout, expected one of {', '.join(known.values())}.")
    pictures = images if images is not None else beside.images
    sensors: dict[str, str] = {}
    for name, text in {**beside.also, **(also or {})}.items():
        folder, calibration = _parts(text)
        beginning = str(_placed(root, folder, name))
        sensors[canonical_modality(name)] = beginning if calibration is None else f"{beginning}:{_placed(root, calibration, name)}"
    return SceneSource(
        path,
        None if named is None else known[named.lower()],
        None if pictures is None else _placed(root, pictures, "images"),
        tuple(sensors.items()),
    )


def _parts(text: str) -> tuple[str, str | None]:
    match = re.fullmatch(r"(.+?):([^:]+\.json)", text)
    return (match[1], match[2]) if match else (text, None)


def _placed(root: Path, text: Path | str, what: str) -> Path:
    """Beside the scene's own files, or else in the working folder."""
    places = [root / text, Path(text)]
    for place in places:
        try:
            if place.exists():
                return place.resolve()
        except (OSError, ValueError):  # a name that nothing can have
            continue
    raise InputError(f"{places[0]}: no such file or folder, expected that of '{what}'.")


def with_sensors(scene: Scene, also: Mapping[str, str], modalities: Sequence[str] | None = None) -> Scene:
    """The scene and more sensors, whose frames stand where those of the first sensor do, or at their place on the rig.

    Args:
        scene: with all of its sensors. also: folders by name, as in ``SceneSource``. modalities: which of all to keep; None: all.
    Raises:
        InputError: no pictures, two names for one picture, a sensor that is there already, sizes without a common ratio, or a bad or
            incomplete calibration.
    """
    if not also:
        return scene
    out = scene
    for name, text in also.items():
        out = _with_sensor(out, name, text)
    kept = wanted_modalities(out.sensors, modalities, scene.root)
    sensors = {name: sensor for name, sensor in out.sensors.items() if name in kept}
    return replace(out, sensors=sensors, frames=tuple(frame for frame in out.frames if frame.sensor in kept))


def _with_sensor(scene: Scene, name: str, text: str) -> Scene:
    if name in scene.sensors:
        raise InputError(f"{scene.root}: there is a sensor '{name}' already, expected another name for the pictures in {text}.")
    place, calibration = _parts(text)
    folder = Path(place)
    reference = next(iter(scene.sensors))
    listed = scene.frames_of(reference)
    rig = None if calibration is None else _on_rig(Path(calibration), reference, name)
    pictures, resizes = Pictures(scene.root, folder), Resizes(str(folder))
    frames: list[Frame] = []
    for frame in listed:
        file = pictures.find(_name_of(frame.path, scene.root))
        if file is None:
            continue
        pose = frame.camera_to_world if rig is None else frame.camera_to_world @ rig.camera_to_reference
        camera = resizes.fitted(frame.camera if rig is None else rig.camera, file)
        mask = frame.mask if rig is None and camera == frame.camera else None  # seen from the same place, the object has the same outline
        frames.append(Frame(name, frame.view, file, camera, pose, name, mask))
    if not frames:
        raise InputError(f"{folder}: no picture in it is called as one of '{reference}', expected names such as {listed[0].path.stem}.")
    described: Mapping[str, Any] = {} if rig is None else rig.described
    sensor = make_sensor(name, described, str(calibration or folder), read_native(frames[0].path), raw="mosaick_pattern" in described)
    problems = list(scene.problems)
    if len(frames) < len(listed):
        problems.append(f"{name}: {len(listed) - len(frames)} of {len(listed)} frames of '{reference}' have no picture in {folder}.")
    if rig is not None and scene.unit != "m":
        problems.append(f"{name}: its place on the rig is in metres, and the poses are taken to be, which the scene does not say.")
    return replace(
        scene,
        sensors={**scene.sensors, name: sensor},
        frames=(*scene.frames, *frames),
        problems=(*problems, *resizes.problems()),
    )


def _name_of(path: Path, root: Path) -> str:
    return path.relative_to(root).as_posix() if path.is_relative_to(root) else path.name


def _on_rig(file: Path, reference: str, name: str) -> RigSensor:
    """A sensor of a calibration, with its place in the axes of the scene's own first sensor."""
    rig = read_calibration(file)
    for needed in (reference, name):
        if needed not in rig:
            raise InputError(f"{file}: no sensor '{needed}', expected it and '{reference}' among {', '.join(rig)}.")
    to_reference = np.linalg.inv(rig[reference].camera_to_reference) @ rig[name].camera_to_reference
    return replace(rig[name], camera_to_reference=to_reference)
