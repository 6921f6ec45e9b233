"""The multiresolution hash grid of positions."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from mmsynth.field import kernels
from mmsynth.field.kernels.constants import FEATURES

_START = 1e-4  # features of a new level are that small


class HashGrid(nn.Module):
    """Multiresolution hash grid over the cube [-extent, extent]³ (Müller et al. 2022), 4 features per level.

    Args:
        levels: number of levels. rows_log2: log2 of the most rows, of all levels or of each; coarse levels take what they need.
        coarsest, finest: cells per axis of the first and the last level; geometric in between.
    """

    resolutions: Tensor
    offsets: Tensor

    def __init__(self, levels: int, rows_log2: int | Sequence[int], coarsest: int, finest: int, extent: float = 1.0) -> None:
        super().__init__()
        growth = (max(finest, coarsest) / coarsest) ** (1.0 / max(levels - 1, 1))
        resolutions = [int(coarsest * growth**i + 0.5) for i in range(levels)]
        self.register_buffer("resolutions", torch.tensor(resolutions), persistent=False)
        self.register_buffer("offsets", _offsets(resolutions, rows_log2), persistent=False)
        self.table = nn.Parameter(torch.empty(int(self.offsets[-1]), FEATURES).uniform_(-_START, _START))
        self.extent = extent

    @property
    def width(self) -> int:
        """Numbers per position."""
        return FEATURES * len(self.resolutions)

    def cell(self, active: int) -> float:
        """Cell size of the finest active level."""
        return 2.0 * self.extent / float(self.resolutions[min(active, len(self.resolutions)) - 1])

    def resize(self, first: int, rows_log2: Sequence[int], generator: torch.Generator) -> int:
        """Give the levels from ``first`` on other numbers of rows: they start anew, unless all have them already; the others stay.

        Returns:
            how many of the first rows of the table are as they were.
        Raises:
            ValueError: a level before ``first`` would change, too.
        """
        kept, offsets = int(self.offsets[first]), _offsets(self.resolutions.tolist(), rows_log2)
        if not torch.equal(offsets[: first + 1], self.offsets[: first + 1].cpu()):
            raise ValueError(f"{rows_log2} changes the rows of a level before level {first}")
        if torch.equal(offsets, self.offsets.cpu()):
            return int(offsets[-1])
        self.offsets = offsets.to(self.offsets.device)
        fresh = torch.empty(int(self.offsets[-1]) - kept, FEATURES).uniform_(-_START, _START, generator=generator)
        self.table.data, self.table.grad = torch.cat([self.table.data[:kept], fresh.to(self.table.device)]), None
        return kept

    def to_grid(self, points: Tensor) -> Tensor:
        """Points of the normalised frame in the grid's own: contracted space where it is wider than the region."""
        return kernels.contract(points) if self.extent > 1.0 else points

    def forward(self, positions: Tensor, active: int) -> Tensor:
        """(N, 3) → (N, width); levels from ``active`` on are zero and cost nothing."""
        return kernels.reference.encode(positions, self.at(active), kernels.hash_encode)

    def at(self, active: int) -> kernels.GridTable:
        """What the kernels take, with so many active levels at most."""
        return kernels.GridTable(self.table, self.resolutions, self.offsets, self.extent, min(active, len(self.resolutions)))


def _offsets(resolutions: list[int], rows_log2: int | Sequence[int]) -> Tensor:
    most = [rows_log2] * len(resolutions) if isinstance(rows_log2, int) else rows_log2
    rows = [min((r + 1) ** 3, 2**m) for r, m in zip(resolutions, most, strict=True)]
    return torch.tensor([sum(rows[:i]) for i in range(len(rows) + 1)])
