"""One frame of one sensor → what another sensor would have seen, in memory.

Methods are those of ``predictions``, and ``auto``: as much of each as the scene's training frames support (``evidence``). Without evidence,
that is without a scene, or where no training view has frames of both modalities, it is guided where both have colours, else the ratio.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
import torch
from torch import Tensor

from mmsynth.errors import InputError
from mmsynth.operations.conversion.evidence import Evidence, gather
from mmsynth.operations.conversion.guidance import guide
from mmsynth.operations.conversion.moving_light import MovingLight
from mmsynth.operations.conversion.predictions import (
    OF_THE_SCENE,
    Compared,
    Prediction,
    Predictions,
    Training,
    compare,
    learn_training,
    predict,
)
from mmsynth.operations.conversion.windows import around_region
from mmsynth.operations.output.progress import RaysDone
from mmsynth.operations.views.coverage import TrainingRays, coverage
from mmsynth.scene.scene import PosedCamera, Scene, Sensor, canonical_modality
from mmsynth.sensors.camera import Camera
from mmsynth.sensors.polarization import stokes_to_intensities

if TYPE_CHECKING:
    from mmsynth.field.field import Field

Method = Literal["auto", "field", "ratio", "guided", "linear", "nearest"]
METHODS: tuple[Method, ...] = get_args(Method)
_SURE = 0.1  # relative deviation at which confidence has fallen to exp(-1/2)


@dataclass(frozen=True)
class Converted:
    """What the target sensor would have seen (H, W).

    Attributes:
        method: the one used; ``auto`` where several were weighed by evidence. weights: how much of each, 1 in all.
        values: (H, W, K) float32, NaN where the lens has no ray. stokes: (H, W, 3) of a polarization target.
        confidence: (H, W) float32 in [0, 1]: exp(-½ (σ / 0.1)²) with σ the relative standard deviation of the gain, 0 where the lens has no
            ray or the frame shows what the field does not have; of ``render_frame``, coverage.
        guided: (H, W) bool, where a frame contributed.
        exposure: of the source frame, in units of the frames that the field learned from. opacity, valid: of the rendering.
        deviation: (H, W, K) of the rendering, where a prior predicts the target; else None.
    """

    method: Method
    weights: dict[Prediction, float]
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
        method: the one used; ``auto`` where several were weighed by evidence. weights: per frame, how much of each, 1 in all.
        evidence: what ``auto`` went by, None: nothing.
    """

    values: Tensor
    stokes: Tensor | None
    confidence: Tensor
    guided: Tensor
    valid: Tensor
    exposure: Tensor
    method: Method
    weights: tuple[dict[Prediction, float], ...]
    evidence: Evidence | None


@dataclass(frozen=True)
class Chosen:
    """A method, and what it needs of the scene: made once for all frames of a pair.

    Attributes:
        method: ``auto`` only with evidence.
    """

    method: Method
    training: Training | None = None
    evidence: Evidence | None = None


def convert(
    field: Field,
    frames: Tensor,
    *,
    source: str,
    target: str,
    poses: Tensor,
    method: Method = "auto",
    scene: Scene | None = None,
    camera: Camera | None = None,
    target_poses: Tensor | None = None,
    target_camera: Camera | None = None,
) -> Conversion:
    """Convert a batch of frames.

    Args:
        frames: (B, 1, H, W) of a mosaicked source, raw, else (B, C, H, W); linear, 1.0 = full scale. poses: (B, 4, 4) camera_to_world of
            the frames, OpenCV axes, scene frame (``register.register`` finds those of frames without one).
        method: auto, field, ratio, guided, linear or nearest. scene: whose training frames auto goes by, and linear and nearest need; None:
            auto goes by the kind of the two modalities alone. camera: of the frames, None: the source's. target_poses: (B, 4, 4), where the
            target stands, with ``target_camera`` (None: the target's); None: the frames' own pixels.
    Raises:
        InputError: unknown modality or method, a method that needs the scene, or shapes that do not fit.
    """
    source, target = canonical_modality(source), canonical_modality(target)
    field.check_modalities([source, target])
    if frames.ndim != 4 or poses.shape != (len(frames), 4, 4) or not len(frames):
        raise InputError(f"convert: frames {tuple(frames.shape)}, poses {tuple(poses.shape)}; expected (B, C, H, W) and (B, 4, 4), B > 0.")
    if target_poses is not None and target_poses.shape != poses.shape:
        raise InputError(f"convert: target_poses {tuple(target_poses.shape)}, expected {tuple(poses.shape)}.")
    chosen, converted = choose(field, scene, source, target, method), []
    for i, frame in enumerate(frames.detach().cpu().double().numpy()):
        raw = frame[0] if field.sensors[source].mosaic is not None and len(frame) == 1 else np.moveaxis(frame, 0, -1)
        view = PosedCamera(camera or field.cameras[source], poses[i].detach().cpu().double().numpy())
        seen_by = None
        if target_poses is not None:
            seen_by = PosedCamera(target_camera or field.cameras[target], target_poses[i].detach().cpu().double().numpy())
        converted.append(convert_frame(field, raw, view, source=source, target=target, method=chosen, seen_by=seen_by))
    images = lambda arrays: torch.from_numpy(np.stack(arrays)).to(frames.device).movedim(-1, 1)
    stokes = [c.stokes for c in converted if c.stokes is not None]
    return Conversion(
        values=images([c.values for c in converted]),
        stokes=images(stokes) if stokes else None,
        confidence=images([c.confidence[..., None] for c in converted]),
        guided=images([c.guided[..., None] for c in converted]),
        valid=images([c.valid[..., None] for c in converted]),
        exposure=torch.tensor([c.exposure for c in converted], device=frames.device),
        method=chosen.method,
        weights=tuple(c.weights for c in converted),
        evidence=chosen.evidence,
    )


def choose(
    field: Field,
    scene: Scene | None,
    source: str,
    target: str,
    method: Method = "auto",
    *,
    lights: dict[str, MovingLight] | None = None,
) -> Chosen:
    """What a method needs, and what ``auto`` goes by.

    Args:
        scene: None: there is none at hand. lights: see ``gather``.
    Raises:
        InputError: no such method, or one that needs training frames where there are none.
    """
    if method not in METHODS:
        raise InputError(f"convert: method is {method!r}, expected one of {', '.join(METHODS)}.")
    if method == "auto":
        found = None if scene is None else gather(field, scene, source, target, lights)
        if found is None:
            return Chosen(_by_kind(field.sensors[source], field.sensors[target]))
        return Chosen("auto", found.training, found)
    if method not in OF_THE_SCENE:
        return Chosen(method)
    if scene is None:
        raise InputError(f"convert: method '{method}' needs the scene's training frames, expected the scene.")
    return Chosen(method, learn_training(field, scene, source, target))


def _by_kind(source: Sensor, target: Sensor) -> Method:
    colours = source.channel_count > 1 and target.channel_count > 1 and not (source.is_polarization or target.is_polarization)
    return "guided" if colours else "ratio"


def convert_frame(
    field: Field,
    raw: np.ndarray,
    view: PosedCamera,
    *,
    source: str,
    target: str,
    method: Method | Chosen = "auto",
    seen_by: PosedCamera | None = None,
    left_out: int | None = None,
    progress: RaysDone | None = None,
) -> Converted:
    """Convert one frame.

    Args:
        raw: (H, W) of a mosaicked source, else (H, W, C), linear, 1.0 = full scale. view: camera and pose of the frame.
        source, target: modalities of the field. method: one that needs no scene, or what ``choose`` found. seen_by: camera and pose of the
            target, None: the source's own pixels. left_out: training view whose frame of the target is not used.
        progress: called with the number of rays done since the last call.
    Raises:
        InputError: unknown modality or method, or a frame of another size.
    """
    source, target = canonical_modality(source), canonical_modality(target)
    field.check_modalities([source, target])
    chosen = method if isinstance(method, Chosen) else choose(field, None, source, target, method)
    compared = compare(field, raw, view, source, target, progress=progress)
    weights: dict[Prediction, float] = {}
    if chosen.evidence is not None:
        weights = chosen.evidence.weights(_prior_sd(field, compared, source), seen_by is not None)
    elif chosen.method != "auto":
        weights = {chosen.method: 1.0}
    said = predict(
        field,
        compared,
        source,
        target,
        list(weights),
        training=chosen.training,
        seen_by=seen_by,
        left_out=left_out,
        to_weigh=chosen.evidence is not None,
        progress=progress,
    )
    return blended(field.sensors[target], chosen.method, compared, said, weights)


def _prior_sd(field: Field, compared: Compared, source: str) -> float:
    """τ of the window that evidence is gathered from."""
    window, sensor = around_region(field, compared.view, field.sensors[source]), field.sensors[source]
    return guide(compared.raw[window], compared.seen.channels[source][window], sensor, compared.seen.valid[window]).prior_sd


def blended(target: Sensor, method: Method, compared: Compared, said: Predictions, weights: Mapping[Prediction, float]) -> Converted:
    """So much of each prediction; ``said`` has all of them."""
    light = sum(weight * said.light[name] for name, weight in weights.items())
    there, guidance = said.there, compared.guidance
    values, stokes = light, None
    if target.is_polarization:
        stokes = np.asarray(light)
        values = stokes_to_intensities(torch.from_numpy(stokes), target.polarizer_angles_deg or ()).numpy()
    guided = np.zeros_like(there.valid)
    for name, weight in weights.items():
        if name != "field" and weight > 0:
            guided |= said.told[name]
    # where the frame says nothing the field is as sure as it proved to be elsewhere
    deviation = np.where(said.told["field"], said.gain_sd, guidance.prior_sd)
    confidence = np.exp(-0.5 * (deviation / _SURE) ** 2)
    return Converted(
        method=method,
        weights=dict(weights),
        values=np.maximum(values, 0.0).astype(np.float32),  # NaN stays
        stokes=None if stokes is None else stokes.astype(np.float32),
        confidence=np.where(there.valid & ~said.unexplained, confidence, 0.0).astype(np.float32),
        guided=guided,
        exposure=guidance.exposure,
        opacity=there.opacity,
        valid=there.valid,
        deviation=there.deviation.get(target.name),
    )


def render_frame(field: Field, rays: TrainingRays, view: PosedCamera, target: str, *, progress: RaysDone | None = None) -> Converted:
    """What the target sensor would have seen at a pose where there is no frame: the field alone. Confidence is coverage by the training
    frames (see ``coverage``), 0 without a surface."""
    seen = field.render(view.camera, view.camera_to_world, [target], geometry=True, progress=progress)
    covered = coverage(rays, view, seen.depth_ray, seen.normal)
    return Converted(
        method="field",
        weights={"field": 1.0},
        values=seen.channels[target],
        stokes=seen.stokes.get(target),
        confidence=np.where(np.isfinite(covered), covered, 0.0).astype(np.float32),
        guided=np.zeros_like(seen.valid),
        exposure=1.0,
        opacity=seen.opacity,
        valid=seen.valid,
        deviation=seen.deviation.get(target),
    )
