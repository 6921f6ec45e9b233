"""nerfstudio and instant-ngp: scenes (``transforms.json`` and image files), poses of ``transforms.json`` and ``camera_path.json``.

* ``transform_matrix`` is camera-to-world in OpenGL axes; principal points have the top-left pixel's centre at 0.5.
* The id of a view is the frame's ``view`` key, else its position in the list (frames without an image count too, so ids
  do not depend on what was downloaded).
* Test views: ``test_filenames`` (or all but ``train_filenames``), else ``test_ids``, else every tenth.
* One file may hold several sensors: a frame's optional key ``modality`` (default rgb, or mono for one-channel images)
  says which, and the optional top-level object ``modalities`` describes them with the keys of ``known_sensors.make_sensor``.
* Pictures of another size than ``w``, ``h``: the camera is scaled, where both sides have one ratio.
* The region of interest is not in the file, unless its optional key ``region`` has it (``centre`` and ``radius``): see
  ``region.region_from_cameras``, and ``region_from_points`` for files with the sparse points of ``ply_file_path`` and for pictures with
  calibration boards. ``unit`` is optional, too.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mmsynth.errors import InputError
from mmsynth.files import read_json
from mmsynth.scene.capture.boards import board_points
from mmsynth.scene.checks import is_file, make_camera, number, numbers, objects, rigid_pose, view_ids, whole
from mmsynth.scene.images import read_native
from mmsynth.scene.known_sensors import make_sensor, wanted_modalities
from mmsynth.scene.layouts.pictures import Pictures, Resizes, without_suffix
from mmsynth.scene.points import SparsePoints, read_ply_points
from mmsynth.scene.region import region_from_cameras, region_from_points, stated_region
from mmsynth.scene.scene import (
    MAX_VIEW,
    OPENGL_TO_OPENCV,
    Frame,
    PosedCamera,
    Region,
    Scene,
    Sensor,
    Split,
    StatedPose,
    canonical_modality,
    make_split,
)
from mmsynth.scene.serialisation import what_scenes_add
from mmsynth.sensors.camera import COEFFICIENTS, Camera, Lens

_BROWN_MODELS = ("OPENCV", "FULL_OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
_FISHEYE_MODEL = "OPENCV_FISHEYE"
_MODEL_OF: dict[str, str] = {"brown_conrady": "OPENCV", "kannala_brandt": _FISHEYE_MODEL}


def read_nerfstudio(path: Path, modalities: Sequence[str] | None = None, images: Path | None = None) -> Scene:
    """Read the scene in a folder with ``transforms.json``, or of the JSON file itself, as ``load_scene``."""
    path = path / "transforms.json" if path.is_dir() else path
    root = path.parent
    pictures = Pictures(root, images)
    meta = read_json(path)
    if not isinstance(meta, dict):
        raise InputError(f"{path}: a JSON {type(meta).__name__}, expected an object with the key 'frames'.")
    listed = objects(meta, "frames", path)
    found = {index: pictures.find(file_name(frame, f"{path}: frame {index}")) for index, frame in enumerate(listed)}
    files = {index: file for index, file in found.items() if file is not None}
    if not files:
        raise InputError(f"{path}: none of the {len(listed)} frames has an image file in {images or root}.")
    problems = _missing(listed, files)
    first: dict[str, np.ndarray] = {}  # by modality as the file spells it: the first image, for size and channels
    for index, file in files.items():
        if _source(listed[index]) not in first:
            first[_source(listed[index])] = read_native(file)
    default = lambda image: "mono" if image.ndim == 2 or image.shape[2] == 2 else "rgb"
    names = {source: canonical_modality(source) if source else default(image) for source, image in first.items()}
    wanted = wanted_modalities(dict.fromkeys(names.values()), modalities, path)
    described = meta.get("modalities", {})
    if not isinstance(described, dict) or not all(isinstance(entry, dict) for entry in described.values()):
        raise InputError(f"{path}: key 'modalities' is not an object of objects.")
    described = {canonical_modality(name): entry for name, entry in described.items()}
    sensors: dict[str, Sensor] = {}
    for source, image in first.items():
        if names[source] in wanted and names[source] not in sensors:
            entry = described.get(names[source], {})
            sensors[names[source]] = make_sensor(names[source], entry, str(path), image, raw="mosaick_pattern" in entry)
    sizes = {source: (image.shape[1], image.shape[0]) for source, image in first.items() if names[source] in sensors}
    frames = _frames(meta, listed, files, names, sizes, path, problems)
    plain = {source: sensors[names[source]].channel_count for source in sizes if sensors[names[source]].mosaic is None}
    alpha = any(first[source].ndim == 3 and first[source].shape[2] > count for source, count in plain.items())
    region = stated_region(meta, path) or _region(meta, root, sensors, frames, problems)
    split = _split(meta, frames, path)
    unit, black = str(meta.get("unit", "input unit")), True if alpha else None
    return Scene(root, "nerfstudio", sensors, tuple(frames), region, split, unit, black, "ignore", problems=tuple(problems))


def _source(frame: Mapping[str, Any]) -> str:
    """Its modality as the file spells it; empty where it does not say."""
    return str(frame.get("modality", ""))


def _missing(listed: Sequence[Mapping[str, Any]], files: Mapping[int, Path]) -> list[str]:
    """A sentence about frames, and one about each modality, without images."""
    problems = []
    if len(files) < len(listed):
        problems.append(f"{len(listed) - len(files)} of {len(listed)} frames have no image file and are left out.")
    there = {_source(listed[index]) for index in files}
    lost = [source or "the default modality" for source in dict.fromkeys(map(_source, listed)) if source not in there]
    return problems + [f"{name}: none of its frames has an image file, it is left out." for name in lost]


def _frames(
    meta: Mapping[str, Any],
    listed: Sequence[Mapping[str, Any]],
    files: Mapping[int, Path],
    names: Mapping[str, str],
    sizes: Mapping[str, tuple[int, int]],
    path: Path,
    problems: list[str],
) -> list[Frame]:
    """Frames with an image, of the modalities whose sizes are given, by sensor and view; every pose in the list is checked."""
    frames: list[Frame] = []
    scaled = Resizes(str(path))
    unmasked: list[Path] = []
    count: Counter[str] = Counter()  # of frames of the same modality before, with an image or without
    for index, frame in enumerate(listed):
        source = _source(frame)
        where = f"{path}: frame {index} ({frame['file_path']})"
        position = count[source]
        count[source] += 1
        pose = rigid_pose(frame.get("transform_matrix"), where) @ OPENGL_TO_OPENCV
        if index not in files or source not in sizes:
            continue
        camera = frame_camera(meta, frame, where, sizes[source])
        if camera is None:
            raise InputError(f"{where}: no focal length, expected 'fl_x' or 'camera_angle_x' in the frame or the file.")
        camera = scaled.fitted(camera, files[index])
        view = whole(frame, "view", where, 0, MAX_VIEW) if "view" in frame else position
        mask = path.parent / str(frame["mask_path"]) if "mask_path" in frame else None
        if mask is not None and not is_file(mask):
            unmasked.append(mask)
            mask = None
        frames.append(Frame(names[source], view, files[index], camera, pose, source, mask))
    problems += scaled.problems()
    if unmasked:
        problems.append(
            f"{len(unmasked)} of {len(frames)} frames name a mask that is not there, first: {unmasked[0]}; nothing is masked in them."
        )
    order = list(dict.fromkeys(names[source] for source in sizes))
    frames.sort(key=lambda frame: (order.index(frame.sensor), frame.view))
    for one, two in itertools.pairwise(frames):
        if (one.sensor, one.view) == (two.sensor, two.view):
            raise InputError(f"{path}: view {one.view} of '{one.sensor}' is listed twice, expected every view once.")
    return frames


def _region(meta: Mapping[str, Any], root: Path, sensors: Mapping[str, Sensor], frames: Sequence[Frame], problems: list[str]) -> Region:
    """That of the cameras; smaller where the file's sparse points, or calibration boards in the pictures, say so."""
    region = region_from_cameras([frame.camera for frame in frames], [frame.camera_to_world for frame in frames])
    stands = np.stack([frame.camera_to_world[:3, 3] for frame in frames])
    if "ply_file_path" in meta:
        points = read_ply_points(root / str(meta["ply_file_path"]))
        if points is not None:
            return region_from_points(points.positions, region, stands)
        problems.append(f"{meta['ply_file_path']}: no readable point cloud, the region of interest is that of the cameras alone")
        return region
    plain = [frame for frame in frames if sensors[frame.sensor].mosaic is None and frame.sensor == frames[0].sensor]
    return region_from_points(board_points(plain), region, stands) if plain else region


def file_name(frame: Mapping[str, Any], where: str) -> str:
    """The name of a frame's picture as the file spells it."""
    if not isinstance(frame.get("file_path"), str):
        raise InputError(f"{where}: key 'file_path' is {frame.get('file_path', 'missing')!r}, expected the name of an image file.")
    return str(frame["file_path"])


def _split(meta: Mapping[str, Any], frames: Sequence[Frame], path: Path) -> Split:
    views = [frame.view for frame in frames]
    by_name = {str(without_suffix(frame.path)): frame.view for frame in frames}
    test, train = _names(meta, "test_filenames", path), _names(meta, "train_filenames", path)
    if test:
        return make_split(views, (view for name, view in by_name.items() if name in test), "test_filenames")
    if train:
        return make_split(views, (view for name, view in by_name.items() if name not in train), "train_filenames")
    return make_split(views, view_ids(meta, "test_ids", path), "test_ids")


def _names(meta: Mapping[str, Any], key: str, path: Path) -> set[str]:
    given = meta.get(key, [])
    if not isinstance(given, list):
        raise InputError(f"{path}: key '{key}' is not a list of file names.")
    return {str(without_suffix(path.parent / str(name))) for name in given}


def read_transforms(content: Mapping[str, Any], path: Path) -> list[StatedPose]:
    """The poses of ``transforms.json``, whose content is given; intrinsics where it has them."""
    out: list[StatedPose] = []
    for index, frame in enumerate(objects(content, "frames", path)):
        where = f"{path}: frame {index}"
        name = str(frame.get("file_path", f"{index:04d}"))
        image = path.parent / name
        size = None
        if not {"w", "h"} <= {**content, **frame}.keys() and is_file(image):
            height, width = read_native(image).shape[:2]
            size = width, height
        pose = rigid_pose(frame.get("transform_matrix"), where) @ OPENGL_TO_OPENCV
        out.append(StatedPose(frame_camera(content, frame, where, size), pose, Path(name).stem))
    return out


def read_camera_path(content: Mapping[str, Any], path: Path) -> list[StatedPose]:
    """The poses of ``camera_path.json``, whose content is given; square pixels, no distortion."""
    kind = content.get("camera_type", "perspective")
    if kind != "perspective":
        raise InputError(f"{path}: camera_type '{kind}' is not supported yet, expected 'perspective'.")
    out: list[StatedPose] = []
    for index, entry in enumerate(objects(content, "camera_path", path)):
        where = f"{path}: camera {index}"
        complaint = f"{where}: key 'camera_to_world' does not hold 16 numbers."
        matrix = numbers(entry.get("camera_to_world"), complaint)
        if matrix.size != 16:
            raise InputError(complaint)
        camera = None
        if "render_width" in content and "render_height" in content and "fov" in entry:
            width, height = whole(content, "render_width", str(path)), whole(content, "render_height", str(path))
            fov = number(entry, "fov", where)
            if not 0 < fov < 180:
                raise InputError(f"{where}: key 'fov' is {fov}, expected between 0 and 180 degrees.")
            focal = float(height / 2 / np.tan(np.radians(fov) / 2))
            camera = make_camera(where, (width, height), (focal, focal, width / 2 - 0.5, height / 2 - 0.5))
        out.append(StatedPose(camera, rigid_pose(matrix.reshape(4, 4), where) @ OPENGL_TO_OPENCV, f"{index:04d}"))
    return out


def frame_camera(shared: Mapping[str, Any], frame: Mapping[str, Any], where: str, size: tuple[int, int] | None = None) -> Camera | None:
    """Intrinsics of one frame of transforms.json; a key of the frame wins over the shared one.

    Distortion k1..k6, p1, p2 is read as OpenCV's rational Brown model, k1..k4 of an ``OPENCV_FISHEYE`` (or ``is_fisheye``) as
    Kannala-Brandt's. Keys that are missing: coefficients = 0, cx, cy = image centre, fl_y = fl_x, and fl_x, fl_y from
    camera_angle_x, camera_angle_y [rad].

    ``size``: width, height of the image, for files without w and h. None when there is neither a focal length nor an angle, or no size.
    """
    merged = {**shared, **frame}
    model = str(merged.get("camera_model", "OPENCV")).upper()
    fisheye = model == _FISHEYE_MODEL or (model in _BROWN_MODELS and bool(merged.get("is_fisheye")))
    if model not in _BROWN_MODELS and not fisheye:
        raise InputError(f"{where}: camera_model {model} is not supported, expected one of {' '.join((*_BROWN_MODELS, _FISHEYE_MODEL))}.")
    if "w" in merged and "h" in merged:
        size = whole(merged, "w", where), whole(merged, "h", where)
    if size is None:
        return None
    width, height = size
    # the innermost place that says anything about the focal length decides
    source = frame if any(key in frame for key in ("fl_x", "fl_y", "camera_angle_x", "camera_angle_y")) else shared
    fx, fy = _focal(source, "x", width, where), _focal(source, "y", height, where)
    fx, fy = (fy if fx is None else fx), (fx if fy is None else fy)
    if fx is None or fy is None:
        return None
    cx, cy = number(merged, "cx", where, default=width / 2), number(merged, "cy", where, default=height / 2)
    lens: Lens = "kannala_brandt" if fisheye else "brown_conrady"
    distortion = [number(merged, key, where, default=0.0) for key in COEFFICIENTS[lens]]
    return make_camera(where, size, (fx, fy, cx - 0.5, cy - 0.5), distortion, lens)


def _focal(entry: Mapping[str, Any], axis: str, pixels: int, where: str) -> float | None:
    if f"fl_{axis}" in entry:
        return number(entry, f"fl_{axis}", where)
    if f"camera_angle_{axis}" in entry:
        angle = number(entry, f"camera_angle_{axis}", where)
        if not 0 < angle < np.pi:
            raise InputError(f"{where}: key 'camera_angle_{axis}' is {angle}, expected an angle between 0 and pi radians.")
        return float(pixels / 2 / np.tan(angle / 2))
    return None


def read_nerfstudio_points(root: Path) -> SparsePoints | None:
    """The points of the file that ``ply_file_path`` of ``transforms.json`` names; None where there are none."""
    path = root / "transforms.json"
    named = read_json(path).get("ply_file_path") if path.is_file() else None
    return None if named is None else read_ply_points(root / str(named))


def described_transforms(scene: Scene, listed: Sequence[tuple[Frame, PosedCamera, str | None]]) -> dict[str, Any]:
    """What ``transforms.json`` says of a scene: ``transforms_content`` with views, split, masks, sensors, and the region of interest.

    Args:
        listed: frames, each with its camera, named by its file, and the name of its mask.
    """
    content = transforms_content([posed for _, posed, _ in listed])
    for entry, (frame, _, mask) in zip(content["frames"], listed, strict=True):
        entry |= {"view": frame.view, "modality": frame.sensor} | ({} if mask is None else {"mask_path": mask})
    named = lambda views: [posed.name for frame, posed, _ in listed if frame.view in views]
    return content | {
        "train_filenames": named(scene.split.train), "test_filenames": named(scene.split.test), **what_scenes_add(scene),
    }  # fmt: skip


def transforms_content(views: Sequence[PosedCamera]) -> dict[str, Any]:
    """What ``transforms.json`` says of pictures, whose ``file_path`` are the cameras' names: for ``write_json``."""
    frames = [
        {
            "camera_model": _MODEL_OF[view.camera.lens],
            "file_path": view.name,
            "w": view.camera.width,
            "h": view.camera.height,
            "fl_x": view.camera.fx,
            "fl_y": view.camera.fy,
            "cx": view.camera.cx + 0.5,
            "cy": view.camera.cy + 0.5,
            **dict(zip(COEFFICIENTS[view.camera.lens], map(float, view.camera.coefficients), strict=True)),
            "transform_matrix": (np.asarray(view.camera_to_world) @ OPENGL_TO_OPENCV).tolist(),
        }
        for view in views
    ]
    return {"camera_model": frames[0]["camera_model"] if frames else "OPENCV", "frames": frames}
