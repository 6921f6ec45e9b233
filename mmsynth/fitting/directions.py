"""Directions of the pixels of cameras, as kernels look them up: of each pixel, or, where that would be large, of nodes between which lenses
are smooth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from mmsynth.field import kernels
from mmsynth.field.kernels.drawing import in_camera
from mmsynth.sensors.camera import Camera, unproject

_MAPPED = 1 << 22  # pixels of all cameras together, up to which each has its own direction
_STEPS = (32, 16, 8, 4, 2)  # pixels between nodes
_ERROR = 1e-7  # of a direction, by which nodes may be off: that of single precision
_LOOKED_AT = 4096  # pixels of a camera
_BAND = 1 << 18  # pixels that are unprojected at once


def pixel_directions(cameras: Sequence[Camera]) -> tuple[kernels.Cameras, list[np.ndarray | None]]:
    """The directions of cameras, and of each camera which pixels (H, W) have one, None = all.

    Nodes stand as far apart as their interpolation errs by no more than single precision does. A camera of which some pixels have no
    ray, behind the fold of its lens, has a direction for each pixel.
    """
    large = sum(c.width * c.height for c in cameras) > _MAPPED
    steps, shapes, nodes, valid = [], [], [], []
    for camera in cameras:
        found = _on_nodes(camera) if large else None
        step, directions, usable = (1, *_of_pixels(camera)) if found is None else (*found, None)
        steps.append(step)
        shapes.append(directions.shape[:2])
        nodes.append(directions.reshape(-1, 3))
        valid.append(usable)
    down, across = (np.array(x, np.int32) for x in zip(*shapes, strict=True))
    arrays = (
        np.array([c.width for c in cameras], np.int32), np.array(steps, np.int32),
        np.cumsum([0, *map(len, nodes)])[:-1], across, down, np.concatenate(nodes),
    )  # fmt: skip
    return kernels.Cameras(*map(torch.from_numpy, arrays)), valid


def _of_pixels(camera: Camera) -> tuple[np.ndarray, np.ndarray | None]:
    """(H, W, 3) float32, and which have a ray, None = all."""
    directions, valid = np.empty((camera.height, camera.width, 3), np.float32), np.empty((camera.height, camera.width), bool)
    rows = max(1, _BAND // camera.width)
    for top in range(0, camera.height, rows):
        v, u = np.mgrid[top : min(top + rows, camera.height), 0 : camera.width].astype(np.float64)
        directions[top : top + rows], valid[top : top + rows] = unproject(np.stack([u, v], -1), camera)
    return directions, None if valid.all() else valid


def _on_nodes(camera: Camera) -> tuple[int, np.ndarray] | None:
    """The widest step that is exact enough, and the directions (rows, columns, 3) float32 of its nodes; None where no step is."""
    random = np.random.default_rng(0)
    pixels = np.stack([random.integers(0, camera.width, _LOOKED_AT), random.integers(0, camera.height, _LOOKED_AT)], -1)
    exact, valid = unproject(pixels, camera)
    for step in _STEPS if valid.all() else ():
        down, across = (-(-(size - 1) // step) + 1 for size in (camera.height, camera.width))
        if min(down, across) < 4:
            continue
        v, u = np.mgrid[0:down, 0:across].astype(np.float64) * step
        nodes, seen = unproject(np.stack([u, v], -1), camera)
        if not seen.all():  # nodes past the edge of the frame lie outside every pixel: where they have a ray, all pixels do
            continue
        of_one = torch.tensor([[camera.width], [step], [0], [across], [down]], dtype=torch.int32)
        known = kernels.Cameras(of_one[0], of_one[1], of_one[2].long(), of_one[3], of_one[4], torch.from_numpy(nodes.reshape(-1, 3)))
        column, row = torch.from_numpy(pixels).T
        found = in_camera(known, torch.zeros_like(row), row, column).numpy()
        if np.abs(found - exact).max() < _ERROR:
            return step, nodes.astype(np.float32)
    return None
