"""One raw frame of a sensor's twin: the light on its pixels, and what its converter makes of that."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from mmsynth.operations.output.progress import RaysDone
from mmsynth.operations.simulation.plan import SimulatedSensor
from mmsynth.scene.scene import PosedCamera
from mmsynth.sensors.camera import resized
from mmsynth.sensors.twin import SensorTwin, aperture, blur, blur_radius

if TYPE_CHECKING:
    from mmsynth.field.field import Field

_STRIP_RAYS = 1 << 18


def render_light(field: Field, planned: SimulatedSensor, view: PosedCamera, *, progress: RaysDone | None = None) -> Tensor:
    """The light on a sensor's pixels, blur and aperture included: (C, H, W), with polarizers (C, 3, H, W); float32. Dark where the lens
    has no ray. By strips of the picture: the finer grid of a whole one may not fit into memory.
    """
    s, sigma = planned.supersampling, planned.file.psf_sigma_px * planned.supersampling
    fine = resized(view.camera, s * view.camera.width)
    margin = s * math.ceil(blur_radius(sigma) / s)
    rows = max(margin, s * max(1, _STRIP_RAYS // (fine.width * s)))

    def strip(top: int) -> Tensor:
        part = replace(fine, height=min(rows, fine.height - top), cy=fine.cy - top)
        seen = field.render(part, view.camera_to_world, planned.modalities, geometry=False, progress=progress)
        light = planned.light({n: x.astype(np.float64) for n, x in seen.channels.items()}, seen.stokes)
        return torch.from_numpy(np.where(seen.valid, light, 0.0).astype(np.float32))

    out = []
    above, here = None, strip(0)
    for top in range(0, fine.height, rows):
        below = strip(top + rows) if top + rows < fine.height else None
        # a blur needs what lies above and below; at the picture's own border it repeats it
        before = above[..., -margin:, :] if above is not None and margin else here[..., :0, :]
        after = below[..., :margin, :] if below is not None else here[..., :0, :]
        blurred = blur(torch.cat([before, here, after], -2), sigma)
        out.append(aperture(blurred[..., before.shape[-2] : before.shape[-2] + here.shape[-2], :], s))
        above, here = here, below if below is not None else here
    return torch.cat(out, -2)


def simulate_frame(
    field: Field, planned: SimulatedSensor, view: PosedCamera, frame: int, *, seed: int = 0, progress: RaysDone | None = None
) -> np.ndarray:
    """One raw frame [DN] as the converter gives it: (H, W), or (H, W, C) without mosaic; uint16."""
    twin = SensorTwin(planned.file, view.camera, planned.sensor.mosaic, seed, planned.polarized)
    light = render_light(field, planned, view, progress=progress)
    numbers = twin.record(twin.expose(light[None]), [frame])[0].numpy().astype(np.uint16)
    if numbers.ndim == 2:
        return numbers
    return numbers[0] if len(numbers) == 1 else np.moveaxis(numbers, 0, -1)
