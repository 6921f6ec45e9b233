"""What a fit makes small."""

from __future__ import annotations

import math

import torch
from torch import Tensor

_BLOCKED = 0.5  # opacity beyond which most of a ray's light is stopped: no edge of the object that it only grazes


def eikonal(gradient: Tensor, shallow: Tensor | float = 1.0) -> Tensor:
    """Mean (|∇sdf| - 1)² (Gropp et al. 2020): (N, 3) → scalar.

    Args:
        shallow: factors (N,) where the slope is below 1. In the middle of a gap the distance has a ridge, and cells as wide as the gap
            hold no slope of 1: a pull towards it closes the gap, which later has no way to open.
    """
    off = torch.linalg.vector_norm(gradient, dim=-1) - 1.0
    return (torch.where(off < 0.0, shallow, 1.0) * off.square()).mean()


def blocked(opacity: Tensor, max_optical_depth: float) -> Tensor:
    """Optical depth of rays that are mostly blocked, 0 of the others: (R,) → (R,). For rays along which nothing is.

    Opacity is 1 - e^-τ, and its gradient e^-τ: pulls on it or its square leave what has become solid as it is. This one is as strong at
    every depth τ: -log(1 - opacity), the emptiness term of the binary cross entropy that NeuS has for masks (Wang et al. 2021, eq. 8).

    Args:
        max_optical_depth: where rays end, and count as opaque.
    """
    depth = -torch.log(1.0 - opacity + math.exp(-max_optical_depth))
    return torch.where(opacity > _BLOCKED, depth, 0.0)
