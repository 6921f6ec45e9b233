"""Adam (Kingma and Ba 2015) of a field's parameters."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn

from mmsynth.field import kernels

_BETAS = (0.9, 0.99)
_EPSILON = 1e-15


class Adam:
    """Adam over named parameters. A step clears the gradients."""

    def __init__(self, parameters: dict[str, nn.Parameter], rates: dict[str, float]) -> None:
        self.parameters, self.rates = parameters, rates
        self.moments = {n: (torch.zeros_like(p), torch.zeros_like(p)) for n, p in parameters.items()}
        self.count = 0

    @torch.no_grad()
    def step(self, factor: float, slower: dict[str, float] | None = None) -> None:
        """One step with all rates times ``factor``, and those of the parameters in ``slower`` times their own, too."""
        self.count += 1
        for name, p in self.parameters.items():
            if p.grad is not None:
                rate = self.rates[name] * factor * (slower or {}).get(name, 1.0)
                kernels.adam(p, p.grad, *self.moments[name], rate, *_BETAS, _EPSILON, self.count)

    def clear(self) -> None:
        """Drop the gradients without a step."""
        for parameter in self.parameters.values():
            if parameter.grad is not None:
                parameter.grad.zero_()

    def state_dict(self) -> dict[str, Any]:
        return {"count": self.count, "moments": {n: list(m) for n, m in self.moments.items()}}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.count = state["count"]
        for name, saved in state["moments"].items():
            for ours, theirs in zip(self.moments[name], saved, strict=True):
                ours.copy_(theirs)
