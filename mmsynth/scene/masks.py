"""Masks of frames: reading one, and finding those that lie in a folder of their own.

A mask is a picture of the frame's size, non-zero = foreground. What that means to a fit is the scene's ``masks``.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mmsynth.errors import InputError
from mmsynth.scene.checks import is_file
from mmsynth.scene.images import SUFFIXES, read_native
from mmsynth.scene.scene import Frame, MaskMeaning, Scene, canonical_modality

_ARCHIVE = ("masks", "scenes", "modalities")  # folders of MMS-DATA's archive of masks, which no scene is called


def read_mask(frame: Frame) -> np.ndarray | None:
    """(H, W) bool: the foreground, where a colour is not zero and, if there is alpha, not transparent; None where a frame has no mask.

    Raises:
        InputError: unreadable, or of another size than the frame.
    """
    if frame.mask is None:
        return None
    mask = read_native(frame.mask)
    height, width = frame.camera.height, frame.camera.width
    if mask.shape[:2] != (height, width):
        raise InputError(
            f"{frame.mask}: the mask is {mask.shape[1]}x{mask.shape[0]} pixels, expected {width}x{height} as its frame {frame.path.name}."
        )
    if mask.ndim == 2:
        return np.asarray(mask != 0)
    if mask.shape[2] in (2, 4):
        return np.asarray((mask[..., :-1] != 0).any(-1) & (mask[..., -1] != 0))
    return np.asarray((mask != 0).any(-1))


def use_masks(scene: Scene, meaning: MaskMeaning | None = None, folder: Path | None = None) -> Scene:
    """The same scene with another meaning of its masks, or with the masks of a folder in place of its own.

    Args:
        meaning: None: as the scene has it. folder: searched with all that is in it, see ``find_masks``; None: no other masks.
    Raises:
        InputError: the folder is not there, has no pictures, or none that belongs to a frame.
    """
    if meaning is not None:
        scene = replace(scene, masks=meaning)
    if folder is None:
        return scene
    found = find_masks(scene, folder)
    frames = tuple(replace(frame, mask=found.get((frame.sensor, frame.view))) for frame in scene.frames)
    without = Counter(frame.sensor for frame in frames if frame.mask is None)
    problems = [f"{folder}: no mask for {count} of {len(scene.frames_of(name))} frames of {name}." for name, count in without.items()]
    return replace(scene, frames=frames, mask_folder=folder, problems=(*scene.problems, *problems))


def find_masks(scene: Scene, folder: Path) -> dict[tuple[str, int], Path]:
    """Masks by sensor and view.

    What lies in a folder named like a sensor is for that sensor: a picture with the name of the frame's picture or, in MMS-DATA, with the
    id of the frame in its name. What lies in no such folder is for the frame whose picture has its name, and for those of the same name
    that look from the same pose through the same lens. Where folders are named like the scene, as in MMS-DATA's archive of masks
    (``scenes/<scene>/modalities/<sensor>/``), the others are other scenes'.

    Raises:
        InputError: no such folder, no pictures in it, none that belongs to a frame, or masks of several scenes of other names.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder, expected one of masks.")
    folder = folder.resolve()
    files = [file for file in sorted(folder.rglob("*")) if file.suffix.lower() in SUFFIXES and is_file(file)]
    files = _of_scene(files, folder, scene)
    owners = {file: _sensor_of(file, folder, scene) for file in files}
    found: dict[tuple[str, int], Path] = {}
    for name in scene.sensors:
        own = [file for file in files if owners[file] == name]
        places = sorted({str(file.parent) for file in own})
        if scene.format == "MMS-DATA" and len(places) > 1:
            raise InputError(f"{folder}: masks of '{name}' lie in {places[0]} and in {places[1]}, expected those of one scene.")
        frames = scene.frames_of(name)
        found |= _by_name(frames, own) or (_by_id(frames, own) if scene.format == "MMS-DATA" else {})
    free = [frame for frame in scene.frames if frame.sensor not in owners.values()]
    found |= _same_view(free, _by_name(free, [file for file in files if owners[file] is None]))
    if not found:
        example = scene.frames[0]
        raise InputError(
            f"{folder}: none of its {len(files)} pictures is the mask of a frame, expected names of the frames' pictures, such as "
            f"{example.path.stem}.png, or names with a frame's id in folders named like the modalities of MMS-DATA."
        )
    return found


def _of_scene(files: list[Path], folder: Path, scene: Scene) -> list[Path]:
    """Those in a folder named like the scene, or one that the scene lies in, if there is one; else all."""
    parts = {file: file.relative_to(folder).parent.parts for file in files}
    known = {part for inside in parts.values() for part in inside if part not in _ARCHIVE and canonical_modality(part) not in scene.sensors}
    named = next((part for part in reversed(scene.root.resolve().parts) if part in known), None)
    return files if named is None else [file for file in files if named in parts[file]]


def _sensor_of(file: Path, folder: Path, scene: Scene) -> str | None:
    """The sensor that the innermost folder with the name of one is named like."""
    inside = (folder.name, *file.relative_to(folder).parent.parts)
    return next((canonical_modality(part) for part in reversed(inside) if canonical_modality(part) in scene.sensors), None)


def _by_name(frames: Sequence[Frame], files: Sequence[Path]) -> dict[tuple[str, int], Path]:
    """Of frames whose picture has the name of one file: ``0001.png`` or ``0001.jpg.png`` for 0001.jpg; by their folders' names, where
    several have it."""
    named: dict[str, list[Path]] = {}
    for file in files:
        named.setdefault(file.stem, []).append(file)
    often = Counter((frame.sensor, frame.path.stem) for frame in frames)
    found = {}
    for frame in frames:
        fits = named.get(frame.path.stem, []) or named.get(frame.path.name, [])
        if len(fits) > 1 or often[frame.sensor, frame.path.stem] > 1:
            fits = [file for file in fits if file.parent.name == frame.path.parent.name]
        if len(fits) == 1:
            found[frame.sensor, frame.view] = fits[0]
    return found


def _by_id(frames: Sequence[Frame], files: Sequence[Path]) -> dict[tuple[str, int], Path]:
    """Of frames whose id is a number in a file's name: of its first, second, ... numbers those that differ and are most frames' ids."""
    numbers = {file: [int(digits) for digits in re.findall(r"\d+", file.stem)] for file in files}
    best: dict[tuple[str, int], Path] = {}
    for place in range(max(map(len, numbers.values()), default=0)):
        having = {file: found[place] for file, found in numbers.items() if len(found) > place}
        ids = {number: file for file, number in having.items()}
        matched = {(frame.sensor, frame.view): ids[frame.view] for frame in frames if frame.view in ids}
        if len(ids) == len(having) and len(matched) > len(best):
            best = matched
    return best


def _same_view(frames: Iterable[Frame], found: Mapping[tuple[str, int], Path]) -> dict[tuple[str, int], Path]:
    """Without those of frames that see something else than the first frame which has that mask."""
    kept: dict[tuple[str, int], Path] = {}
    first: dict[Path, Frame] = {}
    for frame in frames:
        key = frame.sensor, frame.view
        if key in found:
            one = first.setdefault(found[key], frame)
            if one.camera == frame.camera and np.array_equal(one.camera_to_world, frame.camera_to_world):
                kept[key] = found[key]
    return kept
