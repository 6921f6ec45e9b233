"""Rays through the field in Triton: to all their samples and the distances there in one kernel, without the host.

A program has ``LANES`` rays under way, one per lane. In each round every lane goes to the next sample of its ray, and the surface is
evaluated there for all of them; a lane whose ray has ended takes the next ray of a queue, a counter in memory. What a ray
gives does not depend on the lane that takes it. Samples of a ray are the columns of (MAX_SAMPLES, R) arrays.
"""

from __future__ import annotations

from mmsynth.field.kernels.cuda.shared import (
    ALONG_FACE,
    FACE_OVERSHOOT,
    LEAST_ADVANCE,
    LN2,
    LONGEST_STEP,
    MAX_SAMPLES,
    NO_CROSSING,
    OUTSIDE,
    SOFT_SURFACE,
    SOLID,
    STAGES,
    contracted,
    jit,
    position,
    tl,
)
from mmsynth.field.kernels.cuda.surface import distance

LANES = 64  # rays under way per program, which waits for the slowest of them at every sample


@jit
def _softplus(x):  # type: ignore[no-untyped-def]
    """log(1 + eˣ) in double. Triton has no log1p of its own: below 1e-3 its series, exact to 2e-13 like the logarithm above."""
    e = tl.exp(-tl.abs(x))
    log1p = tl.where(e < 1e-3, e * (1.0 - e * (0.5 - e * (1.0 / 3.0 - e * 0.25))), tl.log(1.0 + e))
    return tl.maximum(x, 0.0) + log1p


@jit
def optical_depth(f0, f1, sharpness, first):  # type: ignore[no-untyped-def]
    """Optical depth of sections with sdf f0, f1 at their ends, see ``reference.section_depth``."""
    # double: at s = 1e6 single precision would leave 0.1 of noise in the difference
    before = _softplus(-sharpness * f0.to(tl.float64))
    rise = _softplus(-sharpness * f1.to(tl.float64)) - before
    rise = tl.where(rise < 0.0, 0.0, rise)  # not a maximum, which would hide NaN
    return tl.where(first & (before > LN2), rise + (before - LN2), rise).to(tl.float32)


@jit
def _cell(x, half, extent, grid):  # type: ignore[no-untyped-def]
    return tl.minimum(tl.maximum(((x + extent) * half).to(tl.int32), 0), grid - 1)


@jit
def _leave(x, velocity, cell, half, extent):  # type: ignore[no-untyped-def]
    """Ray distance to the face of the cell ahead, along one axis."""
    face = (cell + (velocity > 0.0).to(tl.int32)).to(tl.float32) / half - extent
    return tl.where(tl.abs(velocity) > ALONG_FACE, (face - x) / velocity, NO_CROSSING)


@jit
def _advance(ox, oy, oz, dx, dy, dz, t, far, jitter, states, grid, half, extent, step, CONTRACTED: tl.constexpr):  # type: ignore[no-untyped-def]
    """See ``reference._advance``: t, position, distance from the centre, speed, state. Only t is meant where t is not before far."""
    ahead = t < far
    entered = t < t  # nowhere yet
    speed = tl.zeros_like(t) + 1.0
    reach = tl.zeros_like(t) + 1.0
    state = tl.zeros_like(t).to(tl.int32)
    while tl.max(ahead.to(tl.int32), 0) > 0:
        # of a ray that has arrived, this finds the same again
        x, y, z, reach = contracted(ox + dx * t, oy + dy * t, oz + dz * t, CONTRACTED)
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
        leave = tl.maximum(leave, (state - OUTSIDE).to(tl.float32) / (2.0 * half * speed)) + step / speed * FACE_OVERSHOOT
        if CONTRACTED:
            leave = tl.minimum(leave, reach * LONGEST_STEP)
        t = tl.where(outside, tl.maximum(t + leave, t * LEAST_ADVANCE), t)
        entered = entered | outside
        ahead = outside & (t < far)
    # a ray enters a shell at a random place, so that samples do not all lie on the faces of cells
    t = tl.where(entered & (t < far), t + jitter * step / speed, t)
    x, y, z, _ = contracted(ox + dx * t, oy + dy * t, oz + dz * t, CONTRACTED)
    return t, x, y, z, reach, speed, state


@jit
def march_kernel(  # type: ignore[no-untyped-def]
    origins, directions, nears, fars, jitters, states, queue, found, counts, sharpness_at, step_at,
    scale, inner, outer, table, resolutions, offsets, hidden, output, rays, width, active, grid, extent,
    sphere_step_factor, min_slope, max_optical_depth,
    CONTRACTED: tl.constexpr, UNITS: tl.constexpr, FEATURES: tl.constexpr, LANES: tl.constexpr, HIDDEN: tl.constexpr,
):  # fmt: skip
    """See ``reference.march``.

    queue: (2,) int32, zeros: the next ray, and samples of all rays. found: (3, MAX_SAMPLES, rays): ray distance of each sample, distance of
    the surface, optical depth of the section that ends there. counts: (rays,) int32, samples.
    """
    sharpness, step = tl.load(sharpness_at), tl.load(step_at).to(tl.float32)
    soft = (1.0 / sharpness * SOFT_SURFACE).to(tl.float32)
    half = 0.5 * grid / extent
    plane = rays * MAX_SAMPLES
    zero = tl.zeros([LANES], tl.float32)
    idle = zero == 0.0
    ray = zero.to(tl.int32)
    k = ray
    ox, oy, oz, dx, dy, dz = zero, zero, zero, zero, zero, zero
    t, far, jitter, depth, t0, f0 = zero, zero, zero, zero, zero, zero
    going = idle
    samples = 0
    while tl.max(going.to(tl.int32), 0) > 0:
        ray = tl.where(idle, tl.atomic_add(queue + tl.zeros([LANES], tl.int32), 1, mask=idle, sem="relaxed"), ray)
        fresh = idle & (ray < rays)
        nx, ny, nz = position(origins, ray, fresh)
        ox, oy, oz = tl.where(fresh, nx, ox), tl.where(fresh, ny, oy), tl.where(fresh, nz, oz)
        nx, ny, nz = position(directions, ray, fresh)
        dx, dy, dz = tl.where(fresh, nx, dx), tl.where(fresh, ny, dy), tl.where(fresh, nz, dz)
        far = tl.where(fresh, tl.load(fars + ray, mask=fresh, other=0.0), far)
        jitter = tl.where(fresh, tl.load(jitters + ray, mask=fresh, other=0.0), jitter)
        t = tl.where(fresh, tl.load(nears + ray, mask=fresh, other=0.0) + jitter * step, t)
        k = tl.where(fresh, 0, k)
        depth = tl.where(fresh, 0.0, depth)
        # lanes without a ray are where their last one ended, and stay
        t = tl.where(ray < rays, t, far)
        t, x, y, z, reach, speed, state = _advance(ox, oy, oz, dx, dy, dz, t, far, jitter, states, grid, half, extent, step, CONTRACTED)
        met = (ray < rays) & (t < far)
        f = distance(x, y, z, met, table, resolutions, offsets, active, scale, hidden, width, output, inner, outer, UNITS, HIDDEN, FEATURES)
        later = met & (k > 0)
        tau = tl.where(later, optical_depth(f0, f, sharpness, k == 1), 0.0)
        depth += tau
        at = found + k * rays + ray
        tl.store(at, t, mask=met)
        tl.store(at + plane, f, mask=met)
        tl.store(at + 2 * plane, tau, mask=met)
        slope = tl.where(later, (f0 - f) / tl.where(later, (t - t0) * speed, 1.0), 1.0)
        jump = step / tl.maximum(slope, min_slope / (1 << tl.maximum(k * STAGES // MAX_SAMPLES - 1, 0)).to(tl.float32))
        jump = tl.where(f > 0.0, tl.maximum(jump, sphere_step_factor * (f - soft)), jump) / speed
        if CONTRACTED:
            jump = tl.minimum(jump, reach * LONGEST_STEP)
        k += met.to(tl.int32)
        samples += tl.sum(met.to(tl.int32), 0)
        going = met & (depth <= max_optical_depth) & ~((state == SOLID) & later) & (k < MAX_SAMPLES)
        tl.store(counts + ray, k, mask=(ray < rays) & ~going)
        t0, f0 = tl.where(met, t, t0), tl.where(met, f, f0)
        t = tl.where(going, t + jump, far)
        idle = (ray < rays) & ~going
        going = going | idle
    tl.atomic_add(queue + 1, samples, sem="relaxed")
