"""What a field shows along random rays of its scene's frames: what a prior is learned from, and made ready for a scene with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

import numpy as np
import torch

from mmsynth.field.field import Field
from mmsynth.field.light import mean_spectrum
from mmsynth.prior.prediction import Prediction, Seen
from mmsynth.prior.samples import SceneSamples, Shapes, shapes_of
from mmsynth.scene.exposure import Exposure
from mmsynth.scene.images import load_frame
from mmsynth.scene.scene import Frame, Sensor
from mmsynth.sensors.camera import ray_map
from mmsynth.sensors.mosaic import channel_map
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
        for start in range(0, len(rows), field.tile):
            origins, directions, camera_x = field.rays_of(in_camera.reshape(-1, 3)[rows[start : start + field.tile]], field.pose_of(frame))
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


def learn_from_frames(field: Field, prediction: Prediction, sensor: Sensor, frames: Sequence[Frame], *, seed: int = 0) -> Prediction:
    """The prediction of a modality with what some frames of it add (``correction``); clipped photosites are passed over.

    Raises:
        InputError: a frame cannot be read.
    """
    random = np.random.default_rng(seed)
    each = -(-_RAYS // len(frames))
    found: dict[str, list[torch.Tensor]] = {}
    for frame in frames:
        pixels, _ = load_frame(sensor, frame)
        values = pixels.reshape(pixels.shape[0] * pixels.shape[1], -1)
        if sensor.mosaic is not None:
            channels = channel_map(sensor.mosaic, *pixels.shape[:2]).reshape(-1, 1)
        else:
            channels = np.broadcast_to(np.arange(values.shape[1]), values.shape)
        in_camera, valid = ray_map(frame.camera)
        usable = valid.reshape(-1, 1) & (values < sensor.saturation)
        photosites = np.argwhere(usable)
        photosites = photosites[np.sort(random.choice(len(photosites), min(each, len(photosites)), replace=False))]
        pixel, k = photosites.T
        for start in range(0, len(pixel), field.tile):
            rows = slice(start, start + field.tile)
            origins, directions, camera_x = field.rays_of(in_camera.reshape(-1, 3)[pixel[rows]], field.pose_of(frame))
            out = field.render_rays(origins, directions, camera_x, list(prediction.facts.known), geometry=True, light=True)
            seen = field.seen(out, origins, directions, camera_x, True)
            numbers = {"channel": torch.from_numpy(channels[pixel[rows], k[rows]].astype(np.int64))}
            numbers["measured"] = torch.from_numpy(values[pixel[rows], k[rows]].astype(np.float32))
            of_shapes = {} if seen.shapes is None else {f"shapes/{f.name}": getattr(seen.shapes, f.name) for f in fields(Shapes)}
            of_body = {f"body/{name}": light for name, light in seen.body.items()}
            for key, value in {**numbers, **of_shapes, **of_body, "images": seen.images, "position": seen.position}.items():
                found.setdefault(key, []).append(value.cpu())
    joined = {key: torch.cat(values) for key, values in found.items()}
    of = lambda prefix: {key.removeprefix(prefix): value for key, value in joined.items() if key.startswith(prefix)}
    rays = Seen(of("body/"), joined["images"], Shapes(**of("shapes/")), joined["position"])
    return prediction.corrected(sensor.name, rays, joined["channel"], joined["measured"], len(frames))


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
