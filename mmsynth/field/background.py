"""What is seen outside the region of interest: a density field in contracted space, where a scene needs one."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from mmsynth.field.encoding import HashGrid
from mmsynth.field.radiance import Shader


def contract(positions: Tensor) -> Tensor:
    """All of space into a ball of radius 2 (mip-NeRF 360, Barron et al. 2022, eq. 10)."""
    norm = torch.linalg.vector_norm(positions, dim=-1, keepdim=True).clamp(min=1.0)
    return positions / norm * (2.0 - 1.0 / norm)


class Background(nn.Module):
    """Density and features outside the unit ball, sampled linearly in disparity."""

    def __init__(self, grid: HashGrid, hidden: int, features: int, shader: Shader) -> None:
        super().__init__()
        self.grid = grid
        self.network = nn.Sequential(nn.Linear(grid.width + 3, hidden), nn.ReLU(), nn.Linear(hidden, 1 + features))
        self.shader = shader

    def forward(self, origins: Tensor, directions: Tensor, start: Tensor, jitter: Tensor, samples: int, active: int) -> Tensor:
        """Composited features of the light that arrives at ``start`` from beyond it.

        What is left of a ray behind its last sample is given to that sample: a background is opaque at infinity.

        Args:
            origins, directions: (R, 3). start: (R,) ray distance > 0. jitter: (R,) in [0, 1).
        Returns:
            (R, F).
        """
        rays = origins.shape[0]
        u = (torch.arange(samples, device=origins.device) + jitter[:, None]) / samples
        t = start[:, None] / (1.0 - u * (1.0 - 1.0 / 64.0))
        x = contract(origins[:, None] + directions[:, None] * t[..., None]).reshape(-1, 3)
        out = self.network(torch.cat([self.grid(x, active), x], -1)).reshape(rays, samples, -1)
        # the ray's step in contracted space, where densities are learned: finite however far the sample
        step = torch.linalg.vector_norm(x.reshape(rays, samples, 3)[:, 1:] - x.reshape(rays, samples, 3)[:, :-1], dim=-1)
        tau = softplus(out[:, :-1, 0]) * 20.0 * step
        before = torch.cat([torch.zeros_like(tau[:, :1]), tau.cumsum(1)], 1)
        transmittance = torch.exp(-before)
        weights = torch.cat([transmittance[:, :-1] * -torch.expm1(-tau), transmittance[:, -1:]], 1)
        return (weights[..., None] * out[..., 1:]).sum(1)
