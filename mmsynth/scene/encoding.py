"""Are pixel values linear, or gamma encoded? Told by evidence in the pictures and their files; nothing is converted.

Each kind of evidence says something or nothing (None), and the first that says something decides, in this order:

* what polarization allows: I0 + I90 = I45 + I135 of linear values (Malus), and of I^(1/γ) the difference over S0 is
  (1 - γ)/2 · DoLP² cos 4φ to second order in the DoLP (both as the encoded values show them), so that a slope measures γ;
* what the file declares: PNG chunks, JPEG and WebP (made for screens), EXR and DNG (linear by definition);
* noise: of shot noise the variance grows with the mean, of encoded values it does not. White noise alone counts, so that texture,
  JPEG and demosaicked pictures say nothing;
* the spacing of codes: an encoded picture of a converter's numbers has gaps in the dark that close towards the bright; numbers of a
  converter of fewer bits than the file are all multiples of one step (weaker: a camera may encode before it rounds);
* a raw mosaic in 16-bit files: nobody encodes those.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from mmsynth.scene.images import read_native, used_bits
from mmsynth.scene.scene import Sensor

Verdict = Literal["linear", "gamma encoded", "cannot be told"]
_CROSS = (0.0, 45.0, 90.0, 135.0)
_BLOCK = 4  # tiles a side
_FLAT = 0.1  # largest deviation within a block over its mean: texture is not taken for polarization
_LEAST = 200  # blocks


@dataclass(frozen=True)
class Encoding:
    """How values stand to light, and the reason in one line."""

    verdict: Verdict
    because: str


def encoding_of(sensor: Sensor, paths: Sequence[Path]) -> Encoding:
    """Tell how a sensor's pictures are encoded, by some of them.

    Raises:
        InputError: a picture cannot be read.
    """
    frames = [read_native(path) for path in paths]
    ways: tuple[Callable[[], Encoding | None], ...] = (
        lambda: by_polarization(sensor, frames),
        lambda: by_file(paths[0]),
        lambda: by_noise(sensor, frames),
        lambda: by_codes(frames),
        lambda: _by_kind(sensor, frames[0]),
    )
    found = (way() for way in ways)
    return next((one for one in found if one is not None), Encoding("cannot be told", "neither the files nor the values say"))


def by_polarization(sensor: Sensor, frames: Sequence[np.ndarray]) -> Encoding | None:
    """Of analysers at 0, 45, 90 and 135 degrees: None for others, and where too little light is polarized."""
    angles = sensor.polarizer_angles_deg
    if angles is None or sorted(angle % 180 for angle in angles) != list(_CROSS):
        return None
    order = [[angle % 180 for angle in angles].index(cross) for cross in _CROSS]
    slopes = np.concatenate([_cross_blocks(sensor, frame, order) for frame in frames])
    if len(slopes) < _LEAST:
        return None
    gamma, deviation = _exponent(slopes[:, 0], slopes[:, 1])
    told = f"I0 + I90 against I45 + I135 gives the exponent {gamma:.2f} ± {deviation:.2f}"
    if deviation > 0.15:
        return None
    if gamma - 3 * deviation > 1.35:
        return Encoding("gamma encoded", told)
    return Encoding("linear", told) if abs(gamma - 1) < 0.25 else Encoding("cannot be told", f"{told}: neither 1 nor a display's 2.2")


def _cross_blocks(sensor: Sensor, frame: np.ndarray, order: Sequence[int]) -> np.ndarray:
    """(N, 2) of flat, lit, unsaturated blocks: DoLP² cos 4φ, and the closure over S0."""
    planes = _planes(sensor, frame)
    channels = [np.mean([_blocks(plane) for plane, channel in planes if channel == k], 0) for k in order]  # (4)(N, pixels)
    mean, spread = np.array([c.mean(1) for c in channels]), np.array([c.std(1) for c in channels])
    s0 = mean.sum(0) / 2
    lit = (s0 > 0.04) & (np.max([c.max(1) for c in channels], 0) < 0.98) & (mean.min(0) > 0)
    lit &= (spread <= _FLAT * mean).all(0)
    mean, s0 = mean[:, lit], s0[lit]
    s1, s2 = (mean[0] - mean[2]) / s0, (mean[1] - mean[3]) / s0
    closure = (mean[0] + mean[2] - mean[1] - mean[3]) / s0
    physical = np.hypot(s1, s2) < 0.95
    return np.stack([s1**2 - s2**2, closure], 1)[physical]


def _exponent(t: np.ndarray, closure: np.ndarray, groups: int = 20) -> tuple[float, float]:
    """γ = 1 - 2 slope, by Huber's robust line, and its deviation by leaving out one of the groups at a time."""
    line = np.stack([np.ones_like(t), t], 1)
    weight = np.ones_like(t)
    for _ in range(20):
        root = np.sqrt(weight)[:, None]
        fitted = np.linalg.lstsq(line * root, closure * root[:, 0], rcond=None)[0]
        apart = np.abs(closure - line @ fitted)
        weight = np.minimum(1.0, 2.2 * np.median(apart) / np.maximum(apart, 1e-12)) if np.median(apart) > 1e-9 else weight
    left = []
    for part in np.array_split(np.arange(len(t)), groups):
        root = np.sqrt(np.delete(weight, part))[:, None]
        left.append(np.linalg.lstsq(np.delete(line, part, 0) * root, np.delete(closure, part) * root[:, 0], rcond=None)[0][1])
    return 1 - 2 * float(fitted[1]), 2 * float(np.std(left)) * float(np.sqrt(groups - 1))


def by_file(path: Path) -> Encoding | None:
    """What the file's own format says."""
    suffix = path.suffix.lower()
    if suffix in (".exr", ".dng"):
        return Encoding("linear", f"{suffix} files are linear by definition")
    with open(path, "rb") as stream:
        head = stream.read(1 << 16)
    if head[:2] == b"\xff\xd8":
        return Encoding("gamma encoded", "JPEG photographs with EXIF are sRGB" if b"Exif\0\0" in head else "JPEG pictures are sRGB")
    if head[8:12] == b"WEBP":
        return Encoding("gamma encoded", "WebP pictures are sRGB")
    if head[:8] == b"\x89PNG\r\n\x1a\n":
        before = head[: head.find(b"IDAT")]
        if b"sRGB" in before:
            return Encoding("gamma encoded", "the PNG files declare sRGB")
        if (at := before.find(b"gAMA")) > 0:
            exponent = 1e5 / max(1, int.from_bytes(before[at + 4 : at + 8], "big"))
            return Encoding("linear" if abs(exponent - 1) < 0.05 else "gamma encoded", f"the PNG files declare the exponent {exponent:.2f}")
    return None


def by_codes(frames: Sequence[np.ndarray]) -> Encoding | None:
    """The spacing of the codes in use, dark and bright; None where they say nothing, as in most 8-bit files."""
    if any(frame.dtype.kind != "u" for frame in frames):
        return None
    bits = frames[0].dtype.itemsize * 8
    counts = np.sum([np.bincount(frame.reshape(-1), minlength=2**bits) for frame in frames], 0)
    codes = np.flatnonzero(counts)
    if len(codes) < 64:
        return None
    # the smallest steps of each end: codes that no pixel happens to have make some steps larger, none smaller
    steps = np.diff(codes)
    dark, bright = (float(np.quantile(part, 0.1)) for part in (steps[: len(steps) // 8], steps[len(steps) // 2 : -len(steps) // 8]))
    if dark >= 3 * bright:
        return Encoding("gamma encoded", f"codes are {dark:.0f} apart in the dark and {bright:.0f} in the bright")
    step = int(np.gcd.reduce(steps))
    if bits == 16 and step in (2, 4, 8, 16, 32, 64):  # 257: an 8-bit picture in a 16-bit file
        return Encoding("linear", f"codes are evenly spaced by {step}, as numbers of a {17 - step.bit_length()}-bit converter are")
    return None


def by_noise(sensor: Sensor, frames: Sequence[np.ndarray]) -> Encoding | None:
    """How the variance of white noise grows with the mean, by the calmest blocks of each level."""
    rows = []
    for frame in frames:
        if frame.dtype.kind != "u":
            return None
        for plane, _ in _planes(sensor, frame):
            blocks = _blocks(plane, 8).reshape(-1, 8, 8) * np.iinfo(frame.dtype).max
            near, far = np.diff(blocks, axis=2), blocks[:, :, 2:] - blocks[:, :, :-2]
            # calm blocks are chosen by other differences than those that are measured, whose variance that would lower
            down = np.diff(blocks, axis=1)
            clear = blocks.max((1, 2)) < 0.98 * np.iinfo(frame.dtype).max
            rows.append(np.stack([blocks.mean((1, 2)), *((x**2).mean((1, 2)) / 2 for x in (near, far, down))], 1)[clear])
    level, near, far, down = np.concatenate(rows).T
    if len(level) < _LEAST or level.max() <= 0:
        return None
    step = 2.0 ** (frames[0].dtype.itemsize * 8 - used_bits(frames[0]))
    points: list[list[float]] = []
    for low in level.max() * 2.0 ** np.arange(-6.0, 0.0, 0.25):
        inside = (level >= low) & (level < low * 2**0.25)
        if inside.sum() < 50:
            continue
        calm = inside & (down <= np.quantile(down[inside], 0.2))
        white = far[calm].mean() / max(near[calm].mean(), 1e-12)
        variance = near[calm].mean() - step**2 / 12
        if 0.8 < white < 1.25 and variance > step**2 / 2:
            points.append([np.log(level[calm].mean()), np.log(variance)])
    if len(points) < 4 or points[-1][0] - points[0][0] < np.log(3):
        return None
    x, y = np.array(points).T
    slope, offset = map(float, np.polyfit(x, y, 1))
    if np.std(y - slope * x - offset) > 0.2:
        return None  # no law of noise: some of it is texture or edges
    told = f"the variance of the noise goes with the mean to the power {slope:.2f}"
    if 0.6 < slope < 1.6:
        return Encoding("linear", told)
    if slope < -0.15:
        return Encoding("gamma encoded", told)
    return Encoding("cannot be told", f"{told}: they are encoded, or it is read noise alone") if slope < 0.3 else None


def _by_kind(sensor: Sensor, frame: np.ndarray) -> Encoding | None:
    if sensor.mosaic is None or frame.dtype != np.uint16:
        return None
    return Encoding("linear", "raw mosaics in 16-bit files are numbers of a converter")


def _planes(sensor: Sensor, frame: np.ndarray) -> list[tuple[np.ndarray, int]]:
    """The photosites of each place of the mosaic's tile, or each channel: (h, w), full scale 1 where the file has one, and which it is."""
    values = frame.astype(np.float64) / (np.iinfo(frame.dtype).max if frame.dtype.kind == "u" else 1.0)
    if sensor.mosaic is None or frame.ndim == 3:
        stacked = values if values.ndim == 3 else values[..., None]
        return [(stacked[..., k], k) for k in range(min(stacked.shape[2], sensor.channel_count))]
    rows, columns = sensor.mosaic.shape
    h, w = frame.shape[0] // rows * rows, frame.shape[1] // columns * columns
    return [(values[i:h:rows, j:w:columns], int(sensor.mosaic[i, j])) for i in range(rows) for j in range(columns)]


def _blocks(plane: np.ndarray, side: int = _BLOCK) -> np.ndarray:
    """(N, side²) of a plane (h, w), what does not fill a block left out."""
    h, w = plane.shape[0] // side, plane.shape[1] // side
    return plane[: h * side, : w * side].reshape(h, side, w, side).swapaxes(1, 2).reshape(-1, side * side)
