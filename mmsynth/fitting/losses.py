"""What is compared, and how."""

from __future__ import annotations

import torch
from torch import Tensor


def residual(predicted: Tensor, target: Tensor, saturation: float) -> Tensor:
    """predicted - target, where a clipped pixel only says "at least": no residual above a saturated target."""
    difference = predicted - target
    return torch.where(target >= saturation, difference.clamp(max=0.0), difference)


def photometric(difference: Tensor, level: float) -> Tensor:
    """Mean Huber loss of residuals relative to the modality's typical value, so that dark modalities count as much."""
    relative = difference / level
    return torch.nn.functional.huber_loss(relative, torch.zeros_like(relative), delta=0.5)


def eikonal(gradient: Tensor) -> Tensor:
    """Mean (|∇sdf| - 1)² (Gropp et al. 2020): (N, 3) → scalar."""
    return (torch.linalg.vector_norm(gradient, dim=-1) - 1.0).square().mean()
