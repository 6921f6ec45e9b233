"""Rays through the field in Triton: to all their samples and the distances there in two kernels, without the host.

The first takes each ray to where it may meet something: that is far for most, and no two are alike. A program of the second has ``LANES``
rays under way, one per lane. In each round every lane goes on towards the next sample of its ray, over ``SKIPS`` free cells at the most,
and the surface is evaluated there for all of them; a lane whose ray has ended takes the next ray of a queue, a counter in memory. What
a ray gives does not depend on the lane that takes it. Samples of a ray are the columns of (MAX_SAMPLES, R) arrays.
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

# the fastest of 17 on an H100: programs of one warp wait for nobody else, and as many as registers allow
LANES = 16  # rays under way per program, which waits for the slowest of them at every sample
PER_CORE = 8  # programs
OPTIONS = {"num_warps": 1, "num_stages": 1}
SKIPS = 2  # a lane that is not there by then goes on beside the others' next samples


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
def _skip(ox, oy, oz, dx, dy, dz, t, ahead, states, grid, half, extent, step, CONTRACTED: tl.constexpr):  # type: ignore[no-untyped-def]
    """See ``reference._advance``: of the rays that are ``ahead`` of where they arrive, those in a free cell leave it. t, distance from
    the centre, speed and state before, whether a ray left; of a ray that has arrived, this finds the same again."""
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
    return tl.where(outside, tl.maximum(t + leave, t * LEAST_ADVANCE), t), reach, speed, state, outside


@jit
def enter_kernel(  # type: ignore[no-untyped-def]
    origins, directions, nears, fars, jitters, states, queue, entries, counts, step_at, rays, grid, extent,
    CONTRACTED: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """Where rays come to the first cell that is not free, or to their ends.

    queue: (2,) int32: cleared for ``march_kernel``. entries: (rays,) ray distance. counts: (rays,) int32: -1 where the ray came through
    free cells, 0 where it begins there.
    """
    i = tl.program_id(0) * LANES + tl.arange(0, LANES)
    live = i < rays
    step = tl.load(step_at).to(tl.float32)
    half = 0.5 * grid / extent
    ox, oy, oz = position(origins, i, live)
    dx, dy, dz = position(directions, i, live)
    far = tl.load(fars + i, mask=live, other=0.0)
    t = tl.load(nears + i, mask=live, other=0.0) + tl.load(jitters + i, mask=live, other=0.0) * step
    ahead = live & (t < far)
    came = t < t
    while tl.max(ahead.to(tl.int32), 0) > 0:
        t, _, _, _, outside = _skip(ox, oy, oz, dx, dy, dz, t, ahead, states, grid, half, extent, step, CONTRACTED)
        came = came | outside
        ahead = outside & (t < far)
    tl.store(entries + i, t, mask=live)
    tl.store(counts + i, -came.to(tl.int32), mask=live)
    if tl.program_id(0) == 0:
        tl.store(queue + tl.arange(0, 2), 0)


@jit
def march_kernel(  # type: ignore[no-untyped-def]
    origins, directions, fars, jitters, states, queue, entries, found, counts, sharpness_at, step_at,
    scale, inner, outer, table, resolutions, offsets, hidden, output, rays, width, active, grid, extent,
    sphere_step_factor, min_slope, max_optical_depth,
    CONTRACTED: tl.constexpr, UNITS: tl.constexpr, FEATURES: tl.constexpr, SKIPS: tl.constexpr, LANES: tl.constexpr, HIDDEN: tl.constexpr,
):  # fmt: skip
    """See ``reference.march``.

    queue: (2,) int32, zeros: the next ray, and what ``sections.weigh_kernel`` counts. entries, counts: of ``enter_kernel``; counts become
    samples. found: (3, MAX_SAMPLES, rays): ray distance of each sample, distance of the surface, optical depth of the section that ends
    there.
    """
    sharpness, step = tl.load(sharpness_at), tl.load(step_at).to(tl.float32)
    soft = (1.0 / sharpness * SOFT_SURFACE).to(tl.float32)
    half = 0.5 * grid / extent
    plane = rays * MAX_SAMPLES
    zero = tl.zeros([LANES], tl.float32)
    busy = zero != 0.0
    came = busy
    ray = zero.to(tl.int32)
    k = ray
    ox, oy, oz, dx, dy, dz = zero, zero, zero, zero, zero, zero
    t, far, jitter, depth, t0, f0 = zero, zero, zero, zero, zero, zero
    while tl.max((ray < rays).to(tl.int32), 0) > 0:
        idle = (ray < rays) & ~busy
        ray = tl.where(idle, tl.atomic_add(queue + tl.zeros([LANES], tl.int32), 1, mask=idle, sem="relaxed"), ray)
        fresh = idle & (ray < rays)
        nx, ny, nz = position(origins, ray, fresh)
        ox, oy, oz = tl.where(fresh, nx, ox), tl.where(fresh, ny, oy), tl.where(fresh, nz, oz)
        nx, ny, nz = position(directions, ray, fresh)
        dx, dy, dz = tl.where(fresh, nx, dx), tl.where(fresh, ny, dy), tl.where(fresh, nz, dz)
        far = tl.where(fresh, tl.load(fars + ray, mask=fresh, other=0.0), far)
        jitter = tl.where(fresh, tl.load(jitters + ray, mask=fresh, other=0.0), jitter)
        t = tl.where(fresh, tl.load(entries + ray, mask=fresh, other=0.0), t)
        came = tl.where(fresh, tl.load(counts + ray, mask=fresh, other=0) < 0, came)
        k = tl.where(fresh, 0, k)
        depth = tl.where(fresh, 0.0, depth)
        # lanes without a ray are where their last one ended, and stay
        t = tl.where(ray < rays, t, far)
        ahead = t < far
        reach, speed, state = zero + 1.0, zero + 1.0, zero.to(tl.int32)
        for _ in tl.static_range(SKIPS):
            t, reach, speed, state, outside = _skip(ox, oy, oz, dx, dy, dz, t, ahead, states, grid, half, extent, step, CONTRACTED)
            came = came | outside
            ahead = outside & (t < far)
        # a ray enters a shell at a random place, so that samples do not all lie on the faces of cells
        t = tl.where(came & ~ahead & (t < far), t + jitter * step / speed, t)
        came = came & ahead
        x, y, z, _ = contracted(ox + dx * t, oy + dy * t, oz + dz * t, CONTRACTED)
        met = (ray < rays) & (t < far) & ~ahead
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
        on = met & (depth <= max_optical_depth) & ~((state == SOLID) & later) & (k < MAX_SAMPLES)
        t0, f0 = tl.where(met, t, t0), tl.where(met, f, f0)
        t = tl.where(on, t + jump, tl.where(ahead, t, far))
        busy = on | ((ray < rays) & ahead)
        tl.store(counts + ray, k, mask=(ray < rays) & ~busy)
