"""Sensor models as ``nn.Module`` for ``nn.Sequential`` and kornia's pipelines: tensors (B, C, H, W), differentiable, on any device."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from mmsynth.sensors import mosaic, polarization


class Mosaic(nn.Module):
    """All channels (B, C, H, W) → raw frame (B, 1, H, W) behind a pattern (see ``mosaic``)."""

    def __init__(self, pattern: np.ndarray) -> None:
        super().__init__()
        self.pattern = pattern

    def forward(self, image: Tensor) -> Tensor:
        return mosaic.mosaic(image, self.pattern)[..., None, :, :]


class Demosaic(nn.Module):
    """Raw frame (B, 1, H, W) → all channels (B, C, H, W), for any pattern (see ``mosaic.demosaic``)."""

    def __init__(self, pattern: np.ndarray) -> None:
        super().__init__()
        self.pattern = pattern

    def forward(self, raw: Tensor) -> Tensor:
        return mosaic.demosaic(raw[..., 0, :, :], self.pattern)


class StokesFromIntensities(nn.Module):
    """Intensities behind K analysers (B, K, H, W) → Stokes vectors (B, 3, H, W)."""

    def __init__(self, angles_deg: Sequence[float] = (0.0, 45.0, 90.0, 135.0)) -> None:
        super().__init__()
        self.angles_deg = tuple(angles_deg)

    def forward(self, intensities: Tensor) -> Tensor:
        return polarization.intensities_to_stokes(intensities.movedim(-3, -1), self.angles_deg).movedim(-1, -3)


class IntensitiesFromStokes(nn.Module):
    """Stokes vectors (B, 3, H, W) → intensities behind K analysers (B, K, H, W)."""

    def __init__(self, angles_deg: Sequence[float] = (0.0, 45.0, 90.0, 135.0)) -> None:
        super().__init__()
        self.angles_deg = tuple(angles_deg)

    def forward(self, stokes: Tensor) -> Tensor:
        return polarization.stokes_to_intensities(stokes.movedim(-3, -1), self.angles_deg).movedim(-1, -3)


def turn_stokes(stokes: Tensor, transform: Tensor) -> Tensor:
    """Stokes vectors of pictures whose pixels were moved already: angles turn with the picture, and change sign where it is mirrored.

    Args:
        stokes: (B, 3, H, W). transform: (B, 3, 3) old pixels (column, row) → new ones, as kornia's ``transform_matrix``.
    Raises:
        ValueError: a transform that is no rotation, mirroring, shift and even scaling: it would shear angles.
    """
    a, b, c, d = transform[:, 0, 0], transform[:, 0, 1], transform[:, 1, 0], transform[:, 1, 1]
    mirrored = a * d - b * c < 0
    sign = torch.where(mirrored, -1.0, 1.0)
    if ((a - sign * d).abs() + (b + sign * c).abs() > 1e-4 * torch.hypot(a, c)).any():
        raise ValueError("a picture of polarization may be turned, mirrored, shifted and scaled evenly, not sheared")
    # the image's right, (a, c) with rows counted downwards, is turned from right towards up by
    angle = torch.atan2(-c, a)
    flat = stokes.movedim(1, -1)
    flat = torch.where(mirrored[:, None, None, None], polarization.flip_stokes(flat), flat)
    return polarization.rotate_stokes(flat, -angle.to(flat)[:, None, None]).movedim(-1, 1)
