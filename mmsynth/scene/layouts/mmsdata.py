"""MMS-DATA scenes in the preprocessed layout: ``meta_data.json`` and ``modalities/<name>/<file>``.

Facts of the format, and what is made of them:

* ``camtoworld`` is camera-to-world in OpenGL axes, in a normalised world; ``worldtogt`` takes that world to metres. The
  scene is given in the metric frame when ``worldtogt`` is there; the scene box (a ball of ``radius`` around the world's origin) becomes
  the region of interest.
* ``distortion_params`` is k1 k2 p1 p2 k3 k4, which is OpenCV's order; only read when ``undistorted`` is false.
* ``pixel_offset`` is added to pixel indices before un-projection, so here it is subtracted from cx and cy.
* ``mosaick_pattern`` counts when ``raw`` is true; the file's pattern wins over the one known for the modality.
* Frames are kept by their ``frame_id``: ids may have gaps and modalities may have different views.

Optional keys of a modality that MMS-DATA does not have and that describe any other sensor: ``channels`` (labels), ``wavelengths_nm``
(a number or null per channel), ``polarizer_angles_deg`` (per channel, from image right towards image up). At the top: ``unit``, of the
frame that ``worldtogt`` leads to, where it is not metres, and ``test_ids``, the test views of a scene without ground truth images. Lenses
that MMS-DATA does not have: ``camera_model`` FULL_OPENCV with the eight distortion_params k1 k2 p1 p2 k3 k4 k5 k6, and OPENCV_FISHEYE
with Kannala-Brandt's k1 k2 k3 k4. A frame may state a camera of its own, by the keys of a modality's.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mmsynth.errors import InputError
from mmsynth.files import read_json
from mmsynth.scene.checks import is_file, is_number, make_camera, number, numbers, objects, rigid_pose, view_ids, whole
from mmsynth.scene.images import read_native
from mmsynth.scene.known_sensors import KNOWN, make_sensor, wanted_modalities
from mmsynth.scene.points import SparsePoints, read_ply_points
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
    ball,
    canonical_modality,
    make_split,
)
from mmsynth.scene.serialisation import camera_to_json, channels_to_json
from mmsynth.sensors.camera import COEFFICIENTS, Camera, Lens

_PINHOLE_MODELS = ("PINHOLE", "SIMPLE_PINHOLE")
# distortion_params of each model; the first six are MMS-DATA's
_MODELS = {
    **dict.fromkeys((*_PINHOLE_MODELS, "SIMPLE_RADIAL", "RADIAL", "OPENCV"), ("k1", "k2", "p1", "p2", "k3", "k4")),
    "FULL_OPENCV": COEFFICIENTS["brown_conrady"],
    "OPENCV_FISHEYE": COEFFICIENTS["kannala_brandt"],
}


def read_mmsdata(root: Path, modalities: Sequence[str] | None = None, images: Path | None = None) -> Scene:
    """Read the scene in a folder, as ``load_scene``. A modality without images is refused. ``images``: in place of ``modalities/``."""
    path = root / "meta_data.json"
    folder = images or root / "modalities"
    meta = _read_meta(path)
    raw = _flag(meta, "raw", path)
    to_output, scale, unit = _world_to_output(meta, path)
    unit = str(meta.get("unit", unit))

    sources = {source: canonical_modality(source) for source in meta["modalities"]}
    for name, count in Counter(sources.values()).items():
        if count > 1:
            raise InputError(f"{path}: {count} modalities are called '{name}' or an alias of it, expected one.")
    wanted = wanted_modalities(sources.values(), modalities, path)
    sensors: dict[str, Sensor] = {}
    frames: list[Frame] = []
    problems: list[str] = []
    for source, name in sources.items():
        if name not in wanted:
            continue
        where = f"{path}: modality '{source}'"
        entry = _modality(meta, source, where)
        present, missing = _frames(_stated_frames(meta, entry, path, where, to_output, scale), root, folder / source, source, name)
        if not present:
            raise InputError(f"{where} has no image files in {folder / source}; leave it out to use the other modalities.")
        if missing:
            problems.append(f"{name}: {missing} of {missing + len(present)} frames have no image file and are left out.")
        sensors[name] = make_sensor(name, entry, where, read_native(present[0].path), raw)
        frames += present
    split = _split(root, meta, (frame.view for frame in frames))
    box = meta.get("scene_box")
    radius = number(box if isinstance(box, dict) else {}, "radius", f"{path}: key 'scene_box'", default=1.0)
    if radius <= 0:
        raise InputError(f"{path}: key 'scene_box': radius {radius}, expected a positive number.")
    region = ball(to_output[:3, 3], scale * radius)
    return Scene(root, "MMS-DATA", sensors, tuple(frames), region, split, unit, problems=tuple(problems))


def read_mmsdata_points(root: Path) -> SparsePoints | None:
    """The points of ``pointcloud.ply``, in the frame and unit of ``read_mmsdata``; None where there are none."""
    points = read_ply_points(root / "pointcloud.ply")
    if points is None:
        return None
    to_output, scale, _ = _world_to_output(_read_meta(root / "meta_data.json"), root / "meta_data.json")
    return replace(points, positions=scale * points.positions @ to_output[:3, :3].T + to_output[:3, 3])


def read_reference_poses(path: Path) -> list[StatedPose]:
    """Poses of the reference sensor, the first modality of a ``meta_data.json``: by frame id, with or without image files.

    They are in the frame and unit of ``read_mmsdata``, named by the stems of their files.
    """
    meta = _read_meta(path)
    source = next(iter(meta["modalities"]))
    where = f"{path}: modality '{source}'"
    entry = _modality(meta, source, where)
    to_output, scale, _ = _world_to_output(meta, path)
    frames = sorted(_stated_frames(meta, entry, path, where, to_output, scale), key=lambda frame: frame[0])
    return [StatedPose(camera, pose, Path(file_name).stem) for _, file_name, camera, pose in frames]


def meta_content(
    root: Path,
    sensors: Sequence[Sensor],
    frames: Mapping[str, Mapping[int, PosedCamera]],
    region: Region,
    unit: str,
    *,
    own_cameras: bool = False,
) -> dict[str, Any]:
    """What ``meta_data.json`` says of a scene: the content of the file, that ``write_json`` takes.

    Args:
        root: to name in errors. region: becomes the scene box.
        frames: by sensor and view id, named by their files; poses in the region's frame.
        own_cameras: frames may have other cameras than their modality, which MMS-DATA's own tools pass over.
    Raises:
        InputError: what the format does not hold: a sensor whose camera changes, frames with all channels at every pixel beside mosaics,
            of a modality that is known to have one.
    """
    to_world = np.diag([1.0 / region.radius] * 3 + [1.0])
    to_world[:3, 3] = -np.array(region.centre) / region.radius
    raw = any(s.mosaic is not None for s in sensors)
    modalities = {}
    for sensor in sensors:
        (camera, _), *others = Counter(frame.camera for frame in frames[sensor.name].values()).most_common()
        if others and not own_cameras:
            raise InputError(f"{root}: {1 + len(others)} cameras of '{sensor.name}', expected one: MMS-DATA has one for all frames.")
        if raw and sensor.mosaic is None and sensor.channel_count > 1 and sensor.name in KNOWN:
            raise InputError(f"{root}: '{sensor.name}' has no mosaic, which MMS-DATA does not hold beside sensors that have one.")
        entry: dict[str, Any] = {
            **_camera_entry(camera),
            **{key: value for key, value in channels_to_json(sensor).items() if value is not None},
        }
        if raw and (sensor.mosaic is not None or sensor.channel_count == 1):
            entry["mosaick_pattern"] = [[0]] if sensor.mosaic is None else sensor.mosaic.tolist()
        entry["frames"] = []
        for view, frame in frames[sensor.name].items():
            moved = frame.camera_to_world.copy()
            moved[:3, 3] = to_world[:3, :3] @ moved[:3, 3] + to_world[:3, 3]
            own = {} if frame.camera == camera else _camera_entry(frame.camera)
            entry["frames"].append(
                {"frame_id": view, "file_name": frame.name, "camtoworld": (moved @ OPENGL_TO_OPENCV)[:3].tolist(), **own}
            )
        modalities[sensor.name] = entry
    return {
        "undistorted": False, "raw": raw, "pixel_offset": 0.0,
        "scene_box": {"collider_type": "sphere", "radius": 1.0, "aabb": [[-1.0] * 3, [1.0] * 3]},
        "worldtogt": np.linalg.inv(to_world).tolist(),
        "unit": unit,
        "modalities": modalities,
    }  # fmt: skip


def _camera_entry(camera: Camera) -> dict[str, Any]:
    """Size, intrinsics and lens."""
    model = lens_model(camera)
    return {
        "camera_model": model,
        **{key: value for key, value in camera_to_json(camera).items() if key not in ("lens", "distortion")},
        "distortion_params": camera.coefficients[: len(_MODELS[model])].tolist(),
    }


def lens_model(camera: Camera) -> str:
    """The ``camera_model`` of a lens: OPENCV is MMS-DATA's, the two others are known here alone."""
    if camera.lens == "kannala_brandt":
        return "OPENCV_FISHEYE"
    return "FULL_OPENCV" if any(camera.coefficients[6:]) else "OPENCV"


def _read_meta(path: Path) -> dict[str, Any]:
    meta = read_json(path)
    if not isinstance(meta, dict) or not isinstance(meta.get("modalities"), dict) or not meta["modalities"]:
        raise InputError(f"{path}: key 'modalities' is missing or empty, expected an object with one entry per sensor.")
    return meta


def _modality(meta: Mapping[str, Any], source: str, where: str) -> dict[str, Any]:
    entry = meta["modalities"][source]
    if not isinstance(entry, dict):
        raise InputError(f"{where} is not an object.")
    return entry


def _flag(meta: Mapping[str, Any], key: str, path: Path) -> bool:
    if not isinstance(meta.get(key), bool):
        raise InputError(f"{path}: key '{key}' is {meta.get(key, 'missing')!r}, expected true or false.")
    return bool(meta[key])


def _world_to_output(meta: Mapping[str, Any], path: Path) -> tuple[np.ndarray, float, str]:
    """The similarity to the frame of the Scene: rigid part with translation (4, 4), scale, unit."""
    if meta.get("worldtogt") is None:
        return np.eye(4), 1.0, "input unit"
    where = f"{path}: key 'worldtogt'"
    matrix = numbers(meta["worldtogt"], f"{where} is not a matrix of numbers, expected 4x4.")
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise InputError(f"{where} is not a finite 4x4 matrix, expected a similarity (rotation, one scale, translation).")
    scale = float(np.sqrt((matrix[:3, :3] ** 2).sum() / 3))  # of a similarity: every row has the length s
    if scale <= 0:
        raise InputError(f"{where} is singular, expected a similarity (rotation, one scale, translation).")
    unscaled = matrix.copy()
    unscaled[:3, :3] /= scale
    try:
        return rigid_pose(unscaled, where), scale, "m"
    except InputError as error:
        raise InputError(f"{where} is not a similarity, expected a rotation, one scale and a translation.") from error


def _camera(meta: Mapping[str, Any], entry: Mapping[str, Any], path: Path, where: str) -> Camera:
    offset = number(meta, "pixel_offset", str(path), default=0.0)
    undistorted = _flag(meta, "undistorted", path)
    model = str(entry.get("camera_model", "OPENCV")).upper()
    if model not in _MODELS:
        raise InputError(f"{where}: camera_model {model} is not supported yet, expected one of {' '.join(_MODELS)}.")
    distortion: list[float] = []
    if not undistorted and model not in _PINHOLE_MODELS:
        given = entry.get("distortion_params")
        expected = _MODELS[model]
        if not isinstance(given, list) or len(given) != len(expected) or not all(is_number(value) for value in given):
            count = {4: "four", 6: "six", 8: "eight"}[len(expected)]
            raise InputError(f"{where}: key 'distortion_params' is {given}, expected the {count} numbers {' '.join(expected)}.")
        distortion = [float(value) for value in given]
    size = whole(entry, "width", where), whole(entry, "height", where)
    fx, fy, cx, cy = (number(entry, key, where) for key in ("fx", "fy", "cx", "cy"))
    lens: Lens = "kannala_brandt" if model == "OPENCV_FISHEYE" else "brown_conrady"
    return make_camera(where, size, (fx, fy, cx - offset, cy - offset), distortion, lens)


def _frames(stated: Iterable[Stated], root: Path, folder: Path, source: str, name: str) -> tuple[list[Frame], int]:
    """Frames with an image file, by view, and the count of those without."""
    present: dict[int, Frame] = {}
    missing = 0
    for view, file_name, camera, pose in stated:
        path = folder / file_name
        if not is_file(path):
            missing += 1
            continue
        mask = root / "masks" / source / f"{view:04d}.png"
        present[view] = Frame(name, view, path, camera, pose, source, mask if mask.is_file() else None)
    return [present[view] for view in sorted(present)], missing


Stated = tuple[int, str, Camera, np.ndarray]  # view id, file name, camera, camera_to_world (4, 4)


def _stated_frames(
    meta: Mapping[str, Any], entry: Mapping[str, Any], path: Path, where: str, to_output: np.ndarray, scale: float
) -> Iterator[Stated]:
    """What a modality lists, in its order; poses in the frame of the Scene."""
    camera = _camera(meta, entry, path, where)
    seen: set[int] = set()
    for index, item in enumerate(objects(entry, "frames", where)):
        view = whole(item, "frame_id", f"{where}, frame entry {index}", 0, MAX_VIEW)
        here = f"{where}, frame {view}"
        if view in seen:
            raise InputError(f"{here} is listed twice, expected every frame_id once.")
        seen.add(view)
        if not isinstance(item.get("file_name"), str):
            raise InputError(f"{here}: key 'file_name' is {item.get('file_name', 'missing')!r}, expected the name of an image file.")
        pose = rigid_pose(item.get("camtoworld"), here) @ OPENGL_TO_OPENCV
        pose[:3, 3] *= scale  # then the rigid part: together s R x + t
        yield view, item["file_name"], _camera(meta, {**entry, **item}, path, here) if "fx" in item else camera, to_output @ pose


def _split(root: Path, meta: Mapping[str, Any], views: Iterable[int]) -> Split:
    """Test views: those of ``test_ids``, else those that have a ground truth image in ``gt/<modality>/``."""
    if "test_ids" in meta:
        return make_split(views, view_ids(meta, "test_ids", root / "meta_data.json"), "test_ids")
    folders = [root / "gt" / source for source in meta["modalities"]]
    stems = {file.stem for folder in folders if folder.is_dir() for file in folder.iterdir()}
    return make_split(views, (int(stem) for stem in stems if stem.isdecimal()), "views in gt/")
