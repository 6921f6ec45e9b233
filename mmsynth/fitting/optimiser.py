"""Adam (Kingma and Ba 2015) for a field's parameters, and an exponential mean of them over the last steps."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import torch
from torch import nn

from mmsynth.field import kernels
from mmsynth.field.kernels.learning import gradient_of

BETAS = (0.9, 0.99)
EPSILON = 1e-15


class Adam:
    """Adam over named parameters. A step clears the gradients.

    Args:
        sparse: names of those of which a step changes only what has a gradient, see ``kernels.AdamStep``.
        epsilons: of some, where it is not ``EPSILON``.
    Attributes:
        count: of steps.
    """

    def __init__(
        self,
        parameters: dict[str, nn.Parameter],
        rates: dict[str, float],
        sparse: Collection[str] = (),
        epsilons: Mapping[str, float] | None = None,
    ) -> None:
        self.parameters, self.rates, self.sparse = dict(parameters), rates, sparse
        self.epsilons = dict.fromkeys(parameters, EPSILON) | dict(epsilons or {})
        self.moments = {n: [torch.zeros_like(p), torch.zeros_like(p)] for n, p in parameters.items()}
        self.count = 0

    def parts(
        self, factor: float, slower: Mapping[str, float] | None = None, beta2: Mapping[str, float] | None = None
    ) -> list[kernels.AdamPart]:
        """What a step takes, with all rates times ``factor``, and those of the parameters in ``slower`` times their own, too; ``beta2``: of
        some, where it is not that of ``BETAS``.

        Who takes it counts it in ``count``.
        """
        parts = []
        for name, p in self.parameters.items():
            rate = self.rates[name] * factor * (slower or {}).get(name, 1.0)
            own = (beta2 or {}).get(name, BETAS[1])
            step = kernels.AdamStep(rate, BETAS[0], own, self.epsilons[name], self.count + 1, name in self.sparse)
            first, second = self.moments[name]
            parts.append(kernels.AdamPart(p, gradient_of(p), first, second, step))
        return parts

    @torch.no_grad()
    def step(self, factor: float, slower: Mapping[str, float] | None = None) -> None:
        """One step, see ``parts``."""
        for part in self.parts(factor, slower):
            kernels.adam(*part)
        self.count += 1

    def resize(self, name: str, kept: int) -> None:
        """Follow a parameter that has new rows behind its first ``kept``; of one that has none the moments stay where they are."""
        if kept == len(self.parameters[name]) == len(self.moments[name][0]):
            return
        self.moments[name] = [torch.cat([m[:kept], torch.zeros_like(self.parameters[name][kept:])]) for m in self.moments[name]]

    def forget(self, name: str) -> None:
        """Leave out a parameter that the field does not have any more."""
        del self.parameters[name], self.moments[name]

    def clear(self) -> None:
        """Drop the gradients without a step."""
        for parameter in self.parameters.values():
            if parameter.grad is not None:
                parameter.grad.zero_()

    def state_dict(self) -> dict[str, Any]:
        return {"count": self.count, "moments": dict(self.moments)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.count = state["count"]
        for name, saved in state["moments"].items():
            for ours, theirs in zip(self.moments[name], saved, strict=True):
                ours.copy_(theirs)


class Average:
    """Exponential mean of named parameters (Polyak and Juditsky 1992): the noise of single batches averages out."""

    def __init__(self, parameters: dict[str, nn.Parameter]) -> None:
        self.parameters = dict(parameters)
        self.means: dict[str, torch.Tensor] = {}
        self.count = 0

    @torch.no_grad()
    def update(self, length: float) -> None:
        """Take the present values in; the mean is over about the last ``length`` times, over all when there were fewer."""
        self.count += 1
        weight = max(1.0 / self.count, 1.0 / max(length, 1.0))
        for name, p in self.parameters.items():
            if name not in self.means:
                self.means[name] = p.detach().clone()
            self.means[name].lerp_(p, weight)

    @torch.no_grad()
    def resize(self, name: str, kept: int) -> None:
        """Follow a parameter that has new rows behind its first ``kept``."""
        if name in self.means:
            self.means[name] = torch.cat([self.means[name][:kept], self.parameters[name][kept:]])

    def forget(self, name: str) -> None:
        """Leave out a parameter that the field does not have any more."""
        del self.parameters[name]
        self.means.pop(name, None)

    @torch.no_grad()
    def apply(self) -> None:
        """Let the parameters be their means; as they are where nothing was taken in."""
        for name, mean in self.means.items():
            self.parameters[name].copy_(mean)

    def state_dict(self) -> dict[str, Any]:
        return {"count": self.count, "means": dict(self.means)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.count = state["count"]
        self.means = {n: mean.to(self.parameters[n].device) for n, mean in state["means"].items()}
