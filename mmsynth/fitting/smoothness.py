"""Smooth walls where few views say where walls are: outside of the region the normals of neighbouring places are pulled together.

A wall that two views see, and no third, can be painted right for both wherever it stands; from between them it is wrong, and no lamp fits
what it mirrors. Most surfaces are smooth: the surface that a ray meets has the normal of a place a little beside it (smooth normals:
UNISURF, Oechsle et al. 2021; robust as by Geman and McClure 1985, see ``kernels.Smooth``: edges feel little of it). In the region detail
would be lost, and where many views see a place they know better.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from mmsynth.field import kernels
from mmsynth.fitting.needs import Needs
from mmsynth.fitting.recipe import Recipe

PAIRS = 128  # of a step
LEAST, MOST = 0.01, 0.04  # how far beside it a place is, in its distance from the region's centre: from farther a table bends into its wall
_EPSILON = 0.03  # of the differences that normals are found by, in the frame of the grid


def pairs_at(progress: float, recipe: Recipe, needs: Needs) -> int:
    """How many surfaces a step asks."""
    return PAIRS if needs.smooth and progress < recipe.schedule.smooth_until else 0


def neighbours(count: int, generator: torch.Generator) -> Tensor:
    """``Smooth.aside``: even over all directions and lengths."""
    directions = normalize(torch.randn(count, 3, generator=generator), dim=-1)
    return directions * (LEAST + (MOST - LEAST) * torch.rand(count, 1, generator=generator))


def smooth(aside: Tensor, recipe: Recipe) -> kernels.Smooth:
    """The pull of a step."""
    return kernels.Smooth(aside, recipe.loss.smooth_weight, _EPSILON)
