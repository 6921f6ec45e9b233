"""Radiance: appearance features in space, composited along the ray and shaded once per ray, with a head per modality."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from mmsynth.field.encoding import spherical_harmonics
from mmsynth.scene.scene import Sensor
from mmsynth.sensors.polarization import coherency_from_factor


class Shader(nn.Module):
    """(features, direction) → hidden layer → a linear head per modality.

    A radiance head has one output per channel, made positive by softplus. A polarization head has six: the Cholesky factor
    of a world-space coherency tensor J = L Lᵀ, so that DoLP ≤ 1 and no reference direction exists (see sensors.polarization).
    ``levels`` holds each modality's typical value: outputs are relative to it, so dark sensors learn as fast as bright ones.
    """

    def __init__(self, features: int, hidden: int, sensors: dict[str, Sensor], levels: dict[str, float]) -> None:
        super().__init__()
        self.trunk = nn.Sequential(nn.Linear(features + 16, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU())
        self.heads = nn.ModuleDict({n: nn.Linear(hidden, 6 if s.is_polarization else s.channel_count) for n, s in sensors.items()})
        self.levels = levels

    def hidden(self, features: Tensor, directions: Tensor, view_dependence: float = 1.0) -> Tensor:
        """(R, F), (R, 3) → (R, H), shared by all modalities."""
        return self.trunk(torch.cat([features, view_dependence * spherical_harmonics(directions)], -1))

    def values(self, modality: str, hidden: Tensor, axes: Tensor | None = None) -> Tensor:
        """Channel values of one modality, linear and ≥ 0.

        Args:
            hidden: (R, H). axes: (R, K, 3) transmission axes of the analysers, for a polarization modality.
        Returns:
            (R, C) radiance, or (R, K) intensities I = eᵀ J e.
        """
        raw = self.heads[modality](hidden)
        if axes is None:
            return softplus(raw) * self.levels[modality]
        # |Lᵀ e|² is eᵀ (L Lᵀ) e without a chance of becoming negative by rounding
        return (axes @ coherency_from_factor(raw)).square().sum(-1) * self.levels[modality]
