"""From the browser's world to the scene's and back.

The browser's world is the field's normalised frame: the region of interest is the unit ball, whatever the scene's unit is. Cameras have
OpenCV axes in both.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from mmsynth.field.field import Field
from mmsynth.scene.scene import PosedCamera
from mmsynth.sensors.camera import Camera


def to_browser(field: Field, points: np.ndarray) -> np.ndarray:
    """Points (..., 3) of the scene → of the browser's world."""
    return (np.asarray(points, dtype=np.float64) - np.array(field.region.centre)) / field.region.radius


def to_scene(field: Field, points: np.ndarray) -> np.ndarray:
    """Points (..., 3) of the browser's world → of the scene."""
    return np.asarray(points, dtype=np.float64) * field.region.radius + np.array(field.region.centre)


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """Rotation matrix (3, 3) → (4,) w, x, y, z."""
    return Rotation.from_matrix(rotation).as_quat(scalar_first=True)


def pose_of(field: Field, wxyz: np.ndarray, position: np.ndarray) -> np.ndarray:
    """The browser's camera → (4, 4) camera_to_world of the scene."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(np.asarray(wxyz, dtype=np.float64), scalar_first=True).as_matrix()
    pose[:3, 3] = to_scene(field, position)
    return pose


def camera_of(width: int, height: int, fov: float) -> Camera:
    """A pinhole of a vertical field of view [rad]."""
    focal = 0.5 * height / np.tan(0.5 * fov)
    return Camera(width, height, focal, focal, 0.5 * (width - 1), 0.5 * (height - 1))


def fov_of(camera: Camera) -> float:
    """Vertical field of view [rad] of the pinhole within a camera."""
    return float(2.0 * np.arctan(0.5 * camera.height / camera.fy))


def view_of(field: Field, wxyz: np.ndarray, position: np.ndarray, fov: float, width: int, height: int) -> PosedCamera:
    """What the browser's camera sees on so many pixels."""
    return PosedCamera(camera_of(width, height, fov), pose_of(field, wxyz, position))
