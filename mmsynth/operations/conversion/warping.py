"""Pictures of one camera carried over to another, through the field's surface."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from mmsynth.operations.views.visibility import SAME_SURFACE
from mmsynth.scene.scene import PosedCamera
from mmsynth.sensors.camera import project, surface_points

if TYPE_CHECKING:
    from mmsynth.field.picture import Rendering


def warped(layers: np.ndarray, seen: Rendering, view: PosedCamera, there: Rendering, seen_by: PosedCamera) -> tuple[np.ndarray, np.ndarray]:
    """Layers (H, W, M) of the pixels of ``view`` → (H', W', M) on those of ``seen_by``, and (H', W') where both see the same surface.

    Args:
        seen, there: renderings of the two, for depth.
    """
    pose = view.camera_to_world
    local = (surface_points(seen_by.camera, seen_by.camera_to_world, there.depth_ray) - pose[:3, 3]) @ pose[:3, :3]
    pixels = project(local, view.camera)
    inside = np.isfinite(pixels).all(-1)  # NaN: no surface, or out of the lens
    at = np.where(inside[..., None], pixels, -10.0).astype(np.float32)
    sample = lambda image, how: cv2.remap(np.ascontiguousarray(image, np.float32), at[..., 0], at[..., 1], how, borderValue=0)
    depth = sample(np.where(np.isfinite(seen.depth_ray), seen.depth_ray, 0.0), cv2.INTER_NEAREST)
    distance = np.linalg.norm(local, axis=-1)
    visible = inside & (np.abs(distance - depth) < SAME_SURFACE * distance)
    return np.dstack([sample(layers[..., i], cv2.INTER_LINEAR) for i in range(layers.shape[-1])]), visible
