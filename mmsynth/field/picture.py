"""What a camera sees of a field."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

_BAND = 1 << 18  # pixels


@dataclass(frozen=True)
class Rendering:
    """What a camera sees, all modalities at every pixel (H, W).

    Attributes:
        channels: per modality (H, W, C) float32, linear, 1.0 = the sensor's full scale; for a polarization modality the
            intensities behind the sensor's analysers, in this camera's own frame.
        stokes: per polarization modality (H, W, 3): S0, S1, S2 in this camera's x-axis frame.
        depth_z, depth_ray: (H, W) float32 along the optical axis, along the ray; scene unit, NaN = no hit.
        normal: (H, W, 3) float32, world frame, unit, outward, NaN = no hit, or not asked for.
        opacity: (H, W) float32 in [0, 1], of the region of interest; 0 where the surface met lies outside it.
        valid: (H, W) bool, False where the lens has no ray (all values are NaN or 0 there).
        deviation: per modality that is predicted and was not measured (H, W, C), the standard deviation of its channels.
    """

    channels: dict[str, np.ndarray]
    stokes: dict[str, np.ndarray]
    depth_z: np.ndarray
    depth_ray: np.ndarray
    normal: np.ndarray
    opacity: np.ndarray
    valid: np.ndarray
    deviation: dict[str, np.ndarray]

    def rows(self, rows: slice) -> Rendering:
        """The same of some rows; its arrays are views of these."""

        def part(value: Any) -> Any:
            return {name: image[rows] for name, image in value.items()} if isinstance(value, dict) else value[rows]

        return replace(self, **{f.name: part(getattr(self, f.name)) for f in fields(self)})


def bands(shape: tuple[int, ...]) -> Iterator[slice]:
    """The rows of a picture (H, W, ...) in parts of so few pixels that what is computed of one needs little memory."""
    height, width = shape[:2]
    step = max(1, _BAND // width)
    for top in range(0, height, step):
        yield slice(top, min(top + step, height))


def picture_of(images: Mapping[str, np.ndarray], shape: tuple[int, int], key: str, channels: int, fill: float = np.nan) -> np.ndarray:
    """Values (H W, ...) of all pixels as (H, W, channels); of what nothing was seen a picture of ``fill``, which takes no memory."""
    if key in images:
        return images[key].reshape(*shape, channels)
    return np.broadcast_to(np.float32(fill), (*shape, channels))
