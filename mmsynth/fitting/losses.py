"""What a fit makes small."""

from __future__ import annotations

import torch
from torch import Tensor


def eikonal(gradient: Tensor) -> Tensor:
    """Mean (|∇sdf| - 1)² (Gropp et al. 2020): (N, 3) → scalar."""
    return (torch.linalg.vector_norm(gradient, dim=-1) - 1.0).square().mean()
