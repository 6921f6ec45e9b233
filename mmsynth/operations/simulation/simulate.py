"""A sensor's digital twin at any poses: the raw frames that it would have recorded, as a scene that can be fitted again.

Layout of ``<out>``: an MMS-DATA scene in the preprocessed raw layout, and beside it what made it ::

    meta_data.json                    written last; the world is the region's ball, ``worldtogt`` takes it to the field's frame
    modalities/NAME/0009.png          raw mosaic in the sensor's bits (or .tiff, or .dng for a Bayer pattern); an instance has the name
                                      of its modality
    sensors/NAME.toml                 the sensor file
    sidecars/NAME/0009.json           all that made the frame: sensor, seed, camera, pose, field, stages, hash; written last of its frame

A run that is cut off goes on where it was: a frame whose sidecar belongs to the same request and whose file has the stated hash is not
made again. The same field, sensor, poses and seed give the same bytes, whatever else is made, in any order.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from mmsynth.errors import InputError
from mmsynth.files import read_json, sha256_of, write_json, write_text
from mmsynth.operations.output.progress import Counter, Progress
from mmsynth.operations.output.records import field_hash
from mmsynth.operations.output.work_partition import WorkPartition
from mmsynth.operations.simulation.frames import simulate_frame
from mmsynth.operations.simulation.plan import SimulatedSensor, plan_sensor
from mmsynth.operations.views.load import RIGS, Rig, load_views, views_of_frames
from mmsynth.scene.image_writers import write_dng, write_png, write_tiff
from mmsynth.scene.layouts.mmsdata import meta_content
from mmsynth.scene.scene import PosedCamera, Scene
from mmsynth.scene.serialisation import CONVENTIONS, posed_to_json
from mmsynth.sensors.mosaic import is_bayer
from mmsynth.sensors.sensor_file import find_sensor_file, sensor_to_toml
from mmsynth.version import __version__

if TYPE_CHECKING:
    from mmsynth.field.field import Field

FrameFormat = Literal["png", "tiff", "dng"]
Split = Literal["train", "test", "all"]
FRAME_FORMATS: tuple[FrameFormat, ...] = get_args(FrameFormat)
IN_THE_FIELD = ("response", "exposure", "psf", "aperture", "vignetting", "analysers", "crosstalk")  # of a sensor that it learned from
STAGES = (
    "psf", "aperture", "exposure", "vignetting", "mosaic", "analyser", "prnu", "shot noise of light and dark current", "crosstalk",
    "read noise", "row noise", "full well", "gain", "black level", "rounding",
)  # fmt: skip


def simulate(
    field: Field,
    sensors: Sequence[str | Path],
    out: Path | str,
    *,
    views: Sequence[PosedCamera] | Path | str | None = None,
    frames: Sequence[int] | Split | None = None,
    scene: Scene | None = None,
    rig: Rig = "native",
    delta: bool = False,
    seed: int = 0,
    file_format: FrameFormat = "png",
    part: WorkPartition | None = None,
    progress: Progress | None = None,
) -> Path | None:
    """Simulate sensors and write their frames as a scene (layout: module docstring).

    Args:
        sensors: sensor files, or names of packaged ones.
        views: of the rig's reference, or the file of their poses (see ``load_views``); a view whose name is a number keeps it as its id.
        frames: instead of views, frames of the scene, by view id or split, with their ids: an instance at those of its own sensor, as the
            fit corrected their poses; a virtual sensor at those of the first one.
        scene: the one that the field was fitted to: needed for ``frames``, and for a trajectory.
        rig: of views. delta: see ``plan_sensor``. seed: of all noise and patterns.
        part: the frames that this process makes, None: all. progress: called with (rays done, rays in all).
    Returns:
        the path of ``meta_data.json``; None where other processes have not finished their frames yet: the last one writes it.
    Raises:
        InputError: see ``plan_sensor``; not one of views and frames, or none of them; two sensors of one name; a format that cannot hold a
            sensor; the disk refused.
    """
    if (views is None) == (frames is None) or (frames is not None and scene is None):
        raise InputError("simulate: give one of --poses and --views, the views of a scene.")
    if rig not in RIGS:
        raise InputError(f"simulate: rig is {rig!r}, expected one of {', '.join(RIGS)}.")
    if frames is not None and rig != "native":
        raise InputError("--rig: frames of the scene have their sensors' own poses, expected it with --poses.")
    planned = _planned(field, sensors, file_format, delta)
    if scene is not None and frames is not None:
        requested = [(p, _at_frames(field, p, scene, frames)) for p in planned]
    else:
        at = load_views(views or (), field, scene)
        requested = [(p, _on_rig(p, at, rig)) for p in planned]
    if not any(at for _, at in requested):
        raise InputError("simulate: no views, expected at least one.")
    return _write(field, requested, Path(out), seed, file_format, part or WorkPartition(), progress)


def expected_errors(scene: Path) -> list[str]:
    """A line for each virtual sensor of a simulated scene whose channels are made of measured ones: how far off they are expected to be."""
    lines = []
    for folder in sorted((scene / "sidecars").iterdir()):
        made = read_json(min(folder.iterdir()))["channels_made_of"]
        if made:
            errors = {label: c["residual"] for label, c in made.items()}
            worst = max(errors, key=lambda label: errors[label])
            lines.append(
                f"{folder.name}: {len(made)} channels made of measured ones, expected errors {min(errors.values()):.1%} to "
                f"{errors[worst]:.1%} ({worst})"
            )
    return lines


def _on_rig(planned: SimulatedSensor, views: Sequence[PosedCamera], rig: Rig) -> list[PosedCamera]:
    """Camera and pose of a sensor at views of the rig's reference."""
    placed = lambda pose: pose if rig == "aligned" else pose @ planned.to_reference
    return [PosedCamera(planned.camera or view.camera, placed(view.camera_to_world), view.name) for view in views]


def _at_frames(field: Field, planned: SimulatedSensor, scene: Scene, frames: Sequence[int] | Split) -> list[PosedCamera]:
    splits = {"train": scene.split.train, "test": scene.split.test, "all": None}
    ids = splits[frames] if isinstance(frames, str) else frames
    if planned.file.instance_of is None:
        return _on_rig(planned, views_of_frames(field, scene, next(iter(scene.sensors)), ids), "native")
    views = views_of_frames(field, scene, planned.file.instance_of, ids)
    return [replace(view, camera=planned.file.camera or view.camera) for view in views]


def _planned(field: Field, sensors: Sequence[str | Path], file_format: FrameFormat, delta: bool) -> list[SimulatedSensor]:
    if file_format not in FRAME_FORMATS:
        raise InputError(f"simulate: format is {file_format!r}, expected one of {', '.join(FRAME_FORMATS)}.")
    if not sensors:
        raise InputError("simulate: no sensor, expected at least one file.")
    planned = [plan_sensor(field, find_sensor_file(str(s)), delta=delta) for s in sensors]
    names = [p.sensor.name for p in planned]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"simulate: two sensors are called '{name}', expected every name once.")
    for p in planned:
        if file_format == "dng" and (p.sensor.mosaic is None or not is_bayer(p.sensor.mosaic) or len(p.sensor.channels) != 3):
            raise InputError(f"{p.file.name}: DNG holds 2x2 Bayer mosaics of red, green and blue, expected --format png or tiff.")
        if file_format == "png" and p.sensor.mosaic is None and p.sensor.channel_count not in (1, 3):
            raise InputError(f"{p.file.name}: {p.sensor.channel_count} channels at every pixel do not fit a PNG, expected --format tiff.")
    return planned


def _write(
    field: Field,
    requested: Sequence[tuple[SimulatedSensor, Sequence[PosedCamera]]],
    out: Path,
    seed: int,
    file_format: FrameFormat,
    part: WorkPartition,
    progress: Progress | None,
) -> Path | None:
    digest = field_hash(field)
    numbered = [(p, list(zip(_ids([view.name for view in views]), views, strict=True))) for p, views in requested]
    listing = {p.sensor.name: {i: replace(view, name=f"{i:04d}.{file_format}") for i, view in own} for p, own in numbered}
    content = meta_content(out, [p.sensor for p, _ in requested], listing, field.region, field.unit)
    (out / "meta_data.json").unlink(missing_ok=True)  # it must not vouch for frames of another request
    for p, _ in requested:
        write_text(out / "sensors" / f"{p.sensor.name}.toml", sensor_to_toml(p.file))
    frames = [(p, i, view) for p, own in numbered for i, view in own]
    mine = part.of(len(frames))
    rays = [p.supersampling**2 * view.camera.width * view.camera.height for p, _, view in frames]
    count = Counter(progress, sum(rays[k] for k in mine))
    complete = True
    for k, (p, i, view) in enumerate(frames):
        name = p.sensor.name
        path, sidecar = out / "modalities" / name / f"{i:04d}.{file_format}", out / "sidecars" / name / f"{i:04d}.json"
        facts = _facts(p, view, i, seed, digest, field.predicted)
        finished = _finished(sidecar, facts, path)
        if k not in mine:
            complete &= finished
            continue
        goal = count.done + rays[k]
        if not finished:
            sidecar.unlink(missing_ok=True)
            _write_frame(path, simulate_frame(field, p, view, i, seed=seed, progress=count), p)
            write_json(sidecar, {**facts, "file": f"modalities/{name}/{path.name}", "sha256": sha256_of(path)})
        count(goal - count.done)
    if not complete:
        return None
    write_json(out / "meta_data.json", content)
    return out / "meta_data.json"


def _ids(names: Sequence[str]) -> list[int]:
    numbers = [int(name) for name in names if name.isdecimal()]
    return numbers if len(numbers) == len(names) == len(set(numbers)) else list(range(len(names)))


def _facts(planned: SimulatedSensor, view: PosedCamera, frame: int, seed: int, digest: str, predicted: Sequence[str]) -> dict[str, Any]:
    return {
        "sensor": json.loads(planned.file.model_dump_json(exclude_defaults=True)),
        "kind": planned.file.kind,
        "frame": frame,
        "seed": seed,
        "supersampling": planned.supersampling,
        "stages": list(STAGES),
        "in_the_field": list(IN_THE_FIELD) if planned.file.kind == "instance" else [],
        "analysers": "of the file" if planned.polarized else "of the field" if planned.sensor.is_polarization else None,
        "predicted": [name for name in planned.modalities if name in predicted],
        "channels_made_of": {
            label: {"residual": c.residual, "noise_gain": c.noise_gain, "weights": c.weights.tolist()}
            for label, c in planned.combinations.items()
        },
        "camera": posed_to_json(view),
        "conventions": {key: CONVENTIONS[key] for key in ("camera_axes", "pixels", "distortion", "world")},
        "field": digest,
        "versions": {"mmsynth": __version__} | {package: version(package) for package in ("numpy", "torch")},
    }


def _finished(sidecar: Path, facts: dict[str, Any], path: Path) -> bool:
    try:
        stated = read_json(sidecar)
    except InputError:
        return False
    same = isinstance(stated, dict) and all(stated.get(k) == v for k, v in json.loads(json.dumps(facts)).items())
    return same and path.is_file() and sha256_of(path) == stated.get("sha256")


def _write_frame(path: Path, numbers: np.ndarray, planned: SimulatedSensor) -> None:
    file = planned.file
    stored = (numbers << file.shift).astype(np.uint8 if file.file_bits == 8 else np.uint16)
    if path.suffix == ".dng":
        assert planned.sensor.mosaic is not None
        black, white = (round(x * 2**file.shift) for x in (file.noise.black_dn, file.noise.white_dn))
        write_dng(path, stored.astype(np.uint16), planned.sensor.mosaic, black, white, f"mmsynth {file.name}")
    elif path.suffix == ".tiff":
        write_tiff(path, stored)
    else:
        write_png(path, stored)
