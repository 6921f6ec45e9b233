"""NeuS and IDR (DTU, BlendedMVS): ``cameras_sphere.npz`` (or ``cameras.npz``), ``image/`` (or ``images/``), ``mask/``.

* P = (world_mat_i @ scale_mat_i)[:3] projects points of a frame in which the unit sphere is the region of interest; P = K R [1 | -C], with
  the centre of the top-left pixel at (0, 0). That frame is the scene's; ``scale_mat_0`` takes it to the world of ``world_mat``.
* Matrix i belongs to the i-th picture by name. Where there are fewer pictures than matrices, the numbers in their names say which.
* Masks are the object: outside of them is nothing, whatever colour the pictures have there.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from mmsynth.errors import InputError
from mmsynth.scene.checks import make_camera, rigid_pose
from mmsynth.scene.images import SUFFIXES, read_native, read_npz
from mmsynth.scene.known_sensors import make_sensor, wanted_modalities
from mmsynth.scene.layouts.pictures import Resizes
from mmsynth.scene.scene import Frame, Region, Scene, make_split

_FILES = ("cameras_sphere.npz", "cameras.npz", "cameras_large.npz")
_SKEW = 1e-4  # of the focal length: 0.05 pixels at the border of a picture of 1000


def cameras_of(root: Path) -> Path | None:
    """The file with the cameras; None where there is none."""
    return next((root / name for name in _FILES if (root / name).is_file()), None)


def read_neus(root: Path, modalities: Sequence[str] | None = None, images: Path | None = None) -> Scene:
    """Read the scene in a folder, as ``load_scene``: one modality, rgb, or mono for grey images."""
    path = cameras_of(root)
    if path is None:
        raise InputError(f"{root}: none of {', '.join(_FILES)} in it.")
    arrays = read_npz(path)
    matrices = {int(key.removeprefix("world_mat_")): key for key in arrays if re.fullmatch(r"world_mat_\d{1,6}", key)}
    if not matrices:
        raise InputError(f"{path}: no array 'world_mat_0', expected one for each picture.")
    folder = images or _folder(root, "image", "images")
    if folder is None:
        raise InputError(f"{root}: no folder 'image' or 'images' in it; --images FOLDER says where the pictures are.")
    files = _numbered(folder, sorted(matrices), path)
    if not files:
        raise InputError(f"{folder}: no pictures in it.")
    first = read_native(next(iter(files.values())))
    name = "mono" if first.ndim == 2 or first.shape[2] == 2 else "rgb"
    wanted_modalities([name], modalities, path)
    masks = _masks(root, files, path)
    resizes = Resizes(str(folder))
    frames = []
    for view, file in files.items():
        intrinsics, pose = _decomposed(_projection(arrays, view, path), f"{path}: world_mat_{view}")
        camera = make_camera(f"{path}: world_mat_{view}", resizes.size_of(file), intrinsics)
        frames.append(Frame(name, view, file, camera, pose, name, masks.get(view)))
    problems = [f"{len(matrices) - len(files)} of {len(matrices)} cameras have no picture."] if len(files) < len(matrices) else []
    if 0 < len(masks) < len(files):
        problems.append(f"{len(files) - len(masks)} of {len(files)} pictures have no mask.")
    return Scene(
        root, "NeuS", {name: make_sensor(name, {}, str(path), first, raw=False)}, tuple(frames), Region((0.0, 0.0, 0.0), 1.0),
        make_split(files), masks="object", problems=tuple(problems),
    )  # fmt: skip


def _folder(root: Path, *names: str) -> Path | None:
    return next((root / name for name in names if (root / name).is_dir()), None)


def _numbered(folder: Path, numbers: Sequence[int], path: Path) -> dict[int, Path]:
    """The pictures of a folder by the number of their matrices."""
    files = sorted(file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES and not file.name.startswith("."))
    if len(files) == len(numbers):
        return dict(zip(numbers, files, strict=True))
    named = {int(file.stem): file for file in files if re.fullmatch(r"\d{1,9}", file.stem)}
    if len(named) < len(files) or not named.keys() <= set(numbers):
        raise InputError(
            f"{folder}: {len(files)} pictures for {len(numbers)} cameras of {path.name}, expected one for each, or numbers as names."
        )
    return {number: named[number] for number in sorted(named)}


def _masks(root: Path, files: Mapping[int, Path], path: Path) -> dict[int, Path]:
    """Masks by the number of their pictures: as many and in the same order, or called the same."""
    folder = _folder(root, "mask", "masks")
    if folder is None:
        return {}
    found = sorted(file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES and not file.name.startswith("."))
    if len(found) == len(files):
        return dict(zip(files, found, strict=True))
    by_name = {_plain(file.stem): file for file in found}
    return {view: by_name[_plain(file.stem)] for view, file in files.items() if _plain(file.stem) in by_name}


def _plain(stem: str) -> str:
    """A number without the zeros before it: pictures 000012, masks 012."""
    return str(int(stem)) if re.fullmatch(r"\d{1,9}", stem) else stem


def _projection(arrays: Mapping[str, np.ndarray], number: int, path: Path) -> np.ndarray:
    """(3, 4) P, from the unit sphere's frame to pixels."""
    parts = []
    for key in (f"world_mat_{number}", f"scale_mat_{number}"):
        value = arrays.get(key)
        if value is None or value.shape != (4, 4) or value.dtype.kind not in "fiu" or not np.isfinite(value).all():
            shape = "missing" if value is None else f"of shape {value.shape} and type {value.dtype}"
            raise InputError(f"{path}: array '{key}' is {shape}, expected a finite 4x4 matrix.")
        parts.append(value.astype(np.float64))
    return np.asarray((parts[0] @ parts[1])[:3])


def _decomposed(projection: np.ndarray, where: str) -> tuple[list[float], np.ndarray]:
    """fx, fy, cx, cy and camera_to_world (4, 4) of P = K R [1 | -C] (RQ decomposition)."""
    scale = float(np.abs(projection).max())
    if not 0 < scale < np.inf or abs(np.linalg.det(projection[:, :3] / scale)) < 1e-15:
        raise InputError(f"{where}: the projection is singular, expected K R [1 | -C].")
    # the sign of P is free: points in front of the camera have a positive third coordinate when det K R > 0
    projection = projection / scale * np.sign(np.linalg.det(projection[:, :3] / scale))
    matrix, rotation = cv2.decomposeProjectionMatrix(projection)[:2]
    signs = np.diag(np.where(np.diag(matrix) < 0, -1.0, 1.0))
    matrix, rotation = matrix @ signs, signs @ rotation
    matrix = matrix / matrix[2, 2]
    if abs(matrix[0, 1]) > _SKEW * matrix[0, 0]:
        raise InputError(f"{where}: K has the skew {matrix[0, 1]:.3g} at a focal length of {matrix[0, 0]:.5g}, expected none.")
    centre = -np.linalg.solve(projection[:, :3], projection[:, 3])
    pose = rigid_pose(np.column_stack([rotation.T, centre]), where)
    return matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(), pose
