"""Volume rendering: samples along rays, weights of the sections between samples, appearance where sections cross the surface.

All lengths are in the normalised frame, where the region of interest is the unit ball. Where a scene has a background, all of
space is contracted into a ball of radius 2, and the one surface reaches as far as rays do.
"""

from __future__ import annotations

import torch
from torch import Tensor

from mmsynth.field import kernels
from mmsynth.field.encoding import HashGrid
from mmsynth.field.kernels import Hits, Rays, Sampling
from mmsynth.field.occupancy import Occupancy
from mmsynth.field.surface import Surface

NEAR = 0.02  # radii from a camera at which rays begin at the least, when all of space is seen
FREE = 0.8  # of the way from a camera to the region of interest, where rays begin then
FARTHEST = 1e3  # where rays end that nothing stops, in radii


def ball_interval(origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Where rays are inside the unit ball: near, far (R,); equal (empty) for rays that miss it or leave it behind."""
    middle = -(origins * directions).sum(-1)
    # distance² of the closest approach, from the perpendicular: |o|² - middle² would cancel for far cameras
    perpendicular = origins + middle[:, None] * directions
    half = torch.sqrt((1.0 - (perpendicular * perpendicular).sum(-1)).clamp(min=0.0))
    near = (middle - half).clamp(min=0.0)
    return near, torch.maximum(middle + half, near)


def beginning(origins: Tensor) -> Tensor:
    """Where sampling of rays begins when all of space is seen, (R,): a surface right before a camera explains its picture and no other."""
    return (FREE * (torch.linalg.vector_norm(origins, dim=-1) - 1.0)).clamp(min=NEAR)


def interval(surface: Surface, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Where sampling of rays begins and ends: near, far (R,)."""
    if surface.grid.extent > 1.0:
        near = beginning(origins)
        return near, torch.full_like(near, FARTHEST)
    return ball_interval(origins, directions)


def trace(
    surface: Surface, appearance: HashGrid, occupancy: Occupancy, origins: Tensor, directions: Tensor, jitter: Tensor, sampling: Sampling
) -> Hits:
    """What rays meet, from where they begin to where they end; see ``kernels.reference.trace``.

    Args:
        origins, directions: (R, 3), unit directions; gradients reach them with the samples' distances held fixed.
        jitter: (R,) in [0, 1), shifts the samples.
    """
    near, far = interval(surface, origins.detach(), directions.detach())
    rays, look = Rays(origins, directions, near, far, jitter), appearance.at(sampling.active_radiance)
    return kernels.trace(*surface.at(sampling.active_surface), look, occupancy.states, rays, sampling)
