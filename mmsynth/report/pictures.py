"""Pictures of a page: as data in it within a budget of bytes, with their colour scale, and with the light of their pixels."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from mmsynth.operations.output import previews
from mmsynth.scene.scene import Sensor

PICTURES = 3_600_000  # bytes of the pictures of a page, as text
SPECTRA = 1_600_000  # bytes of the light of their pixels, as text
_SIDES = (720, 512, 360, 256, 180, 128)  # the longest, in pixels
_WIDEST = 96  # pixels whose light is told, in a line
NO_RAY = 65535


@dataclass(frozen=True)
class Scale:
    """What the colours of a map stand for: numbers at its ends, unit, and the colours from one end to the other (N, 3) uint8."""

    low: float
    high: float
    unit: str
    colours: np.ndarray

    def encode(self) -> dict[str, str]:
        low, high = (f"{value:.4g}" for value in (self.low, self.high))
        return {"low": low, "high": high, "unit": self.unit, "source": _data_uri(self.colours[None], ".png")}


@dataclass(frozen=True)
class Picture:
    """A display image (H, W) or (H, W, 3), uint8 or float in [0, 1]; ``caption`` below it, ``alt`` for those who do not see it;
    ``again``: it is in a wipe of the same row, too, and paper shows it there."""

    caption: str
    image: np.ndarray
    alt: str
    scale: Scale | None = None
    again: bool = False

    def encode(self, most: float) -> dict[str, Any]:
        """What parts.html shows, of ``most`` bytes at the most."""
        return self._shown(_encoded([self.image], most)[0])

    def _shown(self, encoded: tuple[str, int, int]) -> dict[str, Any]:
        source, width, height = encoded
        facts = {"source": source, "width": width, "height": height}
        return {"caption": self.caption, "alt": self.alt, "again": self.again, "scale": self.scale and self.scale.encode(), **facts}


@dataclass(frozen=True)
class Wipe:
    """Two pictures of one size, one over the other, with an edge to move between them; the scale of both is that of ``over``."""

    over: Picture
    under: Picture

    def encode(self, most: float) -> dict[str, Any]:
        over, under = _encoded([self.over.image, self.under.image], most)
        return {"over": self.over._shown(over), "under": self.under._shown(under)}


@dataclass(frozen=True)
class Row:
    """Pictures of the same pixels. ``spectra``: the light of these, as ``spectra_of`` gives it. ``compact``: one of many, shown smaller."""

    title: str
    pictures: Sequence[Picture | Wipe]
    note: str = ""
    predicted: bool = False
    compact: bool = False
    spectra: Mapping[str, Any] | None = field(default=None, repr=False)

    def each(self) -> list[Picture]:
        """All pictures one by one."""
        return [one for p in self.pictures for one in ((p.over, p.under) if isinstance(p, Wipe) else (p,))]


def encode_rows(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """What parts.html shows; all pictures share the budget of a page."""
    most = PICTURES / max(1, sum(len(row.each()) for row in rows))
    return [
        {
            "number": number, "title": row.title, "note": row.note, "predicted": row.predicted, "compact": row.compact,
            "spectra": row.spectra, "pictures": [p.encode(most) for p in row.pictures],
        }
        for number, row in enumerate(rows)
    ]  # fmt: skip


def _encoded(images: Sequence[np.ndarray], most: float) -> list[tuple[str, int, int]]:
    """Pictures of one size → (data URI, width, height): as PNG, or JPEG where that is too long; smaller until they fit."""
    pixels = [previews.as_rgb(image) for image in images]
    for side in _SIDES:
        reduced = [previews.reduced(p, side) for p in pixels]
        out = [
            min((_data_uri(r, suffix) for suffix in (".png", ".jpg")), key=lambda uri: (len(uri) > most, "png" not in uri)) for r in reduced
        ]
        if all(len(uri) <= most for uri in out) or side == _SIDES[-1]:
            break
    return [(uri, r.shape[1], r.shape[0]) for uri, r in zip(out, reduced, strict=True)]


def _data_uri(image: np.ndarray, suffix: str) -> str:
    if suffix == ".png":
        kind, data = "png", previews.encode_png(image)
    else:
        kind, data = "jpeg", bytes(cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 90])[1])
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"


# ------------------------------------------------------------------------------------------------------------------- maps of numbers


def ceiling(value: float) -> float:
    """The next round number, 1, 1.5, 2, 2.5, 3, 4, 5, 6, 8 times a power of ten: the end of a scale."""
    if not value > 0.0 or not math.isfinite(value):
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return next(float(f"{step * power:.6g}") for step in (1, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10) if step * power >= value * (1 - 1e-9))


def error_map(numbers: np.ndarray, high: float, unit: str = "of full scale") -> tuple[np.ndarray, Scale]:
    """Numbers (H, W) from 0 to ``high``, dark to bright, more is as bright; NaN, no number, is grey."""
    ramp = _magma(np.linspace(0.0, 1.0, 96)[None])[0]
    image = np.where(np.isfinite(numbers)[..., None], _magma(np.nan_to_num(numbers) / high), 96).astype(np.uint8)
    return image, Scale(0.0, high, unit, ramp)


def share_map(numbers: np.ndarray, low: float, high: float, unit: str) -> tuple[np.ndarray, Scale]:
    """Numbers (H, W) from ``low`` (dark) to ``high`` (bright); NaN, no number, is black."""
    span = (high - low) or 1.0
    ramp = previews.preview_share(np.linspace(0.0, 1.0, 96)[None])[0]
    return previews.preview_share((numbers - low) / span), Scale(low, high, unit, ramp)


def depth_map(depth: np.ndarray, unit: str) -> tuple[np.ndarray, Scale | None]:
    """Depth (H, W), NaN = nothing met: near bright, far dark."""
    hit = depth[np.isfinite(depth)]
    if not hit.size:
        return previews.preview_depth(depth), None
    near, far = (float(value) for value in np.percentile(hit, (2.0, 98.0)))
    ramp = previews.preview_share(np.linspace(1.0, 0.0, 96)[None])[0]
    return previews.preview_depth(depth, (near, far)), Scale(near, far, unit, ramp)


def angle_scale() -> Scale:
    """The hues of ``previews.preview_aolp``."""
    twice = np.radians(np.linspace(0.0, 360.0, 96))
    ramp = previews.preview_aolp(np.stack([np.ones_like(twice), np.cos(twice), np.sin(twice)], -1)[None])[0]
    return Scale(0.0, 180.0, "°", previews.to_uint8(ramp))


def _magma(share: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.cvtColor(cv2.applyColorMap(previews.to_uint8(share), cv2.COLORMAP_MAGMA), cv2.COLOR_BGR2RGB))


# ---------------------------------------------------------------------------------------------------------------- the light of pixels


def spectra_width(width: int, height: int, numbers: int) -> int:
    """How many pixels of a line have their light told, where all rows of a page tell ``numbers`` at each pixel together."""
    pixels = SPECTRA / (2 * 4 / 3) / max(1, numbers)
    return max(1, min(_WIDEST, width, int(math.sqrt(pixels * width / height))))


def spectra_of(sensor: Sensor, width: int, **light: np.ndarray) -> dict[str, Any]:
    """The light of all pixels, or of blocks of them, in 16 bits.

    Args:
        width: pixels of a line that are kept. light: measured, rendered, deviation (H, W, C), what there is of them; NaN: no ray.
    Returns:
        channels, nm (None: no wavelength), width, height, cell (pixels that one is the mean of, across and down), low, high and each of
        ``light`` as base64 of (height, width, C) uint16, little endian: 0 is low, 65534 high, 65535 no ray.
    """
    rows, columns = next(iter(light.values())).shape[:2]
    height = max(1, round(rows * width / columns))
    reduced = {key: _means(values, width, height) for key, values in light.items()}
    known = np.concatenate([values[np.isfinite(values)] for values in reduced.values()])
    low, high = (min(0.0, float(known.min())), float(known.max())) if known.size else (0.0, 1.0)
    high = high if high > low else low + 1.0
    stored = {}
    for key, values in reduced.items():
        steps = np.where(np.isfinite(values), np.round((np.nan_to_num(values) - low) / (high - low) * (NO_RAY - 1)), NO_RAY)
        stored[key] = base64.b64encode(steps.astype("<u2").tobytes()).decode("ascii")
    facts = {"channels": list(sensor.channels), "nm": [None if w is None else float(w) for w in sensor.wavelengths_nm]}
    return {**facts, "width": width, "height": height, "cell": [columns / width, rows / height], "low": low, "high": high, **stored}


def _means(values: np.ndarray, width: int, height: int) -> np.ndarray:
    """(H, W, C) → (height, width, C) float64, means over what is known; NaN where nothing is."""
    if values.shape[:2] == (height, width):
        return values.astype(np.float64)
    weights = np.isfinite(values).astype(np.float32)
    planes = np.concatenate([np.nan_to_num(values.astype(np.float32)), weights], -1)
    # one plane at a time: OpenCV's limit of channels differs between its functions
    means = np.stack([cv2.resize(planes[..., i], (width, height), interpolation=cv2.INTER_AREA) for i in range(planes.shape[-1])], -1)
    light, share = np.split(means.astype(np.float64), 2, -1)
    return np.where(share > 0.0, light / np.maximum(share, 1e-12), np.nan)
