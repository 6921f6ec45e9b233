"""Linear polarization: analysers, Stokes vectors, coherency tensors.

A pixel's reference axes are x̂ = the camera's x axis and ŷ = image up, both perpendicular to its ray. Angles run from
image right towards image up. With a coherency tensor J (3x3, symmetric, PSD, world space) the intensity behind an ideal
analyser with transmission axis e ⟂ ray is I = eᵀ J e, and

    S0 = Jxx + Jyy    S1 = Jxx - Jyy    S2 = 2 Jxy    I(θ) = ½ (S0 + S1 cos 2θ + S2 sin 2θ)

(Collett, "Field Guide to Polarization"; receiver looking towards the source.)
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def reference_axes(directions: Tensor, camera_x: Tensor) -> tuple[Tensor, Tensor]:
    """x̂ and ŷ of each ray.

    Args:
        directions: (N, 3) unit ray directions (away from the camera), world frame.
        camera_x: (N, 3) unit camera x axes (image right), world frame; never parallel to a ray of a real camera.
    Returns:
        x̂, ŷ: (N, 3) unit vectors with x̂ ⟂ ŷ ⟂ ray, ŷ towards image up.
    """
    x = camera_x - (camera_x * directions).sum(-1, keepdim=True) * directions
    x = x / torch.linalg.vector_norm(x, dim=-1, keepdim=True)
    # OpenCV axes: forward × right = down, so up = right × forward
    return x, torch.linalg.cross(x, directions)


def analyser_axes(directions: Tensor, camera_x: Tensor, angles: Tensor) -> Tensor:
    """Transmission axes e of ideal analysers.

    Args:
        angles: (N,) or (N, K) analyser angles [rad], from image right towards image up.
    Returns:
        (N, 3) or (N, K, 3) unit vectors perpendicular to the rays.
    """
    x, y = reference_axes(directions, camera_x)
    if angles.dim() == 2:
        x, y = x[:, None], y[:, None]
    return torch.cos(angles)[..., None] * x + torch.sin(angles)[..., None] * y


def coherency_from_factor(raw: Tensor) -> Tensor:
    """Six unconstrained numbers → lower-triangular L (..., 3, 3) with positive diagonal; J = L Lᵀ is PSD by construction.

    Args:
        raw: (..., 6): diagonal (before softplus), then L10, L20, L21.
    """
    diagonal = torch.nn.functional.softplus(raw[..., :3])
    zero = torch.zeros_like(raw[..., 0])
    return torch.stack([
        diagonal[..., 0], zero, zero,
        raw[..., 3], diagonal[..., 1], zero,
        raw[..., 4], raw[..., 5], diagonal[..., 2],
    ], -1).reshape(*raw.shape[:-1], 3, 3)  # fmt: skip


def stokes_to_intensities(stokes: np.ndarray, angles_deg: tuple[float, ...]) -> np.ndarray:
    """(..., 3) Stokes S0, S1, S2 → (..., K) intensities behind analysers at the given angles."""
    theta = np.radians(np.asarray(angles_deg, dtype=np.float64))
    s0, s1, s2 = (stokes[..., i : i + 1] for i in range(3))
    return 0.5 * (s0 + s1 * np.cos(2 * theta) + s2 * np.sin(2 * theta))


def intensities_to_stokes(intensities: np.ndarray, angles_deg: tuple[float, ...]) -> np.ndarray:
    """(..., K) intensities → (..., 3) Stokes vectors, least squares over the K analysers (K ≥ 3 distinct angles)."""
    theta = np.radians(np.asarray(angles_deg, dtype=np.float64))
    design = 0.5 * np.stack([np.ones_like(theta), np.cos(2 * theta), np.sin(2 * theta)], -1)
    return intensities @ np.linalg.pinv(design).T


def degree_of_linear_polarization(stokes: np.ndarray) -> np.ndarray:
    """DoLP = sqrt(S1² + S2²) / S0 in (...,); 0 where there is no light (S0 ≤ 0)."""
    strength = np.hypot(stokes[..., 1], stokes[..., 2])
    return np.divide(strength, stokes[..., 0], out=np.zeros_like(strength), where=stokes[..., 0] > 0)


def angle_of_linear_polarization(stokes: np.ndarray) -> np.ndarray:
    """AoLP = ½ atan2(S2, S1) in [-90, 90] degrees. For display and circular metrics only: never average angles."""
    return np.degrees(0.5 * np.arctan2(stokes[..., 2], stokes[..., 1]))


def aolp_error(a_deg: np.ndarray, b_deg: np.ndarray) -> np.ndarray:
    """Circular distance of two AoLP, in [0, 90] degrees."""
    return np.abs((a_deg - b_deg + 90.0) % 180.0 - 90.0)
