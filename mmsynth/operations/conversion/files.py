"""Sensor to sensor, as files: what another sensor of the field would have seen at given frames (see ``methods``)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mmsynth.errors import InputError
from mmsynth.files import write_json
from mmsynth.operations.conversion.methods import Chosen, Converted, Method, choose, convert_frame, render_frame
from mmsynth.operations.conversion.register import landmarks, register
from mmsynth.operations.output import previews
from mmsynth.operations.output.progress import Counter, Progress
from mmsynth.operations.output.records import RECORD_FORMATS, UNITS, RecordFormat, modality_arrays, write_record
from mmsynth.operations.views.coverage import TrainingRays, training_rays
from mmsynth.operations.views.load import load_views, on_the_rig, views_of_frames
from mmsynth.scene.image_writers import write_png16
from mmsynth.scene.images import load_frame
from mmsynth.scene.scene import Frame, PosedCamera, Scene, Sensor, canonical_modality
from mmsynth.scene.serialisation import CONVENTIONS, channels_to_json, posed_to_json
from mmsynth.sensors.mosaic import photosites_of

if TYPE_CHECKING:
    from mmsynth.field.field import Field


def convert_files(
    field: Field,
    scene: Scene,
    out: Path | str,
    *,
    source: str,
    target: str,
    frames: Sequence[int] | None = None,
    views: Sequence[PosedCamera] | Path | str | None = None,
    images: Sequence[Path] = (),
    method: Method = "auto",
    as_sensor: bool = False,
    file_format: RecordFormat = "npz",
    progress: Progress | None = None,
) -> list[Path]:
    """What modality ``target`` would have seen at frames of ``source``: on the frame's own pixels (intrinsics and lens included), aligned
    by construction, or as the target sensor itself would have seen it, from its place on the rig.

    The frames are one of

    * those of the scene (neither ``views`` nor ``images``): all of the source, or those of the view ids in ``frames``;
    * ``images`` of the source sensor, with its size, lens and mosaic: each is registered against the field first (see ``register``);
    * ``images`` at ``views``: each is named as its view is, suffixes apart; views without an image are left out;
    * none, at ``views`` (a poses file, see ``load_views``, or views): the field alone says it.

    Per view, in ``<out>/<target>/``:

    * ``NAME.npz``, ``.exr`` or ``.tiff`` (see ``records``): data (H, W, C) float32, opacity, valid, confidence, guided; polarization also
      stokes (H, W, 3) in this camera's x-axis frame; with ``as_sensor`` and a mosaic also raw (H, W), what its photosites measure;
    * ``NAME.png``: 16-bit preview, at most 800 pixels a side, tone-mapped with one exposure for all views; for polarization S0, and
      ``NAME_dolp.png`` (grey) and ``NAME_aolp.png`` (hue = AoLP, value = DoLP, see ``previews.preview_aolp``); ``NAME_confidence.png``.
      Of a modality that a prior predicts all of them are ``NAME_predicted...``, and the arrays have a deviation (H, W, C);
    * ``NAME.json``: camera, method, exposure, conventions, hash; written last, so a view with a sidecar is complete.

    Args:
        progress: called with (rays done, rays in all).
    Returns:
        the files written, the sidecars included.
    Raises:
        InputError: unknown modality, view id, method or format; an unreadable frame; a target without a place on the rig; an image of no
            view, or one that cannot be registered, and why; a method that needs frames where there are none; or the disk refused. Nothing
            is written then, but for the last two of these.
    """
    source, target = canonical_modality(source), canonical_modality(target)
    field.check_modalities([target])
    if frames is not None and (views is not None or images):
        raise InputError("convert: view ids are of frames of the scene, expected them without images and poses.")
    if file_format not in RECORD_FORMATS:
        raise InputError(f"convert: format is {file_format!r}, expected one of {', '.join(RECORD_FORMATS)}.")
    if len({path.stem for path in images}) < len(images):
        raise InputError("convert: two images have one name, expected names that differ.")
    rays = None
    if views is None and not images:
        items = _of_scene(field, scene, source, target, frames, as_sensor)
    else:
        field.check_modalities([source])
        at = None if views is None else load_views(views, field, scene, sensor=source)
        if at is None:
            items = _registered(field, scene, source, images)
        elif images:
            items = _at_views(field, source, at, images)
        elif method not in ("auto", "field"):
            raise InputError(f"convert: method '{method}' needs frames of {source}, expected images at the poses, or the method field.")
        else:
            items, rays = [_Item(Path(view.name).stem, view) for view in at], training_rays(field, scene)
    if as_sensor:
        items = [item if item.seen_by else replace(item, seen_by=on_the_rig(field, item.view, source, target)) for item in items]
    chosen = Chosen("field") if rays is not None else choose(field, scene, source, target, method)
    return _convert_each(field, source, target, items, Path(out), chosen, file_format, progress, rays)


@dataclass(frozen=True)
class _Item:
    """What to convert: name of the results, camera and pose, the frame there, if there is one, camera and pose of the target if they are
    others, how the frame was registered, and the view id of one of the scene's."""

    name: str
    view: PosedCamera
    frame: Frame | None = None
    seen_by: PosedCamera | None = None
    registration: dict[str, Any] | None = None
    scene_view: int | None = None


def _of_scene(field: Field, scene: Scene, source: str, target: str, ids: Sequence[int] | None, as_sensor: bool) -> list[_Item]:
    views = views_of_frames(field, scene, source, ids)
    field.check_modalities([source])
    items = []
    for frame, view in zip(scene.frames_of(source, None if ids is None else tuple(ids)), views, strict=True):
        own = next(iter(scene.frames_of(target, (frame.view,))), None) if as_sensor else None
        seen_by = None if own is None else PosedCamera(own.camera, field.pose_of(own))
        items.append(_Item(view.name, view, frame, seen_by, scene_view=frame.view))
    return items


def _registered(field: Field, scene: Scene, source: str, images: Sequence[Path]) -> list[_Item]:
    camera, known = field.cameras[source], landmarks(field, scene, source)
    items = []
    for path in images:
        frame = Frame(source, 0, path, camera, np.eye(4))
        at = register(field, known, load_frame(field.sensors[source], frame)[0], camera, source, name=str(path))
        facts = {"covariance": at.covariance.tolist(), "sd_px": at.sd_px, "inliers": at.inliers, "residual": at.residual}
        items.append(_Item(path.stem, PosedCamera(camera, at.pose), frame, registration=facts))
    return items


def _at_views(field: Field, source: str, views: Sequence[PosedCamera], images: Sequence[Path]) -> list[_Item]:
    by_name = {Path(view.name).stem: view for view in views}  # "images/0007.png" is called 0007
    for path in images:
        if path.stem not in by_name:
            some = ", ".join(list(by_name)[:3])
            raise InputError(f"{path}: no pose has this name, expected one of {some}{', ...' if len(by_name) > 3 else ''}.")
    named = [(path, by_name[path.stem]) for path in images]
    return [_Item(path.stem, view, Frame(source, 0, path, view.camera, view.camera_to_world)) for path, view in named]


def _convert_each(
    field: Field,
    source: str,
    target: str,
    items: Sequence[_Item],
    out: Path,
    chosen: Chosen,
    file_format: RecordFormat,
    progress: Progress | None,
    rays: TrainingRays | None,
) -> list[Path]:
    """rays: for confidence where there are no frames."""
    sensor, folder = field.sensors[target], out / target
    if not items:
        raise InputError(f"convert to {target}: no views, expected at least one.")
    pixels = lambda view: 0 if view is None else view.camera.width * view.camera.height
    costs = [pixels(item.view) + pixels(item.seen_by) for item in items]
    count = Counter(progress, sum(costs))
    written: list[Path] = []
    exposure: float | None = None
    for item, cost in zip(items, costs, strict=True):
        goal = count.done + cost
        at = item.seen_by or item.view
        if item.frame is None:
            assert rays is not None
            made = render_frame(field, rays, at, target, progress=count)
        else:
            raw = load_frame(field.sensors[source], item.frame)[0]
            made = convert_frame(
                field,
                raw,
                item.view,
                source=source,
                target=target,
                method=chosen,
                seen_by=item.seen_by,
                left_out=item.scene_view,
                progress=count,
            )
        count(goal - count.done)
        sidecar = folder / f"{item.name}.json"
        # a stale sidecar must not vouch for new files if this run is cut off
        sidecar.unlink(missing_ok=True)
        files = write_record(folder, item.name, _arrays(sensor, made, item.seen_by is not None), file_format, units=UNITS, sensor=sensor)
        exposure = previews.exposure_of(previews.preview_linear(sensor, made.values)) if exposure is None else exposure
        pictures = _write_pictures(folder, item.name, sensor, made, exposure)
        facts = {
            "name": item.name,
            "frame": None if item.frame is None else item.frame.path.name,
            "modality": target,
            "from": source,
            "method": made.method,
            "predicted": made.deviation is not None,
            "weights": made.weights,
            "evidence": None if chosen.evidence is None else chosen.evidence.facts(),
            "frame_exposure": made.exposure,
            "guided": float(made.guided.mean()),
            "registration": item.registration,
            "sensor": channels_to_json(sensor),
            "camera": posed_to_json(at),
            "conventions": CONVENTIONS,
            "unit": field.unit,
            "preview_exposure": exposure,
            "files": files,
        }
        write_json(sidecar, facts)
        written += [*(folder / name for name in files), *pictures, sidecar]
    return written


def _write_pictures(folder: Path, name: str, sensor: Sensor, made: Converted, exposure: float) -> list[Path]:
    shown = name if made.deviation is None else f"{name}_predicted"
    pictures = {f"{shown}.png": previews.tone_map(previews.preview_linear(sensor, made.values), exposure)}
    pictures[f"{shown}_confidence.png"] = made.confidence
    if made.stokes is not None:
        pictures[f"{shown}_dolp.png"] = previews.preview_dolp(made.stokes)
        pictures[f"{shown}_aolp.png"] = previews.preview_aolp(made.stokes)
    for file, picture in pictures.items():
        write_png16(folder / file, previews.reduced(picture))
    return [folder / file for file in pictures]


def _arrays(sensor: Sensor, made: Converted, as_sensor: bool) -> dict[str, np.ndarray]:
    arrays = modality_arrays(made.values, made.stokes, made.deviation)
    arrays |= {"opacity": made.opacity, "valid": made.valid, "confidence": made.confidence, "guided": made.guided}
    if as_sensor and sensor.mosaic is not None:
        arrays["raw"] = photosites_of(made.values, sensor.mosaic)
    return arrays
