"""What a camera sees of mirrored lamps, and of what surfaces do with them: a rendering apart, for who asks for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mmsynth.errors import InputError
from mmsynth.field import kernels, rendering
from mmsynth.field.field import TILE, Field
from mmsynth.field.kernels.mirroring import material
from mmsynth.field.light import stokes
from mmsynth.sensors.camera import Camera, ray_map
from mmsynth.sensors.polarization import reference_axes, stokes_to_intensities


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


@torch.no_grad()
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
    directions = in_camera.reshape(-1, 3)[rows]
    tiles = [directions[start : start + TILE] for start in range(0, len(directions), TILE)]
    parts = [_tile(field, *field.rays_of(tile, camera_to_world), names) for tile in tiles]

    def image(key: str) -> np.ndarray:
        found = np.concatenate([part[key].cpu().numpy() for part in parts]) if parts else np.empty((0, 1), np.float32)
        out = np.full((valid.size, found.shape[1]), np.nan, np.float32)
        out[rows] = found
        return out.reshape(*valid.shape, -1)

    return LightRendering({name: image(name) for name in names}, image("/roughness")[..., 0], image("/strength")[..., 0])


def _tile(field: Field, origins: Tensor, directions: Tensor, camera_x: Tensor, names: Sequence[str]) -> dict[str, Tensor]:
    assert field.light is not None
    rays, jitter = len(origins), torch.full((len(origins),), 0.5, device=origins.device)
    hits = rendering.trace(field.surface, field.appearance, field.occupancy, origins, directions, jitter, field.sampling)
    mirrors, _ = field.mirrors(hits, origins, directions, field.sampling.active_surface)
    lamps, ray = field.light.lamps(), kernels.rays_of(hits.behind)
    images = kernels.reflect(lamps.position, mirrors)

    def together(values: Tensor) -> Tensor:
        seen = hits.share[:, None] * values
        return seen[:rays].index_add(0, ray[rays:], seen[rays:])

    roughness, strength, _ = material(mirrors.material)
    met = torch.where(hits.opacity > 0.5, hits.opacity, torch.full_like(hits.opacity, torch.nan))[:, None]
    out = {"/roughness": together(roughness[:, None]) / met, "/strength": together(strength[:, None]) / met}
    for name in names:
        columns, angles = field.shader.columns[name], field.sensors[name].polarizer_angles_deg
        if angles is None:
            light = images.amount @ lamps.spectrum[:, columns]
        else:
            x, y = (axis[ray] for axis in reference_axes(directions, camera_x))
            light = stokes_to_intensities(stokes(images, lamps.spectrum[:, columns.start], x, y), angles)
        out[name] = field.radiance_scale[name] * together(light)
    return out
