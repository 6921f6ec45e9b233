"""What a camera sees of mirrored lamps, and of what surfaces do with them: a rendering apart, for who asks for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mmsynth.errors import InputError
from mmsynth.field.field import Field
from mmsynth.sensors.camera import Camera, ray_map


@dataclass(frozen=True)
class LightRendering:
    """Pictures (H, W, ...), float32.

    Attributes:
        mirrored: per modality (H, W, C), the part of ``Rendering.channels`` that are images of lamps, linear, 1.0 = full scale; the rest of
            the channels is the diffuse part. 0 where no surface is met, NaN where the lens has no ray.
        roughness: (H, W) α of GGX, in (0, 1). strength: (H, W), height of a highlight in units of the lamp, at normal incidence. Means over
            the surfaces that a pixel sees; NaN where it sees none.
    """

    mirrored: dict[str, np.ndarray]
    roughness: np.ndarray
    strength: np.ndarray


def render_light(field: Field, camera: Camera, camera_to_world: np.ndarray, modalities: Sequence[str] | None = None) -> LightRendering:
    """Render the mirrored part of a camera's light.

    Args:
        camera_to_world: (4, 4), OpenCV axes, scene unit. modalities: names, all when None.
    Raises:
        InputError: an unknown modality, or a field without lamps.
    """
    names = field.check_modalities(modalities)
    if field.light is None or not field.shines:
        raise InputError("light: this field has no lamps, its surfaces mirror none.")
    in_camera, valid = ray_map(camera)
    rows = np.flatnonzero(valid)
    rays = rows, in_camera.reshape(-1, 3)[rows]
    parts = [seen for _, seen in field.cast_tiles([rays], camera_to_world, names, geometry=False, light=True)]

    def image(key: str, channels: int) -> np.ndarray:
        out = np.full((valid.size, channels), np.nan, np.float32)
        if parts:
            out[rows] = np.concatenate([part[key] for part in parts]).reshape(len(rows), channels)
        return out.reshape(*valid.shape, channels)

    mirrored = {name: image(f"mirrored/{name}", field.sensors[name].channel_count) for name in names}
    return LightRendering(mirrored, image("roughness", 1)[..., 0], image("strength", 1)[..., 0])
