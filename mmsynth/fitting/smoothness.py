"""Smooth walls where few views say where walls are: outside of the region the normals that neighbouring rays meet are pulled together.

A wall that two views see, and no third, can be painted right for both wherever it stands; from between them it is wrong, and no lamp fits
what it mirrors. Most surfaces are smooth, so of two rays from one place, a little apart, whose normals n and n' are,

    e / (e + c),   e = 1 - n·n',

is made small (smooth normals: UNISURF, Oechsle et al. 2021; robust as by Geman and McClure 1985): edges feel little of it, and steps in
depth nothing. In the region detail would be lost, and where many views see a place they know better.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from mmsynth.field import kernels
from mmsynth.field.field import Field
from mmsynth.field.kernels.learning import asked_rays, normals

_PAIRS = 256
_APART = 0.2  # radii at the region's centre, what the two rays are apart at the most; a quarter of it at the least
_EPSILON = 0.03  # of the differences that normals are found by, in the frame of the grid
_ROBUST = 0.3  # c
_STEP = 0.3  # relative difference of depth between things of their own


def pull_together(
    field: Field, origins: Tensor, directions: Tensor, sampling: kernels.Sampling, weight: float, seed: tuple[int, ...]
) -> None:
    """Add the gradients of ``weight`` times the mean over pairs to those of the surface.

    Args:
        origins, directions: (R, 3) rays of a step, normalised frame. Each of some of them is paired with one beside it.
    """
    chosen = asked_rays(len(origins), _PAIRS)
    origins, directions = origins[chosen], directions[chosen]
    count = len(chosen)
    random = np.random.default_rng(seed)
    share, some = (torch.from_numpy(x).to(origins) for x in (random.uniform(0.25, 1.0, count), random.normal(size=(count, 3))))
    angle = _APART * share / torch.linalg.vector_norm(origins, dim=-1).clamp(min=1.0)
    aside = normalize(directions + normalize(torch.linalg.cross(directions, some), dim=-1) * angle[:, None], dim=-1)
    origins, directions = torch.cat([origins, origins]), torch.cat([directions, aside])
    with torch.no_grad():
        depth = field.trace(origins, directions, sampling).depth
    one, other = depth[:count], depth[count:]
    met = torch.isfinite(one) & torch.isfinite(other) & ((one - other).abs() < _STEP * one)
    points = origins + directions * depth[:, None]
    outside = torch.linalg.vector_norm(points, dim=-1) > 1.0
    met &= outside[:count] & outside[count:]
    if not bool(met.any()):
        return
    grid, points = field.surface.grid, points[met.repeat(2)]
    slopes = field.surface.gradient(grid.to_grid(points), _EPSILON, sampling.active_surface)
    of_one, of_other = normals(points, slopes, grid.extent).chunk(2)
    apart = 1.0 - (of_one * of_other).sum(-1)
    (weight * (apart / (apart + _ROBUST)).mean()).backward()  # type: ignore[no-untyped-call]
