"""Formulas of other engines that several hard cases are held against."""

from __future__ import annotations

import torch
from torch import Tensor


def neus_weights(sdf: Tensor, s: float | Tensor) -> Tensor:
    """The published form (Wang et al. 2021, code): α = (Φ(f₀) - Φ(f₁) + 1e-5) / (Φ(f₀) + 1e-5), Π(1 - α + 1e-7)."""
    a, b = torch.sigmoid(s * sdf[..., :-1]), torch.sigmoid(s * sdf[..., 1:])
    alpha = ((a - b + 1e-5) / (a + 1e-5)).clamp(0, 1)
    return alpha * torch.cumprod(torch.cat([torch.ones_like(alpha[..., :1]), 1 - alpha + 1e-7], -1), -1)[..., :-1]


def nerfacc_keeps(opacities: Tensor, threshold: float = 0.01) -> Tensor:
    """Cells in which nerfacc goes on to sample: those above the mean of the positive ones, or the threshold if that is less."""
    return opacities > opacities[opacities > 0].mean().clamp(max=threshold)
