"""Polarization from the shape of a surface and from what it looks like.

Light that a surface sends out is polarized along the plane of view and normal or across it (Fresnel; Atkinson and Hancock 2006), but for
the
images of lamps, which ``field.kernels.mirroring`` knows. How far and which way depends on material and surroundings, which nobody measured:
a small network that many scenes have taught gives q, S1 over S0 about that plane, in [-1, 1], and its deviation. q > 0 is along the plane.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from mmsynth.prior.samples import Shapes

_HIDDEN = 32
_STEPS = 1500
_BATCH = 2048
_RATE = 3e-3
_DECAY = 1e-2
_REFRACTIVE_INDEX = 1.5
_OUTLIER = 1.0  # squared error of one sample, at the most
_RANGE = 3.0  # deviations of an input, beyond which it says no more
_LEAST_LEVEL = 0.02  # of the scene's mean
_LEAST_DEVIATION = 0.01
INPUTS = 10


def inputs_of(colour: Tensor, images: Tensor, shapes: Shapes) -> Tensor:
    """What the network looks at, (N, INPUTS).

    Args:
        colour: (N, 3) reflected light of the body in three channels, over the scene's mean. images: (N,) light of lamps, in the same unit.
    """
    c = shapes.cosine.clamp(min=0.02)
    inner = torch.sqrt(1.0 - (1.0 - c.square()) / _REFRACTIVE_INDEX**2)
    across = ((c - _REFRACTIVE_INDEX * inner) / (c + _REFRACTIVE_INDEX * inner)).square()
    along = ((inner - _REFRACTIVE_INDEX * c) / (inner + _REFRACTIVE_INDEX * c)).square()
    level = colour.mean(1)
    share = colour / colour.sum(1, keepdim=True).clamp(min=1e-6)
    features = (
        c,
        across + along,
        across - along,
        torch.log(level + _LEAST_LEVEL),
        share[:, 0],
        share[:, 2],
        colour.min(1).values,
        images.clamp(0.0, 3.0),
        shapes.roughness,
        torch.log(shapes.strength + 1e-2),
    )
    return torch.stack(features, -1)


@dataclass(frozen=True)
class Polarization:
    """The network, and what its inputs are like.

    Attributes:
        centre, scale: (INPUTS,). weights: of its three layers, each weight and bias.
    """

    centre: Tensor
    scale: Tensor
    weights: tuple[Tensor, ...]

    def __call__(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """(N, INPUTS) → q in [-1, 1] and its standard deviation, (N,)."""
        out = _network(self.weights, ((inputs - self.centre) / self.scale).clamp(-_RANGE, _RANGE))
        return out[:, 0].clamp(-1.0, 1.0), torch.exp(out[:, 1]).clamp(_LEAST_DEVIATION, 1.0)


def _network(weights: Sequence[Tensor], x: Tensor) -> Tensor:
    first, first_bias, second, second_bias, last, last_bias = weights
    x = nn.functional.silu(nn.functional.linear(x, first, first_bias))
    return nn.functional.linear(nn.functional.silu(nn.functional.linear(x, second, second_bias)), last, last_bias)


def learn_polarization(inputs: Tensor, q: Tensor, level: Tensor, seed: int = 0) -> Polarization:
    """Teach the network.

    Args:
        inputs: (N, INPUTS) of all scenes. q: (N,) what it should say. level: (N,) S0 over its scene's mean: dark pixels say little.
    """
    centre, scale = inputs.mean(0), inputs.std(0)
    # what was always the same says nothing, whatever it is elsewhere
    scale = torch.where(scale > 1e-6, scale.clamp(min=1e-3), torch.full_like(scale, math.inf))
    normal = ((inputs - centre) / scale).clamp(-_RANGE, _RANGE)
    generator = torch.Generator().manual_seed(seed)
    sizes = ((_HIDDEN, INPUTS), (_HIDDEN, _HIDDEN), (2, _HIDDEN))
    weights: list[Tensor] = []
    for rows, width in sizes:
        bound = width**-0.5
        weights += [((torch.rand(size, generator=generator) * 2 - 1) * bound).requires_grad_() for size in ((rows, width), (rows,))]
    optimiser = torch.optim.AdamW(weights, _RATE, weight_decay=_DECAY)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, _STEPS)
    for _ in range(_STEPS):
        drawn = torch.randint(len(normal), (_BATCH,), generator=generator)
        out = _network(weights, normal[drawn])
        weight = level[drawn].square()
        error = (out[:, 0] - q[drawn]).square()
        # the deviation learns from the error, and not the other way round
        log = out[:, 1].clamp(-6.0, 0.0)
        surprise = 0.5 * error.detach() * torch.exp(-2.0 * log) + log
        loss = (weight * error).clamp(max=_OUTLIER).mean() + 0.05 * (weight * surprise).mean() / weight.mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    return Polarization(centre, scale, tuple(w.detach() for w in weights))
