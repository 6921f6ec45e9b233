"""COLMAP's text model: ``images.txt``, and ``cameras.txt`` beside it.

Poses are world to camera in OpenCV axes; principal points have the top-left pixel's centre at 0.5.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mmsynth.errors import InputError
from mmsynth.scene.checks import floats, make_camera, rotation_of, text_lines
from mmsynth.scene.scene import StatedPose
from mmsynth.sensors.camera import COEFFICIENTS, Camera, Lens

_LINE = "id qw qx qy qz tx ty tz camera name"
# what each parameter of a COLMAP camera model is, in file order
_MODELS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
}


def read_images_txt(path: Path) -> list[StatedPose]:
    """Poses of ``images.txt``, where every image takes two lines, ``id qw qx qy qz tx ty tz camera name`` and its 2-D points.

    Raises:
        InputError: a line that is not that, or a camera that ``cameras.txt`` does not have or that is not supported.
    """
    cameras = _cameras(path.with_name("cameras.txt"))
    out: list[StatedPose] = []
    points_expected = False
    for where, tokens in text_lines(path):
        # a points line holds triples and may be empty or, in some files, left out; an image line never has 3 n tokens
        # unless the name has spaces, and then it comes where no points line is expected
        if points_expected and len(tokens) % 3 == 0:
            points_expected = False
            continue
        if not tokens:
            continue
        if len(tokens) < 10:
            raise InputError(f"{where}: {len(tokens)} values, expected '{_LINE}'.")
        values = floats(tokens[1:8], where, _LINE)
        if not tokens[8].isdecimal() or len(tokens[8]) > 18:
            raise InputError(f"{where}: camera {tokens[8]} is not a whole number, expected '{_LINE}'.")
        camera_id = int(tokens[8])
        if cameras is not None and camera_id not in cameras:
            raise InputError(f"{where}: camera {camera_id} is not in {path.with_name('cameras.txt')}.")
        camera_to_world = np.eye(4)
        camera_to_world[:3, :3] = rotation_of(values[:4], where).T
        camera_to_world[:3, 3] = -camera_to_world[:3, :3] @ values[4:7]
        camera = None if cameras is None else cameras[camera_id]
        out.append(StatedPose(camera, camera_to_world, Path(" ".join(tokens[9:])).stem))
        points_expected = True
    return out


def _cameras(path: Path) -> dict[int, Camera] | None:
    if not path.is_file():
        return None
    out: dict[int, Camera] = {}
    for where, tokens in text_lines(path):
        if not tokens:
            continue
        if len(tokens) < 4 or tokens[1] not in _MODELS:
            models = " ".join(_MODELS)
            raise InputError(f"{where}: unsupported camera, expected 'id model width height ...' with one of the models {models}.")
        names = _MODELS[tokens[1]].split()
        try:
            identity, size = int(tokens[0]), (int(tokens[2]), int(tokens[3]))
            value = dict(zip(names, map(float, tokens[4:]), strict=True))
        except ValueError as error:
            raise InputError(f"{where}: expected {len(names)} numbers ({' '.join(names)}) after the size.") from error
        lens: Lens = "kannala_brandt" if tokens[1] == "OPENCV_FISHEYE" else "brown_conrady"
        distortion = [value.get(key, 0.0) for key in COEFFICIENTS[lens]]
        fx, fy = (value[key] if key in value else value["f"] for key in ("fx", "fy"))
        out[identity] = make_camera(where, size, (fx, fy, value["cx"] - 0.5, value["cy"] - 0.5), distortion, lens)
    return out
