"""The operations in plain torch: the definition that the fast backends are tested against, on any device and dtype.

Symbols: N samples, R rays, L levels, T rows of all levels, F features per level. Samples are packed ray after ray;
``offsets`` (R + 1,) int64 delimits them. Section i runs from sample i to sample i + 1 of the same ray.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import softplus

PRIMES = (1, 2654435761, 805459861)
OUTSIDE, SHELL, SOLID = 0, 1, 2


def hash_encode(positions: Tensor, table: Tensor, resolutions: Tensor, offsets: Tensor, active: int) -> Tensor:
    """Multiresolution hash encoding, trilinear (Müller et al. 2022, section 3), differentiable in ``table``.

    A level whose (resolution + 1)³ corners fit its rows is stored densely, any other is hashed into a power of two of rows.

    Args:
        positions: (N, 3) in [0, 1]. table: (T, F), the rows of all levels. resolutions: (L,) int64, cells per axis.
        offsets: (L + 1,) int64, the rows of each level.
        active: levels above it are skipped and give zeros.
    Returns:
        (N, L F), level-major.
    """
    levels, features = resolutions.shape[0], table.shape[1]
    out = torch.zeros(positions.shape[0], levels, features, dtype=table.dtype, device=table.device)
    corners = torch.tensor([[(c >> 2) & 1, (c >> 1) & 1, c & 1] for c in range(8)], device=positions.device)
    for level in range(min(active, levels)):
        resolution, rows = int(resolutions[level]), table[offsets[level] : offsets[level + 1]]
        scaled = positions * resolution
        base = scaled.floor().clamp(0, resolution - 1)
        fraction = (scaled - base)[:, None]
        cell = base.long()[:, None] + corners
        if (resolution + 1) ** 3 <= len(rows):
            index = (cell[..., 0] * (resolution + 1) + cell[..., 1]) * (resolution + 1) + cell[..., 2]
        else:
            index = (cell[..., 0] * PRIMES[0]) ^ (cell[..., 1] * PRIMES[1]) ^ (cell[..., 2] * PRIMES[2])
            index = index & (len(rows) - 1)
        weight = torch.where(corners.bool(), fraction, 1 - fraction).prod(-1)
        out[:, level] = (rows[index] * weight[..., None]).sum(1)
    return out.reshape(positions.shape[0], levels * features)


def march(
    origins: Tensor, directions: Tensor, near: Tensor, far: Tensor, jitter: Tensor, states: Tensor, step: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Sample the rays where the three-state grid says a surface may be.

    Each ray is a lattice t = near + (k + jitter) step < far. Lattice points in outside cells are skipped; a point in a
    solid cell is kept and ends the ray, at its second sample at the earliest: a ray that starts inside has one section, too.

    Args:
        origins, directions: (R, 3), the grid spans [-1, 1]³. near, far, jitter: (R,). states: (G, G, G) uint8.
    Returns:
        t (N,), ray (N,) int64, offsets (R + 1,) int64.
    """
    grid = states.shape[0]
    count = int(torch.ceil((far - near).max().clamp(min=0) / step)) + 1 if near.numel() else 1
    k = torch.arange(count, device=near.device, dtype=near.dtype)
    t = near[:, None] + (k + jitter[:, None]) * step
    inside = t < far[:, None]
    point = origins[:, None] + directions[:, None] * t[..., None]
    cell = ((point + 1) * (0.5 * grid)).long().clamp(0, grid - 1)
    state = states[cell[..., 0], cell[..., 1], cell[..., 2]]
    candidate = inside & (state != OUTSIDE)
    ends = candidate & (state == SOLID) & (candidate.long().cumsum(1) >= 2)
    keep = candidate & (ends.long().cumsum(1) - ends.long() == 0)
    ray = torch.arange(near.shape[0], device=near.device)[:, None].expand_as(t)[keep]
    offsets = torch.zeros(near.shape[0] + 1, dtype=torch.int64, device=near.device)
    offsets[1:] = keep.sum(1).cumsum(0)
    return t[keep], ray, offsets


def section_weights(sdf: Tensor, sharpness: float, offsets: Tensor) -> tuple[Tensor, Tensor]:
    """Volume-rendering weight of every section, from the SDF at its ends, in log space.

    With the logistic CDF Φ of NeuS (Wang et al. 2021, eq. 10-13) the optical depth of a section is
    τ = relu(log Φ(s f₀) - log Φ(s f₁)) = relu(softplus(-s f₁) - softplus(-s f₀)) and w = T (1 - e^-τ), T = exp(-Σ τ before).
    No epsilon: empty space is exactly empty, and Σ w ≤ 1.

    Args:
        sdf: (N,). sharpness: s > 0. offsets: (R + 1,).
    Returns:
        weights: (N,) of the section that starts at each sample; 0 for the last sample of a ray. Differentiable in ``sdf``.
        crossing: (N,) where in the section the surface is, in [0, 1]: the zero of the chord, ½ where there is none. No gradient.
    """
    count = sdf.shape[0]
    last = torch.zeros(count, dtype=torch.bool, device=sdf.device)
    ends = offsets[1:][offsets[1:] > offsets[:-1]] - 1
    last[ends] = True
    following = torch.cat([sdf[1:], sdf[-1:]])
    tau = torch.relu(softplus(-sharpness * following) - softplus(-sharpness * sdf))
    tau = torch.where(last, torch.zeros_like(tau), tau)
    before = tau.cumsum(0) - tau
    ray = torch.repeat_interleave(torch.arange(offsets.shape[0] - 1, device=sdf.device), offsets[1:] - offsets[:-1])
    start = before[offsets[:-1].clamp(max=max(count - 1, 0))][ray] if count else before
    weights = torch.exp(start - before) * -torch.expm1(-tau)
    with torch.no_grad():
        crosses = (sdf > 0) & (following <= 0) & ~last
        crossing = torch.where(crosses, sdf / torch.where(crosses, sdf - following, torch.ones_like(sdf)), torch.full_like(sdf, 0.5))
    return weights, crossing


def accumulate(weights: Tensor, values: Tensor, ray: Tensor, rays: int) -> Tensor:
    """Σ over the samples of each ray of weight times value: weights (M,), values (M, F), ray (M,) → (R, F)."""
    out = torch.zeros(rays, values.shape[1], dtype=values.dtype, device=values.device)
    return out.index_add(0, ray, weights[:, None] * values)
