"""Previews to look at. This is the only place where values are tone-mapped, clipped or coloured; none of it is data."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch

from mmsynth.files import write_atomic
from mmsynth.scene.preview_colours import PreviewColours
from mmsynth.scene.scene import Sensor
from mmsynth.sensors.polarization import angle_of_linear_polarization, degree_of_linear_polarization

LARGEST = 800
"""Pixels in a row or column of a preview: more is not looked at, and to make it of a full-size frame takes minutes."""
# a display's red, green and blue as bumps over the spectrum: centre and width in nm; enough to recognise a scene, no colorimetry
_PRIMARIES_NM = ((610.0, 40.0), (545.0, 35.0), (455.0, 30.0))


def preview_weights(sensor: Sensor) -> np.ndarray:
    """(3, C): how the sensor's channels mix to display red, green, blue.

    By wavelength where the channels have one and cover the visible; else the three channels of a three-channel sensor in
    their order, grey for a single channel (or a polarization sensor: the sum of its analysers, as S0), and for anything
    else false colours: long waves (or late channels) red, short (or early) blue.
    """
    count = sensor.channel_count
    if count == 1 or sensor.is_polarization:
        return np.full((3, count), 2.0 / count if sensor.is_polarization else 1.0)
    waves = np.array([np.nan if w is None else w for w in sensor.wavelengths_nm], dtype=np.float64)
    known = np.flatnonzero(np.isfinite(waves))
    if known.size >= 3:
        bumps = np.array([np.exp(-0.5 * ((waves - centre) / width) ** 2) for centre, width in _PRIMARIES_NM])
        bumps = np.nan_to_num(bumps)
        if bumps.max(1).min() > 0.1:
            return bumps / bumps.sum(1, keepdims=True)
    if count == 3:
        return np.eye(3)
    order = known[np.argsort(-waves[known])] if known.size >= 2 else np.arange(count)[::-1]
    chosen = [order[0], order[len(order) // 2], order[-1]]
    if len(order) == 2:
        return 0.5 * (np.eye(count)[[chosen[0], chosen[0], chosen[2]]] + np.eye(count)[[chosen[0], chosen[2], chosen[2]]])
    return np.eye(count)[chosen]


def preview_linear(sensor: Sensor, channels: np.ndarray, colours: PreviewColours | None = None) -> np.ndarray:
    """(H, W, C) → (H, W, 3) float32, linear, in sRGB's colours where they are known, not yet exposed; NaN (no ray) becomes 0."""
    mixed = np.nan_to_num(channels.astype(np.float32)) @ preview_weights(sensor).T.astype(np.float32)
    return mixed.clip(min=0.0) if colours is None else (mixed.clip(min=0.0) @ np.array(colours.matrix, np.float32).T).clip(min=0.0)


def exposure_of(linear: np.ndarray, percentile: float = 99.0) -> float:
    """The factor that brings a percentile of the pixels to 0.9. 1 for a black image."""
    level = float(np.percentile(linear, percentile)) if linear.size else 0.0
    return 0.9 / level if level > 1e-6 else 1.0


def tone_map(linear: np.ndarray, exposure: float | None = None) -> np.ndarray:
    """Linear → display values in [0, 1]: exposure (percentile when None), clip, sRGB gamma (kornia takes a second to import)."""
    x = np.clip(linear * (exposure_of(linear) if exposure is None else exposure), 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.power(x, 1 / 2.4) - 0.055).astype(np.float32)


def to_uint8(display: np.ndarray) -> np.ndarray:
    """Display values in [0, 1] → uint8."""
    return np.round(np.clip(np.nan_to_num(display), 0.0, 1.0) * 255.0).astype(np.uint8)


def preview_rgb(sensor: Sensor, channels: np.ndarray, exposure: float | None = None, colours: PreviewColours | None = None) -> np.ndarray:
    """All channels of a sensor (H, W, C), linear → (H, W, 3) uint8, tone-mapped."""
    return to_uint8(tone_map(preview_linear(sensor, channels, colours), exposure))


def preview_dolp(stokes: np.ndarray) -> np.ndarray:
    """Stokes (H, W, 3) → (H, W) float32, DoLP in [0, 1]; 0 where there is no light or no ray."""
    return degree_of_linear_polarization(torch.from_numpy(np.nan_to_num(stokes))).clamp(0.0, 1.0).float().numpy()


def preview_aolp(stokes: np.ndarray, gain: float = 1.0) -> np.ndarray:
    """Stokes (H, W, 3) → (H, W, 3) float32 display RGB: hue = AoLP, value = DoLP times ``gain``, full saturation.

    The hue circle spans 180 degrees of AoLP: red 0 (image right), green 60, blue 120, red again at 180. Unpolarised light
    has no angle and is black.
    """
    stokes = np.nan_to_num(stokes).astype(np.float64)
    hue = (2.0 * angle_of_linear_polarization(torch.from_numpy(stokes)).numpy()) % 360.0
    hsv = np.stack([hue, np.ones_like(hue), (gain * preview_dolp(stokes)).clip(max=1.0)], -1).astype(np.float32)
    return cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)


def preview_depth(depth: np.ndarray, span: tuple[float, float] | None = None) -> np.ndarray:
    """Depth (H, W), NaN = no hit → (H, W, 3) uint8: near bright, far dark (viridis), no hit black.

    Args:
        span: nearest and farthest; None: the 2nd and 98th percentile.
    """
    hit = np.isfinite(depth)
    if not hit.any():
        return np.zeros((*depth.shape, 3), np.uint8)
    near, far = np.percentile(depth[hit], (2.0, 98.0)) if span is None else span
    return preview_share((far - depth) / max(float(far - near), 1e-9))


def preview_share(share: np.ndarray) -> np.ndarray:
    """Numbers in [0, 1] (H, W), NaN = none → (H, W, 3) uint8, viridis; none is black."""
    known = np.isfinite(share)
    levels = to_uint8(np.where(known, share, 0.0))
    return np.where(known[..., None], cv2.cvtColor(cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS), cv2.COLOR_BGR2RGB), 0).astype(np.uint8)


def preview_normal(normal: np.ndarray) -> np.ndarray:
    """World normals (H, W, 3), NaN = no hit → (H, W, 3) uint8: x, y, z from -1..1 to red, green, blue; no hit black."""
    hit = np.isfinite(normal).all(-1, keepdims=True)
    return np.where(hit, to_uint8(0.5 * (normal + 1.0)), 0).astype(np.uint8)


def reduced(image: np.ndarray, side: int = LARGEST) -> np.ndarray:
    """A picture (H, W) or (H, W, 3) with at most ``side`` pixels in a row or column, by means over areas; smaller ones as they are."""
    factor = side / max(image.shape[:2])
    if factor >= 1.0:
        return image
    size = (max(1, round(image.shape[1] * factor)), max(1, round(image.shape[0] * factor)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))


def as_rgb(image: np.ndarray) -> np.ndarray:
    """Display image, uint8 or float in [0, 1], (H, W) or (H, W, 3) → (H, W, 3) uint8."""
    pixels = image if image.dtype == np.uint8 else to_uint8(image)
    return np.repeat(pixels[..., None], 3, -1) if pixels.ndim == 2 else pixels


def encode_png(image: np.ndarray) -> bytes:
    """(H, W, 3) RGB uint8 → PNG file content."""
    return bytes(cv2.imencode(".png", np.ascontiguousarray(as_rgb(image)[..., ::-1]))[1])


def contact_sheet(images: Sequence[Sequence[np.ndarray]], labels: Sequence[Sequence[str]], path: Path, height: int = 240) -> None:
    """Write rows of labelled pictures as one PNG.

    Args:
        images: rows of display images (uint8, or float in [0, 1]); sizes may differ, all are scaled to ``height`` pixels.
        labels: one per image, drawn above it (ASCII).
    """
    strip, gap = 22, 6
    rows = []
    for row, names in zip(images, labels, strict=True):
        cells = []
        for image, name in zip(row, names, strict=True):
            pixels = as_rgb(image)
            width = max(1, round(pixels.shape[1] * height / pixels.shape[0]))
            shrinks = pixels.shape[0] > height
            cell = np.full((height + strip + gap, width + gap, 3), 255, np.uint8)
            # photosites stay visible where a small picture is enlarged
            scaled = cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_NEAREST)
            cell[strip : strip + height, :width] = scaled
            cv2.putText(cell, name, (2, strip - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (20, 20, 20), 1, cv2.LINE_AA)
            cells.append(cell)
        rows.append(np.concatenate(cells, 1))
    width = max(row.shape[1] for row in rows)
    sheet = np.concatenate([np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), constant_values=255) for row in rows])
    data = encode_png(sheet)
    write_atomic(Path(path), lambda temporary: temporary.write_bytes(data))
