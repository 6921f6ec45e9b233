"""What a step draws. It is drawn beside the kernels of the step before, so that no core waits for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from mmsynth.field import kernels, rendering
from mmsynth.field.field import Field
from mmsynth.fitting.measurements import Batch, Measurements, batch_of
from mmsynth.fitting.smoothness import neighbours


@dataclass(frozen=True)
class ToDraw:
    """Rays of a step.

    Attributes:
        rays: how many of each modality. drawings: of the photosites that are learned from, and of those outside of masks, if there are any.
        points: how many, random ones of all space, near what rays meet, and neighbours of what they meet. generator: the random
            numbers of these, and of what else is due in the step.
    """

    rays: dict[str, int]
    drawings: Sequence[kernels.Drawing]
    points: tuple[int, int, int]
    generator: torch.Generator


@dataclass(frozen=True)
class DrawnStep:
    """A batch, its rays with those outside of masks after them, points (N, 3) of all space, in the frame of the grid, noise (P, 3),
    standard normal, and neighbours, see ``kernels.Smooth``. generator: see ``ToDraw``."""

    batch: Batch
    rays: kernels.Rays
    points: torch.Tensor
    noise: torch.Tensor
    aside: torch.Tensor
    generator: torch.Generator


def drawn_step(field: Field, measurements: Measurements, asked: ToDraw, drawn: Sequence[kernels.Drawn]) -> DrawnStep:
    """What was drawn as a step takes it."""
    batch = batch_of(measurements, asked.rays, drawn[0])
    origins, directions, jitter = batch.origins, batch.directions, batch.jitter
    for more in drawn[1:]:
        origins, directions = torch.cat([origins, more.origins]), torch.cat([directions, more.directions])
        jitter = torch.cat([jitter, more.jitter])
    near, far = rendering.interval(field.surface, origins, directions)
    anywhere, close, pairs = asked.points
    points = (torch.rand(anywhere, 3, generator=asked.generator) * 2 - 1) * field.surface.grid.extent
    noise = torch.randn(close, 3, generator=asked.generator)
    aside = neighbours(pairs, asked.generator)
    return DrawnStep(batch, kernels.Rays(origins, directions, near, far, jitter), points, noise, aside, asked.generator)
