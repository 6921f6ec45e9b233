"""From the features of what rays meet to what sensors measure of it, in plain torch: with ``mirroring`` and ``reference`` the definition.

Symbols: R rays, H surfaces that they meet, M numbers measured along them.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import huber_loss, linear, softplus

from mmsynth.field.kernels.constants import HUBER_DELTA
from mmsynth.field.kernels.parameters import Measured, ShadedRays, ShaderWeights
from mmsynth.sensors.polarization import coherency_from_factor

HARMONIC_DEGREES = torch.tensor([0] + [1] * 3 + [2] * 5 + [3] * 7)


def spherical_harmonics(d: Tensor) -> Tensor:
    """Real spherical harmonics up to degree 3 (orthonormal), (N, 3) unit vectors → (N, 16)."""
    x, y, z = d.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    return torch.stack([
        torch.full_like(x, 0.28209479177387814),
        0.4886025119029199 * y, 0.4886025119029199 * z, 0.4886025119029199 * x,
        1.0925484305920792 * x * y, 1.0925484305920792 * y * z, 0.31539156525252005 * (3 * zz - 1),
        1.0925484305920792 * x * z, 0.5462742152960396 * (xx - yy),
        0.5900435899266435 * y * (3 * xx - yy), 2.890611442640554 * x * y * z, 0.4570457994644658 * y * (5 * zz - 1),
        0.3731763325901154 * z * (5 * zz - 3), 0.4570457994644658 * x * (5 * zz - 1), 1.445305721320277 * z * (xx - yy),
        0.5900435899266435 * x * (xx - 3 * yy),
    ], -1)  # fmt: skip


def hidden_layers(weights: ShaderWeights, features: Tensor, directions: Tensor, degrees: Tensor | int) -> Tensor:
    """The last hidden layer of the shader, (R, H), which all modalities share."""
    seen = HARMONIC_DEGREES.to(features.device) <= (degrees if isinstance(degrees, int) else degrees[:, None])
    inputs = torch.cat([features, spherical_harmonics(directions) * seen], -1)
    return torch.relu(linear(torch.relu(linear(inputs, weights.first, weights.first_bias)), weights.second, weights.second_bias))


def shade(weights: ShaderWeights, features: Tensor, directions: Tensor, degrees: Tensor | int) -> Tensor:
    """(R, F), (R, 3) → (R, outputs of all modalities), before the functions that make them light.

    Args:
        degrees: of the spherical harmonics of the direction that are seen, 0 = none; one number, or (R,) int64.
    """
    return linear(hidden_layers(weights, features, directions, degrees), weights.heads, weights.heads_bias)


def compare(
    weights: ShaderWeights, rays: ShadedRays, measured: Measured, gain: Tensor | None = None, mirrored: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Shade rays and compare them with what was measured.

    Args:
        gain: (M,) factors of the predictions, none: 1. mirrored: (M,) relative light that is not the shader's, none: 0.
    Returns:
        The photometric loss, a scalar, and the squared residual of every measurement, (M,), without a gradient.
    """
    ray = rays_of(rays.behind, len(rays.share))
    trains = rays.trains_geometry[ray]
    hidden = hidden_layers(weights, rays.features, rays.directions[ray], rays.degrees[ray])
    hidden = torch.where(trains[:, None], hidden, hidden.detach())
    share = torch.where(trains, rays.share, rays.share.detach())
    predicted = predict(linear(hidden, weights.heads, weights.heads_bias), share, measured, rays.behind)
    if mirrored is not None:
        predicted = predicted + mirrored * measured.level
    difference = residual(predicted if gain is None else predicted * gain, measured)
    return photometric(difference, measured), difference.detach().square()


def radiance(raw: Tensor) -> Tensor:
    """Outputs of a radiance head → relative radiance > 0."""
    return softplus(raw)


def intensity(raw: Tensor, axes: Tensor) -> Tensor:
    """Outputs (..., 6) of a polarization head → relative intensity behind analysers with axes (..., 3): (...)."""
    # |Lᵀ e|² is eᵀ (L Lᵀ) e without a chance of becoming negative by rounding
    return (coherency_from_factor(raw).mT @ axes[..., None])[..., 0].square().sum(-1)


def rays_of(behind: Tensor, rows: int) -> Tensor:
    """The ray of each of the H = ``rows`` rows of ``Hits``: (R,) rows of what is behind → (H,)."""
    rays = torch.arange(len(behind), device=behind.device)
    # with two rows for every ray nothing has to be counted, which on a GPU the host would wait for
    return rays.repeat(2) if rows == 2 * len(behind) else torch.cat([rays, torch.nonzero(behind >= 0)[:, 0]])


def predict(outputs: Tensor, share: Tensor, measured: Measured, behind: Tensor | None = None) -> Tensor:
    """What the sensors should have measured: shader outputs (H, outputs) and shares (H,) → (M,).

    Args:
        behind: (R,), see ``Hits``; None: rays meet one surface each.
    """
    seen = _relative(outputs, share, measured.ray, measured.output, measured.axes)
    if behind is not None:
        row = behind[measured.ray]
        chosen = torch.nonzero(row >= 0)[:, 0]
        bright = len(measured.ray) - len(measured.axes)
        axes = measured.axes[chosen[chosen >= bright] - bright]
        seen = seen.index_add(0, chosen, _relative(outputs, share, row[chosen], measured.output[chosen], axes))
    return seen * measured.level


def _relative(outputs: Tensor, share: Tensor, row: Tensor, output: Tensor, axes: Tensor) -> Tensor:
    """Relative light of one row for each number, (M,)."""
    bright = len(row) - len(axes)
    value = radiance(outputs[row[:bright], output[:bright]])
    if len(axes):
        factor = output[bright:, None] + torch.arange(6, device=outputs.device)
        value = torch.cat([value, intensity(outputs[row[bright:, None], factor], axes)])
    return value * share[row]


def residual(predicted: Tensor, measured: Measured) -> Tensor:
    """predicted - target, where a clipped pixel only says "at least": no residual above a saturated target."""
    difference = predicted - measured.target
    return torch.where(measured.target >= measured.saturation, difference.clamp(max=0.0), difference)


def photometric(difference: Tensor, measured: Measured) -> Tensor:
    """Mean over modalities of the Huber loss of residuals relative to the modality's typical value: dark ones count as much."""
    relative = difference / measured.level
    return (huber_loss(relative, torch.zeros_like(relative), reduction="none", delta=HUBER_DELTA) * measured.weight).sum()
