"""A point from the pixels in which posed frames see it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mmsynth.scene.region import nearest_to_rays
from mmsynth.scene.scene import Frame
from mmsynth.sensors.camera import project, unproject

Sighting = tuple[Frame, np.ndarray]
"""A frame and the pixel (2,) in which it sees a point."""


def nearest_point(seen: Sequence[Sighting]) -> np.ndarray | None:
    """The point (3,) nearest to all rays (least squares); None where a pixel has no ray, or the rays no common point."""
    rays, valid = zip(*(unproject(pixel, frame.camera) for frame, pixel in seen), strict=True)
    poses = np.stack([frame.camera_to_world for frame, _ in seen])
    return nearest_to_rays(poses[:, :3, 3], np.einsum("nij,nj->ni", poses[:, :3, :3], rays)) if all(valid) else None


def reprojection_error(point: np.ndarray, frame: Frame, pixel: np.ndarray) -> float:
    """Pixels from where a frame sees a point (3,) to where it lies; NaN behind the camera."""
    local = frame.camera_to_world[:3, :3].T @ (point - frame.camera_to_world[:3, 3])
    return float(np.linalg.norm(project(local, frame.camera) - pixel))
