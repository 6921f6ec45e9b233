"""What a fit makes small."""

from __future__ import annotations

import torch
from torch import Tensor

from mmsynth.field import kernels
from mmsynth.field.radiance import Shader
from mmsynth.fitting.measurements import Batch


def compare(
    shader: Shader, features: Tensor, opacity: Tensor, batch: Batch, degrees: Tensor, trains_geometry: Tensor, gain: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Photometric loss of a batch and its squared residuals; see ``kernels.reference.compare``, and ``kernels.ShadedRays`` for the rays."""
    rays = kernels.ShadedRays(features, opacity, batch.directions, degrees, trains_geometry)
    return kernels.compare(shader.weights(), rays, batch.measured, gain)


def eikonal(gradient: Tensor) -> Tensor:
    """Mean (|∇sdf| - 1)² (Gropp et al. 2020): (N, 3) → scalar."""
    return (torch.linalg.vector_norm(gradient, dim=-1) - 1.0).square().mean()
