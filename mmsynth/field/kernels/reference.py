"""The operations in plain torch: the definition that the fast back ends are tested against, on any device and in any precision.

Symbols: N samples, R rays, L levels, T rows of all levels, F features per level. Samples are packed ray after ray;
``offsets`` (R + 1,) int64 delimits them. Section i runs from sample i to sample i + 1 of the same ray.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import softplus

from mmsynth.field.kernels.constants import (
    ALONG_FACE,
    FACE_OVERSHOOT,
    HASH_PRIMES,
    LAYER_GAP,
    LEAST_ADVANCE,
    LEAST_WEIGHT,
    LN2,
    LONGEST_STEP,
    MAX_SAMPLES_PER_RAY,
    NO_CROSSING,
    OUTSIDE,
    SHELL,
    SOFT_SURFACE,
    SOLID,
    STAGES,
)
from mmsynth.field.kernels.drawing import draw as draw  # this, ``mirroring`` and ``shading`` are of the reference, too
from mmsynth.field.kernels.drawing import odds as odds
from mmsynth.field.kernels.mirroring import mirror as mirror
from mmsynth.field.kernels.mirroring import reflect as reflect
from mmsynth.field.kernels.parameters import (
    AdamStep,
    Cells,
    GridTable,
    Hits,
    Rays,
    Samples,
    Sampling,
    SurfaceNetwork,
)
from mmsynth.field.kernels.shading import compare as compare
from mmsynth.field.kernels.shading import shade as shade

Encoding = Callable[[Tensor, Tensor, Tensor, Tensor, int], Tensor]  # see ``hash_encode``


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
            index = (cell[..., 0] * HASH_PRIMES[0]) ^ (cell[..., 1] * HASH_PRIMES[1]) ^ (cell[..., 2] * HASH_PRIMES[2])
            index = index & (len(rows) - 1)
        weight = torch.where(corners.bool(), fraction, 1 - fraction).prod(-1)
        out[:, level] = (rows[index] * weight[..., None]).sum(1)
    return out.reshape(positions.shape[0], levels * features)


def encode(positions: Tensor, grid: GridTable, hash_encode: Encoding = hash_encode) -> Tensor:
    """Features of positions in the frame of a grid, (N, 3) → (N, L F); those outside go to its border."""
    unit = (positions * (0.5 / grid.extent) + 0.5).clamp(0.0, 1.0)
    return hash_encode(unit, grid.table, grid.resolutions, grid.offsets, grid.active)


def surface_value(positions: Tensor, grid: GridTable, network: SurfaceNetwork) -> Tensor:
    """Signed distance, positive outside: (N, 3) in the frame of the grid → (N,). min(|x| - r₀, r₁ - |x|) + network(features, x)."""
    ones = torch.ones_like(positions[:, :1])
    hidden = torch.relu(torch.cat([positions, ones, encode(positions, grid)], -1) @ network.hidden.T)
    norm = torch.linalg.vector_norm(positions, dim=-1)
    spheres = torch.minimum(norm - network.inner_radius, network.outer_radius - norm)
    return hidden @ network.output[:-1] + network.output[-1] + spheres


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
        leave = torch.where(velocity.abs() > ALONG_FACE, (face - where) / velocity, torch.full_like(where, NO_CROSSING)).amin(-1)
        # the cell's certificate may reach beyond it
        leave = torch.maximum(leave.clamp(min=0.0), (state.to(t) - OUTSIDE) / (2.0 * half * speed)) + FACE_OVERSHOOT * step / speed
        if extent > 1:
            leave = torch.minimum(leave, LONGEST_STEP * reach)
        t = torch.where(skip, torch.maximum(t + leave, t * LEAST_ADVANCE), t)
        skipped |= skip
    # a ray enters a shell at a random place, so that samples do not all lie on the faces of cells
    entered = skipped & (t < far)
    t = torch.where(entered, t + jitter * step / speed, t)
    points = origins + directions * t[:, None]
    return t, contract(points) if extent > 1 else points, reach, speed, state


def classify(states: Tensor, cells: Cells, sdf: Callable[[Tensor], Tensor]) -> None:
    """States of the cells that are looked at, by the distance at their centres: shell, solid, or outside, with how far it is free.

    Args:
        states: (G, G, G) uint8, changed in place. sdf: (N, 3) → (N,).
    """
    grid, flat = states.shape[0], states.view(-1)
    again = torch.arange(cells.first, flat.shape[0], cells.every, device=flat.device)
    looked_at = again if cells.every == 1 else torch.cat([torch.nonzero(flat == SHELL)[:, 0], again])
    for part in looked_at.split(65536):
        index = torch.stack([part // (grid * grid), part // grid % grid, part % grid], -1)
        value = sdf(((index.float() + 0.5) * (2.0 / grid) - 1.0) * cells.extent)
        free = ((value - cells.margin) * cells.halves).clamp(0, 253 - OUTSIDE)
        state = torch.where(value > cells.margin, OUTSIDE + free, torch.where(value < -cells.margin, SOLID, SHELL))
        flat[part] = state.to(torch.uint8)


def march(
    sdf: Callable[[Tensor], Tensor], rays: Rays, states: Tensor, extent: float, sampling: Sampling, most: int = MAX_SAMPLES_PER_RAY
) -> Samples:
    """Sample rays where the three-state grid says that a surface may be, guided by the distance at the samples.

    Outside cells are skipped, by the distance that they certify. From a sample with distance f, a ray goes on by
    step / slope, the slope being how fast f fell since the last sample, or by ``sphere_step_factor`` (f - 3 / s) where that is longer. The
    slope counts as ``min_slope`` at the least, and as less when many samples are used up (``STAGES``). It ends in a solid cell (at its
    second sample at the earliest), at an optical depth of ``max_optical_depth``, and after ``most`` samples.

    Args:
        sdf: (N, 3) → (N,). states: (G, G, G) uint8 over [-extent, extent]³; space is contracted when extent > 1.
    """
    origins, directions, near, far, jitter = rays
    count = len(origins)
    s = sampling
    t = near + jitter * s.step
    going = torch.arange(count, device=t.device)
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
            before = last[1][here]
            depth[here] += section_depth(before.double(), f.double(), s.sharpness, torch.full_like(f, k == 1, dtype=torch.bool)).to(f)
            slope = (last[1][here] - f) / ((at - last[0][here]) * speed)
        last[0][here], last[1][here] = at, f
        jump = s.step / slope.clamp(min=s.min_slope / (1 << max(0, k * STAGES // most - 1)))
        jump = torch.where(f > 0, torch.maximum(jump, s.sphere_step_factor * (f - SOFT_SURFACE / s.sharpness)), jump) / speed
        if extent > 1:
            jump = torch.minimum(jump, LONGEST_STEP * reach)
        t[here] = at + jump
        going = here[(depth[here] <= s.max_optical_depth) & ~((state == SOLID) & (k > 0))]
        if not len(going):
            break
    if not found:
        return Samples(t[:0], going[:0], torch.zeros(count + 1, dtype=torch.int64, device=t.device))
    ray, at = torch.cat([r for r, _ in found]), torch.cat([x for _, x in found])
    order = torch.argsort(ray, stable=True)
    offsets = torch.zeros(count + 1, dtype=torch.int64, device=t.device)
    offsets[1:] = torch.bincount(ray, minlength=count).cumsum(0)
    return Samples(at[order], ray[order], offsets)


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


def section_depth(before: Tensor, after: Tensor, sharpness: float, first: Tensor) -> Tensor:
    """Optical depth τ of sections by the distances at their ends, see ``section_weights``.

    first: whether it is a ray's first: where that begins behind a surface, f₀ < 0, it has relu(log Φ(0) - log Φ(s f₀)) besides, as if it
    came from the surface. Where a ray enters the region of interest, or leaves a camera, inside of something solid, that is what it meets,
    and opacity that should not be there pulls the distance up; a difference of both ends would only turn its slope.
    """
    passed = softplus(-sharpness * before)
    return torch.relu(softplus(-sharpness * after) - passed) + torch.where(first, torch.relu(passed - LN2), torch.zeros_like(passed))


def section_weights(sdf: Tensor, sharpness: float, offsets: Tensor) -> tuple[Tensor, Tensor]:
    """Volume-rendering weight of every section, from the SDF at its ends, in log space.

    With the logistic CDF Φ of NeuS (Wang et al. 2021, eq. 10-13) the optical depth of a section is
    τ = relu(log Φ(s f₀) - log Φ(s f₁)) = relu(softplus(-s f₁) - softplus(-s f₀)) and w = T (1 - e^-τ), T = exp(-Σ τ before).
    No epsilon: empty space is exactly empty, and Σ w ≤ 1. A ray comes from the open, see ``section_depth``.

    Args:
        sdf: (N,). sharpness: s > 0. offsets: (R + 1,).
    Returns:
        weights: (N,) of the section that starts at each sample; 0 for the last sample of a ray. Differentiable in ``sdf``.
        crossing: (N,) where in the section the surface is, in [0, 1]: the zero of the chord, ½ where there is none, 0 where the ray begins
            behind it. No gradient.
    """
    count = sdf.shape[0]
    last = torch.zeros(count, dtype=torch.bool, device=sdf.device)
    ends = offsets[1:][offsets[1:] > offsets[:-1]] - 1
    last[ends] = True
    following = torch.cat([sdf[1:], sdf[-1:]])
    first = torch.zeros_like(last)
    first[offsets[:-1][offsets[1:] > offsets[:-1]]] = True
    tau = torch.where(last, torch.zeros_like(sdf), section_depth(sdf, following, sharpness, first))
    ray = torch.repeat_interleave(torch.arange(offsets.shape[0] - 1, device=sdf.device), offsets[1:] - offsets[:-1])
    weights = torch.exp(-exclusive_sum(tau, offsets, ray)) * -torch.expm1(-tau)
    with torch.no_grad():
        crosses = (sdf > 0) & (following <= 0) & ~last
        crossing = torch.where(crosses, sdf / torch.where(crosses, sdf - following, torch.ones_like(sdf)), torch.full_like(sdf, 0.5))
        crossing = torch.where(first & (sdf < 0), torch.zeros_like(sdf), crossing)
    return weights, crossing


def trace(grid: GridTable, network: SurfaceNetwork, appearance: GridTable, states: Tensor, rays: Rays, sampling: Sampling) -> Hits:
    """March, evaluate, weigh and composite the features of rays.

    Args:
        appearance: of the same extent as ``grid``. states: see ``march``. Gradients reach origins and directions of the rays with the
            samples' distances held fixed.
    """
    sdf = lambda x: surface_value(x, grid, network)
    with torch.no_grad():
        samples = march(sdf, rays, states, grid.extent, sampling)
    return composite(sdf, appearance, rays, samples, sampling)


def composite(sdf: Callable[[Tensor], Tensor], appearance: GridTable, rays: Rays, samples: Samples, sampling: Sampling) -> Hits:
    """Evaluate, weigh and composite the samples of R rays.

    Appearance is looked up where each section crosses the surface, once per section that matters; it is shaded once per surface that a ray
    meets, and these are two at the most: what is behind a gap of ``LAYER_GAP`` is apart from what is before it.
    """
    t, ray, offsets = samples
    count = len(rays.origins)

    def position(ray: Tensor, t: Tensor) -> Tensor:
        points = rays.origins[ray] + rays.directions[ray] * t[:, None]
        return contract(points) if appearance.extent > 1.0 else points

    weights, crossing = section_weights(sdf(position(ray, t)), sampling.sharpness, offsets)
    with torch.no_grad():
        # what is left of a ray that was ended goes to its last section
        before = exclusive_sum(weights, offsets, ray)
        enough = -torch.expm1(torch.tensor(-sampling.max_optical_depth))
        ends = (before + weights > enough) & ~(before > enough)
        rest = torch.where(ends, 1.0 - before - weights, torch.zeros_like(weights))
    weights = weights + rest
    opacity = weights.new_zeros(count).index_add(0, ray, weights)
    chosen = torch.nonzero(weights.detach() > sampling.min_section_weight)[:, 0]
    following = (chosen + 1).clamp(max=max(len(t) - 1, 0))
    at, w = ray[chosen], weights[chosen]
    where = torch.lerp(t[chosen], t[following], crossing[chosen])
    crossings = position(at, where)
    encoded = encode(crossings, appearance)
    second = _second_surface(crossings.detach(), at, chosen, LAYER_GAP / sampling.sharpness, count, len(t))
    behind = torch.full_like(second, -1)
    met_twice = torch.nonzero(second < len(t))[:, 0]
    behind[met_twice] = torch.arange(count, count + len(met_twice), device=second.device)
    rows = count + len(met_twice)
    row = torch.where(torch.arange(len(t), device=ray.device) < second[ray], ray, behind[ray])
    share = w.new_zeros(rows).index_add(0, row, weights)
    shown = w.new_zeros(rows).index_add(0, row[chosen], w)
    features = torch.zeros(rows, encoded.shape[1], dtype=w.dtype, device=w.device).index_add(0, row[chosen], w[:, None] * encoded)
    depth = _median_depth(t, weights.detach(), before, crossing, ray, count)
    shown = shown.clamp(min=LEAST_WEIGHT)
    distance = w.new_zeros(rows).index_add(0, row[chosen], w * where).detach() / shown.detach()
    return Hits(features / shown[:, None], share, distance, behind, opacity, depth, torch.tensor(len(t)))


def _second_surface(crossings: Tensor, ray: Tensor, section: Tensor, gap: float, rays: int, none: int) -> Tensor:
    """The section with which the second surface of each ray begins, (rays,), ``none`` where there is one at the most.

    Args:
        crossings: (K, 3) of sections that matter, in the grid's frame. ray, section: (K,) indices.
    """
    apart = torch.linalg.vector_norm(crossings[1:] - crossings[:-1], dim=-1) > gap
    begins = torch.nonzero(apart & (ray[1:] == ray[:-1]))[:, 0] + 1
    return torch.full((rays,), none, device=ray.device).scatter_reduce(0, ray[begins], section[begins], "amin")


def _median_depth(t: Tensor, weights: Tensor, before: Tensor, crossing: Tensor, ray: Tensor, rays: int) -> Tensor:
    """Ray distance at which half of the light is met, at the surface crossing of that section: (R,), NaN = no hit.

    Args:
        t, weights, before, crossing, ray: (N,) of packed samples; ``before`` is the weight in front of each section.
    """
    depth = torch.full((rays,), float("nan"), dtype=t.dtype, device=t.device)
    reached = torch.nonzero((before + weights >= 0.5) & (before < 0.5))[:, 0]
    following = (reached + 1).clamp(max=max(len(t) - 1, 0))
    return depth.index_put((ray[reached],), torch.lerp(t[reached], t[following], crossing[reached]))


@torch.no_grad()
def adam(parameter: Tensor, gradient: Tensor, first: Tensor, second: Tensor, step: AdamStep) -> None:
    """One step of Adam (Kingma and Ba 2015, algorithm 1), in place; the gradient is cleared.

    Args:
        parameter, gradient, first, second: one shape; the moments are updated.
    """
    rate, beta1, beta2, epsilon, count, sparse = step
    moved = gradient != 0 if sparse else torch.ones_like(gradient, dtype=torch.bool)
    m, v = first * beta1 + gradient * (1 - beta1), second * beta2 + gradient * gradient * (1 - beta2)
    change = m / ((v / (1 - beta2**count)).sqrt_().add_(epsilon)) * (rate / (1 - beta1**count))
    for kept, new in ((first, m), (second, v), (parameter, parameter - change)):
        kept.copy_(torch.where(moved, new, kept))
    gradient.zero_()
