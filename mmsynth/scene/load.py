"""Read a scene, or poses, of any known layout; refuse a scene that nothing can be learned from."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mmsynth.errors import InputError
from mmsynth.files import read_json
from mmsynth.scene.checks import rigid_pose
from mmsynth.scene.layouts.colmap import read_images_txt
from mmsynth.scene.layouts.middlebury import read_middlebury
from mmsynth.scene.layouts.mmsdata import read_mmsdata, read_mmsdata_points, read_reference_poses
from mmsynth.scene.layouts.nerfstudio import read_camera_path, read_nerfstudio, read_nerfstudio_points, read_transforms
from mmsynth.scene.layouts.tum import is_tum, read_tum
from mmsynth.scene.points import SparsePoints
from mmsynth.scene.scene import Frame, Region, Scene, StatedPose
from mmsynth.sensors.camera import Camera, project, round_trip_error, unproject

_ROUND_TRIP = 1e-3  # pixels


def load_scene(path: Path | str, *, modalities: Sequence[str] | None = None) -> Scene:
    """Read a scene; its layout is recognised by the files in the folder.

    ``meta_data.json``: MMS-DATA; ``transforms.json``: nerfstudio or instant-ngp; ``*_par.txt``: Middlebury.

    Args:
        path: the scene's folder, or one of these JSON files.
        modalities: names or aliases of the sensors to read; None: all.
    Raises:
        InputError: nothing there, unknown format or modality, bad metadata, fewer than two frames to train on, or no
            camera that sees the region of interest.
    """
    path = Path(path)
    scene = _reader(path)(path.parent if path.name == "meta_data.json" else path, modalities)
    training = [frame for frame in scene.frames if frame.view in scene.split.train]
    if len(training) < 2:
        raise InputError(f"{path}: {len(training)} frames to train on ({len(scene.frames)} in all), expected at least 2.")
    problems = [*scene.problems, *_lens_problems(scene)]
    for name in scene.sensors:
        if not any(frame.sensor == name for frame in training):
            problems.append(f"{name}: none of its frames is in a training view.")
    blind = [frame for frame in scene.frames if not sees(frame, scene.region)]
    if len(blind) > 0.75 * len(scene.frames):
        # poses and region in different frames: the few that still see it do so by accident
        raise InputError(
            f"{path}: {len(blind)} of {len(scene.frames)} frames do not see the region of interest "
            f"(centre ({', '.join(f'{value:.4g}' for value in scene.region.centre)}), radius {scene.region.radius:.4g}), "
            "expected poses and region in one frame."
        )
    if blind:
        example = f"{blind[0].sensor} view {blind[0].view}"
        problems.append(f"{len(blind)} of {len(scene.frames)} frames do not see the region of interest, the first is {example}.")
    return dataclasses.replace(scene, problems=tuple(problems))


def _reader(path: Path) -> Callable[[Path, Sequence[str] | None], Scene]:
    if not path.exists():
        raise InputError(f"{path}: no such file or folder.")
    if path.is_file():
        if path.suffix.lower() != ".json":
            raise InputError(f"{path}: not a scene, expected a folder or its JSON file.")
        return read_mmsdata if path.name == "meta_data.json" else read_nerfstudio
    if (path / "meta_data.json").is_file():
        return read_mmsdata
    if (path / "transforms.json").is_file():
        return read_nerfstudio
    if any(path.glob("*_par.txt")):
        return read_middlebury
    if (path / "calibration.json").is_file():
        raise InputError(f"{path}: calibration.json without meta_data.json is an MMS-DATA source scene, which has no camera poses.")
    raise InputError(f"{path}: not a scene, expected meta_data.json (MMS-DATA), transforms.json (nerfstudio) or *_par.txt (Middlebury).")


def read_poses(path: Path) -> list[StatedPose]:
    """Read the poses to render from, in file order.

    Accepted:

    * nerfstudio ``transforms.json`` (OpenGL axes);
    * nerfstudio ``camera_path.json`` (OpenGL axes, vertical field of view in degrees, square pixels, no distortion; its poses are
      taken to be in the scene's frame);
    * MMS-DATA ``meta_data.json``: the poses of its first modality, in the frame and unit in which the scene is read;
    * COLMAP ``images.txt`` (with ``cameras.txt`` beside it if there), or a folder that holds it;
    * TUM, ``.tum`` or ``.txt``: lines ``t tx ty tz qx qy qz qw``, camera to world, OpenCV axes; no intrinsics. The name of a pose is
      its time as the file spells it. A ``.txt`` of another name than ``images.txt`` is TUM when its first line has at most eight values;
    * ``{"convention": "OpenCV ...", "rig": [4x4, ...]}`` (OpenCV axes).

    Raises:
        InputError: missing or unknown file, no pose in it, or a pose that is not finite and rigid.
    """
    path = Path(path)
    if path.is_dir():
        path = path / "images.txt"
    if is_tum(path):
        poses = read_tum(path)
    elif path.suffix.lower() == ".txt":
        poses = read_images_txt(path)
    else:
        content = read_json(path)
        if not isinstance(content, dict):
            kind = type(content).__name__
            raise InputError(f"{path}: a JSON {kind}, expected an object with 'frames', 'camera_path', 'modalities' or 'rig'.")
        if "frames" in content:
            poses = read_transforms(content, path)
        elif "camera_path" in content:
            poses = read_camera_path(content, path)
        elif "modalities" in content:
            poses = read_reference_poses(path)
        elif "rig" in content:
            poses = _read_matrices(content, path)
        else:
            raise InputError(f"{path}: none of the keys 'frames' (transforms.json), 'camera_path', 'modalities' (MMS-DATA) or 'rig' found.")
    if not poses:
        raise InputError(f"{path}: no poses in it, expected at least one.")
    return poses


def _read_matrices(content: Mapping[str, Any], path: Path) -> list[StatedPose]:
    convention = str(content.get("convention", "OpenCV"))
    if "opencv" not in convention.lower():
        raise InputError(f"{path}: key 'convention' is '{convention}', expected OpenCV axes (x right, y down, z forward).")
    if not isinstance(content["rig"], list):
        raise InputError(f"{path}: key 'rig' is not a list of 4x4 matrices.")
    return [StatedPose(None, rigid_pose(matrix, f"{path}: pose {index}"), f"{index:04d}") for index, matrix in enumerate(content["rig"])]


def sparse_points(scene: Scene) -> SparsePoints | None:
    """The sparse points that lie with a scene, in its frame and unit; None where there are none."""
    readers: dict[str, Callable[[Path], SparsePoints | None]] = {"MMS-DATA": read_mmsdata_points, "nerfstudio": read_nerfstudio_points}
    read = readers.get(scene.format)
    return None if read is None else read(scene.root)


def sees(frame: Frame, region: Region) -> bool:
    """Whether a ray of the frame meets the region: one of 9x9 rays over the frame, corners included, or the one to its centre."""
    camera = frame.camera
    to_camera = np.linalg.inv(frame.camera_to_world)
    centre = to_camera[:3, :3] @ np.asarray(region.centre) + to_camera[:3, 3]
    if np.linalg.norm(centre) <= region.radius:
        return True  # the camera is inside
    directions, valid = _looks(camera)
    along = directions @ centre
    hit = valid & (along > 0) & (centre @ centre - along**2 <= region.radius**2)
    if hit.any():
        return True
    # a region smaller than the spacing of the rays
    pixel = project(centre, camera)
    return bool(np.all(pixel >= -0.5) and np.all(pixel <= np.array([camera.width, camera.height]) - 0.5))


def _grid(camera: Camera) -> np.ndarray:
    """(81, 2) pixels: 9x9 over the frame, corners included."""
    return np.stack(np.meshgrid(np.linspace(0, camera.width - 1, 9), np.linspace(0, camera.height - 1, 9)), -1).reshape(-1, 2)


@functools.lru_cache(maxsize=256)
def _looks(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Rays of the grid: unit directions (81, 3) and whether the lens has them."""
    return unproject(_grid(camera), camera)


def _lens_problems(scene: Scene) -> list[str]:
    """A sentence for every sensor whose lens model has no ray for a part of its pictures, or rays that do not come back."""
    errors, lost = dict.fromkeys(scene.sensors, 0.0), dict.fromkeys(scene.sensors, 0.0)
    for name, camera in dict.fromkeys((frame.sensor, frame.camera) for frame in scene.frames):
        error, missing = round_trip_error(camera, _grid(camera))
        errors[name], lost[name] = max(errors[name], error), max(lost[name], missing)
    found = [f"{n}: the lens model has no ray for about {part:.0%} of the pixels; they are not used." for n, part in lost.items() if part]
    return found + [f"{n}: rays come back {e:.1g} pixels from where they began." for n, e in errors.items() if e > _ROUND_TRIP]
