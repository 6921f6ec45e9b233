"""Where to sample: a grid over [-extent, extent]³ whose cells are shell (a surface may be there), solid, or outside.

The signed distance is a certificate: a cell whose centre is farther from the surface than its half diagonal holds none, and an
outside cell says, too, how far around it there is none. The margin 5/s covers the soft surface: what is lost beyond it is an
opacity of e⁻⁵ = 7e-3.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import torch
from torch import Tensor, nn

from mmsynth.field import kernels
from mmsynth.field.kernels import OUTSIDE, SHELL, Cells, GridTable, SurfaceNetwork, reference

_TURNS = 16  # in which all cells are looked at, or a few more
_CELLS = 50_000  # of a turn, at the least: a small grid has fewer turns
_NEXT = 5  # cells from those of a turn to those of the next: what is beside a cell has its turn in between


class Occupancy(nn.Module):
    """Three-state grid, all shell at the start. It re-opens: at every update some of the certified cells have their turn to be tested."""

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
        turn: int | None = None,
        slack: float = 1.5,
    ) -> bool:
        """Classify all shell cells anew, and of the others those whose turn it is.

        Args:
            sdf: (N, 3) → (N,), or what ``kernels.surface_value`` takes of a surface.
            turn: the number of this update: each cell is looked at once in any ``turns`` of them that follow one another. None: all cells.
            slack: how far |∇sdf| may exceed 1 (it does while training).
        Returns:
            False when no shell was left and the whole grid was opened again: nothing to see, worth a report.
        """
        grid = self.states.shape[0]
        every = 1 if turn is None else self.turns
        first = 0 if turn is None else turn * _NEXT % every
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

    @property
    def turns(self) -> int:
        """Updates until each cell was looked at."""
        # without a factor in common with the grid's side: or else the cells of a plane, which a table may lie in, would all wait for one
        # turn, and a surface could not move there until then
        fewest = min(_TURNS, -(-self.states.numel() // _CELLS))
        return next(n for n in itertools.count(fewest) if math.gcd(n, self.states.shape[0] * _NEXT) == 1)

    def empty(self, cells: Tensor) -> None:
        """Let rays pass cells, (G, G, G) bool, whatever the distance in them; updates ask it again."""
        self.states[cells.to(self.states.device)] = OUTSIDE
