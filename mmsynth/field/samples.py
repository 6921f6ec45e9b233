"""What a field shows along random rays of its scene's frames: what a prior is learned from, and made ready for a scene with."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from mmsynth.field.field import TILE, Field
from mmsynth.field.light import mean_spectrum
from mmsynth.prior.samples import SceneSamples, Shapes, shapes_of
from mmsynth.scene.exposure import Exposure
from mmsynth.scene.scene import Frame
from mmsynth.sensors.camera import ray_map
from mmsynth.sensors.polarization import reference_axes

_RAYS = 24_576  # of all frames
_MET = 0.9  # opacity, from which on a ray shows the region


def sample_field(field: Field, frames: Sequence[Frame], name: str, exposure: Exposure, *, seed: int = 0, rays: int = _RAYS) -> SceneSamples:
    """Light of all measured modalities, and the surfaces, along random rays of frames that show the region of interest.

    Args:
        frames: one or more of one modality, those that were learned from. name: of the scene. exposure: what is stated of it.
    """
    random = np.random.default_rng(seed)
    found: dict[str, list[torch.Tensor]] = {}
    each = -(-rays // len(frames))
    for frame in frames:
        in_camera, valid = ray_map(frame.camera)
        inside = np.flatnonzero(valid)
        rows = random.choice(inside, min(each, len(inside)), replace=False)
        for start in range(0, len(rows), TILE):
            origins, directions, camera_x = field.rays_of(in_camera.reshape(-1, 3)[rows[start : start + TILE]], field.pose_of(frame))
            seen = field.render_rays(origins, directions, camera_x, field.measured, geometry=True, light=True)
            x, y = reference_axes(directions, camera_x)
            for key, value in {**seen, "directions": directions, "x": x, "y": y}.items():
                found.setdefault(key, []).append(value.cpu())
    seen = {key: torch.cat(values) for key, values in found.items()}
    met = (seen["opacity"] > _MET) & torch.isfinite(seen["normal"]).all(1)
    if not bool(met.any()):
        met = torch.ones_like(met)  # nothing is met: what is seen is all that there is
    seen = {key: value[met] for key, value in seen.items()}
    zero = torch.zeros_like(seen["opacity"])
    # NaN: half of the ray meets nothing
    gloss = [torch.where(torch.isfinite(v), v, zero) for v in (seen.get(key, zero) for key in ("roughness", "strength"))]
    normals = torch.where(torch.isfinite(seen["normal"]), seen["normal"], -seen["directions"])
    shapes: Shapes = shapes_of(normals, seen["directions"], seen["x"], seen["y"], *gloss)
    polarized = next((n for n in field.measured if field.sensors[n].is_polarization), None)
    return SceneSamples(
        name=name,
        sensors={n: field.sensors[n] for n in field.measured},
        exposure=exposure,
        body={n: field.body_of(n, seen).double().numpy() for n in field.measured},
        lamp=_lamp(field),
        images=seen.get("images", torch.zeros_like(seen["directions"])).double().numpy(),
        polarized=None if polarized is None else seen[f"stokes/{polarized}"][:, 1:].double().numpy(),
        shapes=shapes,
    )


@torch.no_grad()
def _lamp(field: Field) -> dict[str, np.ndarray] | None:
    """Mean spectrum of the field's lamps by modality, 1.0 = full scale for a lamp as it is; of a polarization modality (1,)."""
    if field.light is None or not field.shines:
        return None
    spectrum = mean_spectrum(field.light.lamps().spectrum).cpu().double()
    out = {}
    for name in field.measured:
        column = field.shader.columns[name]
        of = spectrum[column.start : column.start + 1] if field.sensors[name].is_polarization else spectrum[column]
        out[name] = (of * field.radiance_scale[name]).numpy()
    return out
