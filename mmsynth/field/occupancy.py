"""Where to sample: a grid over [-extent, extent]³ whose cells are shell (a surface may be there), solid, or outside.

The signed distance is a certificate: a cell whose centre is farther from the surface than its half diagonal holds none, and an
outside cell says, too, how far around it there is none. The margin 5/s covers the soft surface: what is lost beyond it is an
opacity of e⁻⁵ = 7e-3.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from mmsynth.field import kernels
from mmsynth.field.kernels import OUTSIDE, SHELL, Cells, GridTable, SurfaceNetwork, reference


class Occupancy(nn.Module):
    """Three-state grid, all shell at the start. It re-opens: a part of the certified cells is tested again at every update."""

    states: Tensor

    def __init__(self, resolution: int, extent: float = 1.0) -> None:
        super().__init__()
        self.extent = extent
        self.register_buffer("states", torch.full((resolution,) * 3, SHELL, dtype=torch.uint8))

    @torch.no_grad()
    def update(
        self,
        sdf: Callable[[Tensor], Tensor] | tuple[GridTable, SurfaceNetwork],
        sharpness: float,
        generator: torch.Generator,
        share: float,
        slack: float = 1.5,
    ) -> bool:
        """Classify all shell cells and a ``share`` of the others, every n-th from a random one on, anew.

        Args:
            sdf: (N, 3) → (N,), or what ``kernels.surface_value`` takes of a surface.
            slack: how far |∇sdf| may exceed 1 (it does while training).
        Returns:
            False when no shell was left and the whole grid was opened again: nothing to see, worth a report.
        """
        grid, every = self.states.shape[0], max(1, round(1.0 / share))
        first = int(torch.randint(every, (1,), generator=generator))
        margin = slack * self.extent * 3**0.5 / grid + 5.0 / sharpness
        cells = Cells(self.extent, every, first, margin, grid / (self.extent * slack))
        if callable(sdf):
            reference.classify(self.states, cells, sdf)
        else:
            kernels.classify(self.states, cells, *sdf)
        if bool((self.states == SHELL).any()):
            return True
        self.states.fill_(SHELL)
        return False

    def empty(self, cells: Tensor) -> None:
        """Let rays pass cells, (G, G, G) bool, whatever the distance in them; the next update asks it again."""
        self.states[cells.to(self.states.device)] = OUTSIDE
