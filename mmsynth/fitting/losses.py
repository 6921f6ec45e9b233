"""What is compared, and how."""

from __future__ import annotations

import torch
from torch import Tensor

from mmsynth.field import kernels
from mmsynth.field.radiance import Shader, intensity, radiance
from mmsynth.fitting.measurements import Batch


def compare(
    shader: Shader, features: Tensor, opacity: Tensor, batch: Batch, degrees: Tensor, teaches: Tensor, gain: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Shade rays and compare them with what was measured.

    Args:
        features: (R, F). opacity: (R,). degrees: (R,) int64 of the harmonics of direction that are seen.
        teaches: (R,) bool; rays that do not pass gradients on to the heads alone, not to features, opacity and trunk.
        gain: (M,) factors of the numbers, none: 1.
    Returns:
        The photometric loss, a scalar, and the squared residual of every number, (M,), without a gradient.
    """
    if kernels.on_cpu(features):
        rays = batch.directions, degrees, teaches
        numbers = batch.target, batch.ray, batch.output, batch.axes, batch.level, batch.saturation, batch.weight
        return kernels.cpu.compare(shader, features, opacity, rays, numbers, gain)
    return compare_by_parts(shader, features, opacity, batch, degrees, teaches, gain)


def compare_by_parts(
    shader: Shader, features: Tensor, opacity: Tensor, batch: Batch, degrees: Tensor, teaches: Tensor, gain: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """``compare`` from single operations, with autograd, on any device and in any precision."""
    hidden = shader.hidden(features, batch.directions, degrees)
    hidden = torch.where(teaches[:, None], hidden, hidden.detach())
    opacity = torch.where(teaches, opacity, opacity.detach())
    predicted = predict(shader.heads(hidden), opacity, batch)
    difference = residual(predicted if gain is None else predicted * gain, batch)
    return photometric(difference, batch), difference.detach().square()


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
