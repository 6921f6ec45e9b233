"""The operations in plain torch: the definition that the fast backends are tested against, on any device and dtype.

Symbols: N samples, R rays, L levels, T rows of all levels, F features per level. Samples are packed ray after ray;
``offsets`` (R + 1,) int64 delimits them. Section i runs from sample i to sample i + 1 of the same ray.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn.functional import softplus

if TYPE_CHECKING:
    from mmsynth.field.rendering import Sampling

MOST = 96  # samples of one ray
_SKIP = 0.25  # of the distance from the centre: the longest step in contracted space
_ONWARD = 1.0 + 2.0**-22  # the least that a float32 moves on: a short step far from a ray's origin may round to none
PRIMES = (1, 2654435761, 805459861)
SHELL, SOLID, OUTSIDE = 0, 1, 2  # and more than OUTSIDE: half cells that are certainly free around the cell


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


def contract(positions: Tensor) -> Tensor:
    """All of space into a ball of radius 2 (mip-NeRF 360, Barron et al. 2022, eq. 10); the unit ball stays as it is."""
    norm = torch.linalg.vector_norm(positions, dim=-1, keepdim=True).clamp(min=1.0)
    return positions / norm * (2.0 - 1.0 / norm)


def contracted_velocity(positions: Tensor, directions: Tensor) -> Tensor:
    """Change of the contracted position per unit of distance along the directions, (N, 3)."""
    norm = torch.linalg.vector_norm(positions, dim=-1, keepdim=True).clamp(min=1.0)
    unit = positions / norm
    along = (unit * directions).sum(-1, keepdim=True)
    across = (2.0 * norm - 1.0) / norm**2
    moved = directions * across + unit * along * (1.0 / norm**2 - across)
    return torch.where(norm > 1.0, moved, directions)


def _advance(
    origins: Tensor, directions: Tensor, t: Tensor, far: Tensor, jitter: Tensor, states: Tensor, extent: float, step: float
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """The first place at or after t where a surface may be: t, position, distance from the centre, speed, state, per ray."""
    grid = states.shape[0]
    half = 0.5 * grid / extent
    t = t.clone()
    skipped = torch.zeros_like(t, dtype=torch.bool)
    while True:
        points = origins + directions * t[:, None]
        reach = torch.linalg.vector_norm(points, dim=-1).clamp(min=1.0)
        where = contract(points) if extent > 1 else points
        velocity = contracted_velocity(points, directions) if extent > 1 else directions
        speed = torch.linalg.vector_norm(velocity, dim=-1)
        cell = ((where + extent) * half).long().clamp(0, grid - 1)
        state = states[cell[:, 0], cell[:, 1], cell[:, 2]]
        skip = (t < far) & (state >= OUTSIDE)
        if not bool(skip.any()):
            break
        face = (cell + (velocity > 0)) / half - extent
        leave = torch.where(velocity.abs() > 1e-9, (face - where) / velocity, torch.full_like(where, 1e9)).amin(-1)
        # the cell's certificate may reach beyond it
        leave = torch.maximum(leave.clamp(min=0.0), (state.to(t) - OUTSIDE) / (2.0 * half * speed)) + 0.1 * step / speed
        if extent > 1:
            leave = torch.minimum(leave, _SKIP * reach)
        t = torch.where(skip, torch.maximum(t + leave, t * _ONWARD), t)
        skipped |= skip
    # a ray enters a shell at a random place, so that samples do not all lie on the faces of cells
    entered = skipped & (t < far)
    t = torch.where(entered, t + jitter * step / speed, t)
    points = origins + directions * t[:, None]
    return t, contract(points) if extent > 1 else points, reach, speed, state


def march(
    sdf: Callable[[Tensor], Tensor],
    origins: Tensor,
    directions: Tensor,
    near: Tensor,
    far: Tensor,
    jitter: Tensor,
    states: Tensor,
    extent: float,
    sampling: Sampling,
    most: int = MOST,
) -> tuple[Tensor, Tensor, Tensor]:
    """Sample rays where the three-state grid says that a surface may be, guided by the distance at the samples.

    Outside cells are skipped, by the distance that they certify. From a sample with distance f, a ray goes on by
    step / slope, the slope being how fast f fell since the last sample, or by ``stride`` (f - 3 / s) where that is longer. It
    ends in a solid cell (at its second sample at the earliest), at an optical depth of ``opaque``, and after ``most`` samples.

    Args:
        sdf: (N, 3) → (N,). origins, directions: (R, 3). near, far, jitter: (R,).
        states: (G, G, G) uint8 over [-extent, extent]³; space is contracted when extent > 1.
    Returns:
        t (N,), ray (N,) int64, offsets (R + 1,) int64.
    """
    rays = len(origins)
    s = sampling
    t = near + jitter * s.step
    going = torch.arange(rays, device=t.device)
    last = torch.zeros_like(t), torch.zeros_like(t)  # the last sample: where, distance
    depth = torch.zeros_like(t)
    found: list[tuple[Tensor, Tensor]] = []
    for k in range(most):
        here = going
        at, where, reach, speed, state = _advance(origins[here], directions[here], t[here], far[here], jitter[here], states, extent, s.step)
        alive = at < far[here]
        here, at, where, reach, speed, state = (x[alive] for x in (here, at, where, reach, speed, state))
        if not len(here):
            break
        f = sdf(where)
        found.append((here, at))
        slope = torch.ones_like(f)
        if k:
            tau = softplus(-s.sharpness * f.double()) - softplus(-s.sharpness * last[1][here].double())
            depth[here] += tau.clamp(min=0.0).to(f)
            slope = (last[1][here] - f) / ((at - last[0][here]) * speed)
        last[0][here], last[1][here] = at, f
        jump = s.step / slope.clamp(min=s.min_slope)
        jump = torch.where(f > 0, torch.maximum(jump, s.sphere_step_factor * (f - 3.0 / s.sharpness)), jump) / speed
        if extent > 1:
            jump = torch.minimum(jump, _SKIP * reach)
        t[here] = at + jump
        going = here[(depth[here] <= s.max_optical_depth) & ~((state == SOLID) & (k > 0))]
        if not len(going):
            break
    if not found:
        return t[:0], going[:0], torch.zeros(rays + 1, dtype=torch.int64, device=t.device)
    ray, at = torch.cat([r for r, _ in found]), torch.cat([x for _, x in found])
    order = torch.argsort(ray, stable=True)
    offsets = torch.zeros(rays + 1, dtype=torch.int64, device=t.device)
    offsets[1:] = torch.bincount(ray, minlength=rays).cumsum(0)
    return at[order], ray[order], offsets


def exclusive_sum(values: Tensor, offsets: Tensor, ray: Tensor) -> Tensor:
    """Sum of the values before each sample of the same ray; packed (N,), offsets (R + 1,), ray (N,)."""
    if not len(values):
        return values
    # per ray and not one long sum over all rays: in float32 that would leave an error of the size of the total
    lengths = offsets[1:] - offsets[:-1]
    padded = torch.zeros(len(lengths), int(lengths.max()) + 1, dtype=values.dtype, device=values.device)
    column = torch.arange(len(values), device=values.device) - offsets[ray]
    padded = padded.index_put((ray, column + 1), values)
    return padded.cumsum(1)[ray, column]


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
    ray = torch.repeat_interleave(torch.arange(offsets.shape[0] - 1, device=sdf.device), offsets[1:] - offsets[:-1])
    weights = torch.exp(-exclusive_sum(tau, offsets, ray)) * -torch.expm1(-tau)
    with torch.no_grad():
        crosses = (sdf > 0) & (following <= 0) & ~last
        crossing = torch.where(crosses, sdf / torch.where(crosses, sdf - following, torch.ones_like(sdf)), torch.full_like(sdf, 0.5))
    return weights, crossing


@torch.no_grad()
def adam(
    parameter: Tensor, gradient: Tensor, first: Tensor, second: Tensor, rate: float, beta1: float, beta2: float, epsilon: float, count: int
) -> None:
    """One step of Adam (Kingma and Ba 2015, algorithm 1), in place; the gradient is cleared.

    Args:
        parameter, gradient, first, second: one shape; the moments are updated. count: 1 at the first step.
    """
    first.mul_(beta1).add_(gradient, alpha=1 - beta1)
    second.mul_(beta2).addcmul_(gradient, gradient, value=1 - beta2)
    parameter.addcdiv_(first, (second / (1 - beta2**count)).sqrt_().add_(epsilon), value=-rate / (1 - beta1**count))
    gradient.zero_()
