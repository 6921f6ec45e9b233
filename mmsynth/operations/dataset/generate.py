"""An aligned multimodal dataset from any poses: every modality, depth, normals, opacity and mask, with all that a reader must know.

Layout of ``<out>``::

    dataset.json             conventions, sensors, unit, field hash, recipe, versions; per file sha256, bytes, arrays (shape, dtype, unit)
    transforms.json          the views as nerfstudio reads them (OpenGL axes, pixel centres at +0.5), images = views/NNNN/image.png
    views/NNNN/
        rgb.npz ms.npz ...   one record per modality (see ``records``): data, stokes
        geometry.npz         depth_z, depth_ray, normal, normal_camera, opacity, mask (opacity > 0.5), valid, coverage (see ``coverage``),
                             saturated_rgb ... (where that sensor would have clipped)
        light.npz            mirrored_rgb ..., the part of each modality that is images of lamps, roughness, strength; where it is asked for
        flow.npz             flow to the next view, occluded (see ``flow``); the last view has none
        image.png            16-bit linear picture of the first modality (for transforms.json and for looking)
        view.json            camera and pose per modality, the files and their hashes; written last: the view is complete
    raw/                     where sensors were asked for: their raw frames, a scene in the layout of MMS-DATA (see ``simulate``)

As ``exr`` or ``tiff`` the records are of that type. ``webdataset`` packs 64 views at a time into shards/NNNNNN.tar, whose sidecar is
written last, and removes their folders. ``mms-data`` puts the modalities into modalities/NAME/NNNN.tiff (16 bits, clipped to [0, 1]) with
a meta_data.json, a scene that can be fitted. On the native rig every modality has a grid of its own: ``geometry_NAME``, ``light_NAME``,
``flow_NAME``, ``image_NAME`` and ``transforms_NAME.json`` instead.

A run that is interrupted goes on where it was: a view whose ``view.json`` belongs to the same request and whose files have the
stated hashes is not rendered again. The same field and request give the same bytes, in one process or in many.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mmsynth.errors import InputError
from mmsynth.field.light_rendering import render_light
from mmsynth.files import sha256_of, write_json
from mmsynth.operations.dataset.index import PER_SHARD, finished_view, pack_shard, shard_name, view_folder
from mmsynth.operations.dataset.plan import DatasetFormat, Plan, check_request, meta_of, plan_dataset
from mmsynth.operations.output.previews import preview_linear
from mmsynth.operations.output.progress import Counter, Progress, RaysDone
from mmsynth.operations.output.records import (
    UNITS,
    RecordFormat,
    modality_arrays,
    read_record,
    write_record,
)
from mmsynth.operations.output.work_partition import WorkPartition
from mmsynth.operations.simulation.simulate import simulate
from mmsynth.operations.views.coverage import TrainingRays, coverage, covered_views, training_rays, view_scores
from mmsynth.operations.views.flow import optical_flow
from mmsynth.operations.views.load import Rig, load_views
from mmsynth.scene.image_writers import write_png16
from mmsynth.scene.layouts.nerfstudio import transforms_content
from mmsynth.scene.scene import PosedCamera, Scene

if TYPE_CHECKING:
    from mmsynth.field.field import Field
    from mmsynth.field.picture import Rendering


@dataclass(frozen=True)
class GeneratedDataset:
    """What a request made.

    Attributes:
        path: of ``dataset.json``; None where other processes have not finished their views yet: the last one writes it.
        views: how many. left_out: name and coverage score of those that the training frames cover too little.
    """

    path: Path | None
    views: int
    left_out: tuple[tuple[str, float], ...] = ()


def generate_dataset(
    field: Field,
    views: Sequence[PosedCamera] | Path | str,
    out: Path | str,
    *,
    scene: Scene | None = None,
    modalities: Sequence[str] | None = None,
    rig: Rig = "aligned",
    file_format: DatasetFormat = "npz",
    outputs: Sequence[str] | None = None,
    min_coverage: float | None = None,
    rays: TrainingRays | None = None,
    sensors: Sequence[str | Path] = (),
    seed: int = 0,
    part: WorkPartition | None = None,
    progress: Progress | None = None,
) -> GeneratedDataset:
    """Render all modalities at all views and write them as a dataset (layout: module docstring).

    Args:
        views: where to look from, or the file of their poses (see ``load_views``).
        scene: the one that the field was fitted to: its training frames are what coverage is judged by, and a trajectory starts from.
        modalities: names or aliases; None: all of the field.
        rig: of what the views are, see ``Rig``; on the native rig, of the field's first sensor.
        file_format: "npz", "exr" (named float channels), "tiff" (16-bit images, float geometry), "webdataset" or "mms-data".
        outputs: of "geometry", "flow", "coverage" and "light", what is wanted beside the modalities; None: all but light, coverage with a
            scene only.
        min_coverage: leave out views that the training frames cover less, in [0, 1]; 1 = their own pixels (see ``coverage.view_score``).
        rays: of the training frames, where they were made already (``coverage.training_rays``); None: of the scene.
        sensors: files of those whose raw frames at these views go into raw/, a scene of its own (see ``simulate``, also for ``seed``).
        part: the views that this process renders, None: all.
        progress: called with (rays done, rays in all); finished views count at once. What coverage takes comes before the views, raw frames
            after them, and each counts anew.
    Raises:
        InputError: no views, or none that is covered enough; unknown modality, rig, format or output; a modality without a place on the
            rig; a camera that the format does not hold; coverage without a scene; or the disk refused.
    """
    if min_coverage is not None and not 0.0 <= min_coverage <= 1.0:
        raise InputError(f"--min-coverage {min_coverage:g}: expected a number from 0 to 1.")
    names, wanted = check_request(field, modalities, rig, file_format, outputs)
    views = load_views(views, field, scene)
    if not views:
        raise InputError("dataset: no views, expected at least one.")
    if rays is None and scene is not None and (min_coverage is not None or "coverage" in wanted):
        rays = training_rays(field, scene, progress=progress)
    if rays is None and (min_coverage is not None or (outputs is not None and "coverage" in wanted)):
        raise InputError("dataset: coverage needs the rays of the training frames, expected the scene.")
    left_out: list[tuple[str, float]] = []
    if min_coverage is not None and rays is not None:
        views, left_out = covered_views(views, view_scores(field, rays, views, progress=progress), min_coverage)
    plan = plan_dataset(field, views, Path(out), names, rig, file_format, wanted, rays)
    part = part or WorkPartition()
    _write_views(plan, part, progress)
    raw = simulate(field, sensors, plan.out / "raw", views=views, rig=rig, seed=seed, part=part, progress=progress) if sensors else None
    path = None if sensors and raw is None else _summary(plan, raw, seed)
    return GeneratedDataset(path, len(views), tuple(left_out))


def _write_views(plan: Plan, part: WorkPartition, progress: Progress | None) -> None:
    """Render and write the views of this process that are not there yet, and pack them, where the format says so."""
    packed = plan.format == "webdataset"
    mine = part.of(len(plan.placed), PER_SHARD if packed else 1)
    cameras = [[placed[group[0]].camera for group in plan.groups] for placed in plan.placed]
    costs = [sum(camera.width * camera.height for camera in of_view) for of_view in cameras]
    count = Counter(progress, sum(costs[i] for i in mine))
    ahead: dict[int, list[Rendering]] = {}  # the next view, rendered already for the flow to it
    goal = 0
    for index in mine:
        goal += costs[index]
        if plan.finished(index) is None:
            (plan.out / "dataset.json").unlink(missing_ok=True)  # it must not vouch for views of another request
            here = ahead.pop(index) if index in ahead else _render(plan, index, count)
            following = _following(plan, index, index + 1 in mine, ahead, count)
            _write_view(plan, index, here, following)
        count(max(0, goal - count.done))
        if packed and (index + 1 in (mine.stop, len(plan.placed)) or (index + 1) % PER_SHARD == 0):
            first = index // PER_SHARD * PER_SHARD
            if plan.shard(index) is None:
                pack_shard(plan.out, shard_name(index), range(first, index + 1))
                plan.shard(index)


def _of(stem: str, modality: str, rig: Rig) -> str:
    """File stem: on the native rig, one per modality."""
    return stem if rig == "aligned" else f"{stem}_{modality}"


def _render(plan: Plan, index: int, progress: RaysDone | None, modalities: bool = True) -> list[Rendering]:
    """Each group of modalities of a view, or its geometry alone."""
    geometry = bool(plan.outputs)
    out = []
    for group in plan.groups:
        at, names = plan.placed[index][group[0]], group if modalities else []
        out.append(plan.field.render(at.camera, at.camera_to_world, names, geometry=geometry, progress=progress))
    return out


def _following(plan: Plan, index: int, mine: bool, ahead: dict[int, list[Rendering]], progress: RaysDone) -> list[np.ndarray] | None:
    """depth_ray of the next view, by group: rendered now and kept, where it is still to be made, else read from what was made."""
    if "flow" not in plan.outputs or index + 1 == len(plan.placed):
        return None
    # folders of another process may go into a shard at any time
    readable = "geometry" in plan.outputs and (mine or plan.format != "webdataset")
    made = finished_view(plan.out, index + 1, plan.keys[index + 1]) if readable else None
    if made is not None:
        folder = plan.out / view_folder(index + 1)
        return [read_record(folder, made["files"], _of("geometry", group[0], plan.rig))["depth_ray"] for group in plan.groups]
    if mine and plan.finished(index + 1) is None:
        ahead[index + 1] = _render(plan, index + 1, progress)
        return [rendering.depth_ray for rendering in ahead[index + 1]]
    return [rendering.depth_ray for rendering in _render(plan, index + 1, None, modalities=False)]


def _write_view(plan: Plan, index: int, renderings: Sequence[Rendering], following: Sequence[np.ndarray] | None) -> None:
    """Write the files of one view. The sidecar goes first, so that it never vouches for new files, and comes last."""
    folder = plan.out / view_folder(index)
    (folder / "view.json").unlink(missing_ok=True)
    files: dict[str, Any] = {}
    scores = []
    record_format: RecordFormat = "npz" if plan.format == "webdataset" or plan.format == "mms-data" else plan.format
    units = UNITS | {"depth_z": plan.field.unit, "depth_ray": plan.field.unit}
    for number, (group, rendering) in enumerate(zip(plan.groups, renderings, strict=True)):
        at = plan.placed[index][group[0]]
        for name in group:
            files |= _write_modality(plan, index, name, rendering, record_format)
        if "geometry" in plan.outputs:
            arrays = _geometry_arrays(rendering, at.camera_to_world)
            for name in group:
                clipped = rendering.channels[name] >= min(plan.field.sensors[name].saturation, 1.0)
                arrays[f"saturated_{name}"] = np.asarray(clipped.any(-1))
            if "coverage" in plan.outputs and plan.rays is not None:
                arrays["coverage"] = coverage(plan.rays, at, rendering.depth_ray, rendering.normal)
                hit = arrays["coverage"][np.isfinite(arrays["coverage"])]
                scores.append(float(hit.mean(dtype=np.float64)) if hit.size else 0.0)
            files |= write_record(folder, _of("geometry", group[0], plan.rig), arrays, record_format, units=units)
        if "light" in plan.outputs:
            light = render_light(plan.field, at.camera, at.camera_to_world, group)
            arrays = {f"mirrored_{name}": values for name, values in light.mirrored.items()}
            arrays |= {"roughness": light.roughness, "strength": light.strength}
            shares = UNITS | {f"mirrored_{name}": "full scale" for name in group}
            files |= write_record(folder, _of("light", group[0], plan.rig), arrays, record_format, units=shares)
        if following is not None:
            there = plan.placed[index + 1][group[0]]
            flow, occluded = optical_flow(at, rendering.depth_ray, rendering.normal, there, following[number])
            files |= write_record(folder, _of("flow", group[0], plan.rig), {"flow": flow, "occluded": occluded}, record_format, units=units)
        picture = folder / f"{_of('image', group[0], plan.rig)}.png"
        write_png16(picture, preview_linear(plan.field.sensors[group[0]], rendering.channels[group[0]]))
        shown = {"shape": [at.camera.height, at.camera.width, 3], "dtype": "uint16", "unit": "full scale"}
        files[picture.name] = {
            "record": picture.stem,
            "sha256": sha256_of(picture),
            "bytes": picture.stat().st_size,
            "arrays": {"image": shown},
        }
    score = {"coverage_score": float(np.mean(scores))} if scores else {}
    write_json(folder / "view.json", {"request": plan.keys[index], **plan.stated[index], **score, "files": files})


def _write_modality(plan: Plan, index: int, name: str, rendering: Rendering, record_format: RecordFormat) -> dict[str, Any]:
    sensor, folder = plan.field.sensors[name], plan.out / view_folder(index)
    arrays = modality_arrays(rendering.channels[name], rendering.stokes.get(name), rendering.deviation.get(name))
    if plan.format != "mms-data":
        return write_record(folder, name, arrays, record_format, units=UNITS, sensor=sensor)
    frame = write_record(plan.out / "modalities" / name, f"{index:04d}", {"data": arrays.pop("data")}, "tiff", units=UNITS, sensor=sensor)
    files = {f"../../modalities/{name}/{file}": facts | {"record": name} for file, facts in frame.items()}
    return files | write_record(folder, name, arrays, record_format, units=UNITS)


def _geometry_arrays(rendering: Rendering, pose: np.ndarray) -> dict[str, np.ndarray]:
    return {
        "depth_z": rendering.depth_z,
        "depth_ray": rendering.depth_ray,
        "normal": rendering.normal,
        "normal_camera": (rendering.normal @ pose[:3, :3]).astype(np.float32),
        "opacity": rendering.opacity,
        "mask": rendering.opacity > 0.5,
        "valid": rendering.valid,
    }


def _summary(plan: Plan, raw: Path | None, seed: int) -> Path | None:
    """Write what stands above the views, once all of them are there; raw: the meta_data.json of their raw frames, seed: of their noise."""
    out, views = plan.out, []
    shards: dict[str, dict[str, Any]] = {}
    for index in range(len(plan.placed)):
        # another process may have its views and not yet their shard
        shard = plan.shard(index) if plan.format == "webdataset" else None
        stated = shard[index % PER_SHARD] if shard else plan.finished(index) if plan.format != "webdataset" else None
        if stated is None:
            return None
        where = {"folder": view_folder(index)}
        if shard:
            where = {"shard": shard_name(index), "key": f"{index:04d}"}
            path = out / shard_name(index)
            shards[shard_name(index)] = shards.get(shard_name(index)) or {"sha256": sha256_of(path), "bytes": path.stat().st_size}
        views.append(where | {key: value for key, value in stated.items() if key != "request"})
    files = []
    for group in plan.groups if plan.format != "webdataset" else []:
        picture = f"{_of('image', group[0], plan.rig)}.png"
        pictures = [replace(cameras[group[0]], name=f"{view_folder(i)}/{picture}") for i, cameras in enumerate(plan.placed)]
        files.append(out / f"{_of('transforms', group[0], plan.rig)}.json")
        write_json(files[-1], transforms_content(pictures))
    if plan.format == "mms-data":
        files.append(out / "meta_data.json")
        write_json(files[-1], meta_of(plan.field, out, list(plan.request["modalities"]), plan.placed))
    if raw is not None:
        files += [raw, *(path for kind in ("modalities", "sensors", "sidecars") for path in sorted((raw.parent / kind).rglob("[!.]*.*")))]
    listed = {str(path.relative_to(out)): {"sha256": sha256_of(path), "bytes": path.stat().st_size} for path in files}
    write_json(
        out / "dataset.json",
        {**plan.request, "files": listed} | ({"raw_seed": seed} if raw else {}) | ({"shards": shards} if shards else {}) | {"views": views},
    )
    return out / "dataset.json"
