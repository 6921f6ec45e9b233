"""Importance sampling of the training pixels: rays go more often where their residuals are large.

A step estimates the mean loss over all pixels from a few thousand rays. Its gradient varies least when rays are drawn in proportion to
the size of theirs (Katharopoulos and Fleuret 2018, eq. 6), which the residual stands for. Each ray weighs less by as much as it was
drawn more often than evenly, so the expected gradient is that of even draws.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

RUN = 32  # pixels, one after the other, that are counted together, at the least
_MOST_RUNS = 1 << 18  # of a modality
_KEPT = 0.8  # of a run's residual when a ray of it was looked at


class Importance:
    """How often each pixel of each modality is drawn.

    A run's density is ``evenly + (1 - evenly) r / mean(r)``, r: an exponential mean of the residuals of its rays, 1 at the start, which
    is more than most: runs that were never looked at are not forgotten.

    Args:
        pixels: how many each modality has. evenly: share of the rays that are drawn evenly; no ray weighs more than 1 / evenly.
    Attributes:
        run: pixels of a run, of each modality; the last run may have fewer.
        residuals, density: of each run, (N,) float32; density relative to even draws.
    """

    def __init__(self, pixels: Mapping[str, int], evenly: float) -> None:
        self.pixels, self.evenly = dict(pixels), evenly
        self.run = {name: max(RUN, -(-count // _MOST_RUNS)) for name, count in pixels.items()}
        self.residuals = {name: np.ones(-(-count // self.run[name]), np.float32) for name, count in pixels.items()}
        self.density = {name: np.ones_like(r) for name, r in self.residuals.items()}
        self._ends: dict[str, np.ndarray] = {}
        self._count()

    def _lengths(self, name: str, run: np.ndarray) -> np.ndarray:
        return np.minimum(self.run[name], self.pixels[name] - self.run[name] * run)

    def _count(self) -> None:
        for name, density in self.density.items():
            self._ends[name] = np.cumsum(density * self._lengths(name, np.arange(len(density))), dtype=np.float64)

    def renew(self) -> None:
        """Draw from now on by what was learned until now."""
        for name, residuals in self.residuals.items():
            lengths = self._lengths(name, np.arange(len(residuals)))
            mean = np.average(residuals, weights=lengths)
            if mean > 0:
                self.density[name] = (self.evenly + (1.0 - self.evenly) * residuals / mean).astype(np.float32)
        self._count()

    def draw(self, name: str, count: int, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Pixels of a modality, numbered as ``Pixels`` numbers them, and the weights of their rays, float32; (count,) each."""
        ends = self._ends[name]
        run = np.searchsorted(ends, random.random(count) * ends[-1], side="right").clip(max=len(ends) - 1)
        pixel = self.run[name] * run + (random.random(count) * self._lengths(name, run)).astype(np.int64)
        return pixel, np.float32(ends[-1] / self.pixels[name]) / self.density[name][run]

    def learn(self, name: str, pixel: np.ndarray, residual: np.ndarray) -> None:
        """Take in the relative residuals of rays that were drawn, (R,) each."""
        run = pixel // self.run[name]
        self.residuals[name][run] = _KEPT * self.residuals[name][run] + (1.0 - _KEPT) * residual

    def state_dict(self) -> dict[str, Any]:
        return {
            key: {n: torch.from_numpy(x) for n, x in values.items()}
            for key, values in (("residuals", self.residuals), ("density", self.density))
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.residuals = {n: x.numpy().copy() for n, x in state["residuals"].items()}
        self.density = {n: x.numpy().copy() for n, x in state["density"].items()}
        self._count()
