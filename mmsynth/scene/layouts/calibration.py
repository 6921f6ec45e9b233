"""The rig's calibration, ``calibration.json``: one object for each sensor, the first is the reference.

The format is that of MMS-DATA's source scenes: ``width height fx fy cx cy`` [px] with the centre of the top-left pixel at (0, 0),
``distortion_params``, ``mosaick_pattern``, and ``camera2reference``, 4x4, OpenCV axes, metres: points of the sensor's camera into that of
the reference. ``distortion_params`` is k1 k2 p1 p2 k3 k4, of which MMS-DATA needs all six; here also fewer or more, k1 k2 p1 p2 [k3 [k4 k5
k6]], and with ``camera_model`` "OPENCV_FISHEYE" k1 k2 k3 k4 of Kannala-Brandt. The keys that describe a sensor beyond that are those of
``known_sensors.make_sensor``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mmsynth.errors import InputError
from mmsynth.files import read_json, write_json
from mmsynth.scene.checks import is_number, make_camera, number, rigid_pose, whole
from mmsynth.scene.known_sensors import DESCRIBED_BY
from mmsynth.scene.scene import canonical_modality
from mmsynth.sensors.camera import Camera, Lens

FISHEYE_MODEL = "OPENCV_FISHEYE"


@dataclass(frozen=True)
class RigSensor:
    """A sensor at its place on a rig.

    Attributes:
        camera_to_reference: (4, 4) float64, rigid, metres: points of this camera → points of the reference camera.
        described: keys of the file that describe the sensor (``make_sensor``), such as ``mosaick_pattern``; empty: by its name alone.
        source_name: the sensor as the file spells it.
    """

    camera: Camera
    camera_to_reference: np.ndarray
    described: Mapping[str, Any] = field(default_factory=dict)
    source_name: str = ""


Rig = dict[str, RigSensor]
"""By canonical name; the first is the reference."""


def read_calibration(path: Path) -> Rig:
    """Read a rig.

    Raises:
        InputError: unreadable, no sensor, two of one name, a bad camera, or a first sensor whose camera2reference is not the identity.
    """
    content = read_json(path)
    if not isinstance(content, dict) or not content:
        raise InputError(f"{path}: expected an object with one entry for each sensor.")
    rig: Rig = {}
    for source, entry in content.items():
        where, name = f"{path}: sensor '{source}'", canonical_modality(source)
        if not isinstance(entry, dict):
            raise InputError(f"{where} is not an object.")
        if name in rig:
            raise InputError(f"{path}: two sensors are called '{name}' or an alias of it, expected one.")
        described = {key: entry[key] for key in DESCRIBED_BY if key in entry}
        place = rigid_pose(entry.get("camera2reference"), f"{where}, camera2reference")
        if not rig and np.abs(place - np.eye(4)).max() > 1e-9:
            raise InputError(f"{where}: the first sensor is the reference, expected camera2reference to be the identity.")
        rig[name] = RigSensor(_camera(entry, where), place, described, source)
    return rig


def write_calibration(path: Path, rig: Rig) -> None:
    """Write a rig, which ``read_calibration`` gives back but for the rounding of rotations. Raises InputError: cannot be written."""
    write_json(path, {sensor.source_name or name: _entry(sensor) for name, sensor in rig.items()})


def _camera(entry: Mapping[str, Any], where: str) -> Camera:
    lens: Lens = "kannala_brandt" if str(entry.get("camera_model", "")).upper() == FISHEYE_MODEL else "brown_conrady"
    given = entry.get("distortion_params", [])
    if not isinstance(given, list) or not all(is_number(value) for value in given):
        raise InputError(f"{where}: key 'distortion_params' is {given!r}, expected a list of numbers: k1 k2 p1 p2 k3 k4.")
    size = whole(entry, "width", where), whole(entry, "height", where)
    intrinsics = [number(entry, key, where) for key in ("fx", "fy", "cx", "cy")]
    return make_camera(where, size, intrinsics, [float(value) for value in given], lens)


def _entry(sensor: RigSensor) -> dict[str, Any]:
    camera = sensor.camera
    distortion = camera.coefficients.tolist()
    if camera.lens == "brown_conrady" and not any(distortion[6:]):
        distortion = distortion[:6]  # as MMS-DATA's own tools expect
    return {
        "camera_model": FISHEYE_MODEL if camera.lens == "kannala_brandt" else "OPENCV",
        "width": camera.width, "height": camera.height,
        "fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy,
        "distortion_params": distortion,
        **sensor.described,
        "camera2reference": np.asarray(sensor.camera_to_reference, dtype=np.float64).tolist(),
    }  # fmt: skip
