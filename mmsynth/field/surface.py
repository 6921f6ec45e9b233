"""The surface: a signed distance function in the normalised region of interest (the unit ball)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from mmsynth.field.encoding import HashGrid

# corners of a regular tetrahedron: the four taps of a first derivative, its trace exact for linear functions
_TAPS = ((1.0, -1.0, -1.0), (-1.0, -1.0, 1.0), (-1.0, 1.0, -1.0), (1.0, 1.0, 1.0))


class Surface(nn.Module):
    """sdf(x) = |x| - r₀ + MLP(hash grid(x), x), with a zero last layer: exactly a sphere at step 0, no warm-up fit."""

    def __init__(self, grid: HashGrid, hidden: int, initial_radius: float) -> None:
        super().__init__()
        self.grid = grid
        self.hidden = nn.Linear(grid.width + 3, hidden)
        self.last = nn.Linear(hidden, 1)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)
        self.initial_radius = initial_radius

    def forward(self, positions: Tensor, active: int) -> Tensor:
        """Signed distance, positive outside: (N, 3) → (N,)."""
        hidden = torch.relu(self.hidden(torch.cat([self.grid(positions, active), positions], -1)))
        return self.last(hidden)[:, 0] + (torch.linalg.vector_norm(positions, dim=-1) - self.initial_radius)

    def gradient(self, positions: Tensor, epsilon: float, active: int) -> Tensor:
        """∇sdf by four-tap differences of size ``epsilon`` (Neuralangelo, Li et al. 2023): (N, 3) → (N, 3)."""
        taps = positions.new_tensor(_TAPS)
        shifted = positions[:, None] + taps * (epsilon / 3**0.5)
        values = self(shifted.reshape(-1, 3), active).reshape(-1, 4)
        return (values @ taps) * (3**0.5 / (4 * epsilon))
