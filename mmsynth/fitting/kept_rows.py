"""Of large frames with far more pixels than a fit draws, every so many rows are kept: a frame of every k-th row is one of another camera.

A fit of a minute draws some four million rays, photographs of a scene can have billions of pixels: in memory nearly all of them would be
for nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from mmsynth.scene.scene import Frame, Sensor
from mmsynth.sensors.camera import Camera

_HELD = 1 << 29  # numbers of all frames together, which are held anyway: one or two bytes each
_CLOSER = 2.0  # kept rows stand closer together than rays do, by so much
_FEWEST = 64  # rows that are kept of a frame, at the least


@dataclass(frozen=True)
class Kept:
    """What is kept of a frame: ``rows``, and ``camera``, that of the frame which they are."""

    rows: slice
    camera: Camera


def kept_of(frames: Sequence[tuple[Sensor, Sequence[Frame]]], rays_to_come: float) -> list[list[Kept]]:
    """What is kept of each frame of several modalities, of a fit that will draw so many rays of all."""
    numbers = sum(s.values_per_pixel * f.camera.width * f.camera.height for s, listed in frames for f in listed)
    rays = math.inf if numbers <= _HELD else rays_to_come / len(frames)
    out = []
    for sensor, listed in frames:
        cameras = [f.camera for f in listed]
        rows = kept_rows(cameras, rays, 1 if sensor.mosaic is None else sensor.mosaic.shape[0])
        out.append([Kept(r, seen_in(c, r)) for r, c in zip(rows, cameras, strict=True)])
    return out


def kept_rows(cameras: Sequence[Camera], rays_to_come: float, period: int) -> list[slice]:
    """Which rows of each frame of a modality are kept.

    From one to the next it is k rows, so that a frame of them has the mosaic of the whole, and k no more than half of what would be
    between rays that a fit spreads evenly over all pixels. Frames take turns in where they begin: what one leaves out others show.

    Args:
        cameras: of the frames. rays_to_come: of this modality. period: rows after which its mosaic repeats.
    """
    apart = math.sqrt(sum(c.width * c.height for c in cameras) / rays_to_come)
    most = min(apart / _CLOSER, min(c.height for c in cameras) / (_FEWEST * period))
    step = 1 + period * max(0, math.floor((most - 1) / period))
    return [slice(period * (i % step), None, step) for i in range(len(cameras))]


def seen_in(camera: Camera, rows: slice) -> Camera:
    """The camera of such rows of its frames."""
    step, height = rows.step, len(range(camera.height)[rows])
    return camera if step == 1 else replace(camera, height=height, fy=camera.fy / step, cy=(camera.cy - rows.start) / step)
