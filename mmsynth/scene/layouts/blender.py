"""NeRF-synthetic (Blender): ``transforms_train.json``, ``transforms_val.json``, ``transforms_test.json`` and the pictures they list.

* ``transform_matrix`` is camera-to-world in OpenGL axes; ``camera_angle_x`` [rad] is the horizontal field of view, the principal point is
  the picture's centre unless the file says otherwise (keys as in ``nerfstudio``).
* The split is the files': views of ``train`` train, views of ``test`` test. Views of ``val`` are left out, because methods are chosen by
  them; they test where there are no others. Ids of views count on through the files in the order train, val, test.
* ``w`` and ``h`` need not be the pictures': cameras are scaled to the files. Where the sides have no common ratio, a camera that is
  stated by its angle alone is that of the file's own size.
* Alpha says where the object is: what is outside is black, and the region of interest is where the silhouettes meet.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mmsynth.errors import InputError
from mmsynth.files import read_json
from mmsynth.scene.checks import objects, rigid_pose
from mmsynth.scene.images import load_frame, read_native
from mmsynth.scene.known_sensors import make_sensor, wanted_modalities
from mmsynth.scene.layouts.nerfstudio import file_name, frame_camera
from mmsynth.scene.layouts.pictures import Pictures, Resizes
from mmsynth.scene.region import region_from_cameras, region_from_silhouettes
from mmsynth.scene.scene import OPENGL_TO_OPENCV, Frame, Region, Scene, Sensor, make_split
from mmsynth.sensors.camera import Camera

SPLITS = ("train", "val", "test")
_IN_PIXELS = ("fl_x", "fl_y", "cx", "cy")


def file_of(root: Path, split: str) -> Path:
    """The metadata of one split."""
    return root / f"transforms_{split}.json"


def read_blender(root: Path, modalities: Sequence[str] | None = None, images: Path | None = None) -> Scene:
    """Read the scene in a folder, as ``load_scene``: one modality, rgb, or mono for grey images. What is listed and missing is left out."""
    pictures = Pictures(root, images)
    resizes = Resizes(str(root))
    present = [split for split in SPLITS if file_of(root, split).is_file()]
    metas = {split: _meta(file_of(root, split)) for split in present}
    problems: list[str] = []
    if {"val", "test"} <= metas.keys():
        problems.append(f"{len(metas['val']['frames'])} frames of transforms_val.json are left out: transforms_test.json tests.")
    frames: list[Frame] = []
    testing: set[int] = set()
    missing = listed = view = 0
    for split, meta in metas.items():
        shared = {key: value for key, value in meta.items() if key != "frames"}
        for index, entry in enumerate(meta["frames"]):
            where = f"{file_of(root, split)}: frame {index} ({entry.get('file_path')})"
            file = pictures.find(file_name(entry, where))
            pose = rigid_pose(entry.get("transform_matrix"), where) @ OPENGL_TO_OPENCV
            if split != "val" or "test" not in metas:
                listed += 1
                if file is None:
                    missing += 1
                else:
                    frames.append(Frame("", view, file, _camera(shared, entry, where, file, resizes), pose))
                    testing |= {view} if split != "train" else set()
            view += 1
    if not frames:
        raise InputError(
            f"{root}: none of the {listed} frames of its transforms files has an image file in {images or root}; "
            "--images FOLDER says where they are."
        )
    if missing:
        problems.append(f"{missing} of {listed} frames have no image file and are left out.")
    first = read_native(frames[0].path)
    name = "mono" if first.ndim == 2 or first.shape[2] == 2 else "rgb"
    wanted_modalities([name], modalities, root)
    sensor = make_sensor(name, {}, str(root), first, raw=False)
    placed = tuple(Frame(name, f.view, f.path, f.camera, f.camera_to_world, name) for f in frames)
    alpha = first.ndim == 3 and first.shape[2] > sensor.channel_count
    region = region_from_cameras([f.camera for f in frames], [f.camera_to_world for f in frames])
    region = _region_of_alpha(sensor, [f for f in placed if f.view not in testing], region) if alpha else region
    stated = make_split((f.view for f in frames), testing, file_of(root, present[-1]).name)
    problems += resizes.problems()
    return Scene(
        root, "Blender", {name: sensor}, placed, region, stated, black_background=True if alpha else None, problems=tuple(problems)
    )


def _region_of_alpha(sensor: Sensor, frames: Sequence[Frame], seen: Region, most: int = 24) -> Region:
    """Where the silhouettes of some pictures meet, of none that test; damaged ones are passed over."""
    chosen: list[tuple[np.ndarray, Frame]] = []
    for index in sorted({round(value) for value in np.linspace(0, len(frames) - 1, min(most, len(frames)))}):
        try:
            alpha = load_frame(sensor, frames[index])[1]
        except InputError:
            continue
        if alpha is not None:
            chosen.append((alpha > 0, frames[index]))
    silhouettes = [silhouette for silhouette, _ in chosen]
    return region_from_silhouettes(silhouettes, [f.camera for _, f in chosen], [f.camera_to_world for _, f in chosen], seen)


def _meta(path: Path) -> dict[str, Any]:
    meta = read_json(path)
    if not isinstance(meta, dict):
        raise InputError(f"{path}: a JSON {type(meta).__name__}, expected an object with the key 'frames'.")
    objects(meta, "frames", path)
    return meta


def _camera(shared: Mapping[str, Any], entry: Mapping[str, Any], where: str, file: Path, resizes: Resizes) -> Camera:
    """The camera of a picture; its own size counts where the file states another, without a common ratio, and nothing in pixels."""
    size = resizes.size_of(file)
    try:
        camera = frame_camera(shared, entry, where, size)
        fitted = None if camera is None else resizes.fitted(camera, file)
    except InputError:
        if any(key in {**shared, **entry} for key in _IN_PIXELS):
            raise
        sizeless = [{key: value for key, value in part.items() if key not in ("w", "h")} for part in (shared, entry)]
        fitted = frame_camera(sizeless[0], sizeless[1], where, size)
    if fitted is None:
        raise InputError(f"{where}: no focal length, expected 'camera_angle_x' or 'fl_x' in the frame or the file.")
    return fitted
