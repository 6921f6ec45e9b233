"""The pictures of a run's page: frames beside their renderings, errors, polarization, geometry, and what a prior predicts."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from mmsynth.operations.output import previews
from mmsynth.report.pictures import (
    Picture,
    Row,
    Wipe,
    angle_scale,
    ceiling,
    depth_map,
    error_map,
    share_map,
    spectra_of,
    spectra_width,
)
from mmsynth.scene.images import load_frame
from mmsynth.scene.masks import read_mask
from mmsynth.scene.preview_colours import preview_colours_of
from mmsynth.scene.scene import Frame, MaskMeaning, Scene, Sensor
from mmsynth.sensors.camera import Camera, every_nth
from mmsynth.sensors.mosaic import channels_of, demosaic_edge_aware, is_bayer
from mmsynth.sensors.polarization import intensities_to_stokes

if TYPE_CHECKING:
    from mmsynth.field.field import Field
    from mmsynth.field.picture import Rendering


def measured_channels(sensor: Sensor, frame: Frame, masks: MaskMeaning) -> np.ndarray:
    """A frame with all channels at every pixel (H, W, C), demosaicked for display; times its alpha, and black outside of the mask of an
    object, as it is fitted and scored."""
    pixels, alpha = load_frame(sensor, frame)
    if alpha is not None:
        pixels = pixels * alpha[..., None]
    if sensor.mosaic is not None and is_bayer(sensor.mosaic):
        channels = np.moveaxis(demosaic_edge_aware(pixels, sensor.mosaic), 0, -1)
    else:
        channels = channels_of(pixels, sensor.mosaic)
    mask = read_mask(frame) if masks == "object" else None
    return channels if mask is None else channels * mask[..., None]


@dataclass
class _Seen:
    """A modality at a view, before the scale of all errors is known: error (H, W) of the pixels shown, NaN = no ray or ignored, and what
    comes before and after it."""

    title: str
    error: np.ndarray
    before: list[Picture | Wipe]
    after: list[Picture | Wipe]
    spectra: dict[str, Any]


def picture_rows(field: Field, scene: Scene) -> tuple[int | None, list[Row]]:
    """Per modality frame | rendering, error, for polarization also AoLP and DoLP; last depth and normals. Of frames of more than 800 pixels
    in a row or column, every n-th pixel is rendered and shown.

    Returns:
        the id of the first test view (None: no frame) and the rows.
    """
    names = [name for name in field.measured if name in scene.sensors]
    frames = {name: (scene.frames_of(name, scene.split.test) or scene.frames_of(name))[:1] for name in names}
    numbers = 2 * sum(field.sensors[name].channel_count for name in [*names, *field.predicted])
    seen: list[_Seen] = []
    geometry: Row | None = None
    for name in names:
        for frame in frames[name]:
            rendering = field.render(_shown_of(frame)[0], field.pose_of(frame), [name], geometry=geometry is None)
            if geometry is None:
                geometry = _geometry_row(rendering, field.unit, frame.view)
            seen.append(_seen(field, scene, frame, rendering, numbers))
    known = [error[np.isfinite(error)] for error in (s.error for s in seen)]
    high = ceiling(max((float(np.percentile(error, 99.0)) for error in known if error.size), default=1.0))
    rows = [Row(s.title, [*s.before, _error(s, high), *s.after], spectra=s.spectra) for s in seen]
    shown = next((of[0] for of in frames.values() if of), None)
    if field.predicted and shown is not None:
        rows += _predicted_rows(field, shown, numbers)
    return (None, []) if shown is None or geometry is None else (shown.view, [*rows, geometry])


def _shown_of(frame: Frame) -> tuple[Camera, int]:
    """What of a frame is shown, and every how many-th pixel that is: as many as a page has room for."""
    n = math.ceil(max(frame.camera.width, frame.camera.height) / previews.LARGEST)
    return every_nth(frame.camera, n), n


def _seen(field: Field, scene: Scene, frame: Frame, rendering: Rendering, numbers: int) -> _Seen:
    name = frame.sensor
    camera, n = _shown_of(frame)
    sensor, ours = field.sensors[name], rendering.channels[name]
    measured = measured_channels(scene.sensors[name], frame, scene.masks)[::n, ::n]
    colours = preview_colours_of(scene.sensors[name], scene.frames_of(name))
    linear = previews.preview_linear(sensor, measured, colours)
    exposure = previews.exposure_of(linear)
    theirs = Picture(f"frame {frame.view}", previews.to_uint8(previews.tone_map(linear, exposure)), f"{name}: frame of view {frame.view}")
    rendered = Picture(
        "rendering", previews.preview_rgb(sensor, ours, exposure, colours), f"{name}: rendering of view {frame.view}", again=True
    )
    after: list[Picture | Wipe] = []
    if sensor.polarizer_angles_deg is not None:
        stokes = intensities_to_stokes(torch.from_numpy(measured), sensor.polarizer_angles_deg).numpy()
        after = _polarization(name, stokes, rendering.stokes[name])
    mask = read_mask(frame) if scene.masks == "ignore" else None
    compared = rendering.valid if mask is None else rendering.valid & mask[::n, ::n]
    error = np.where(compared, np.abs(ours - measured).mean(-1), np.nan)
    spectra = spectra_of(sensor, spectra_width(camera.width, camera.height, numbers), measured=measured, rendered=ours)
    return _Seen(name, error, [Wipe(theirs, rendered), rendered], after, spectra)


def _error(seen: _Seen, high: float) -> Picture:
    image, scale = error_map(seen.error, high)
    mean = float(np.nanmean(seen.error)) if np.isfinite(seen.error).any() else float("nan")
    return Picture(f"error, mean {mean:.3g}", image, f"{seen.title}: map of the error, mean {mean:.3g} of full scale", scale)


def _polarization(name: str, measured: np.ndarray | None, ours: np.ndarray) -> list[Picture | Wipe]:
    """AoLP with DoLP as its brightness, and DoLP alone, to one scale; measured: Stokes vectors of the frame, if there is one."""
    pairs = {"rendering" if measured is not None else "predicted": ours} | ({} if measured is None else {"frame": measured})
    dolp = {key: previews.preview_dolp(stokes) for key, stokes in pairs.items()}
    light = np.nan_to_num(ours[..., 0])
    lit = light > 0.1 * np.percentile(light, 99.0)  # noise of dark pixels looks polarized
    high = min(1.0, ceiling(float(np.percentile(dolp["frame" if measured is not None else "predicted"][lit], 95.0)))) if lit.any() else 1.0
    angles, degrees = {}, {}
    for key, stokes in pairs.items():
        shown = previews.to_uint8(previews.preview_aolp(stokes, 1.0 / high))
        angles[key] = Picture(
            f"AoLP (hue), DoLP (value, to {high:g}): {key}", shown, f"{name}: angle of linear polarization, {key}", angle_scale()
        )
        image, scale = share_map(dolp[key], 0.0, high, "DoLP")
        degrees[key] = Picture(f"DoLP: {key}", image, f"{name}: degree of linear polarization, {key}", scale)
    if measured is None:
        return [angles["predicted"], degrees["predicted"]]
    under = Picture("rendering", angles["rendering"].image, angles["rendering"].alt)
    return [Wipe(angles["frame"], under), Wipe(degrees["frame"], degrees["rendering"])]


def _geometry_row(rendering: Rendering, unit: str, view: int) -> Row:
    depth, scale = depth_map(rendering.depth_z, unit)
    pictures = [
        Picture("depth", depth, f"depth of view {view}", scale),
        Picture("normals (x, y, z as red, green, blue)", previews.preview_normal(rendering.normal), f"normals of view {view}"),
        Picture("opacity", previews.to_uint8(rendering.opacity), f"opacity of view {view}"),
    ]
    return Row("geometry", pictures)


def _predicted_rows(field: Field, frame: Frame, numbers: int) -> list[Row]:
    """Of each modality that a prior predicts, at a frame's pose: prediction, deviation, for polarization also AoLP and DoLP."""
    camera, _ = _shown_of(frame)
    rendering = field.render(camera, field.pose_of(frame), field.predicted, geometry=False)
    rows = []
    for name in field.predicted:
        sensor, ours, deviation = field.sensors[name], rendering.channels[name], rendering.deviation[name]
        exposure = previews.exposure_of(previews.preview_linear(sensor, ours))
        mean = np.where(rendering.valid, deviation.mean(-1), np.nan)
        known = mean[np.isfinite(mean)]
        image, scale = error_map(mean, ceiling(float(np.percentile(known, 99.0)) if known.size else 1.0))
        pictures: list[Picture | Wipe] = [
            Picture("predicted", previews.preview_rgb(sensor, ours, exposure), f"{name}: prediction of view {frame.view}"),
            Picture("its standard deviation", image, f"{name}: standard deviation of the prediction", scale),
        ]
        if sensor.is_polarization:
            pictures += _polarization(name, None, rendering.stokes[name])
        width = spectra_width(camera.width, camera.height, numbers)
        spectra = spectra_of(sensor, width, rendered=ours, deviation=deviation)
        note = "No frame of this modality: a prior of other scenes says what it would have seen, and how sure it is (a scale of its own)."
        rows.append(Row(name, pictures, note, predicted=True, spectra=spectra))
    return rows
