"""Space right before the cameras that no picture tells of."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch

from mmsynth.field.rendering import beginning
from mmsynth.fitting.measurements import Modality
from mmsynth.sensors.camera import project


def unseen_before_cameras(modalities: Iterable[Modality], resolution: int) -> np.ndarray:
    """Cells of contracted space that are nearer to a training camera than its rays begin, and that no training picture sees whole.

    That rays begin there says that nothing is before; where other cameras see something all the same, they are right. But what nobody sees
    is what the surface happens to be there, and a new view whose rays begin nearer would see it: a ghost. In the region of interest
    are no such cells.

    Args:
        resolution: cells along each axis of [-2, 2]³.
    Returns:
        (G, G, G) bool.
    """
    frames = [
        (m.cameras[c], rotation.astype(np.float64), origin.astype(np.float64), float(begin))
        for m in modalities
        for c, rotation, origin, begin in zip(m.camera_index, m.rotations, m.origins, beginning(torch.from_numpy(m.origins)), strict=True)
    ]
    axis = (np.arange(resolution) + 0.5) * (4.0 / resolution) - 2.0
    cells = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    contracted = np.linalg.norm(cells, axis=1)
    number = np.flatnonzero((contracted > 1.0) & (contracted < 2.0))
    to_border = 2.0 - contracted[number, None]  # one over the distance from the centre
    points = cells[number] / (contracted[number, None] * to_border)
    before = np.zeros(len(points), bool)
    for _, _, origin, begin in frames:
        before |= np.square(points - origin).sum(1) < begin**2
    number, points = number[before], points[before]
    size = np.sqrt(3.0) * 2.0 / resolution / to_border[before, 0] ** 2  # half a diagonal of a cell, along the radius: longest there
    seen = np.zeros(len(points), bool)
    for camera, rotation, origin, begin in frames:
        away = np.linalg.norm(points - origin, axis=1)
        asked = np.flatnonzero(~seen & (away - size >= begin))
        pixels = project((points[asked] - origin) @ rotation, camera)
        margin = max(camera.fx, camera.fy) * size[asked] / away[asked]
        last = np.array([camera.width, camera.height]) - 1.0
        seen[asked] = np.minimum(pixels, last - pixels).min(1) > margin  # not where the lens has no pixel: NaN
    unseen = np.zeros(resolution**3, bool)
    unseen[number[~seen]] = True
    return unseen.reshape((resolution,) * 3)
