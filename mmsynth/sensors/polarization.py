"""Linear polarization: analysers, Stokes vectors, coherency tensors, in any frame.

A pixel's reference axes are x̂ = the camera's x axis and ŷ = image up, both perpendicular to its ray. Angles run from
image right towards image up. With a coherency tensor J (3x3, symmetric, PSD, world space) the intensity behind an ideal
analyser with transmission axis e ⟂ ray is I = eᵀ J e, and

    S0 = Jxx + Jyy    S1 = Jxx - Jyy    S2 = 2 Jxy    I(θ) = ½ (S0 + S1 cos 2θ + S2 sin 2θ)

(Collett, "Field Guide to Polarization"; receiver looking towards the source.) Stokes vectors are the last axis, (..., 3).

Angles of polarization (AoLP) are for display and for metrics: what is averaged, resampled or learned is S or intensities. A
picture that is flipped or turned, or resampled into another camera, has its Stokes vectors in another frame: see ``flip_stokes``,
``rotate_stokes``, ``resample_stokes``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

OffAxis = Literal["ideal", "lens", "korger"]
Figures = Sequence[float] | Tensor | float
"""One for each analyser, or one of them all."""


# --- analysers


def reference_axes(directions: Tensor, camera_x: Tensor) -> tuple[Tensor, Tensor]:
    """x̂ and ŷ of each ray.

    Args:
        directions: (N, 3) unit ray directions (away from the camera), world frame.
        camera_x: (N, 3) unit camera x axes (image right), world frame; never parallel to a ray of a camera narrower than 180°.
    Returns:
        x̂, ŷ: (N, 3) unit vectors with x̂ ⟂ ŷ ⟂ ray, ŷ towards image up.
    """
    x = camera_x - (camera_x * directions).sum(-1, keepdim=True) * directions
    x = x / torch.linalg.vector_norm(x, dim=-1, keepdim=True)
    # OpenCV axes: forward × right = down, so up = right × forward
    return x, torch.linalg.cross(x, directions)


def analyser_axes(
    directions: Tensor, camera_x: Tensor, angles: Tensor, off_axis: OffAxis = "ideal", camera_z: Tensor | None = None
) -> Tensor:
    """Transmission axes e of analysers on the sensor, as the light of each ray meets them.

    On the optical axis the three models agree. Off it:
        ideal: the angle is measured in the ray's own reference axes.
        lens: a rotationally symmetric lens bends the ray onto the axis, and its polarization with it, by the shortest rotation.
        korger: the analyser stands tilted in the ray and absorbs along its own absorbing axis a: e ⟂ ray and e ⟂ a
            (Korger et al. 2013; Mitsuba's ``polarizer``; Pistellato and Bergamasco 2022 for cameras).

    Args:
        directions: (N, 3) unit ray directions, world frame. camera_x: (N, 3) unit camera x axes.
        angles: (N,) or (N, K) analyser angles [rad], from image right towards image up.
        camera_z: (N, 3) unit optical axes, for the models other than ``ideal``.
    Returns:
        (N, 3) or (N, K, 3) unit vectors perpendicular to the rays.
    Raises:
        ValueError: a model other than ``ideal`` without optical axes.
    """
    if off_axis == "ideal":
        x, y = reference_axes(directions, camera_x)
        return _turned(x, y, angles)
    if camera_z is None:
        raise ValueError(f"off-axis model {off_axis!r} needs the optical axes")
    up = torch.linalg.cross(camera_x, camera_z)
    if off_axis == "lens":
        return _turned(_carried(camera_x, camera_z, directions), _carried(up, camera_z, directions), angles)
    absorbing = _turned(camera_x, up, angles + 0.5 * math.pi)
    rays = directions if angles.dim() == 1 else directions[:, None].expand_as(absorbing)
    e = torch.linalg.cross(rays, absorbing)
    return e / torch.linalg.vector_norm(e, dim=-1, keepdim=True)


def _turned(x: Tensor, y: Tensor, angles: Tensor) -> Tensor:
    if angles.dim() == 2:
        x, y = x[:, None], y[:, None]
    return torch.cos(angles)[..., None] * x + torch.sin(angles)[..., None] * y


def _carried(vector: Tensor, from_axis: Tensor, to_axis: Tensor) -> Tensor:
    """The shortest rotation from one unit axis to another, of vectors perpendicular to the first; not for opposite axes."""
    share = (vector * to_axis).sum(-1, keepdim=True) / (1.0 + (from_axis * to_axis).sum(-1, keepdim=True))
    return vector - share * (from_axis + to_axis)


def analyser_matrix(angles_deg: Figures, throughput: Figures = 1.0, extinction_ratio: Figures = math.inf) -> Tensor:
    """(K, 3) float64, or (..., 3): the intensities behind K analysers are this times a Stokes vector.

    I = t / 2 (S0 + D (S1 cos 2θ + S2 sin 2θ)), D = (ER - 1) / (ER + 1): an analyser with extinction ratio ER passes 1 / ER of the light
    that it should absorb, of all that it passes together t.
    """
    angles, passed, ratio = (torch.as_tensor(x, dtype=torch.float64) for x in (angles_deg, throughput, extinction_ratio))
    theta = 2.0 * torch.deg2rad(angles)
    contrast = 1.0 - 2.0 / (ratio + 1.0)  # finite for ER = inf, too
    return 0.5 * passed[..., None] * torch.stack([torch.ones_like(theta), contrast * torch.cos(theta), contrast * torch.sin(theta)], -1)


def stokes_to_intensities(
    stokes: Tensor, angles_deg: Sequence[float], throughput: Figures = 1.0, extinction_ratio: Figures = math.inf
) -> Tensor:
    """(..., 3) Stokes S0, S1, S2 → (..., K) intensities behind analysers (see ``analyser_matrix``)."""
    return stokes @ analyser_matrix(angles_deg, throughput, extinction_ratio).to(stokes).T


def intensities_to_stokes(
    intensities: Tensor, angles_deg: Sequence[float], throughput: Figures = 1.0, extinction_ratio: Figures = math.inf
) -> Tensor:
    """(..., K) intensities → (..., 3) Stokes vectors, least squares over the K analysers (K ≥ 3 distinct angles)."""
    return intensities @ torch.linalg.pinv(analyser_matrix(angles_deg, throughput, extinction_ratio)).to(intensities).T


def closure(intensities: Tensor, angles_deg: Sequence[float]) -> Tensor:
    """What no Stokes vector explains, (..., K) → (..., K - 3): for 0, 45, 90, 135 degrees ½ (I0 - I45 + I90 - I135).

    Of a linear camera it is noise: with independent noise of σ in each intensity, each number has σ, too. A black level, a
    non-linearity or angles in the wrong order show as a mean that is not 0 or a spread that follows the light.
    """
    matrix = analyser_matrix(angles_deg)
    unexplained = torch.linalg.qr(matrix, mode="complete").Q[:, 3:]
    sign = torch.sign(unexplained[0]).where(unexplained[0] != 0, torch.ones(()))
    return intensities @ (unexplained * sign).to(intensities)


# --- coherency tensors and frames


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


def coherency_to_stokes(coherency: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """J (..., 3, 3) → Stokes (..., 3) in the frame of unit vectors x ⟂ y (..., 3), both perpendicular to the ray."""
    jx, jy = (coherency @ x[..., None])[..., 0], (coherency @ y[..., None])[..., 0]
    xx, yy, xy = (x * jx).sum(-1), (y * jy).sum(-1), (x * jy).sum(-1)
    return torch.stack([xx + yy, xx - yy, 2.0 * xy], -1)


def stokes_to_coherency(stokes: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Stokes (..., 3) in the frame x ⟂ y (..., 3) → the J (..., 3, 3) of transverse light; PSD where DoLP ≤ 1."""
    s0, s1, s2 = (s[..., None, None] for s in stokes.unbind(-1))
    outer = lambda a, b: a[..., :, None] * b[..., None, :]
    return 0.5 * ((s0 + s1) * outer(x, x) + (s0 - s1) * outer(y, y) + s2 * (outer(x, y) + outer(y, x)))


def rotate_stokes(stokes: Tensor, angle: Tensor) -> Tensor:
    """The same light (..., 3) in a frame turned by ``angle`` (...) [rad] from x towards y: AoLP falls by the angle."""
    c, s = torch.cos(2.0 * angle), torch.sin(2.0 * angle)
    s0, s1, s2 = stokes.unbind(-1)
    return torch.stack(torch.broadcast_tensors(s0, c * s1 + s * s2, c * s2 - s * s1), -1)


def frame_angle(x: Tensor, y: Tensor, to_x: Tensor) -> Tensor:
    """Signed angle (...) [rad] from x towards y at which ``to_x`` stands; all (..., 3), in one plane."""
    return torch.atan2((to_x * y).sum(-1), (to_x * x).sum(-1))


def flip_stokes(stokes: Tensor) -> Tensor:
    """Stokes of a picture that was mirrored, left to right or top to bottom: the pixels are moved by the caller, S2 turns its sign."""
    return stokes * stokes.new_tensor([1.0, 1.0, -1.0])


def resample_stokes(image: Tensor, pixels: Tensor, turn: Tensor) -> Tensor:
    """A picture of Stokes vectors as another camera has it, bilinear.

    Args:
        image: (B, 3, H, W). pixels: (B, H', W', 2) where in it each new pixel looks, column and row, centres at integers.
        turn: (B, H', W') [rad] from the image's x̂ towards its ŷ to the new pixel's x̂, see ``frame_angle``.
    Returns:
        (B, 3, H', W'), 0 (no light) outside of the image. Differentiable.
    """
    from kornia.geometry.transform import remap  # a second to import

    found = remap(image, pixels[..., 0], pixels[..., 1], align_corners=True)
    return rotate_stokes(found.movedim(1, -1), turn).movedim(-1, 1)


# --- degree and angle


def degree_of_linear_polarization(stokes: Tensor, intensity_sd: Tensor | float = 0.0) -> Tensor:
    """DoLP = √(S1² + S2²) / S0, (..., 3) → (...); 0 where there is no light (S0 ≤ 0), with a gradient of 0 where there is no polarization.

    Args:
        intensity_sd: standard deviation of the noise of one intensity behind each of the four analysers 0, 45, 90, 135 degrees. Noise alone
            makes light look polarized: √(p² - σ_p²), σ_p² = 2 σ² / S0² (1 + p² / 2), is without that bias (Wardle and Kronberg 1974).
    """
    s0 = stokes[..., 0]
    lit = s0 > 0
    safe = torch.where(lit, s0, 1.0)
    degree = torch.linalg.vector_norm(stokes[..., 1:], dim=-1) / safe
    if not (isinstance(intensity_sd, float) and intensity_sd == 0.0):
        square = degree**2 - 2.0 * (intensity_sd / safe) ** 2 * (1.0 + 0.5 * degree**2)
        degree = torch.sqrt(torch.where(square > 0, square, 1.0)) * (square > 0)
    return torch.where(lit, degree, 0.0)


def angle_of_linear_polarization(stokes: Tensor) -> Tensor:
    """AoLP = ½ atan2(S2, S1) in [-90, 90] degrees, (..., 3) → (...). For display and circular metrics only: never average angles."""
    return torch.rad2deg(0.5 * torch.atan2(stokes[..., 2], stokes[..., 1]))


def aolp_sd(stokes: Tensor, intensity_sd: Tensor | float) -> Tensor:
    """Standard deviation of AoLP [degrees] from noise of ``intensity_sd`` in each of four intensities: √2 σ / (2 p S0), small noise."""
    strength = torch.linalg.vector_norm(stokes[..., 1:], dim=-1)
    return torch.rad2deg(2.0**0.5 * intensity_sd / (2.0 * strength))


def aolp_difference(a_deg: Tensor, b_deg: Tensor) -> Tensor:
    """a - b of two AoLP, signed, in [-90, 90) degrees."""
    return torch.remainder(a_deg - b_deg + 90.0, 180.0) - 90.0


def aolp_mean(angles_deg: Tensor, weights: Tensor | None = None) -> Tensor:
    """Circular mean ½ arg Σ w exp(2iψ) of AoLP over all elements [degrees], in [-90, 90]; NaN where there is no direction."""
    doubled = torch.deg2rad(2.0 * angles_deg)
    w = torch.ones_like(doubled) if weights is None else weights
    c, s = (w * torch.cos(doubled)).sum(), (w * torch.sin(doubled)).sum()
    known = torch.hypot(c, s) > 1e-12 * w.abs().sum()
    return torch.where(known, torch.rad2deg(0.5 * torch.atan2(s, c)), torch.nan)


def aolp_mae(a_deg: Tensor, b_deg: Tensor, weights: Tensor | None = None) -> Tensor:
    """Mean absolute circular difference [degrees], in [0, 90]; weighted, by DoLP or S0 DoLP for instance."""
    error = aolp_difference(a_deg, b_deg).abs()
    w = torch.ones_like(error) if weights is None else weights
    return (w * error).sum() / w.sum()
