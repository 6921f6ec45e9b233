"""What is compared, and how."""

from __future__ import annotations

import torch
from torch import Tensor

from mmsynth.field.radiance import intensity, radiance
from mmsynth.fitting.measurements import Batch


def predict(outputs: Tensor, opacity: Tensor, batch: Batch) -> Tensor:
    """What the sensors should have measured: shader outputs (R, outputs) and opacity (R,) → (M,)."""
    bright = len(batch.ray) - len(batch.axes)
    value = radiance(outputs[batch.ray[:bright], batch.output[:bright]])
    if len(batch.axes):
        factor = batch.output[bright:, None] + torch.arange(6, device=outputs.device)
        value = torch.cat([value, intensity(outputs[batch.ray[bright:, None], factor], batch.axes)])
    return value * batch.level * opacity[batch.ray]


def residual(predicted: Tensor, batch: Batch) -> Tensor:
    """predicted - target, where a clipped pixel only says "at least": no residual above a saturated target."""
    difference = predicted - batch.target
    return torch.where(batch.target >= batch.saturation, difference.clamp(max=0.0), difference)


def photometric(difference: Tensor, batch: Batch) -> Tensor:
    """Mean over modalities of the Huber loss of residuals relative to the modality's typical value: dark ones count as much."""
    relative = difference / batch.level
    return (torch.nn.functional.huber_loss(relative, torch.zeros_like(relative), reduction="none", delta=0.5) * batch.weight).sum()


def eikonal(gradient: Tensor) -> Tensor:
    """Mean (|∇sdf| - 1)² (Gropp et al. 2020): (N, 3) → scalar."""
    return (torch.linalg.vector_norm(gradient, dim=-1) - 1.0).square().mean()
