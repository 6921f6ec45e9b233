"""One frame of one sensor → what another sensor would have seen, in memory.

Three methods:

* ``field``: the field's rendering alone.
* ``ratio``: times the local gain between the frame and the field's rendering of it, as far as the target varies with the source
  (``guidance``). Of polarization all Stokes components alike: DoLP and AoLP stay the field's.
* ``guided``: the ratio, and what colour the frame has beyond it, through a local linear map learned from the field's own renderings.

What ``guided`` gives is not projected onto what reproduces the source exactly: as the map from target to source is learned, too, that took
0.7 dB from one scene with ground truth and gave 0.02 to another.

``auto`` is guided where both have colours, else the ratio: measured on scenes with ground truth, neither is worse than the field, because
the gain is shrunk to 1 by as much as frame and rendering agree within their noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

import cv2
import numpy as np
import torch
from torch import Tensor

from mmsynth.errors import InputError
from mmsynth.operations.conversion.guidance import Guide, gain_exponent, guide, linear_map
from mmsynth.operations.output.progress import RaysDone
from mmsynth.operations.views.coverage import TrainingRays, coverage
from mmsynth.operations.views.visibility import SAME_SURFACE
from mmsynth.scene.scene import PosedCamera, Sensor, canonical_modality
from mmsynth.sensors.camera import Camera, project, surface_points

if TYPE_CHECKING:
    from mmsynth.field.field import Field
    from mmsynth.field.picture import Rendering

Method = Literal["auto", "field", "ratio", "guided"]
METHODS: tuple[Method, ...] = get_args(Method)
_WARPED_SHARE = 0.6  # of a correction is right where it arrives through the surface: measured, on two scenes with ground truth
_SURE = 0.1  # relative deviation at which confidence has fallen to exp(-1/2)


@dataclass(frozen=True)
class Converted:
    """What the target sensor would have seen (H, W).

    Attributes:
        method: the one used. values: (H, W, K) float32, NaN where the lens has no ray. stokes: (H, W, 3) of a polarization target.
        confidence: (H, W) float32 in [0, 1]: exp(-½ (σ / 0.1)²) with σ the relative standard deviation of the gain, 0 where the lens has no
            ray or the frame shows what the field does not have; of ``render_frame``, coverage.
        guided: (H, W) bool, where the frame contributed.
        exposure: of the source frame, in units of the frames that the field learned from. opacity, valid: of the rendering.
        deviation: (H, W, K) of the rendering, where a prior predicts the target; else None.
    """

    method: Method
    values: np.ndarray
    stokes: np.ndarray | None
    confidence: np.ndarray
    guided: np.ndarray
    exposure: float
    opacity: np.ndarray
    valid: np.ndarray
    deviation: np.ndarray | None = None


@dataclass(frozen=True)
class Conversion:
    """``Converted`` of a batch, as tensors on the device of the frames.

    Attributes:
        values: (B, K, H, W) float32. stokes: (B, 3, H, W) or None. confidence, guided, valid: (B, 1, H, W). exposure: (B,).
        method: the one used.
    """

    values: Tensor
    stokes: Tensor | None
    confidence: Tensor
    guided: Tensor
    valid: Tensor
    exposure: Tensor
    method: Method


def convert(
    field: Field,
    frames: Tensor,
    *,
    source: str,
    target: str,
    poses: Tensor,
    method: Method = "auto",
    camera: Camera | None = None,
    target_poses: Tensor | None = None,
    target_camera: Camera | None = None,
) -> Conversion:
    """Convert a batch of frames.

    Args:
        frames: (B, 1, H, W) of a mosaicked source, raw, else (B, C, H, W); linear, 1.0 = full scale. poses: (B, 4, 4) camera_to_world of
            the frames, OpenCV axes, scene frame (``register.register`` finds those of frames without one).
        method: auto, field, ratio or guided. camera: of the frames, None: the source's. target_poses: (B, 4, 4), where the target stands,
            with ``target_camera`` (None: the target's); None: the frames' own pixels.
    Raises:
        InputError: unknown modality or method, or shapes that do not fit.
    """
    source, target = canonical_modality(source), canonical_modality(target)
    field.check_modalities([source, target])
    if frames.ndim != 4 or poses.shape != (len(frames), 4, 4) or not len(frames):
        raise InputError(f"convert: frames {tuple(frames.shape)}, poses {tuple(poses.shape)}; expected (B, C, H, W) and (B, 4, 4), B > 0.")
    if target_poses is not None and target_poses.shape != poses.shape:
        raise InputError(f"convert: target_poses {tuple(target_poses.shape)}, expected {tuple(poses.shape)}.")
    converted = []
    for i, frame in enumerate(frames.detach().cpu().double().numpy()):
        raw = frame[0] if field.sensors[source].mosaic is not None and len(frame) == 1 else np.moveaxis(frame, 0, -1)
        view = PosedCamera(camera or field.cameras[source], poses[i].detach().cpu().double().numpy())
        seen_by = None
        if target_poses is not None:
            seen_by = PosedCamera(target_camera or field.cameras[target], target_poses[i].detach().cpu().double().numpy())
        converted.append(convert_frame(field, raw, view, source=source, target=target, method=method, seen_by=seen_by))
    images = lambda arrays: torch.from_numpy(np.stack(arrays)).to(frames.device).movedim(-1, 1)
    stokes = [c.stokes for c in converted if c.stokes is not None]
    return Conversion(
        values=images([c.values for c in converted]),
        stokes=images(stokes) if stokes else None,
        confidence=images([c.confidence[..., None] for c in converted]),
        guided=images([c.guided[..., None] for c in converted]),
        valid=images([c.valid[..., None] for c in converted]),
        exposure=torch.tensor([c.exposure for c in converted], device=frames.device),
        method=converted[0].method,
    )


def chosen_method(method: Method, source: Sensor, target: Sensor) -> Method:
    """What ``auto`` stands for.

    Raises:
        InputError: no such method.
    """
    if method not in METHODS:
        raise InputError(f"convert: method is {method!r}, expected one of {', '.join(METHODS)}.")
    if method != "auto":
        return method
    colours = source.channel_count > 1 and target.channel_count > 1 and not (source.is_polarization or target.is_polarization)
    return "guided" if colours else "ratio"


def convert_frame(
    field: Field,
    raw: np.ndarray,
    view: PosedCamera,
    *,
    source: str,
    target: str,
    method: Method = "auto",
    seen_by: PosedCamera | None = None,
    progress: RaysDone | None = None,
) -> Converted:
    """Convert one frame.

    Args:
        raw: (H, W) of a mosaicked source, else (H, W, C), linear, 1.0 = full scale. view: camera and pose of the frame.
        source, target: modalities of the field. seen_by: camera and pose of the target, None: the source's own pixels.
        progress: called with the number of rays done since the last call.
    Raises:
        InputError: unknown modality or method, or a frame of another size.
    """
    source, target = canonical_modality(source), canonical_modality(target)
    field.check_modalities([source, target])
    sensor = field.sensors[source]
    used = chosen_method(method, sensor, field.sensors[target])
    expected = (view.camera.height, view.camera.width) + (() if sensor.mosaic is not None else (sensor.channel_count,))
    if raw.shape != expected:
        raise InputError(f"convert: a frame of shape {raw.shape}, expected {expected} of {source}.")
    both = list(dict.fromkeys((source, target)))
    seen = field.render(view.camera, view.camera_to_world, both, geometry=False, progress=progress)
    guidance = guide(raw, seen.channels[source], sensor, seen.valid)
    of_light = field.sensors[target].is_polarization  # one gain for all of a Stokes vector
    gain = np.ones((*seen.valid.shape, 1 if of_light else field.sensors[target].channel_count))
    colour = np.zeros((*seen.valid.shape, field.sensors[target].channel_count))
    if used != "field":
        shown = seen.channels[target].mean(-1, keepdims=True) if of_light else seen.channels[target]
        gain = np.maximum(guidance.gain, 1e-3)[..., None] ** gain_exponent(seen.channels[source], shown, seen.valid)
    if used == "guided" and not of_light:
        local_map = linear_map(seen.channels[source], seen.channels[target], seen.valid)
        colour = (local_map @ guidance.residual_colour[..., None])[..., 0]
    if seen_by is None:
        guided = seen.valid & ~guidance.unexplained
        return _corrected(field, target, used, seen, gain, colour, guidance.gain_sd, guided, guidance.unexplained, guidance)
    there = field.render(seen_by.camera, seen_by.camera_to_world, [target], geometry=False, progress=progress)
    gain, colour = gain**_WARPED_SHARE, colour * _WARPED_SHARE
    layers = np.dstack([gain, colour, guidance.gain_sd, seen.valid, guidance.unexplained])
    warped, visible = _warped(layers, seen, view, there, seen_by)
    unexplained = visible & (warped[..., -1] > 0.5)
    guided = visible & (warped[..., -2] > 0.99) & ~unexplained
    gain, colour, gain_sd = warped[..., : gain.shape[-1]], warped[..., gain.shape[-1] : -3], warped[..., -3]
    return _corrected(field, target, used, there, gain, colour, gain_sd, guided, unexplained, guidance)


def render_frame(field: Field, rays: TrainingRays, view: PosedCamera, target: str, *, progress: RaysDone | None = None) -> Converted:
    """What the target sensor would have seen at a pose where there is no frame: the field alone. Confidence is coverage by the training
    frames (see ``coverage``), 0 without a surface."""
    seen = field.render(view.camera, view.camera_to_world, [target], geometry=True, progress=progress)
    covered = coverage(rays, view, seen.depth_ray, seen.normal)
    return Converted(
        method="field",
        values=seen.channels[target],
        stokes=seen.stokes.get(target),
        confidence=np.where(np.isfinite(covered), covered, 0.0).astype(np.float32),
        guided=np.zeros_like(seen.valid),
        exposure=1.0,
        opacity=seen.opacity,
        valid=seen.valid,
        deviation=seen.deviation.get(target),
    )


def _corrected(
    field: Field,
    target: str,
    used: Method,
    seen: Rendering,
    gain: np.ndarray,
    colour: np.ndarray,
    gain_sd: np.ndarray,
    guided: np.ndarray,
    unexplained: np.ndarray,
    guidance: Guide,
) -> Converted:
    """A rendering, times ``gain`` and plus ``colour`` where the frame has a say (``guided``)."""
    gain, colour = np.where(guided[..., None], gain, 1.0), np.where(guided[..., None], colour, 0.0)
    values = np.maximum(seen.channels[target] * gain + colour, 0.0)  # NaN stays
    stokes = seen.stokes[target] * gain if field.sensors[target].is_polarization else None
    # where the frame says nothing the field is as sure as it proved to be elsewhere
    deviation = np.where(guided, gain_sd, guidance.prior_sd)
    confidence = np.exp(-0.5 * (deviation / _SURE) ** 2)
    return Converted(
        method=used,
        values=values.astype(np.float32),
        stokes=None if stokes is None else stokes.astype(np.float32),
        confidence=np.where(seen.valid & ~unexplained, confidence, 0.0).astype(np.float32),
        guided=guided if used != "field" else np.zeros_like(guided),
        exposure=guidance.exposure,
        opacity=seen.opacity,
        valid=seen.valid,
        deviation=seen.deviation.get(target),
    )


def warp_through_surface(field: Field, values: np.ndarray, view: PosedCamera, seen_by: PosedCamera) -> tuple[np.ndarray, np.ndarray]:
    """Values (H, W, M) of one camera's pixels → on another's, through the field's surface; and where it sees the same surface."""
    seen, there = (field.render(at.camera, at.camera_to_world, [], geometry=False) for at in (view, seen_by))
    return _warped(np.where(seen.valid[..., None], values, 0.0), seen, view, there, seen_by)


def _warped(
    layers: np.ndarray, seen: Rendering, view: PosedCamera, there: Rendering, seen_by: PosedCamera
) -> tuple[np.ndarray, np.ndarray]:
    """Layers (H, W, M) of the source's pixels → on the target's, through the surface; and where the source sees the same surface."""
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
