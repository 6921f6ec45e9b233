"""Marching in Triton, in rounds: one kernel takes every ray to its next sample, the surface is evaluated there.

Rays that have ended idle until the next time that the host asks how many are left.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from mmsynth.field.kernels.constants import LEAST_ADVANCE, LONGEST_STEP, MAX_SAMPLES_PER_RAY, SOFT_SURFACE
from mmsynth.field.kernels.cuda.sections import optical_depth
from mmsynth.field.kernels.cuda.shared import ALONG_FACE, FACE_OVERSHOOT, NO_CROSSING, OUTSIDE, SOLID, jit, position, tl, triton
from mmsynth.field.kernels.parameters import Rays, Samples, Sampling

_LANES = 32  # rays per program while marching: one warp, which ends when its slowest ray has met a cell
_ROUNDS = 4  # of marching between two times that the host asks which rays are left


@jit
def _place(ox, oy, oz, dx, dy, dz, t, CONTRACTED: tl.constexpr):  # type: ignore[no-untyped-def]
    """Position on a ray, and its distance from the centre before contraction, at least 1."""
    x, y, z = ox + dx * t, oy + dy * t, oz + dz * t
    reach = tl.maximum(tl.sqrt(x * x + y * y + z * z), 1.0)
    if CONTRACTED:
        factor = (2.0 - 1.0 / reach) / reach
        x, y, z = x * factor, y * factor, z * factor
    return x, y, z, reach


@jit
def _cell(x, half, extent, grid):  # type: ignore[no-untyped-def]
    return tl.minimum(tl.maximum(((x + extent) * half).to(tl.int32), 0), grid - 1)


@jit
def _leave(x, velocity, cell, half, extent):  # type: ignore[no-untyped-def]
    """Ray distance to the face of the cell ahead, along one axis."""
    face = (cell + (velocity > 0.0).to(tl.int32)).to(tl.float32) / half - extent
    return tl.where(tl.abs(velocity) > ALONG_FACE, (face - x) / velocity, NO_CROSSING)


@jit
def _advance(  # type: ignore[no-untyped-def]
    ox, oy, oz, dx, dy, dz, t, far, jitter, states, grid, half, extent, step, skip, LEAST_ADVANCE: tl.constexpr, CONTRACTED: tl.constexpr
):
    """See ``reference._advance``: t, position, distance from the centre, speed, state. Only t is meant where t is not before far."""
    ahead = t < far
    entered = t < t  # nowhere yet
    speed = tl.zeros_like(t) + 1.0
    reach = tl.zeros_like(t) + 1.0
    state = tl.zeros_like(t).to(tl.int32)
    while tl.max(ahead.to(tl.int32), 0) > 0:
        # of a ray that has arrived, this finds the same again
        x, y, z, reach = _place(ox, oy, oz, dx, dy, dz, t, CONTRACTED)
        vx, vy, vz = dx, dy, dz
        if CONTRACTED:
            length = 2.0 - 1.0 / reach  # of x, where it is more than 1
            ux, uy, uz = x / length, y / length, z / length
            across = (2.0 * reach - 1.0) / (reach * reach)
            radial = (ux * dx + uy * dy + uz * dz) * (1.0 / (reach * reach) - across)
            vx = tl.where(reach > 1.0, dx * across + ux * radial, dx)
            vy = tl.where(reach > 1.0, dy * across + uy * radial, dy)
            vz = tl.where(reach > 1.0, dz * across + uz * radial, dz)
        speed = tl.sqrt(vx * vx + vy * vy + vz * vz)
        ix, iy, iz = _cell(x, half, extent, grid), _cell(y, half, extent, grid), _cell(z, half, extent, grid)
        state = tl.load(states + (ix * grid + iy) * grid + iz).to(tl.int32)
        outside = ahead & (state >= OUTSIDE)
        leave = tl.minimum(_leave(x, vx, ix, half, extent), _leave(y, vy, iy, half, extent))
        leave = tl.maximum(tl.minimum(leave, _leave(z, vz, iz, half, extent)), 0.0)
        # the cell's certificate may reach beyond it
        leave = tl.maximum(leave, (state - OUTSIDE).to(tl.float32) / (2.0 * half * speed)) + FACE_OVERSHOOT * step / speed
        t = tl.where(outside, tl.maximum(t + tl.minimum(leave, skip * reach), t * LEAST_ADVANCE), t)
        entered = entered | outside
        ahead = outside & (t < far)
    # a ray enters a shell at a random place, so that samples do not all lie on the faces of cells
    t = tl.where(entered & (t < far), t + jitter * step / speed, t)
    x, y, z, _ = _place(ox, oy, oz, dx, dy, dz, t, CONTRACTED)
    return t, x, y, z, reach, speed, state


@jit
def round_kernel(  # type: ignore[no-untyped-def]
    lanes, sdf, origins, directions, fars, jitters, states, memory, found, counts, where, alive, count, rays, k, grid,
    half, extent, step, skip, sphere_step_factor, soft, min_slope, max_optical_depth, sharpness: tl.float64,
    MAX_SAMPLES_PER_RAY: tl.constexpr, LEAST_ADVANCE: tl.constexpr, CONTRACTED: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """From the distances at samples k - 1 of rays to their samples k; see ``reference.march``.

    memory: (6, rays), of the last sample of a ray: t (far when the ray has ended), speed, reach and state there, and of the sample
    before it the distance, and the optical depth up to it.
    """
    i = tl.program_id(0) * LANES + tl.arange(0, LANES)
    live = i < count
    ray = tl.load(lanes + i, mask=live, other=0)
    m = memory + ray
    at = tl.load(m, mask=live, other=0.0)
    far = tl.load(fars + ray, mask=live, other=0.0)
    before = live & (at < far)
    sampled = before & (k > 0)
    several = sampled & (k > 1)
    f = tl.load(sdf + i, mask=sampled, other=0.0)
    speed = tl.load(m + rays, mask=sampled, other=1.0)
    reach = tl.load(m + 2 * rays, mask=sampled, other=1.0)
    state = tl.load(m + 3 * rays, mask=sampled, other=0.0)
    f0 = tl.load(m + 4 * rays, mask=several, other=1.0)
    at0 = tl.load(found + ray * MAX_SAMPLES_PER_RAY + k - 2, mask=several, other=-1.0)
    depth = tl.load(m + 5 * rays, mask=several, other=0.0) + optical_depth(f0, f, sharpness, several).to(tl.float32)
    slope = tl.where(several, (f0 - f) / ((at - at0) * speed), 1.0)
    jump = step / tl.maximum(slope, min_slope)
    jump = tl.where(f > 0.0, tl.maximum(jump, sphere_step_factor * (f - soft)), jump) / speed
    on = before & (depth <= max_optical_depth) & ~((state == SOLID) & several)
    t = tl.where(on, tl.where(sampled, at + tl.minimum(jump, skip * reach), at), far)
    ox, oy, oz = position(origins, ray, live)
    dx, dy, dz = position(directions, ray, live)
    jitter = tl.load(jitters + ray, mask=live, other=0.0)
    t, x, y, z, reach, speed, found_state = _advance(
        ox, oy, oz, dx, dy, dz, t, far, jitter, states, grid, half, extent, step, skip, LEAST_ADVANCE, CONTRACTED
    )
    met = live & (t < far)
    tl.store(m, tl.where(met, t, far), mask=live)
    tl.store(alive + i, met.to(tl.uint8), mask=live)
    # of rays that have ended, a place that the surface can be asked about
    tl.store(where + 3 * i, tl.where(met, x, 0.0), mask=live)
    tl.store(where + 3 * i + 1, tl.where(met, y, 0.0), mask=live)
    tl.store(where + 3 * i + 2, tl.where(met, z, 0.0), mask=live)
    tl.store(m + rays, speed, mask=met)
    tl.store(m + 2 * rays, reach, mask=met)
    tl.store(m + 3 * rays, found_state.to(tl.float32), mask=met)
    tl.store(m + 4 * rays, f, mask=met)
    tl.store(m + 5 * rays, depth, mask=met)
    tl.store(found + ray * MAX_SAMPLES_PER_RAY + k, t, mask=met)
    tl.store(counts + ray, k + 1, mask=met)


@torch.no_grad()
def march(sdf: Callable[[Tensor], Tensor], rays: Rays, states: Tensor, extent: float, sampling: Sampling) -> Samples:
    """See ``reference.march``; float32. A round is one kernel and ``sdf``; the host waits for the GPU after every ``_ROUNDS``."""
    origins, directions, near, far, jitter = (x.contiguous() for x in rays)
    states, total, grid, s = states.contiguous(), len(origins), states.shape[0], sampling
    found = torch.empty(total, MAX_SAMPLES_PER_RAY, device=near.device)
    memory = torch.empty(6, total, device=near.device)
    counts = torch.zeros(total, dtype=torch.int64, device=near.device)
    lanes = torch.arange(total, device=near.device)
    where, alive = torch.empty(total, 3, device=near.device), torch.empty(total, dtype=torch.uint8, device=near.device)
    value = memory[0] = near + jitter * s.step
    for k in range(MAX_SAMPLES_PER_RAY if total else 0):
        count = len(lanes)
        with torch.cuda.device_of(found):
            round_kernel[(triton.cdiv(count, _LANES),)](
                lanes, value, origins, directions, far, jitter, states, memory, found, counts, where, alive, count, total, k, grid,
                0.5 * grid / extent, extent, s.step, LONGEST_STEP if extent > 1 else math.inf, s.sphere_step_factor,
                SOFT_SURFACE / s.sharpness, s.min_slope, s.max_optical_depth, float(s.sharpness),
                MAX_SAMPLES_PER_RAY, LEAST_ADVANCE, extent > 1, _LANES, num_warps=1,
            )  # fmt: skip
        if k + 1 == MAX_SAMPLES_PER_RAY:
            break
        if k % _ROUNDS == 0:
            left = torch.nonzero(alive[:count])[:, 0]
            if not len(left):
                break
            if len(left) < count:
                lanes, where = lanes[left], where[left]
        value = sdf(where).contiguous()
    t = found[torch.arange(MAX_SAMPLES_PER_RAY, device=near.device) < counts[:, None]]
    ray = torch.repeat_interleave(torch.arange(total, device=near.device), counts, output_size=len(t))
    offsets = torch.zeros(total + 1, dtype=torch.int64, device=near.device)
    offsets[1:] = counts.cumsum(0)
    return Samples(t, ray, offsets)
