"""Radiance: appearance features in space, composited along the ray and shaded once per ray, with a head per modality."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from mmsynth.field.encoding import spherical_harmonics
from mmsynth.scene.scene import Sensor
from mmsynth.sensors.polarization import coherency_from_factor


class Shader(nn.Module):
    """(features, direction) -> hidden layers -> one linear layer whose outputs belong to the modalities in turn.

    A radiance modality has one output per channel, made positive by softplus. A polarization modality has six: the Cholesky
    factor of a world-space coherency tensor J = L Lᵀ, so that DoLP ≤ 1 and no reference direction exists (see
    sensors.polarization). ``levels`` holds each modality's typical value: outputs are relative to it, so dark sensors learn
    as fast as bright ones.
    """

    term_degree: Tensor

    def __init__(self, features: int, hidden: int, sensors: dict[str, Sensor], levels: dict[str, float]) -> None:
        super().__init__()
        self.trunk = nn.Sequential(nn.Linear(features + 16, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU())
        self.columns: dict[str, slice] = {}
        width = 0
        for name, sensor in sensors.items():
            self.columns[name] = slice(width, width + (6 if sensor.is_polarization else sensor.channel_count))
            width = self.columns[name].stop
        self.heads = nn.Linear(hidden, width)
        self.levels = levels
        self.register_buffer("term_degree", torch.tensor([0] + [1] * 3 + [2] * 5 + [3] * 7), persistent=False)

    def forward(self, features: Tensor, directions: Tensor, degree: Tensor | int) -> Tensor:
        """(R, F), (R, 3) → (R, outputs of all modalities), before the functions that make them light.

        Args:
            degree: of the spherical harmonics of the direction that are seen, 0 = none; one number, or (R,) int64.
        """
        return self.heads(self.hidden(features, directions, degree))

    def hidden(self, features: Tensor, directions: Tensor, degree: Tensor | int) -> Tensor:
        """The last hidden layer, (R, H), which all modalities share."""
        seen = self.term_degree <= (degree if isinstance(degree, int) else degree[:, None])
        return self.trunk(torch.cat([features, spherical_harmonics(directions) * seen], -1))

    def values(self, modality: str, outputs: Tensor, axes: Tensor | None = None) -> Tensor:
        """All channels of one modality, linear and ≥ 0.

        Args:
            outputs: (R, outputs). axes: (R, K, 3) transmission axes of the analysers, for a polarization modality.
        Returns:
            (R, C) radiance, or (R, K) intensities I = eᵀ J e.
        """
        raw = outputs[:, self.columns[modality]]
        if axes is None:
            return radiance(raw) * self.levels[modality]
        return intensity(raw[:, None], axes) * self.levels[modality]


def radiance(raw: Tensor) -> Tensor:
    """Outputs of a radiance head → relative radiance > 0."""
    return softplus(raw)


def intensity(raw: Tensor, axes: Tensor) -> Tensor:
    """Outputs (..., 6) of a polarization head → relative intensity behind analysers with axes (..., 3): (...)."""
    # |Lᵀ e|² is eᵀ (L Lᵀ) e without a chance of becoming negative by rounding
    return (coherency_from_factor(raw).mT @ axes[..., None])[..., 0].square().sum(-1)
