"""What a fit makes small."""

from __future__ import annotations

import torch
from torch import Tensor


def eikonal(gradient: Tensor, shallow: Tensor | float = 1.0) -> Tensor:
    """Mean (|∇sdf| - 1)² (Gropp et al. 2020): (N, 3) → scalar.

    Args:
        shallow: factors (N,) where the slope is below 1. In the middle of a gap the distance has a ridge, and cells as wide as the gap
            hold no slope of 1: a pull towards it closes the gap, which later has no way to open.
    """
    off = torch.linalg.vector_norm(gradient, dim=-1) - 1.0
    return (torch.where(off < 0.0, shallow, 1.0) * off.square()).mean()
