"""How many rows the finer levels of the hash tables need: counted when the surface takes shape, before these levels are used."""

from __future__ import annotations

import math

import torch

from mmsynth.field.field import Field
from mmsynth.field.kernels import SHELL

_LEAST = 12
_PROBES = 65536
_CROSSED = 0.75  # of a cell's size: mean distance within which a plane crosses a cube, (|n_x| + |n_y| + |n_z|) / 2 over all n


@torch.no_grad()
def cells_at_surface(field: Field, active: int, generator: torch.Generator) -> tuple[float, float]:
    """About how many cells of the finest level of the surface's and of the radiance's grid the surface crosses.

    Random points of the occupancy grid's shell: the share of them that lies within half a cell of the surface, times the cells
    that the shell has. ``active``: levels of the surface's grid in use.
    """
    states, grid = field.occupancy.states, field.surface.grid
    shell, extent, across = torch.nonzero(states == SHELL), grid.extent, states.shape[0]
    chosen = torch.randint(len(shell), (_PROBES,), generator=generator).to(shell.device)
    points = shell[chosen] + torch.rand(_PROBES, 3, generator=generator).to(shell.device)
    distance = field.surface((points * (2.0 / across) - 1.0) * extent, active).abs()

    def count(cell: float) -> float:
        return float((distance < _CROSSED * cell).float().mean()) * len(shell) * (2.0 * extent / across / cell) ** 3

    return count(grid.cell(len(grid.resolutions))), count(field.appearance.cell(len(field.appearance.resolutions)))


def rows_log2(wanted: float, most: int) -> int:
    """log2 of a level's rows: the power of two nearest to ``wanted``, at least 2^12, at most 2^most."""
    return min(most, max(_LEAST, round(math.log2(max(wanted, 1.0)))))
