"""Sensor to sensor, as files: what another sensor of the field would have seen at given frames (see ``conversion``)."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mmsynth.errors import InputError
from mmsynth.files import write_json
from mmsynth.operations.conversion.methods import Converted, chosen_method, convert_frame, render_frame
from mmsynth.operations.conversion.register import landmarks, register
from mmsynth.operations.output import previews
from mmsynth.operations.output.progress import Counter, Progress
from mmsynth.operations.output.records import FORMATS, UNITS, modality_arrays, write_record
from mmsynth.operations.views.coverage import TrainingRays, training_rays
from mmsynth.operations.views.trajectories import View
from mmsynth.scene.image_writers import write_png16
from mmsynth.scene.images import load_frame
from mmsynth.scene.scene import Frame, PosedCamera, Scene, Sensor, canonical_modality
from mmsynth.scene.serialisation import CONVENTIONS, channels_to_json, posed_to_json
from mmsynth.sensors.camera import Camera
from mmsynth.sensors.mosaic import photosites_of

if TYPE_CHECKING:
    from mmsynth.field.field import Field


def source_views(field: Field, scene: Scene, source: str, views: Sequence[int] | None = None) -> list[View]:
    """Camera, pose (as the fit corrected it) and name (view id, 4 digits) of all frames of a sensor, or of some views.

    Raises:
        InputError: unknown sensor or view id.
    """
    source = canonical_modality(source)
    if source not in scene.sensors:
        raise InputError(f"modality {source!r}: not in the scene {scene.root}, expected one of {', '.join(scene.sensors)}.")
    frames = scene.frames_of(source)
    if views is not None:
        known = {frame.view for frame in frames}
        missing = sorted(set(views) - known)
        if missing:
            raise InputError(f"view {missing[0]}: the scene has no frame of '{source}' with this id, expected some of {_ranges(known)}.")
        frames = tuple(frame for frame in frames if frame.view in set(views))
    return [(frame.camera, field.pose_of(frame), f"{frame.view:04d}") for frame in frames]


def _ranges(ids: set[int]) -> str:
    """{0, 1, 2, 5} → "0-2, 5"."""
    runs: list[list[int]] = []
    for i in sorted(ids):
        if runs and i == runs[-1][1] + 1:
            runs[-1][1] = i
        else:
            runs.append([i, i])
    return ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in runs)


def convert_frames(
    field: Field,
    scene: Scene,
    source: str,
    target: str,
    out: Path | str,
    views: Sequence[int] | None = None,
    method: str = "auto",
    as_sensor: bool = False,
    format: str = "npz",
    progress: Progress | None = None,
) -> list[Path]:
    """What modality ``target`` would have seen at every ``source`` frame: on the frame's own pixels (intrinsics and lens included), aligned
    by construction, or as the target sensor itself would have seen it, from its place on the rig.

    Per view, in ``<out>/<target>/``:

    * ``NAME.npz`` or ``NAME.exr`` (see ``records``): data (H, W, C) float32, opacity, valid, confidence, guided; polarization also stokes
      (H, W, 3) in this camera's x-axis frame; with ``as_sensor`` and a mosaic also raw (H, W), what its photosites measure;
    * ``NAME.png``: 16-bit preview, tone-mapped with one exposure for all views; for polarization S0, and ``NAME_dolp.png`` (grey)
      and ``NAME_aolp.png`` (hue = AoLP, value = DoLP, see ``previews.preview_aolp``); ``NAME_confidence.png``;
    * ``NAME.json``: camera, method, exposure, conventions, hash; written last, so a view with a sidecar is complete.

    Args:
        views: view ids; None: all frames of the source. method: see ``conversion``. format: "npz" or "exr".
        progress: called with (rays done, rays in all).
    Returns:
        the files written, the sidecars included.
    Raises:
        InputError: unknown modality, view, method or format, an unreadable frame, a target without a place on the rig, or the disk refused.
    """
    source, target = canonical_modality(source), canonical_modality(target)
    # known before anything is rendered or written
    field.check_modalities([target])
    chosen = source_views(field, scene, source, views)
    field.check_modalities([source])
    frames = [f for f in scene.frames_of(source) if views is None or f.view in set(views)]
    items = []
    for frame, (camera, pose, name) in zip(frames, chosen, strict=True):
        own = next(iter(scene.frames_of(target, (frame.view,))), None) if as_sensor and target in scene.sensors else None
        place = None if not as_sensor else (own.camera, field.pose_of(own)) if own else _on_the_rig(field, source, target, pose)
        items.append(_Item(name, camera, pose, place, frame.path.name, functools.partial(_pixels, scene.sensors[source], frame)))
    return _convert_each(field, source, target, items, Path(out), method, format, progress)


def convert_images(
    field: Field,
    scene: Scene,
    source: str,
    target: str,
    images: Sequence[Path],
    out: Path | str,
    method: str = "auto",
    as_sensor: bool = False,
    format: str = "npz",
    progress: Progress | None = None,
) -> list[Path]:
    """``convert_frames`` of frames without a pose: each is registered against the field first (see ``register``).

    Args:
        images: files of the source sensor, with its size, lens and mosaic. Their names become those of the results.
    Raises:
        InputError: as ``convert_frames``; a file of another size; a frame that cannot be registered, and why. Nothing is written then.
    """
    source, target = canonical_modality(source), canonical_modality(target)
    field.check_modalities([source, target])
    _check_names(images)
    camera = field.cameras[source]
    known = landmarks(field, scene, source)
    items = []
    for path in images:
        frame = Frame(source, 0, path, camera, np.eye(4))
        found = register(field, known, _pixels(field.sensors[source], frame), camera, source, str(path))
        facts = {"covariance": found.covariance.tolist(), "sd_px": found.sd_px, "inliers": found.inliers, "residual": found.residual}
        place = _on_the_rig(field, source, target, found.pose) if as_sensor else None
        read = functools.partial(_pixels, field.sensors[source], frame)
        items.append(_Item(path.stem, camera, found.pose, place, path.name, read, facts))
    return _convert_each(field, source, target, items, Path(out), method, format, progress)


def convert_at_poses(
    field: Field,
    scene: Scene,
    source: str,
    target: str,
    views: Sequence[View],
    out: Path | str,
    images: Sequence[Path] = (),
    method: str = "auto",
    as_sensor: bool = False,
    format: str = "npz",
    progress: Progress | None = None,
) -> list[Path]:
    """``convert_frames`` at any poses of the source: of frames that were taken there, or without any, when the field alone says it.

    Args:
        views: camera, pose and name of each (see ``trajectories.load_views``). images: frames of the source at some of them, each named as
            its view is, suffixes apart; the other views are left out. Without images: all views.
    Raises:
        InputError: as ``convert_frames``; an image of no view; a method that needs frames where there are none.
    """
    source, target = canonical_modality(source), canonical_modality(target)
    field.check_modalities([source, target])
    places = lambda pose: _on_the_rig(field, source, target, pose) if as_sensor else None
    if not images:
        if method not in ("auto", "field"):
            raise InputError(f"convert: method '{method}' needs frames of {source}, expected images at the poses, or the method field.")
        plain = [_Item(_plain_name(name), camera, pose, places(pose)) for camera, pose, name in views]
        return _convert_each(field, source, target, plain, Path(out), "field", format, progress, training_rays(field, scene))
    _check_names(images)
    known = {_plain_name(name): (camera, pose) for camera, pose, name in views}
    items = []
    for path in images:
        if path.stem not in known:
            some = ", ".join(list(known)[:3])
            raise InputError(f"{path}: no pose has this name, expected one of {some}{', ...' if len(known) > 3 else ''}.")
        camera, pose = known[path.stem]
        frame = Frame(source, 0, path, camera, pose)
        read = functools.partial(_pixels, field.sensors[source], frame)
        items.append(_Item(path.stem, camera, pose, places(pose), path.name, read))
    return _convert_each(field, source, target, items, Path(out), method, format, progress)


def _check_names(images: Sequence[Path]) -> None:
    if not images:
        raise InputError("convert: no images, expected at least one file.")
    if len({path.stem for path in images}) < len(images):
        raise InputError("convert: two images have one name, expected names that differ.")


def _plain_name(name: str) -> str:
    """File stem of a view: "images/0007.png" → "0007"."""
    return Path(name).stem


def _pixels(sensor: Sensor, frame: Frame) -> np.ndarray:
    return load_frame(sensor, frame)[0]


@dataclass(frozen=True)
class _Item:
    """What to convert: name of the results, camera and pose, those of the target if they are others, and the frame, if there is one."""

    name: str
    camera: Camera
    pose: np.ndarray
    seen_by: tuple[Camera, np.ndarray] | None
    file: str | None = None
    read: Callable[[], np.ndarray] | None = None
    registration: dict[str, Any] | None = None


def _convert_each(
    field: Field,
    source: str,
    target: str,
    items: Sequence[_Item],
    out: Path,
    method: str,
    format: str,
    progress: Progress | None,
    rays: TrainingRays | None = None,
) -> list[Path]:
    sensor, folder = field.sensors[target], out / target
    if not items:
        raise InputError(f"convert to {target}: no views, expected at least one.")
    if format not in FORMATS:
        raise InputError(f"convert: format is {format!r}, expected one of {', '.join(FORMATS)}.")
    used = chosen_method(method, field.sensors[source], sensor)
    costs = [sum(c.width * c.height for c in (i.camera, *(() if i.seen_by is None else (i.seen_by[0],)))) for i in items]
    count = Counter(progress, sum(costs))
    written: list[Path] = []
    exposure: float | None = None
    for item, cost in zip(items, costs, strict=True):
        goal = count.done + cost
        if item.read is None:
            assert rays is not None
            camera, pose = item.seen_by or (item.camera, item.pose)
            found = render_frame(field, rays, camera, pose, target, progress=count)
        else:
            found = convert_frame(field, item.read(), item.camera, item.pose, source, target, used, item.seen_by, progress=count)
        count(goal - count.done)
        sidecar = folder / f"{item.name}.json"
        # a stale sidecar must not vouch for new files if this run is cut off
        sidecar.unlink(missing_ok=True)
        files = write_record(folder, item.name, _arrays(sensor, found, item.seen_by is not None), format, UNITS, sensor)
        linear = previews.preview_linear(sensor, found.values)
        exposure = previews.exposure_of(linear) if exposure is None else exposure
        pictures = {
            folder / f"{item.name}.png": previews.tone_map(linear, exposure),
            folder / f"{item.name}_confidence.png": found.confidence,
        }
        if found.stokes is not None:
            pictures[folder / f"{item.name}_dolp.png"] = previews.preview_dolp(found.stokes)
            pictures[folder / f"{item.name}_aolp.png"] = previews.preview_aolp(found.stokes)
        for path, picture in pictures.items():
            write_png16(path, picture)
        facts = {
            "name": item.name,
            "frame": item.file,
            "modality": target,
            "from": source,
            "method": found.method,
            "frame_exposure": found.exposure,
            "guided": float(found.guided.mean()),
            "registration": item.registration,
            "sensor": channels_to_json(sensor),
            "camera": posed_to_json(PosedCamera(*(item.seen_by or (item.camera, item.pose)))),
            "conventions": CONVENTIONS,
            "unit": field.unit,
            "preview_exposure": exposure,
            "files": files,
        }
        write_json(sidecar, facts)
        written += [*(folder / name for name in files), *pictures, sidecar]
    return written


def _on_the_rig(field: Field, source: str, target: str, pose: np.ndarray) -> tuple[Camera, np.ndarray]:
    """Camera and pose of the target sensor when the source has this pose."""
    if target not in field.cameras or source not in field.rig or target not in field.rig:
        raise InputError(f"convert: {target!r} has no known place on the rig of {source!r}, expected frames of both.")
    return field.cameras[target], pose @ np.linalg.inv(field.rig[source]) @ field.rig[target]


def _arrays(sensor: Sensor, found: Converted, as_sensor: bool) -> dict[str, np.ndarray]:
    arrays = modality_arrays(found.values, found.stokes)
    arrays |= {"opacity": found.opacity, "valid": found.valid, "confidence": found.confidence, "guided": found.guided}
    if as_sensor and sensor.mosaic is not None:
        arrays["raw"] = photosites_of(found.values, sensor.mosaic)
    return arrays
