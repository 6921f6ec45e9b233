"""Generated camera paths.

They turn around the region of interest and look at its centre (up is the training cameras' mean up), or follow the training
poses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from mmsynth.errors import InputError
from mmsynth.scene.checks import number, whole
from mmsynth.scene.scene import PosedCamera, Region
from mmsynth.sensors.camera import Camera

_KEYS: dict[str, dict[str, Any]] = {
    "orbit": {"views": 60, "elevation_deg": 25.0, "radius": None},
    "hemisphere": {"views": 60, "min_elevation_deg": 10.0, "radius": None},
    "spiral": {"views": 60, "turns": 2.0, "min_elevation_deg": 10.0, "max_elevation_deg": 60.0, "radius": None},
    "interpolate": {"views": 60},
    "perturb": {"per_pose": 2, "rotation_deg": 3.0, "translation": 0.05, "seed": 0},
}


def world_up(poses: Sequence[np.ndarray]) -> np.ndarray:
    """Mean up (-y axis) of cameras, (3,) unit; where they cancel, the direction in which the cameras spread least, or z."""
    up = -np.mean([pose[:3, 1] for pose in poses], axis=0) if len(poses) else np.zeros(3)
    if np.linalg.norm(up) < 0.1:
        centres = np.array([pose[:3, 3] for pose in poses]).reshape(-1, 3)
        flat = len(centres) >= 3
        up = np.linalg.svd(centres - centres.mean(0))[2][2] if flat else np.array([0.0, 0.0, 1.0])
        up = up if up[np.abs(up).argmax()] > 0 else -up
    return up / np.linalg.norm(up)


def look_at(eye: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Camera at ``eye`` that looks at ``target`` with ``up`` upwards in its image: (4, 4), OpenCV axes.

    Looking along ``up``, any roll will do; one is chosen.
    """
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-6:
        right = np.cross(forward, np.eye(3)[np.abs(up).argmin()])
    right = right / np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(forward, right), forward, eye], 1)
    return pose


def _horizon(up: np.ndarray, centre: np.ndarray, poses: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Two horizontal unit vectors; the first points from the centre to the first training camera."""
    start = poses[0][:3, 3] - centre if len(poses) else np.zeros(3)
    start = start - (start @ up) * up
    if np.linalg.norm(start) < 1e-9:
        axis = np.eye(3)[np.abs(up).argmin()]
        start = axis - (axis @ up) * up
    start = start / np.linalg.norm(start)
    return start, np.cross(up, start)


def _around(azimuth: np.ndarray, sine: np.ndarray, radius: float, region: Region, poses: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Poses on a sphere about the region's centre. azimuth [rad], sine of the elevation: (V,)."""
    up, centre = world_up(poses), np.asarray(region.centre, dtype=np.float64)
    first, second = _horizon(up, centre, poses)
    flat = np.sqrt(np.clip(1.0 - sine**2, 0.0, None))
    offset = (flat * np.cos(azimuth))[:, None] * first + (flat * np.sin(azimuth))[:, None] * second + sine[:, None] * up
    return [look_at(centre + radius * o, centre, up) for o in offset]


def _interpolate(views: int, poses: Sequence[np.ndarray], reach: float) -> list[np.ndarray]:
    """Through all training poses in their order: positions linear, rotations by SLERP, at constant speed.

    The way between two poses is √(distance² + (reach · angle)²): a camera that turns on the spot moves what it sees, too. Poses that
    repeat take no time.

    Args:
        reach: how far away things are, in the scene's unit: what an angle in radians counts for.
    """
    from scipy.spatial.transform import Rotation, Slerp  # half a second to import, and most poses come from files

    rotations, centres = Rotation.from_matrix(np.array([p[:3, :3] for p in poses])), np.array([p[:3, 3] for p in poses])
    turned = (rotations[:-1].inv() * rotations[1:]).magnitude()
    way = np.concatenate([[0.0], np.cumsum(np.hypot(np.linalg.norm(np.diff(centres, axis=0), axis=1), reach * turned))])
    moved = np.concatenate([[True], np.diff(way) > 1e-9 * way[-1]])  # the rest is rounding
    if moved.sum() == 1:
        return [poses[0]] * views
    at = np.linspace(0.0, way[moved][-1], views)
    out = np.tile(np.eye(4), (views, 1, 1))
    out[:, :3, :3] = Slerp(way[moved], rotations[moved])(at).as_matrix()
    for axis in range(3):
        out[:, axis, 3] = np.interp(at, way[moved], centres[moved, axis])
    return list(out)


def through(keys: Sequence[PosedCamera], views: int, reach: float) -> list[PosedCamera]:
    """A smooth path through two key poses or more: positions by a cubic spline, rotations by one with continuous angular velocity (SciPy's
    ``RotationSpline``), focal length by a cubic spline of its logarithm; the size of the pictures is the first one's.

    Args:
        reach: see ``_interpolate``; keys stand at times by the way between them.
    Returns:
        ``views`` cameras, named by their number, the first and last of them the first and last key.
    """
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    poses = np.stack([key.camera_to_world for key in keys])
    rotations, centres = Rotation.from_matrix(poses[:, :3, :3]), poses[:, :3, 3]
    turned = (rotations[:-1].inv() * rotations[1:]).magnitude()
    way = np.hypot(np.linalg.norm(np.diff(centres, axis=0), axis=1), reach * turned)
    at = np.concatenate([[0.0], np.cumsum(np.maximum(way, 1e-3 * max(float(way.mean()), 1e-9)))])  # two keys at one place: a short halt
    times = np.linspace(0.0, at[-1], views)
    where, how = CubicSpline(at, centres)(times), RotationSpline(at, rotations)(times).as_matrix()
    shares = np.array([key.camera.fy / key.camera.height for key in keys])
    focal = np.exp(CubicSpline(at, np.log(shares))(times)) * keys[0].camera.height
    out = []
    for i in range(views):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = how[i], where[i]
        zoom = focal[i] / keys[0].camera.fy
        camera = replace(keys[0].camera, fx=keys[0].camera.fx * zoom, fy=keys[0].camera.fy * zoom)
        out.append(PosedCamera(camera, pose, f"{i:04d}"))
    return out


def _perturb(
    per_pose: int, rotation: float, translation: float, seed: int, region: Region, poses: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Cameras turned about and moved along their own axes by normal deviates: those of copy k of pose i depend on (seed, i, k) alone.

    Args:
        rotation: standard deviation of each component of the rotation vector [rad].
        translation: of each coordinate, as a share of the pose's distance to the region's centre.
    """
    from scipy.spatial.transform import Rotation

    out = []
    for index, pose in enumerate(poses):
        distance = float(np.linalg.norm(pose[:3, 3] - region.centre))
        for copy in range(per_pose):
            deviates = np.random.default_rng([seed, index, copy]).standard_normal(6)
            motion = np.eye(4)
            motion[:3, :3] = Rotation.from_rotvec(rotation * deviates[:3]).as_matrix()
            motion[:3, 3] = translation * distance * deviates[3:]
            out.append(pose @ motion)
    return out


def _directions(kind: str, spec: Mapping[str, Any], where: str) -> tuple[np.ndarray, np.ndarray]:
    """Azimuth [rad] and sine of the elevation of a path on a sphere, (V,) each."""
    views = whole(spec, "views", where, 1, 100_000)
    steps = np.arange(views)
    if kind == "orbit":
        elevation = np.radians(number(spec, "elevation_deg", where, -90.0, 90.0))
        return 2 * np.pi * steps / views, np.full(views, np.sin(elevation))
    lowest = number(spec, "min_elevation_deg", where, -90.0, 90.0 if kind == "spiral" else 89.0)
    if kind == "hemisphere":
        golden_angle = np.pi * (3.0 - np.sqrt(5.0))
        floor = np.sin(np.radians(lowest))
        return golden_angle * steps, floor + (1.0 - floor) * (steps + 0.5) / views
    highest = number(spec, "max_elevation_deg", where, -90.0, 90.0)
    if lowest > highest:
        raise InputError(f"{where}: key 'max_elevation_deg' is {highest:g}, expected at least 'min_elevation_deg', {lowest:g}.")
    share = np.linspace(0.0, 1.0, views)
    turns = number(spec, "turns", where, -1000.0, 1000.0)
    return 2 * np.pi * turns * share, np.sin(np.radians(lowest + (highest - lowest) * share))


def trajectory_views(
    spec: Mapping[str, Any], region: Region, camera: Camera, training: Sequence[np.ndarray], where: str = "trajectory"
) -> list[PosedCamera]:
    """A generated camera path.

    * ``{"trajectory": "orbit", "views": 60, "elevation_deg": 25, "radius": r}``: a circle, starting at the first training camera's side;
    * ``{"trajectory": "hemisphere", "views": 60, "min_elevation_deg": 10, "radius": r}``: a Fibonacci lattice, equal area per view;
    * ``{"trajectory": "spiral", "views": 60, "turns": 2, "min_elevation_deg": 10, "max_elevation_deg": 60, "radius": r}``: rises
      evenly from the one elevation to the other while it turns, both ends included;
    * ``{"trajectory": "interpolate", "views": 60}``: through the training poses in their order, at constant speed, rotations by SLERP;
    * ``{"trajectory": "perturb", "per_pose": 2, "rotation_deg": 3, "translation": 0.05, "seed": 0}``: copies of every training pose, each
      turned and moved at random about its own axes; standard deviations per axis, of the translation as a share of the pose's distance to
      the region's centre.

    Args:
        camera: intrinsics of every view. training: (4, 4) poses; give up direction, and the radius (median distance) when none is stated.
        where: what to name in errors.
    Raises:
        InputError: unknown trajectory or key, or a value out of range.
    """
    kind = spec.get("trajectory")
    if not isinstance(kind, str) or kind not in _KEYS:
        raise InputError(f"{where}: key 'trajectory' is {kind!r}, expected one of {', '.join(_KEYS)}.")
    allowed = _KEYS[kind]
    unknown = [key for key in spec if key != "trajectory" and key not in allowed]
    if unknown:
        raise InputError(f"{where}: unknown key '{unknown[0]}', expected one of {', '.join(allowed)} for '{kind}'.")
    spec = {**allowed, **spec}
    distances = [float(np.linalg.norm(pose[:3, 3] - region.centre)) for pose in training]
    reach = float(np.median(distances)) if distances and np.median(distances) > 0 else 3.0 * region.radius
    if kind in ("interpolate", "perturb"):
        least = 2 if kind == "interpolate" else 1
        if len(training) < least:
            raise InputError(f"{where}: {len(training)} training poses, expected at least {least} to {kind}.")
    if kind == "interpolate":
        poses = _interpolate(whole(spec, "views", where, 1, 100_000), training, reach)
    elif kind == "perturb":
        per_pose, seed = whole(spec, "per_pose", where, 1, 10_000), whole(spec, "seed", where, 0, 2**53)
        rotation, translation = number(spec, "rotation_deg", where, 0.0, 180.0), number(spec, "translation", where, 0.0, 10.0)
        poses = _perturb(per_pose, np.radians(rotation), translation, seed, region, training)
    else:
        azimuth, sine = _directions(kind, spec, where)
        radius = reach if spec["radius"] is None else number(spec, "radius", where, 1e-9, 1e9)
        poses = _around(azimuth, sine, radius, region, training)
    return [PosedCamera(camera, pose, f"{index:04d}") for index, pose in enumerate(poses)]
