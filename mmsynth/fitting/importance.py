"""Importance sampling of the training pixels: rays go more often where their residuals are large.

A step estimates the mean loss over all pixels from a few thousand rays. Its gradient varies least when rays are drawn in proportion to
the size of theirs (Katharopoulos and Fleuret 2018, eq. 6), which the residual stands for. Each ray weighs less by as much as it was
drawn more often than evenly, so the expected gradient is that of even draws.
"""

from __future__ import annotations

from typing import Any

from torch import Tensor

from mmsynth.field import kernels

KEPT = 0.8  # of a tile's residual when a ray of it was looked at


class Importance:
    """How often each tile of the frames is drawn.

    A tile's density is ``evenly + (1 - evenly) r / mean(r)``, r: an exponential mean of the residuals of its rays, 1 at the start, which
    is more than most: tiles that were never looked at are not forgotten.

    Args:
        even: all tiles as often as they have pixels. first_tile: (N + 1,), of each modality.
        evenly: share of the rays that are drawn evenly; no ray weighs more than 1 / evenly.
    Attributes:
        residuals: (T,) float32, of each tile. selection: what is drawn from.
    """

    def __init__(self, even: kernels.Selection, first_tile: Tensor, evenly: float) -> None:
        self.selection, self.first_tile, self.evenly = even, first_tile.cpu(), evenly  # numbers that the host asks for
        self.residuals = even.weight.new_ones(len(even.weight))

    def renewed(self, held: Tensor | None = None) -> kernels.Selection:
        """How to draw by what was learned until now, and nothing of the tiles ``held`` (T,) bool."""
        pixels = self.selection.pixels if held is None else self.selection.pixels * ~held
        ends, weight = kernels.odds(self.residuals, pixels, self.first_tile, self.evenly)
        return self.selection._replace(ends=ends, weight=weight)

    def renew(self, held: Tensor | None = None) -> None:
        """Draw so from now on."""
        self.selection = self.renewed(held)

    def learn(self, tile: Tensor, residual: Tensor) -> None:
        """Take in the relative residuals of rays that were drawn, (R,) each."""
        if self.residuals.device.type != "cpu":
            self.residuals[tile] = KEPT * self.residuals[tile] + (1.0 - KEPT) * residual
            return
        held, at = self.residuals.numpy(), tile.numpy()
        held[at] = KEPT * held[at] + (1.0 - KEPT) * residual.numpy()  # of several rays in a tile the last one counts: torch does not say

    def state_dict(self) -> dict[str, Any]:
        return {"residuals": self.residuals, "ends": self.selection.ends, "weight": self.selection.weight}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.residuals = state["residuals"].to(self.residuals.device).clone()
        self.selection = self.selection._replace(**{n: state[n].to(self.residuals.device).clone() for n in ("ends", "weight")})
