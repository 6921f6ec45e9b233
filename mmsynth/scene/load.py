"""Read a scene, or poses, of any known layout; refuse a scene that nothing can be learned from."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mmsynth.errors import InputError
from mmsynth.files import read_json
from mmsynth.scene.also import stated_source, with_sensors
from mmsynth.scene.checks import rigid_pose
from mmsynth.scene.layouts.blender import SPLITS, file_of, read_blender
from mmsynth.scene.layouts.colmap import halves_in, models_in, read_colmap, read_colmap_points
from mmsynth.scene.layouts.colmap_model import read_model_poses
from mmsynth.scene.layouts.middlebury import read_middlebury
from mmsynth.scene.layouts.mmsdata import read_mmsdata, read_mmsdata_points, read_reference_poses
from mmsynth.scene.layouts.nerfstudio import read_camera_path, read_nerfstudio, read_nerfstudio_points, read_transforms
from mmsynth.scene.layouts.neus import cameras_of, read_neus
from mmsynth.scene.layouts.tum import is_tum, read_tum
from mmsynth.scene.masks import use_masks
from mmsynth.scene.points import SparsePoints
from mmsynth.scene.scene import Frame, Layout, MaskMeaning, Region, Scene, SceneSource, StatedPose
from mmsynth.sensors.camera import Camera, project, round_trip_error, unproject

_ROUND_TRIP = 1e-3  # pixels


@dataclass(frozen=True)
class _Reader:
    """How a layout is recognised in a folder, and read: (folder or file, modalities, folder of the pictures) -> Scene."""

    marks: str
    is_in: Callable[[Path], bool]
    read: Callable[[Path, Sequence[str] | None, Path | None], Scene]


# of two layouts with as many pictures, the first is taken
_READERS: dict[Layout, _Reader] = {
    "MMS-DATA": _Reader("meta_data.json", lambda root: (root / "meta_data.json").is_file(), read_mmsdata),
    "nerfstudio": _Reader("transforms.json", lambda root: (root / "transforms.json").is_file(), read_nerfstudio),
    "Blender": _Reader("transforms_train.json", lambda root: any(file_of(root, split).is_file() for split in SPLITS), read_blender),
    "COLMAP": _Reader("sparse/0", lambda root: bool(models_in(root)), read_colmap),
    "NeuS": _Reader("cameras_sphere.npz", lambda root: cameras_of(root) is not None, read_neus),
    "Middlebury": _Reader("*_par.txt", lambda root: any(root.glob("*_par.txt")), read_middlebury),
}


def load_scene(
    path: Path | str,
    *,
    modalities: Sequence[str] | None = None,
    layout: str | None = None,
    images: Path | str | None = None,
    also: Mapping[str, str] | None = None,
    masks: MaskMeaning | None = None,
    mask_folder: Path | None = None,
) -> Scene:
    """Read a scene; its layout is recognised by the files in the folder.

    ``meta_data.json``: MMS-DATA; ``transforms.json``: nerfstudio or instant-ngp; ``transforms_train.json`` ...: NeRF-synthetic (Blender);
    ``sparse/0`` ...: COLMAP; ``cameras_sphere.npz``: NeuS, IDR; ``*_par.txt``: Middlebury. Of several in one folder that with more
    pictures is read, and ``Scene.problems`` says so. A ``scene.toml`` in the folder may hold ``layout``, ``images`` and ``also``; what is
    given here wins.

    Args:
        path: the scene's folder, or one of these JSON files.
        modalities: names or aliases of the sensors to read; None: all.
        layout: name of a layout, in any case; None: the one that the folder holds.
        images: folder where the pictures are, by the names that the metadata give them, with any suffix; None: where the metadata say.
        also: more sensors of a layout made for one, by name, ``FOLDER`` or ``FOLDER:calibration.json``, see ``scene.also``.
            Folders are relative to the scene's folder, or else to the working folder.
        masks: what they mean; None: what the layout says. mask_folder: where they are, see ``masks.find_masks``; None: where the layout
            has them.
    Raises:
        InputError: nothing there, unknown format or modality, bad metadata, fewer than two frames to train on, no camera that sees the
            region of interest, or a folder without masks of this scene.
    """
    source = stated_source(Path(path), layout, images, also)
    scene = _read(source, None if source.also else modalities)
    scene = with_sensors(scene, dict(source.also), modalities)
    return use_masks(dataclasses.replace(_checked(scene, source.path), source=source), masks, mask_folder)


def load_again(
    stated: Mapping[str, Any],
    *,
    modalities: Sequence[str] | None = None,
    masks: MaskMeaning | None = None,
    mask_folder: Path | None = None,
) -> Scene:
    """Read the scene of a run again: ``stated`` is what its manifest says of the scene (``serialisation.source_to_json``).

    Args:
        masks, mask_folder: see ``use_masks``; None: as the manifest has them.
    """
    how = {key: stated.get(key) for key in ("images", "also")}
    of_fit = stated.get("mask_folder")
    return load_scene(
        stated["path"],
        modalities=modalities,
        layout=stated.get("format"),
        masks=masks or stated.get("masks"),
        mask_folder=mask_folder or (Path(of_fit) if of_fit else None),
        **how,
    )


def _checked(scene: Scene, path: Path) -> Scene:
    """The scene with what is to be said of it; refused where nothing can be learned."""
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


def _read(source: SceneSource, modalities: Sequence[str] | None) -> Scene:
    path, images = source.path, source.images
    if path.is_file():
        name: Layout = "MMS-DATA" if path.name == "meta_data.json" else "nerfstudio"
        if path.suffix.lower() != ".json":
            raise InputError(f"{path}: not a scene, expected a folder or its JSON file.")
        if source.layout not in (None, name):
            raise InputError(f"{path}: a file of the layout {name}, expected the folder for the layout {source.layout}.")
        return _READERS[name].read(path.parent if name == "MMS-DATA" else path, modalities, images)
    if source.layout is not None:
        reader = _READERS[source.layout]
        if not reader.is_in(path):
            raise InputError(f"{path}: no {reader.marks} in it, expected the layout {source.layout}.")
        return reader.read(path, modalities, images)
    held = [name for name, reader in _READERS.items() if reader.is_in(path)]
    if not held and (path / "calibration.json").is_file():
        raise InputError(f"{path}: calibration.json without meta_data.json is an MMS-DATA source scene, which has no camera poses.")
    if not held and (halves := halves_in(path)):
        raise InputError(halves[0])
    if not held:
        known = ", ".join(f"{reader.marks} ({name})" for name, reader in _READERS.items())
        raise InputError(f"{path}: not a scene, expected {known}.")
    return _READERS[held[0]].read(path, modalities, images) if len(held) == 1 else _richest(path, held, modalities, images)


def _richest(path: Path, held: Sequence[Layout], modalities: Sequence[str] | None, images: Path | None) -> Scene:
    """The scene with the most pictures of a folder that holds several layouts."""
    found: dict[Layout, Scene] = {}
    refused: dict[Layout, InputError] = {}
    for name in held:
        try:
            found[name] = _READERS[name].read(path, modalities, images)
        except InputError as error:
            refused[name] = error
    if not found:
        raise next(iter(refused.values()))
    taken = max(found, key=lambda name: len(found[name].frames))
    files = {frame.path for frame in found[taken].frames}
    # the same pictures described twice, as ``mmsynth pose`` does, leave nothing to decide
    others = [f"{name} with {len(s.frames)}" for name, s in found.items() if {frame.path for frame in s.frames} != files]
    others += [f"{name}, which cannot be read ({str(error).rstrip('.')})" for name, error in refused.items()]
    if not others:
        return found[taken]
    note = f"read as {taken}, {len(found[taken].frames)} pictures; the folder also holds {', '.join(others)}: --layout NAME decides."
    return dataclasses.replace(found[taken], problems=(note, *found[taken].problems))


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
        poses = read_model_poses(path)
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
    if scene.format == "COLMAP":
        return read_colmap_points(scene.root, scene.source.images if scene.source else None)
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
