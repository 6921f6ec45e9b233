"""Radiance: appearance features in space, composited along the ray and shaded once per ray, with one head for each modality."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from mmsynth.field import kernels
from mmsynth.field.kernels.constants import HARMONICS
from mmsynth.scene.scene import Sensor
from mmsynth.sensors.polarization import coherency_from_factor


class Shader(nn.Module):
    """(features, direction) -> hidden layers -> one linear layer whose outputs belong to the modalities in turn.

    A radiance modality has one output per channel, made positive by softplus. A polarization modality has six: the Cholesky
    factor of a world-space coherency tensor J = L Lᵀ, so that DoLP ≤ 1 and no reference direction exists (see
    sensors.polarization). ``radiance_scale`` holds each modality's typical value: outputs are relative to it, so dark sensors learn
    as fast as bright ones.
    """

    def __init__(self, features: int, hidden: int, sensors: dict[str, Sensor], radiance_scale: dict[str, float]) -> None:
        super().__init__()
        self.trunk = nn.Sequential(nn.Linear(features + HARMONICS, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU())
        self.columns: dict[str, slice] = {}
        width = 0
        for name, sensor in sensors.items():
            self.columns[name] = slice(width, width + (6 if sensor.is_polarization else sensor.channel_count))
            width = self.columns[name].stop
        self.heads = nn.Linear(hidden, width)
        self.radiance_scale = radiance_scale

    def forward(self, features: Tensor, directions: Tensor, degree: Tensor | int) -> Tensor:
        """(R, F), (R, 3) → (R, outputs of all modalities), before the functions that make them light.

        Args:
            degree: of the spherical harmonics of the direction that are seen, 0 = none; one number, or (R,) int64.
        """
        return kernels.shade(self.weights(), features, directions, degree)

    def weights(self) -> kernels.ShaderWeights:
        """What the kernels take."""
        return kernels.ShaderWeights(*self.parameters())  # in the order of the layers, weights before biases

    def values(self, modality: str, outputs: Tensor) -> Tensor:
        """All channels of one radiance modality, linear and ≥ 0: (R, outputs) → (R, C)."""
        return kernels.radiance(outputs[:, self.columns[modality]]) * self.radiance_scale[modality]

    def polarized(self, modality: str, outputs: Tensor, x: Tensor, y: Tensor, angles: Tensor) -> tuple[Tensor, Tensor]:
        """All channels of one polarization modality, I = eᵀ J e behind analysers that all rays share, and the Stokes vectors.

        Args:
            outputs: (R, outputs). x, y: (R, 3) reference axes of the rays. angles: (K,) from x towards y [rad].
        Returns:
            intensities (R, K) ≥ 0, and S0, S1, S2 in the frame of x and y: (R, 3).
        """
        # every axis is a sum of two, and so is Lᵀ e: two products with L serve all analysers
        factor = coherency_from_factor(outputs[:, self.columns[modality]])
        across, up = (torch.stack([x, y], 1) @ factor).unbind(1)
        behind = (torch.cos(angles)[:, None, None] * across + torch.sin(angles)[:, None, None] * up).square().sum(-1).T
        xx, yy, xy = across.square().sum(-1), up.square().sum(-1), (across * up).sum(-1)
        return behind * self.radiance_scale[modality], torch.stack([xx + yy, xx - yy, 2.0 * xy], -1) * self.radiance_scale[modality]
