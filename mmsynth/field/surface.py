"""The surface: a signed distance function in the normalised region of interest (the unit ball)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from mmsynth.field import kernels
from mmsynth.field.encoding import HashGrid
from mmsynth.field.kernels.learning import surface_gradient


class Surface(nn.Module):
    """sdf(x) = min(|x| - r₀, r₁ - |x|) + network(hash grid(x), x), with a zero last layer: exact spheres at step 0, no warm-up fit.

    Args:
        spheres: r₀ of the ball in the middle, r₁ of the horizon around everything, in the grid's frame.
    """

    def __init__(self, grid: HashGrid, hidden: int, spheres: tuple[float, float]) -> None:
        super().__init__()
        if hidden % 4:
            raise ValueError(f"{hidden} hidden units, expected a multiple of 4: the CPU kernels take four at a time")
        self.grid = grid
        layer = nn.Linear(grid.width + 3, hidden)
        w = layer.weight.detach()
        self.hidden = nn.Parameter(torch.cat([w[:, -3:], layer.bias.detach()[:, None], w[:, :-3]], 1))
        self.output_weight = nn.Parameter(torch.zeros(hidden + 1))
        self.inner_radius, self.outer_radius = (float(np.float32(r)) for r in spheres)

    def forward(self, positions: Tensor, active: int) -> Tensor:
        """Signed distance, positive outside: (N, 3) → (N,)."""
        return kernels.surface_value(positions, *self.at(active))

    def at(self, active: int) -> tuple[kernels.GridTable, kernels.SurfaceNetwork]:
        """What the kernels take, with so many active levels at most."""
        return self.grid.at(active), kernels.SurfaceNetwork(self.hidden, self.output_weight, self.inner_radius, self.outer_radius)

    def gradient(self, positions: Tensor, epsilon: float, active: int) -> Tensor:
        """∇sdf by four-tap differences of size ``epsilon`` (Neuralangelo, Li et al. 2023): (N, 3) → (N, 3)."""
        return surface_gradient(positions, epsilon, *self.at(active), kernels.surface_value)
