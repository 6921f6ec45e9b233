"""Scores of conversions on test views: every method.

Truth, in this order: noise-free light of the target at the source's own pose (``gt/aligned``), noise-free light at the target's own pose
(``gt/<modality>``), else the target's raw test frame. In the last two the conversion is made as the target sensor.

``auto`` stands beside all that it weighs (``conversion.evidence``), the field alone included.

Values are clipped to [0, 1]; PSNR, RMSE, SAM, Stokes and AoLP errors are over all pixels with a ray, ``psnr_region`` over those in the
region of interest; SSIM is that of ``evaluate``, over pixels with a ray; ERGAS (of a ratio of 1) is torchmetrics'. Without truth, raw
photosites are compared: PSNR alone.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torchmetrics.functional.image import error_relative_global_dimensionless_synthesis

from mmsynth.errors import InputError
from mmsynth.operations.conversion.methods import Converted, blended, choose, convert_frame
from mmsynth.operations.conversion.moving_light import MovingLight
from mmsynth.operations.conversion.predictions import PREDICTIONS, compare, learn_training, predict
from mmsynth.operations.output.progress import Progress
from mmsynth.scene.ground_truth import GroundTruth
from mmsynth.scene.images import load_frame
from mmsynth.scene.scene import Frame, PosedCamera, Scene, Sensor, canonical_modality
from mmsynth.sensors.metrics import psnr_from_mse, spectral_angle_deg, ssim_of_channels
from mmsynth.sensors.mosaic import photosites_of
from mmsynth.sensors.polarization import (
    angle_of_linear_polarization,
    aolp_difference,
    degree_of_linear_polarization,
    stokes_to_intensities,
)

if TYPE_CHECKING:
    from mmsynth.field.field import Field


def evaluate_conversions(
    field: Field, scene: Scene, pairs: Sequence[tuple[str, str]], *, progress: Progress | None = None
) -> list[dict[str, Any]]:
    """``evaluate_conversion`` of pairs of source and target; progress: called with (pairs done, pairs in all)."""
    out: list[dict[str, Any]] = []
    lights: dict[str, MovingLight] = {}
    for done, (source, target) in enumerate(pairs, 1):
        out.append(evaluate_conversion(field, scene, source, target, lights=lights))
        if progress is not None:
            progress(done, len(pairs))
    return out


def evaluate_conversion(
    field: Field,
    scene: Scene,
    source: str,
    target: str,
    *,
    views: Sequence[int] | None = None,
    lights: dict[str, MovingLight] | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Score all methods of one pair.

    Args:
        views: view ids; None: the scene's test views. lights: see ``evidence.gather``. progress: called with (frames done, frames in all).
    Returns:
        ``{"source", "target", "truth": "aligned" | "own pose" | "raw", "views": [...], "auto": {method: weight}, "evidence":
        ``Evidence.facts`` or None, "seconds_per_frame", "methods": {name: {"psnr", "psnr_region", "ssim", "rmse": [per channel], "sam",
        "ergas", "stokes_rmse", "dolp_rmse", "aolp_mae", "physical"}}}``.
    Raises:
        InputError: unknown modality, or no frames of the source in these views.
    """
    source, target = canonical_modality(source), canonical_modality(target)
    field.check_modalities([source, target])
    frames = scene.frames_of(source, tuple(scene.split.test) if views is None else tuple(views))
    if not frames:
        raise InputError(f"{scene.root}: no frames of {source} in the test views, expected some to convert.")
    truth = GroundTruth(scene)
    own_of = {f.view: f for f in scene.frames_of(target, tuple(f.view for f in frames))}
    aligned = source == "rgb" and all(target in truth.aligned(f.view) for f in frames)
    # one kind of truth for all: figures of photosites with noise and of light are not pooled
    kind = "aligned" if aligned else "own pose" if all(truth.image(own) is not None for own in own_of.values()) else "raw"
    auto = choose(field, scene, source, target, lights=lights)
    training = learn_training(field, scene, source, target) if auto.training is None else auto.training
    totals: dict[str, list[dict[str, np.ndarray]]] = {}
    sensor, seconds = field.sensors[target], 0.0
    weights: dict[str, float] = {}
    judged: list[int] = []
    for done, frame in enumerate(frames, 1):
        raw, _ = load_frame(field.sensors[source], frame)
        own = None if aligned else own_of.get(frame.view)
        if not aligned and own is None:
            continue
        seen_by = None if own is None else PosedCamera(own.camera, field.pose_of(own))
        view = PosedCamera(frame.camera, field.pose_of(frame))
        light, region = _truth_of(truth, sensor, frame, own, kind)
        began = time.perf_counter()
        found = convert_frame(field, raw, view, source=source, target=target, method=auto, seen_by=seen_by, left_out=frame.view)
        seconds += time.perf_counter() - began
        for taken, weight in found.weights.items():
            weights[taken] = weights.get(taken, 0.0) + weight
        results: dict[str, np.ndarray] = {"auto": _values(found, sensor)}
        compared = compare(field, raw, view, source, target)
        said = predict(field, compared, source, target, PREDICTIONS, training=training, seen_by=seen_by, left_out=frame.view)
        results |= {m: _values(blended(sensor, m, compared, said, {m: 1.0}), sensor) for m in PREDICTIONS}
        for name, values in results.items():
            totals.setdefault(name, []).append(_errors(values, light, found.valid, region, sensor, kind))
        judged.append(frame.view)
        if progress is not None:
            progress(done, len(frames))
    if not judged:
        raise InputError(f"{scene.root}: no frames of {target} in the views of {source} to judge by.")
    return {
        "source": source,
        "target": target,
        "truth": kind,
        "views": judged,
        "auto": {name: weight / len(judged) for name, weight in weights.items()},
        "evidence": None if auto.evidence is None else auto.evidence.facts(),
        "methods": {name: _summary(rows) for name, rows in totals.items()},
        "seconds_per_frame": seconds / len(judged),
    }


def _truth_of(truth: GroundTruth, target: Sensor, frame: Frame, own: Frame | None, kind: str) -> tuple[np.ndarray, np.ndarray | None]:
    """Light (H, W, C), of polarization Stokes, or raw photosites; the region."""
    if own is None:
        shape = truth.geometry(frame.view) or {}
        region = shape["in_roi"].astype(bool) if "in_roi" in shape else truth.region(frame)
        return truth.aligned(frame.view)[target.name].astype(np.float64), region
    light = truth.image(own) if kind == "own pose" else None
    return (load_frame(target, own)[0] if light is None else light).astype(np.float64), truth.region(own)


def _values(found: Converted, target: Sensor) -> np.ndarray:
    return (found.stokes if target.is_polarization and found.stokes is not None else found.values).astype(np.float64)


def _errors(
    values: np.ndarray, light: np.ndarray, valid: np.ndarray, region: np.ndarray | None, target: Sensor, kind: str
) -> dict[str, np.ndarray]:
    """Sums to be pooled over views, and means of those that are not pooled."""
    values = np.where(valid[..., None], values, 0.0)
    intensities = lambda s: stokes_to_intensities(torch.from_numpy(s), target.polarizer_angles_deg or ()).numpy()
    seen = intensities(values) if target.is_polarization else values
    if kind == "raw":
        if target.mosaic is not None:
            seen = photosites_of(seen, target.mosaic)
        real = light if light.ndim == seen.ndim else light[..., None]
    else:
        real = intensities(light) if target.is_polarization else light
    seen, real = np.clip(seen, 0.0, 1.0), np.clip(real, 0.0, 1.0)
    square = (seen - real) ** 2
    out = {"mse": square[valid]}
    if region is not None:
        out["mse_region"] = square[valid & region]
    if kind == "raw":
        return out
    out["mse_channels"] = square[valid].reshape(-1, square.shape[-1])
    similar = ssim_of_channels(real, seen, valid)
    if similar:
        out["ssim"] = np.array([np.mean(similar)])
    if target.is_polarization:
        ours, true = (torch.from_numpy(x[valid]) for x in (values, light))
        out["stokes"] = ((ours - true) ** 2).numpy().ravel()
        out["dolp"] = ((degree_of_linear_polarization(ours) - degree_of_linear_polarization(true)) ** 2).numpy()
        apart = aolp_difference(angle_of_linear_polarization(ours), angle_of_linear_polarization(true)).abs().numpy()
        strength = true[:, 1:].norm(dim=1).numpy()
        out["aolp"], out["aolp_weight"] = apart * strength, strength
        out["physical"] = (ours[:, 1:].norm(dim=1) <= ours[:, 0] + 1e-6).double().numpy()
    elif target.channel_count > 1:
        out["sam"] = spectral_angle_deg(values[valid], light[valid])
        both = [torch.from_numpy(np.where(valid[..., None], x, 0.0)).movedim(-1, 0)[None].float() for x in (seen, real)]
        out["ergas"] = np.array([float(error_relative_global_dimensionless_synthesis(both[0], both[1], ratio=1.0))])
    return out


def _summary(rows: Sequence[dict[str, np.ndarray]]) -> dict[str, Any]:
    pooled = lambda key: np.concatenate([row[key] for row in rows]) if all(key in row for row in rows) else None
    out: dict[str, Any] = {}
    for key, name in (("mse", "psnr"), ("mse_region", "psnr_region")):
        found = pooled(key)
        if found is not None and found.size:
            out[name] = psnr_from_mse(float(found.mean()))
    channels = pooled("mse_channels")
    if channels is not None:
        out["rmse"] = np.sqrt(channels.mean(0)).tolist()
    for key, name, root in (
        ("ssim", "ssim", False), ("sam", "sam", False), ("ergas", "ergas", False), ("stokes", "stokes_rmse", True),
        ("dolp", "dolp_rmse", True), ("physical", "physical", False),
    ):  # fmt: skip
        found = pooled(key)
        if found is not None and np.isfinite(found).any():
            mean = float(found[np.isfinite(found)].mean())
            out[name] = mean**0.5 if root else mean
    angle, weight = pooled("aolp"), pooled("aolp_weight")
    if angle is not None and weight is not None and weight.sum() > 0:
        out["aolp_mae"] = float(angle.sum() / weight.sum())
    return out
