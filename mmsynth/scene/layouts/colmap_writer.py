"""COLMAP's binary model: ``cameras rigs frames images points3D .bin``, as COLMAP reads and writes it since 3.12.

Older versions pass over ``rigs.bin`` and ``frames.bin``: the pose of every image stands in ``images.bin``, too. Quaternions are w x y z,
poses world to camera in OpenCV axes, principal points have the top-left pixel's centre at 0.5, numbers are little-endian. Facts of the
format: the files that pycolmap writes, with which the tests compare, byte by byte.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from mmsynth.scene.points import SparsePoints
from mmsynth.scene.scene import PosedCamera
from mmsynth.sensors.camera import Camera

_CAMERA = 0  # the type of a sensor, beside IMUs
_NUMBERS = {"PINHOLE": 1, "OPENCV": 4, "OPENCV_FISHEYE": 5, "FULL_OPENCV": 6}
_SAME = 1e-10  # of a rotation's entries, and of a distance over the cameras' extent: poses of one rig
_ROUNDING = 64 * np.finfo(float).eps  # of a coordinate, of what two inverses and a product leave
Images = Mapping[str, Mapping[int, PosedCamera]]
"""By sensor and view: the camera, its pose, and the picture's name below ``images/``."""


@dataclass(frozen=True)
class RigPoses:
    """Poses of a rig: world to rig by view, (4, 4) each, and from the rig to its sensors, whose first is the reference."""

    rig_from_world: dict[int, np.ndarray]
    sensor_from_rig: dict[str, np.ndarray] = field(default_factory=dict)


def rig_of(images: Images) -> RigPoses | None:
    """The rig on which sensors stand; None where their poses differ from a rigid rig's, share no views, or a sensor has several cameras."""
    positions = np.stack([view.camera_to_world[:3, 3] for own in images.values() for view in own.values()])
    extent = float(np.linalg.norm(positions - positions.mean(0), axis=1).max())
    near = _SAME * extent + _ROUNDING * float(np.abs(positions).max())
    waiting = {name: {view: np.linalg.inv(posed.camera_to_world) for view, posed in own.items()} for name, own in images.items()}
    first = next(iter(waiting))
    rig = RigPoses(dict(waiting.pop(first)), {first: np.eye(4)})
    while waiting:
        name = next((name for name, own in waiting.items() if own.keys() & rig.rig_from_world.keys()), None)
        if name is None:
            return None
        own = waiting.pop(name)
        shared = min(own.keys() & rig.rig_from_world.keys())
        place = rig.sensor_from_rig[name] = own[shared] @ np.linalg.inv(rig.rig_from_world[shared])
        for view, pose in own.items():
            stands = rig.rig_from_world.setdefault(view, np.linalg.inv(place) @ pose)
            # where the camera is, not its translation: a world far from its origin has that in every digit
            apart = np.linalg.inv(place @ stands)[:3, 3] - np.linalg.inv(pose)[:3, 3]
            if np.abs((place @ stands - pose)[:3, :3]).max() > _SAME or np.linalg.norm(apart) > near:
                return None
    one_camera = all(len({posed.camera for posed in own.values()}) == 1 for own in images.values())
    return rig if one_camera else None


def colmap_files(images: Images, points: SparsePoints | None = None) -> dict[str, bytes]:
    """The files of a model, by name.

    Several sensors become one rig where ``rig_of`` finds one: images of one view are a frame. Else every image is a frame of its own, and
    so are those of one sensor.
    """
    rig = rig_of(images) if len(images) > 1 else None
    listed = [(name, view, posed) for name, own in images.items() for view, posed in own.items()]
    # sensors have a camera each, also where two are equal
    numbers = {camera: i for i, camera in enumerate(dict.fromkeys((name, posed.camera) for name, _, posed in listed), 1)}
    cameras = [numbers[name, posed.camera] for name, _, posed in listed]
    return {
        "cameras.bin": _counted([_camera(number, camera) for (_, camera), number in numbers.items()]),
        "rigs.bin": _rigs(rig, {number: name for (name, _), number in numbers.items()}),
        "frames.bin": _frames(rig, listed, cameras),
        "images.bin": _counted(
            [
                struct.pack("<I7dI", i, *_motion(np.linalg.inv(posed.camera_to_world)), camera)
                + posed.name.encode() + b"\0" + struct.pack("<Q", 0)
                for i, ((_, _, posed), camera) in enumerate(zip(listed, cameras, strict=True), 1)
            ]
        ),
        "points3D.bin": _points(points),
    }  # fmt: skip


def camera_model(camera: Camera) -> tuple[str, list[float]]:
    """The name of COLMAP's model of a camera, and its parameters; every lens has one."""
    intrinsics = [camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5]
    if camera.lens == "kannala_brandt":
        return "OPENCV_FISHEYE", intrinsics + camera.coefficients.tolist()
    if not any(camera.distortion):
        return "PINHOLE", intrinsics
    if not any(camera.coefficients[4:]):
        return "OPENCV", intrinsics + camera.coefficients[:4].tolist()
    return "FULL_OPENCV", intrinsics + camera.coefficients.tolist()


def _counted(entries: list[bytes]) -> bytes:
    return struct.pack("<Q", len(entries)) + b"".join(entries)


def _camera(number: int, camera: Camera) -> bytes:
    model, parameters = camera_model(camera)
    return struct.pack(f"<IiQQ{len(parameters)}d", number, _NUMBERS[model], camera.width, camera.height, *parameters)


def _rigs(rig: RigPoses | None, names: Mapping[int, str]) -> bytes:
    """``names``: the sensor of every camera."""
    if rig is None:
        return _counted([struct.pack("<IIiI", number, 1, _CAMERA, number) for number in names])
    places = [
        struct.pack("<iIB7d", _CAMERA, number, 1, *_motion(rig.sensor_from_rig[name])) for number, name in list(names.items())[1:]
    ]  # the first is the reference
    return _counted([struct.pack("<IIiI", 1, len(names), _CAMERA, next(iter(names))) + b"".join(places)])


def _frames(rig: RigPoses | None, listed: list[tuple[str, int, PosedCamera]], cameras: list[int]) -> bytes:
    data = lambda i: struct.pack("<iIQ", _CAMERA, cameras[i], i + 1)
    if rig is None:
        poses = [_motion(np.linalg.inv(posed.camera_to_world)) for _, _, posed in listed]
        return _counted([struct.pack("<II7dI", i + 1, cameras[i], *pose, 1) + data(i) for i, pose in enumerate(poses)])
    entries = []
    for count, (view, pose) in enumerate(sorted(rig.rig_from_world.items()), 1):
        members = [i for i, (_, of, _) in enumerate(listed) if of == view]
        entries.append(struct.pack("<II7dI", count, 1, *_motion(pose), len(members)) + b"".join(map(data, members)))
    return _counted(entries)


def _points(points: SparsePoints | None) -> bytes:
    """Without errors (-1, as COLMAP says it) and without tracks."""
    if points is None:
        return _counted([])
    pairs = zip(points.positions, points.colours, strict=True)
    return _counted([struct.pack("<Q3d3BdQ", i, *map(float, xyz), *map(int, rgb), -1.0, 0) for i, (xyz, rgb) in enumerate(pairs, 1)])


def _motion(pose: np.ndarray) -> list[float]:
    """Quaternion w x y z, translation."""
    from scipy.spatial.transform import Rotation  # a second to import

    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return [w, x, y, z, *map(float, pose[:3, 3])]
