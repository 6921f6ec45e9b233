"""What each layout is made of: which file goes where, what its own files say, and what does not fit into it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from mmsynth.errors import InputError
from mmsynth.scene.layouts.colmap import BESIDE
from mmsynth.scene.layouts.colmap_writer import colmap_files, rig_of
from mmsynth.scene.layouts.mmsdata import lens_model, meta_content
from mmsynth.scene.layouts.nerfstudio import described_transforms
from mmsynth.scene.points import SparsePoints, ply_of
from mmsynth.scene.scene import Frame, MaskMeaning, PosedCamera, Scene
from mmsynth.scene.serialisation import what_scenes_add

ExportLayout = Literal["mms-data", "nerfstudio", "colmap"]
LAYOUTS: tuple[str, ...] = get_args(ExportLayout)
_ARRAYS = (".npy", ".npz", ".exr", ".dng")


@dataclass(frozen=True)
class Plan:
    """A layout before anything is written; names are paths within the folder to come.

    Attributes:
        pictures, masks: name → the file to copy. index: name → content, in the order of writing: the last one is that by which the
            layout is recognised.
        notes: sentences on what the layout does not hold, or only mmsynth reads.
    """

    pictures: dict[str, Path]
    masks: dict[str, Path]
    index: dict[str, bytes]
    notes: list[str] = field(default_factory=list)


def plan_of(scene: Scene, poses: Mapping[int, np.ndarray], points: SparsePoints | None, layout: ExportLayout) -> Plan:
    """Lay a scene out.

    Args:
        poses: camera_to_world (4, 4) of ``scene.frames``, by their position in it.
    Raises:
        InputError: unknown layout, or a scene that it does not hold.
    """
    planners: dict[str, Callable[[Scene, Mapping[int, np.ndarray], SparsePoints | None], Plan]]
    planners = {"mms-data": _mmsdata, "nerfstudio": _nerfstudio, "colmap": _colmap}
    if layout not in planners:
        raise InputError(f"--layout: {layout!r}, expected one of {', '.join(LAYOUTS)}.")
    plan = planners[layout](scene, poses, points)
    arrays = sorted({path.suffix for path in plan.pictures.values() if path.suffix.lower() in _ARRAYS})
    if arrays:
        plan.notes.append(f"pictures are {' and '.join(arrays)} files, copied as they are: few tools read those.")
    if (scene.root / "gt").is_dir():
        plan.notes.append("gt/, the scene's ground truth, is not copied.")
    return plan


def _names(scene: Scene) -> dict[int, str]:
    """Of every frame, by its position: the stem of its file where that tells the frames of each sensor apart and is the same in every
    sensor of a view, else the id of the view."""
    by_view: dict[int, set[str]] = {}
    for frame in scene.frames:
        by_view.setdefault(frame.view, set()).add(frame.path.stem)
    kept = all(len(stems) == 1 for stems in by_view.values()) and len(set.union(*by_view.values())) == len(by_view)
    return {i: frame.path.stem if kept else f"{frame.view:04d}" for i, frame in enumerate(scene.frames)}


def _placed(scene: Scene, poses: Mapping[int, np.ndarray], name: Callable[[int, Frame], str]) -> dict[str, dict[int, PosedCamera]]:
    """By sensor and view."""
    out: dict[str, dict[int, PosedCamera]] = {sensor: {} for sensor in scene.sensors}
    for i, frame in enumerate(scene.frames):
        out[frame.sensor][frame.view] = PosedCamera(frame.camera, poses[i], name(i, frame))
    return out


def _mmsdata(scene: Scene, poses: Mapping[int, np.ndarray], points: SparsePoints | None) -> Plan:
    images = _placed(scene, poses, lambda _, frame: f"{frame.view:04d}{frame.path.suffix.lower()}")
    content = meta_content(scene.root, list(scene.sensors.values()), images, scene.region, scene.unit)
    normalised = lambda at: (at - np.asarray(scene.region.centre)) / scene.region.radius
    cloud = {} if points is None else {"pointcloud.ply": ply_of(replace(points, positions=normalised(points.positions)))}
    plan = Plan(
        pictures={f"modalities/{f.sensor}/{images[f.sensor][f.view].name}": f.path for f in scene.frames},
        masks={f"masks/{f.sensor}/{f.view:04d}.png": f.mask for f in scene.frames if f.mask is not None},
        index={**cloud, "meta_data.json": _json(content | {"test_ids": list(scene.split.test)})},
        notes=_masks_note(scene, "off", "MMS-DATA"),
    )
    for name, own in images.items():
        model = lens_model(next(iter(own.values())).camera)
        if model != "OPENCV":
            plan.notes.append(f"{name}: its lens, {model}, is none of MMS-DATA's; mmsynth reads it.")
    views = sorted({frame.view for frame in scene.frames})
    if views != list(range(len(views))):
        plan.notes.append("the ids of views have gaps, which MMS-DATA's own loader does not expect.")
    return plan


def _nerfstudio(scene: Scene, poses: Mapping[int, np.ndarray], points: SparsePoints | None) -> Plan:
    names, several = _names(scene), len(scene.sensors) > 1
    stem = {i: f"{frame.sensor}/{names[i]}" if several else names[i] for i, frame in enumerate(scene.frames)}
    picture = {i: f"images/{stem[i]}{frame.path.suffix.lower()}" for i, frame in enumerate(scene.frames)}
    mask = {i: f"masks/{stem[i]}{f.mask.suffix.lower()}" for i, f in enumerate(scene.frames) if f.mask is not None}
    listed = [(frame, PosedCamera(frame.camera, poses[i], picture[i]), mask.get(i)) for i, frame in enumerate(scene.frames)]
    content = described_transforms(scene, listed) | ({} if points is None else {"ply_file_path": "sparse_pc.ply"})
    plan = Plan(
        pictures={picture[i]: frame.path for i, frame in enumerate(scene.frames)},
        masks={mask[i]: f.mask for i, f in enumerate(scene.frames) if f.mask is not None},
        index={**({} if points is None else {"sparse_pc.ply": ply_of(points)}), "transforms.json": _json(content)},
        notes=_masks_note(scene, "ignore", "nerfstudio"),
    )
    if several:
        plan.notes.append("nerfstudio takes all frames for colour photographs; the sensors are told apart by keys that mmsynth reads.")
    elif _mosaics(scene):
        plan.notes.append(f"{_mosaics(scene)}: nerfstudio has no mosaics, raw frames are grey pictures there; mmsynth reads their pattern.")
    return plan


def _colmap(scene: Scene, poses: Mapping[int, np.ndarray], points: SparsePoints | None) -> Plan:
    names, several = _names(scene), len(scene.sensors) > 1
    folder = lambda sensor: f"{sensor}/" if several else ""
    picture = {i: f"{folder(frame.sensor)}{names[i]}{frame.path.suffix.lower()}" for i, frame in enumerate(scene.frames)}
    images = _placed(scene, poses, lambda i, _: picture[i])
    test = [picture[i] for i, frame in enumerate(scene.frames) if frame.view in scene.split.test]
    plan = Plan(
        pictures={f"images/{picture[i]}": frame.path for i, frame in enumerate(scene.frames)},
        # COLMAP's own way to name masks
        masks={f"masks/{picture[i]}.png": f.mask for i, f in enumerate(scene.frames) if f.mask is not None},
        index={
            BESIDE: _json(what_scenes_add(scene)),
            "sparse/0/test.txt": "".join(f"{name}\n" for name in test).encode(),
            **{f"sparse/0/{name}": content for name, content in colmap_files(images, points).items()},
        },
        notes=_masks_note(scene, "ignore", "COLMAP"),
    )
    if several and rig_of(images) is None:
        plan.notes.append("the sensors' poses are not those of one rigid rig with one camera each: every picture is a frame of its own.")
    if _mosaics(scene):
        plan.notes.append(f"{_mosaics(scene)}: COLMAP has no mosaics, raw frames are grey pictures there; mmsynth reads {BESIDE}.")
    plan.notes.append(f"COLMAP holds no region of interest and no unit (here {scene.unit}); they are in {BESIDE}.")
    return plan


def _mosaics(scene: Scene) -> str:
    return ", ".join(name for name, sensor in scene.sensors.items() if sensor.mosaic is not None)


def _masks_note(scene: Scene, there: MaskMeaning, layout: str) -> list[str]:
    if scene.masks == there or all(frame.mask is None for frame in scene.frames):
        return []
    return [
        f"masks mean '{scene.masks}' in this scene and '{there}' in {layout}'s layout: say `--masks {scene.masks}` to fit it as before."
    ]


def _json(content: Mapping[str, Any]) -> bytes:
    return (json.dumps(content, indent=1, allow_nan=False) + "\n").encode()
