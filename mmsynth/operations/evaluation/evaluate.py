"""Scores of a field: test views against the raw frames, and against noise-free truth where a scene has it.

Definitions (all values linear, peak 1.0 = full scale, so PSNR = -10 log10 MSE; MSE is pooled over the pixels of all test views, not
averaged per view in dB):

* ``psnr``: raw photosites with a valid lens ray. A sensor clips, so predictions are clipped to [0, 1] here. What is transparent, or
  outside the masks of an object, counts as black; what is outside masks that say what to ignore does not count, here and in ``ssim``.
* ``psnr_view_mean``: the mean of dB over views, each view's MSE pooled over its pixels.
* ``psnr_foreground``: as ``psnr``, in the foreground. ``foreground_from``: "masks" (the scene's masks or alpha), "gt" (first hit in the
  region), and only where there is neither "opacity" (the field's own > 0.5: a field must not choose its own exam, so it says so).
* ``psnr_foreground_view_mean``: the mean of dB over views, each view's MSE pooled over the pixels of its foreground. Papers on MMS-DATA
  give this one; where views differ it is mostly the higher of the two, as a geometric mean of errors is below the arithmetic one.
* ``psnr_moved``, ``psnr_foreground_moved``, ``psnr_truth_moved``: where the fit moved views, so are those that it did not learn from (see
  ``placing``), and these are ``psnr``, ``psnr_foreground`` and ``psnr_truth`` at their places then; ``moved_px``: of each of these views
  how far off it was, pixels. All else is scored at the poses of the input.
* ``ssim``: Wang et al. 2004, per sub-frame of one mosaic position (never on the interleaved mosaic), averaged; frames without
  mosaic per channel.
* ``lpips``: of Zhang et al. 2018, where a network is installed, see ``perceptual``.
* ``psnr_truth``, ``psnr_truth_full``: all channels at every pixel of the own pose against ``gt/<modality>``, in the region and
  everywhere; both clipped to [0, 1], the range that frames can record.
* ``psnr_aligned``: the same at the RGB camera's pose (``gt/aligned``), in the region: what sensor-to-sensor synthesis delivers.
* ``psnr_highlights, psnr_silhouettes, psnr_rest``: of ``psnr_aligned``, its parts (see ``parts``), where ``gt/geometry`` tells them.
* ``psnr_aligned_free_gain``: of a predicted modality, ``psnr_aligned`` times the one gain that suits best, ``free_gain``; ``within_2sd``:
  the share of pixels and channels whose error is below two of the deviations that were predicted.
* ``sam``: mean angle between spectra, degrees (Kruse et al. 1993); ``stokes_rmse`` over S0, S1, S2; ``s1_s2_rmse``, beside
  ``s1_s2_unpolarized_rmse``, that of saying that nothing is polarized; ``dolp_rmse``, ``dolp_mae``; ``aolp_mae``:
  circular, degrees, weighted by the true polarised light S0 DoLP. In the region, at the RGB pose, else (without ``gt/aligned``)
  at the own pose.
* geometry, at the RGB pose, in the region: ``depth_mae`` (z-depth, scene unit), ``normal_mae_deg`` and
  ``normal_median_deg`` where both have a surface,
  ``hit_rate``: the share of true surface pixels that hit one; ``chamfer_visible``: mean distance from the field's surface points to
  the nearest true one and back, averaged, between the points that the test views see (a ground-truth mesh also has undersides
  that no camera saw; of a picture of more than 262,144 pixels, points of every n-th row and column). Only for scenes in metres, as the
  truth is.

What is undefined (no such truth, no pixel) is left out; there is no NaN in the result.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from mmsynth.errors import InputError
from mmsynth.field.picture import Rendering, bands
from mmsynth.operations.evaluation.parts import PARTS, parts_of
from mmsynth.operations.evaluation.perceptual import LARGE_ENOUGH, Distance, find_lpips, lpips_of_channels
from mmsynth.operations.evaluation.placing import place
from mmsynth.operations.evaluation.scores import Scores
from mmsynth.operations.evaluation.visible_points import chamfer, seen_points
from mmsynth.operations.output.progress import Counter, Progress
from mmsynth.scene.ground_truth import GroundTruth
from mmsynth.scene.images import load_frame
from mmsynth.scene.masks import read_mask
from mmsynth.scene.scene import Frame, MaskMeaning, Scene, Sensor
from mmsynth.sensors.metrics import psnr_from_mse, spectral_angle_deg, ssim, ssim_of_channels
from mmsynth.sensors.mosaic import channels_of, photosites_of
from mmsynth.sensors.polarization import angle_of_linear_polarization, aolp_difference, degree_of_linear_polarization, stokes_to_intensities

if TYPE_CHECKING:
    from mmsynth.field.field import Field

_FOREGROUND_SOURCES = ("masks", "gt", "opacity")


def evaluate(field: Field, scene: Scene, *, views: Sequence[int] | None = None, progress: Progress | None = None) -> dict[str, Any]:
    """Score a field on test views (definitions: module docstring).

    The scene may record other photosites of the same channels through other lenses than the one that the field learned from.

    Args:
        views: view ids; None: the scene's test views. progress: called with (rays done, rays in all).
    Returns:
        ``{"modalities": {name: {"psnr", "psnr_foreground", "foreground_from", "ssim", "psnr_truth", ...}}, "geometry": {...},
        "views": [...], "seconds": {"render", "total"}, "rays_per_s"}``, ready for JSON; with "moved_px" where the fit moved views.
    Raises:
        InputError: no frame of these views, a sensor with other channels than the field's, a file that cannot be read, or masks that are
            all empty.
    """
    began = time.perf_counter()
    chosen = tuple(scene.split.test) if views is None else tuple(views)
    frames = _frames_of(field, scene, chosen, named=views is not None)
    truth = GroundTruth(scene)
    # the pose of gt/aligned and gt/geometry
    at_rgb = [f for f in scene.frames_of("rgb", chosen) if truth.aligned(f.view) or truth.geometry(f.view)]
    unplaced = [f for f in frames if field.corrections.views and f.view not in field.corrections.views]
    count = Counter(progress, sum(frame.camera.width * frame.camera.height for frame in (*frames, *unplaced, *at_rgb)))
    exam = _Exam(field, scene, truth, count)
    for frame in frames:
        _at_own_pose(exam, frame)
    exam.check_masks(frames)
    placed = place(field, scene, unplaced)
    for frame in unplaced:
        _where_placed(exam, frame, placed.poses[frame.sensor, frame.view])
    for frame in at_rgb:
        _at_rgb_pose(exam, frame)
    return {
        "modalities": {name: _summary(exam.scores[name], exam.own_pose[name]) for name in exam.scores if exam.scores[name].means},
        "geometry": _geometry(exam),
        "views": sorted({frame.view for frame in frames}),
        "seconds": {"render": exam.seconds, "total": time.perf_counter() - began},
        "rays_per_s": exam.rays / max(exam.seconds, 1e-9),
    } | ({"moved_px": {str(view): pixels for view, pixels in placed.pixels.items()}} if unplaced else {})


def _frames_of(field: Field, scene: Scene, chosen: tuple[int, ...], named: bool) -> list[Frame]:
    """Of all modalities that field and scene share; views that somebody named must all be there."""
    frames = [frame for name in field.sensors if name in scene.sensors for frame in scene.frames_of(name, chosen)]
    missing = sorted(set(chosen) - {frame.view for frame in frames})
    if not frames or (named and missing):
        what = f"view {missing[0]}" if missing else "test views"
        raise InputError(f"{scene.root}: no frames of {what} for any of {', '.join(field.sensors)}, expected view ids of the scene.")
    return frames


class _Exam:
    """What is asked, and what was scored so far."""

    def __init__(self, field: Field, scene: Scene, truth: GroundTruth, count: Counter) -> None:
        self.field, self.truth, self.count, self.metric, self.masks = field, truth, count, scene.unit == "m", scene.masks
        # what a prior predicts has no frames, or few, and is scored where there is truth
        names = [name for name in field.sensors if name in scene.sensors or name in field.predicted]
        self.sensors = {name: scene.sensors.get(name, field.sensors[name]) for name in names}
        for name, sensor in self.sensors.items():
            ours = field.sensors[name].channel_count
            if sensor.channel_count != ours:
                raise InputError(f"{scene.root}: '{name}' has {sensor.channel_count} channels, expected the {ours} that the field learned.")
        self.lpips = find_lpips()
        self.scores = {name: Scores() for name in names}
        self.own_pose = {name: Scores() for name in names}
        self.geometry = Scores()
        self.points: list[np.ndarray] = []
        self.true_points: list[np.ndarray] = []
        self.normal_errors: list[np.ndarray] = []  # degrees
        self.rays, self.seconds = 0, 0.0

    def check_masks(self, frames: Sequence[Frame]) -> None:
        """Masks of frames that were scored and have no foreground in any are an error: the score would silently be that of another."""
        for name, scores in self.scores.items():
            masked = [frame for frame in frames if frame.sensor == name and frame.mask is not None]
            if masked and scores.value("psnr_foreground/masks") is None:
                which = f"this mask of {name} and those of all its other test frames"
                raise InputError(f"{masked[0].mask}: {which} are empty, expected pixels that are not zero.")

    def render(self, frame: Frame, names: Sequence[str], geometry: bool, pose: np.ndarray | None = None) -> Rendering:
        """As a frame's camera sees the field, from its own pose or from another."""
        started = time.perf_counter()
        own = self.field.pose_of(frame) if pose is None else pose
        found = self.field.render(frame.camera, own, names, geometry=geometry, progress=self.count)
        self.seconds += time.perf_counter() - started
        self.rays += int(found.valid.sum())
        return found


def _at_own_pose(exam: _Exam, frame: Frame) -> None:
    """A frame's sensor against the frame, and against noise-free light at its pose."""
    sensor, scores = exam.sensors[frame.sensor], exam.scores[frame.sensor]
    rendering = exam.render(frame, [sensor.name], False)
    size = rendering.valid.shape
    region = _checked(exam.truth.region(frame), size, f"gt/masks, {sensor.name} view {frame.view}")
    _score_raw(scores, sensor, _compared(sensor, frame, rendering, region, exam.masks), exam.lpips)
    light = _checked(exam.truth.image(frame), (*size, _components(sensor)), f"gt, {sensor.name} view {frame.view}")
    if light is None:
        return
    everywhere = np.ones(size, bool)
    _score_truth(scores, "psnr_truth_full", sensor, rendering, light, everywhere)
    if region is not None:
        _score_truth(scores, "psnr_truth", sensor, rendering, light, region)
    _score_light(exam.own_pose[sensor.name], sensor, rendering, light, everywhere if region is None else region)


def _where_placed(exam: _Exam, frame: Frame, pose: np.ndarray) -> None:
    """A frame's sensor against the frame, from where it saw what it shows."""
    sensor, scores = exam.sensors[frame.sensor], exam.scores[frame.sensor]
    rendering = exam.render(frame, [sensor.name], False, pose)
    region, light = exam.truth.region(frame), exam.truth.image(frame)
    found = _compared(sensor, frame, rendering, region, exam.masks)
    scores.add("psnr_moved", found.squared[found.valid])
    for source, inside in found.foreground.items():
        scores.add(f"psnr_foreground_moved/{source}", found.squared[found.valid & inside])
    if light is not None and region is not None:
        _score_truth(scores, "psnr_truth_moved", sensor, rendering, light, region)


def _at_rgb_pose(exam: _Exam, frame: Frame) -> None:
    """All sensors, and the geometry, at the pose of an RGB frame."""
    aligned = {name: light for name, light in exam.truth.aligned(frame.view).items() if name in exam.scores}
    shape = exam.truth.geometry(frame.view) or {}
    rendering = exam.render(frame, list(aligned), bool(shape))
    size = rendering.valid.shape
    region = shape["in_roi"].astype(bool) if "in_roi" in shape else exam.truth.region(frame)
    region = _checked(region, size, f"gt region, view {frame.view}")
    where = np.ones(size, bool) if region is None else region
    for name, light in aligned.items():
        sensor = exam.field.sensors[name]
        _checked(light, (*size, _components(sensor)), f"gt/aligned, {name} view {frame.view}")
        _score_truth(exam.scores[name], "psnr_aligned", sensor, rendering, light, where)
        if name in exam.field.predicted:
            _score_prediction(exam.scores[name], sensor, rendering, light, where)
        if "depth_z" in shape:
            brightness = light[..., :1] if sensor.is_polarization else light
            for part, pixels in parts_of(brightness, shape, exam.truth.labels(), where).items():
                _score_truth(exam.scores[name], f"psnr_{part}", sensor, rendering, light, pixels)
        _score_light(exam.scores[name], sensor, rendering, light, where)
    if "depth_z" in shape and exam.metric:  # the truth is in metres
        _score_geometry(exam, rendering, shape, where)
        surface = where & rendering.valid
        exam.points.append(
            seen_points(frame.camera, exam.field.pose_of(frame), rendering.depth_z, surface & np.isfinite(rendering.depth_z))
        )
        exam.true_points.append(seen_points(frame.camera, exam.field.pose_of(frame), shape["depth_z"], surface & (shape["depth_z"] > 0)))


def _components(sensor: Sensor) -> int:
    """Of noise-free light: Stokes vectors of a polarization sensor, else channels."""
    return 3 if sensor.is_polarization else sensor.channel_count


def raw_ssim(measured: np.ndarray, predicted: np.ndarray, valid: np.ndarray, sensor: Sensor) -> list[float]:
    """SSIM of each mosaic sub-frame (or of each channel of a frame without mosaic)."""
    if sensor.mosaic is None:
        return ssim_of_channels(measured, predicted, valid)
    rows, columns = sensor.mosaic.shape
    parts = [(slice(i, None, rows), slice(j, None, columns)) for i in range(rows) for j in range(columns)]
    found = (ssim(measured[part], predicted[part], valid[part]) for part in parts)
    return [value for value in found if value is not None]


def _checked(truth: np.ndarray | None, shape: tuple[int, ...], what: str) -> np.ndarray | None:
    """Truth or a mask of the wrong size or channel count is an error of the scene, not a score."""
    if truth is not None and truth.shape != shape:
        raise InputError(f"{what}: array of shape {truth.shape}, expected {shape}.")
    return truth


@dataclass(frozen=True)
class _Compared:
    """What a sensor recorded, and what is predicted for it, both (H, W) of a mosaic, else (H, W, C); masks are (H, W).

    Attributes:
        squared: errors, as ``measured``. valid: the pixels that count. foreground: what is known of it, by source.
    """

    measured: np.ndarray
    predicted: np.ndarray
    squared: np.ndarray
    valid: np.ndarray
    foreground: dict[str, np.ndarray]


def _compared(sensor: Sensor, frame: Frame, rendering: Rendering, region: np.ndarray | None, masks: MaskMeaning) -> _Compared:
    measured, alpha = load_frame(sensor, frame)
    channels = rendering.channels[sensor.name]
    mask, valid = read_mask(frame), rendering.valid
    if alpha is not None:
        # what is transparent was never seen
        measured = measured * alpha[..., None]
    if mask is not None and masks == "object":
        measured = measured * (mask if measured.ndim == 2 else mask[..., None])
    if mask is not None and masks == "ignore":
        valid = valid & mask
    predicted = np.clip(np.nan_to_num(channels if sensor.mosaic is None else photosites_of(channels, sensor.mosaic)), 0.0, 1.0)
    if mask is None and alpha is not None:
        mask = alpha > 0.5
    foreground = {"masks": mask, "gt": region, "opacity": rendering.opacity > 0.5}
    known = {source: inside for source, inside in foreground.items() if inside is not None}
    return _Compared(measured, predicted, (predicted - measured) ** 2, valid, known)


def _score_raw(scores: Scores, sensor: Sensor, found: _Compared, lpips: Distance | None) -> None:
    """Against the frame as the sensor recorded it."""
    predicted, squared, valid = found.predicted, found.squared, found.valid
    scores.add("psnr", squared[valid])
    if valid.any():
        scores.add("view_mean", _decibels(squared[valid]))
    for source, inside in found.foreground.items():
        scores.add(f"psnr_foreground/{source}", squared[valid & inside])
        if (valid & inside).any():
            scores.add(f"view_mean/{source}", _decibels(squared[valid & inside]))
    measured = np.clip(found.measured, 0.0, 1.0)
    scores.add("ssim", np.array(raw_ssim(measured, predicted, valid, sensor)))
    if lpips is not None and min(valid.shape) >= LARGE_ENOUGH:
        # both demosaicked alike: networks have no eyes for a mosaic
        seen, shown = (channels_of(values.astype(np.float32), sensor.mosaic) for values in (measured, predicted))
        scores.add("lpips", np.array(lpips_of_channels(lpips, seen, np.where(valid[..., None], shown, seen))))


def _decibels(squared: np.ndarray) -> np.ndarray:
    """PSNR of squared errors, as an array of one number."""
    return np.array(psnr_from_mse(float(squared.mean(dtype=np.float64))))


def _score_truth(scores: Scores, key: str, sensor: Sensor, rendering: Rendering, truth: np.ndarray, where: np.ndarray) -> None:
    """All channels against noise-free light; truth (H, W, C), of a polarization sensor Stokes (H, W, 3)."""
    for seen, light, here in _by_bands(rendering, truth, where):
        difference = np.clip(seen.channels[sensor.name], 0.0, 1.0) - np.clip(_channels(light, sensor), 0.0, 1.0)
        scores.add(key, difference[here] ** 2)


def _by_bands(rendering: Rendering, truth: np.ndarray, where: np.ndarray) -> Iterator[tuple[Rendering, np.ndarray, np.ndarray]]:
    """Rendering, truth and the pixels in question that have a ray, some rows at a time: all of a full-size picture takes gigabytes."""
    for rows in bands(where.shape):
        part = rendering.rows(rows)
        yield part, truth[rows], where[rows] & part.valid


def _channels(light: np.ndarray, sensor: Sensor) -> np.ndarray:
    """(H, W, C) of truth, which is (H, W, 3) Stokes vectors of a polarization sensor."""
    if sensor.polarizer_angles_deg is None:
        return light
    return stokes_to_intensities(torch.from_numpy(light), sensor.polarizer_angles_deg).numpy()


def _score_prediction(scores: Scores, sensor: Sensor, rendering: Rendering, truth: np.ndarray, where: np.ndarray) -> None:
    """What is asked of a modality that was not measured: how good it is but for its gain, and whether it knows how good it is."""
    for seen, light, here in _by_bands(rendering, truth, where):
        values, real_values = seen.channels[sensor.name][here], _channels(light, sensor)[here]
        ours, real = (np.clip(v, 0.0, 1.0).astype(np.float64) for v in (values, real_values))
        for key, products in (("ours_ours", ours * ours), ("ours_true", ours * real), ("true_true", real * real)):
            scores.add(f"gain/{key}", products)
        scores.add("within_2sd", np.abs(values - real_values) < 2.0 * seen.deviation[sensor.name][here])


def _score_light(scores: Scores, sensor: Sensor, rendering: Rendering, truth: np.ndarray, where: np.ndarray) -> None:
    """Errors that PSNR does not show: the shape of the spectrum, the polarization."""
    for seen, light, here in _by_bands(rendering, truth, where):
        if sensor.is_polarization:
            ours, real = (torch.from_numpy(s[here].astype(np.float64)) for s in (seen.stokes[sensor.name], light))
            scores.add("stokes_rmse", ((ours - real) ** 2).numpy())
            scores.add("dolp_mae", (degree_of_linear_polarization(ours) - degree_of_linear_polarization(real)).abs().numpy())
            scores.add("s1_s2_rmse", ((ours - real)[:, 1:] ** 2).numpy())
            scores.add("s1_s2_unpolarized_rmse", (real[:, 1:] ** 2).numpy())
            scores.add("dolp_rmse", ((degree_of_linear_polarization(ours) - degree_of_linear_polarization(real)) ** 2).numpy())
            error = aolp_difference(angle_of_linear_polarization(ours), angle_of_linear_polarization(real)).abs()
            scores.add("aolp_mae", error.numpy(), real[:, 1:].norm(dim=1).numpy())
        elif sensor.channel_count > 3:
            scores.add("sam", spectral_angle_deg(seen.channels[sensor.name][here], light[here]))


def _score_geometry(exam: _Exam, rendering: Rendering, truth: dict[str, np.ndarray], region: np.ndarray) -> None:
    surface = region & (truth["depth_z"] > 0) & rendering.valid
    both = surface & np.isfinite(rendering.depth_z)
    exam.geometry.add("hit_rate", both[surface])
    exam.geometry.add("depth_mae", np.abs(rendering.depth_z[both] - truth["depth_z"][both]))
    if "normal" in truth:
        a, b = rendering.normal[both].astype(np.float64), truth["normal"][both].astype(np.float64)
        known = np.isfinite(a).all(-1) & (np.linalg.norm(b, axis=-1) > 0.5)
        exam.normal_errors.append(np.asarray(spectral_angle_deg(a[known], b[known])))


def _geometry(exam: _Exam) -> dict[str, float]:
    """All that is known of the surface's errors."""
    out = _values(exam.geometry, ("depth_mae", "hit_rate")) | chamfer(exam.points, exam.true_points)
    errors = np.concatenate(exam.normal_errors) if exam.normal_errors else np.empty(0)
    errors = errors[np.isfinite(errors)]
    return out | ({"normal_mae_deg": float(errors.mean()), "normal_median_deg": float(np.median(errors))} if len(errors) else {})


def _values(scores: Scores, keys: Sequence[str]) -> dict[str, Any]:
    found = {key: scores.value(key) for key in keys}
    return {key: value for key, value in found.items() if value is not None}


def _prediction(scores: Scores) -> dict[str, Any]:
    """Of a predicted modality: PSNR with the one gain that suits best, that gain, and how often the error is below two deviations."""
    ours, both, true = (scores.value(f"gain/{key}") for key in ("ours_ours", "ours_true", "true_true"))
    within = scores.value("within_2sd")
    if not ours or both is None or true is None or within is None:
        return {}
    mse = max(true - both * both / ours, 0.0)
    return {"predicted": True, "psnr_aligned_free_gain": psnr_from_mse(mse), "free_gain": both / ours, "within_2sd": within}


def _summary(scores: Scores, own_pose: Scores) -> dict[str, Any]:
    """The keys of one modality in the order of the module docstring."""
    out = _values(scores, ("psnr",))
    if "view_mean" in scores.means:
        out["psnr_view_mean"] = scores.value("view_mean")
    for source in _FOREGROUND_SOURCES:
        value = scores.value(f"psnr_foreground/{source}")
        if value is not None:
            out |= {"psnr_foreground": value, "psnr_foreground_view_mean": scores.value(f"view_mean/{source}"), "foreground_from": source}
            moved = {"psnr_moved": scores.value("psnr_moved"), "psnr_foreground_moved": scores.value(f"psnr_foreground_moved/{source}")}
            out |= {key: value for key, value in moved.items() if value is not None}
            break
    out |= _values(
        scores, ("ssim", "lpips", "psnr_truth", "psnr_truth_moved", "psnr_truth_full", "psnr_aligned", *(f"psnr_{part}" for part in PARTS))
    )
    out |= _prediction(scores)
    light = ("sam", "stokes_rmse", "s1_s2_rmse", "s1_s2_unpolarized_rmse", "dolp_rmse", "dolp_mae", "aolp_mae")
    return out | (_values(scores, light) or _values(own_pose, light))
