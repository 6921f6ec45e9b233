"""Middlebury multi-view scenes: images and ``*_par.txt`` with one line ``name K R t`` per image, P = K [R t].

``[R t]`` is world to camera in OpenCV axes, and the origin is the top-left pixel. The tight bounding box in ``README.txt``
gives the region of interest (the ball around it); without it the cameras do. The id of a view is its line's position.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mmsynth.errors import InputError
from mmsynth.scene.checks import floats, make_camera, rigid_pose, text_lines
from mmsynth.scene.images import read_native
from mmsynth.scene.known_sensors import make_sensor, wanted_modalities
from mmsynth.scene.layouts.pictures import Pictures, Resizes
from mmsynth.scene.region import region_from_cameras
from mmsynth.scene.scene import Frame, Region, Scene, ball, make_split


def read_middlebury(root: Path, modalities: Sequence[str] | None = None, images: Path | None = None) -> Scene:
    """Read the scene in a folder, as ``load_scene``: one modality, rgb, or mono for grey images. What is listed and missing is left out."""
    files = sorted(root.glob("*_par.txt"))
    if len(files) != 1:
        raise InputError(f"{root}: {len(files)} files match *_par.txt, expected one.")
    path = files[0]
    pictures, resizes = Pictures(root, images), Resizes(str(path))
    found: list[tuple[int, Path, list[float], np.ndarray]] = []
    missing = 0
    lines = [line for line in text_lines(path) if line[1]]
    lines = lines[1:] if lines and len(lines[0][1]) == 1 else lines  # the count of images
    for view, (where, tokens) in enumerate(lines):
        intrinsics, pose = _parse(tokens, where)
        file = pictures.find(tokens[0])
        if file is not None:
            found.append((view, file, intrinsics, pose))
        else:
            missing += 1
    if not found:
        raise InputError(f"{path}: none of the {missing} images listed is in {images or root}.")
    first = read_native(found[0][1])
    name = "mono" if first.ndim == 2 or first.shape[2] == 2 else "rgb"
    wanted_modalities([name], modalities, path)
    frames = tuple(
        Frame(name, view, image, make_camera(f"{path}: view {view}", resizes.size_of(image), intrinsics), pose, name)
        for view, image, intrinsics, pose in found
    )
    region = _stated_region(root) or region_from_cameras([f.camera for f in frames], [f.camera_to_world for f in frames])
    problems = (f"{missing} of {missing + len(found)} frames have no image file and are left out.",) if missing else ()
    sensors = {name: make_sensor(name, {}, str(path), first, raw=False)}
    return Scene(root, "Middlebury", sensors, frames, region, make_split(f.view for f in frames), problems=problems)


def _parse(tokens: Sequence[str], where: str) -> tuple[list[float], np.ndarray]:
    """fx, fy, cx, cy and camera_to_world (4, 4)."""
    values = floats(tokens[1:], where, "name, K, R, t")
    if len(values) != 21:
        raise InputError(f"{where}: {len(values)} numbers, expected 'name' and the 21 numbers of K, R and t.")
    matrix = values[:9].reshape(3, 3)
    if matrix[2, 2] <= 0 or np.abs(matrix[[1, 2, 2], [0, 0, 1]]).max() > 0:
        raise InputError(f"{where}: K is not upper triangular with a positive last entry.")
    matrix = matrix / matrix[2, 2]
    if abs(matrix[0, 1]) > 1e-6 * matrix[0, 0]:
        raise InputError(f"{where}: K has the skew {matrix[0, 1]:g}, expected 0: cameras with skew are not supported.")
    world_to_camera = rigid_pose(np.column_stack([values[9:18].reshape(3, 3), values[18:]]), where)
    camera_to_world = np.eye(4)
    camera_to_world[:3, :3] = world_to_camera[:3, :3].T
    camera_to_world[:3, 3] = -world_to_camera[:3, :3].T @ world_to_camera[:3, 3]
    return matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(), camera_to_world


def _stated_region(root: Path) -> Region | None:
    """The ball around the bounding box in README.txt: two lines '(x y z)', the corners."""
    path = root / "README.txt"
    if not path.is_file():
        return None
    triple = r"\(\s*([-+.\deE]+)[\s,]+([-+.\deE]+)[\s,]+([-+.\deE]+)\s*\)"
    match = re.search(triple + r"\s+" + triple, path.read_text(encoding="utf-8", errors="replace"))
    if match is None:
        return None
    try:
        corners = np.array([float(value) for value in match.groups()]).reshape(2, 3)
    except ValueError:
        return None
    radius = float(np.linalg.norm(corners[1] - corners[0]) / 2)
    return ball(corners.mean(0), radius) if radius > 0 else None
