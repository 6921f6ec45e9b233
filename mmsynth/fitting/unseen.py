"""Space right before the cameras that no picture tells of."""

from __future__ import annotations

import functools
import math
from collections.abc import Collection

import numpy as np
import torch

from mmsynth.field.rendering import beginning
from mmsynth.fitting.measurements import Modality
from mmsynth.sensors.camera import Camera, project, unproject

_AT_ONCE = 1 << 13  # cells: their distances from all cameras are kept


def unseen_before_cameras(modalities: Collection[Modality], resolution: int) -> np.ndarray:
    """Cells of contracted space that are nearer to a training camera than its rays begin, and that no training picture sees whole.

    That rays begin there says that nothing is before; where other cameras see something all the same, they are right. But what nobody sees
    is what the surface happens to be there, and a new view whose rays begin nearer would see it: a ghost. In the region of interest
    are no such cells.

    Args:
        resolution: cells along each axis of [-2, 2]³.
    Returns:
        (G, G, G) bool.
    """
    origins = torch.from_numpy(np.concatenate([m.origins for m in modalities])).double()
    begins = beginning(origins)
    rotations = np.concatenate([m.rotations for m in modalities]).astype(np.float64)
    cameras = [m.cameras[c] for m in modalities for c in m.camera_index]
    every = np.arange(resolution**3)
    parts = [_before_cameras(part, resolution, origins, begins) for part in np.array_split(every, -(-len(every) // _AT_ONCE))]
    number, points, size = (np.concatenate(x) for x in zip(*parts, strict=True))
    seen = np.zeros(len(points), bool)
    for camera, rotation, origin, begin in zip(cameras, rotations, origins.numpy(), begins.tolist(), strict=True):
        ahead = points @ rotation[:, 2] - origin @ rotation[:, 2]
        asked = np.flatnonzero(~seen & (ahead > _widest(camera) * begin))
        local = (points[asked] - origin) @ rotation
        away = np.linalg.norm(local, axis=1)
        pixels, margin = project(local, camera), max(camera.fx, camera.fy) * size[asked] / away
        last = np.array([camera.width, camera.height]) - 1.0
        inside = np.minimum(pixels, last - pixels).min(1) > margin  # not where the lens has no pixel: NaN
        seen[asked] = inside & (away - size[asked] >= begin)
    unseen = np.zeros(resolution**3, bool)
    unseen[number[~seen]] = True
    return unseen.reshape((resolution,) * 3)


def _before_cameras(number: np.ndarray, resolution: int, origins: torch.Tensor, begins: torch.Tensor) -> tuple[np.ndarray, ...]:
    """Of numbered cells those that are nearer to a camera than its rays begin: numbers (N,), centres (N, 3), half a diagonal (N,)."""
    cells = (np.stack(np.unravel_index(number, (resolution,) * 3), -1) + 0.5) * (4.0 / resolution) - 2.0
    contracted = np.linalg.norm(cells, axis=1)
    outside = (contracted > 1.0) & (contracted < 2.0)
    number, cells, contracted = number[outside], cells[outside], contracted[outside, None]
    away = 1.0 / (2.0 - contracted)  # from the centre
    points = cells / contracted * away
    before = (torch.cdist(torch.from_numpy(points), origins) < begins).any(1).numpy()
    # along the radius, where contracted space is stretched most
    return number[before], points[before], np.sqrt(3.0) * 2.0 / resolution * away[before, 0] ** 2


@functools.lru_cache(maxsize=256)
def _widest(camera: Camera) -> float:
    """Cosine of the widest angle between the axis and the border of a picture, -inf where that is a right angle or more, or unknown."""
    u, v = np.linspace(0.0, camera.width - 1.0, 64), np.linspace(0.0, camera.height - 1.0, 64)
    sides = [(u, np.full(64, end)) for end in v[[0, -1]]] + [(np.full(64, end), v) for end in u[[0, -1]]]
    directions, valid = unproject(np.stack([np.concatenate(x) for x in zip(*sides, strict=True)], -1), camera)
    return float(directions[:, 2].min()) if valid.all() and directions[:, 2].min() > 0 else -math.inf
