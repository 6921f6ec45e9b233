"""How many rows the finer levels of the hash tables need: counted when the surface takes shape, before these levels are used."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from mmsynth.field.field import Field
from mmsynth.field.kernels import SHELL, Sampling
from mmsynth.fitting.choices import Choice
from mmsynth.fitting.recipe import RadianceRecipe, Recipe, SurfaceRecipe

_LEAST = 12  # log2 of rows
_PROBES = 65536
_CROSSED = 0.75  # of a cell's size: mean distance within which a plane crosses a cube, (|n_x| + |n_y| + |n_z|) / 2 over all n


@dataclass(frozen=True)
class TableSizes:
    """log2 of the most rows of every level of the surface's and of the radiance's table.

    Attributes:
        first: levels of the two that are the first to have another size: those before them were in use.
    """

    surface: tuple[int, ...]
    radiance: tuple[int, ...]
    first: tuple[int, int]
    choice: Choice[tuple[int, int]]


def size_tables(field: Field, recipe: Recipe, sampling: Sampling, generator: torch.Generator) -> TableSizes:
    """Rows for the levels that are not yet active: as many as the cells at the surface, as it is now, ask for."""
    most = int(field.design.surface_rows_log2), int(field.design.radiance_rows_log2)  # type: ignore[arg-type]  # all levels alike
    grids: tuple[SurfaceRecipe | RadianceRecipe, ...] = recipe.surface, recipe.radiance
    first = sampling.active_surface, sampling.active_radiance
    cells = cells_at_surface(field, sampling.active_surface, generator)
    rows = [rows_log2(n / grid.cells_per_row, m) for n, grid, m in zip(cells, grids, most, strict=True)]
    why = ", ".join(
        f"{name} 2^{r} for {n:.2g} cells" + (" (by the rays to come or the recipe no more)" if r == m else "")
        for name, r, m, n in zip(("surface", "radiance"), rows, most, cells, strict=True)
    )
    surface, radiance = ((m,) * a + (r,) * (grid.levels - a) for m, r, a, grid in zip(most, rows, first, grids, strict=True))
    why = f"rows for each of the finer levels, cells of the finest at the surface: {why}"
    return TableSizes(surface, radiance, first, Choice((rows[0], rows[1]), why, tuple(rows) != most))


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
