"""The operations for NVIDIA GPUs, compiled by Triton.

The encoding runs over (block of samples, group of levels), levels on the slow axis of the grid: the tables of one group stay
in the L2 cache while all samples pass, and a sample's part of a group is one 32-byte sector. Its backward pass adds to the
table with float32 atomics, whose order differs from run to run: gradients of the table are *not* bit-deterministic, by about
float32 rounding. Everything else here is: the other operations use no atomics. Weights and optical depths are computed in double
precision inside, as on the CPU.

Rays march in rounds: one kernel takes every ray to its next sample, the surface is evaluated there. Rays that have ended idle
until the next time that the host asks how many are left.

The module imports anywhere; ``available`` says whether its operations can run. With TRITON_INTERPRET=1 in the environment
before triton is first imported they run, slowly, on CPU tensors: that is how they are tested without a GPU.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from mmsynth.field.kernels.reference import _ONWARD, _SKIP, MOST

if TYPE_CHECKING:
    from mmsynth.field.rendering import Sampling
    from mmsynth.field.surface import Surface

try:
    import triton
    import triton.language as tl
except ImportError:
    triton = tl = None

__all__ = ["available", "hash_encode", "march", "section_weights", "surface_value"]

_BLOCK = 128  # samples per program: one per thread at Triton's default of four warps
_LEVELS = 2  # levels per program: with four features, the 32-byte sector of a sample's row, written and read as a whole
_RAYS, _SAMPLES = 4, 32  # rays per program and samples per step: one warp per ray, neighbouring lanes on neighbouring samples
_LANES = 32  # rays per program while marching: one warp, which ends when its slowest ray has met a cell
_ROUNDS = 4  # of marching between two times that the host asks which rays are left


def _jit(function: Any) -> Any:
    """``triton.jit`` that compiles once, not anew for sizes that happen to be 1 or multiples of 16; a no-op without triton."""
    return function if triton is None else triton.jit(do_not_specialize=["count", "rays", "levels", "active", "k", "grid"])(function)


@_jit
def _position(positions, i, live):  # type: ignore[no-untyped-def]
    x = tl.load(positions + 3 * i, mask=live, other=0.0)
    y = tl.load(positions + 3 * i + 1, mask=live, other=0.0)
    z = tl.load(positions + 3 * i + 2, mask=live, other=0.0)
    return x, y, z


@_jit
def _level(resolutions, offsets, level, used):  # type: ignore[no-untyped-def]
    """Of one level: cells per axis, first row, whether it is dense, mask of the hash, and what a step along x, y, z multiplies."""
    resolution = tl.load(resolutions + level, mask=used, other=1)
    begin = tl.load(offsets + level, mask=used, other=0)
    rows = tl.load(offsets + level + 1, mask=used, other=1) - begin
    side = resolution + 1
    dense = side * side * side <= rows
    # uint32 throughout: products wrap, as the hash wants, and the low bits are those of the reference's int64
    step_x = tl.where(dense, side * side, 1).to(tl.uint32)
    step_y = tl.where(dense, side, 2654435761).to(tl.uint32)
    step_z = tl.where(dense, 1, 805459861).to(tl.uint32)
    return resolution.to(tl.float32), begin, dense, (rows - 1).to(tl.uint32), step_x, step_y, step_z


@_jit
def _axis(unit, resolution, step):  # type: ignore[no-untyped-def]
    """Along one axis: the share of the cell's index in the row number, and where in the cell the position is."""
    scaled = unit * resolution
    # NaN > 0 is false: even then the cell is within the table
    base = tl.where(scaled > 0.0, tl.minimum(tl.floor(scaled), resolution - 1.0), 0.0)
    return tl.mul(base.to(tl.int32).to(tl.uint32), step, sanitize_overflow=False), scaled - base


@_jit
def _row(x, y, z, step_x, step_y, step_z, dense, mask, CORNER: tl.constexpr):  # type: ignore[no-untyped-def]
    """Row within the level of one of the eight corners, z fastest. Dense and hashed levels differ in + and ^ alone."""
    if CORNER & 4:
        x = tl.add(x, step_x, sanitize_overflow=False)
    if CORNER & 2:
        y = tl.add(y, step_y, sanitize_overflow=False)
    if CORNER & 1:
        z = tl.add(z, step_z, sanitize_overflow=False)
    total = tl.add(tl.add(x, y, sanitize_overflow=False), z, sanitize_overflow=False)
    return tl.where(dense, total, (x ^ y ^ z) & mask).to(tl.int32)


@_jit
def _weight(x, y, z, CORNER: tl.constexpr):  # type: ignore[no-untyped-def]
    """Trilinear weight of one corner."""
    wx = x if CORNER & 4 else 1.0 - x
    wy = y if CORNER & 2 else 1.0 - y
    wz = z if CORNER & 1 else 1.0 - z
    return wx * wy * wz


@_jit
def _interpolate(ux, uy, uz, table, resolutions, offsets, level, used, live, FEATURES: tl.constexpr):  # type: ignore[no-untyped-def]
    """Features of one level at unit positions, (BLOCK, FEATURES); zeros where not ``live`` and for an unused level."""
    resolution, begin, dense, mask, step_x, step_y, step_z = _level(resolutions, offsets, level, used)
    x, fx = _axis(ux, resolution, step_x)
    y, fy = _axis(uy, resolution, step_y)
    z, fz = _axis(uz, resolution, step_z)
    feature = tl.arange(0, FEATURES)[None, :]
    rows = table + begin * FEATURES
    here = (live & used)[:, None]
    value = tl.zeros([ux.shape[0], FEATURES], tl.float32)
    for c in tl.static_range(8):
        row = _row(x, y, z, step_x, step_y, step_z, dense, mask, c)
        # the features of a row are one vector load
        value += _weight(fx, fy, fz, c)[:, None] * tl.load(rows + row[:, None] * FEATURES + feature, mask=here, other=0.0)
    return value


@_jit
def _encode(  # type: ignore[no-untyped-def]
    positions, table, resolutions, offsets, out, count, levels, active,
    FEATURES: tl.constexpr, BLOCK: tl.constexpr, LEVELS: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = i < count
    x, y, z = _position(positions, i, live)
    feature = tl.arange(0, FEATURES)[None, :]
    for k in tl.static_range(LEVELS):
        level = tl.program_id(1) * LEVELS + k
        value = _interpolate(x, y, z, table, resolutions, offsets, level, level < active, live, FEATURES)
        tl.store(out + (i * levels + level)[:, None] * FEATURES + feature, value, mask=(live & (level < levels))[:, None])


@_jit
def _encode_backward(  # type: ignore[no-untyped-def]
    positions, gradient, stride, resolutions, offsets, out, count, active,
    FEATURES: tl.constexpr, BLOCK: tl.constexpr, LEVELS: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = i < count
    ux, uy, uz = _position(positions, i, live)
    feature = tl.arange(0, FEATURES)[None, :]
    for k in tl.static_range(LEVELS):
        level = tl.program_id(1) * LEVELS + k
        used = level < active
        resolution, begin, dense, mask, step_x, step_y, step_z = _level(resolutions, offsets, level, used)
        x, fx = _axis(ux, resolution, step_x)
        y, fy = _axis(uy, resolution, step_y)
        z, fz = _axis(uz, resolution, step_z)
        g = tl.load(gradient + (i * stride + level * FEATURES)[:, None] + feature, mask=(live & used)[:, None], other=0.0)
        # most samples of a ray lie in empty space and have no gradient; NaN != 0, so that one is passed on
        some = (tl.sum((g != 0.0).to(tl.int32), 1) > 0)[:, None]
        rows = out + begin * FEATURES
        for c in tl.static_range(8):
            row = _row(x, y, z, step_x, step_y, step_z, dense, mask, c)
            tl.atomic_add(rows + row[:, None] * FEATURES + feature, _weight(fx, fy, fz, c)[:, None] * g, mask=some, sem="relaxed")


@_jit
def _encode_backward_positions(  # type: ignore[no-untyped-def]
    positions, table, gradient, stride, resolutions, offsets, out, count, active, FEATURES: tl.constexpr, BLOCK: tl.constexpr
):
    """A program does all levels, so that a position's gradient is one sum and needs no atomics."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = i < count
    ux, uy, uz = _position(positions, i, live)
    feature = tl.arange(0, FEATURES)[None, :]
    gx = tl.zeros([BLOCK], tl.float32)
    gy = tl.zeros([BLOCK], tl.float32)
    gz = tl.zeros([BLOCK], tl.float32)
    for level in range(0, active):
        resolution, begin, dense, mask, step_x, step_y, step_z = _level(resolutions, offsets, level, level < active)
        x, fx = _axis(ux, resolution, step_x)
        y, fy = _axis(uy, resolution, step_y)
        z, fz = _axis(uz, resolution, step_z)
        g = tl.load(gradient + (i * stride + level * FEATURES)[:, None] + feature, mask=live[:, None], other=0.0)
        rows = table + begin * FEATURES
        for c in tl.static_range(8):
            row = _row(x, y, z, step_x, step_y, step_z, dense, mask, c)
            value = tl.sum(g * tl.load(rows + row[:, None] * FEATURES + feature, mask=live[:, None], other=0.0), 1) * resolution
            wx = fx if c & 4 else 1.0 - fx
            wy = fy if c & 2 else 1.0 - fy
            wz = fz if c & 1 else 1.0 - fz
            gx += value * (wy * wz) * (1.0 if c & 4 else -1.0)
            gy += value * (wx * wz) * (1.0 if c & 2 else -1.0)
            gz += value * (wx * wy) * (1.0 if c & 1 else -1.0)
    tl.store(out + 3 * i, gx, mask=live)
    tl.store(out + 3 * i + 1, gy, mask=live)
    tl.store(out + 3 * i + 2, gz, mask=live)


@_jit
def _softplus(x):  # type: ignore[no-untyped-def]
    """log(1 + eˣ) in double. Triton has no log1p of its own: below 1e-3 its series, exact to 2e-13 like the logarithm above."""
    e = tl.exp(-tl.abs(x))
    log1p = tl.where(e < 1e-3, e * (1.0 - e * (0.5 - e * (1.0 / 3.0 - e * 0.25))), tl.log(1.0 + e))
    return tl.maximum(x, 0.0) + log1p


@_jit
def _sigmoid(x):  # type: ignore[no-untyped-def]
    e = tl.exp(-tl.abs(x))
    return tl.where(x >= 0.0, 1.0, e) / (1.0 + e)


@_jit
def _opacity(tau):  # type: ignore[no-untyped-def]
    """1 - e^-τ in double, for τ >= 0; the series as in ``_softplus``."""
    return tl.where(tau < 1e-3, tau * (1.0 - tau * (0.5 - tau * (1.0 / 6.0 - tau * (1.0 / 24.0)))), 1.0 - tl.exp(-tau))


@_jit
def _depth(f0, f1, sharpness, section):  # type: ignore[no-untyped-def]
    """Optical depth of sections with sdf f0, f1 at their ends, in double; 0 where there is no section."""
    # double: at s = 1e6 single precision would leave 0.1 of noise in the difference
    tau = _softplus(-sharpness * f1.to(tl.float64)) - _softplus(-sharpness * f0.to(tl.float64))
    return tl.where(section & ~(tau < 0.0), tau, 0.0)  # not a maximum, which would hide NaN


@_jit
def _sections(sdf, sharpness: tl.float64, offsets, weights, crossing, rays, RAYS: tl.constexpr, SAMPLES: tl.constexpr):  # type: ignore[no-untyped-def]
    ray = tl.program_id(0) * RAYS + tl.arange(0, RAYS)
    begin = tl.load(offsets + ray, mask=ray < rays, other=0)
    end = tl.load(offsets + ray + 1, mask=ray < rays, other=0)
    depth = tl.zeros([RAYS], tl.float64)
    for start in range(0, tl.max(end - begin, 0), SAMPLES):
        i = begin[:, None] + (start + tl.arange(0, SAMPLES))[None, :]
        live = i < end[:, None]
        section = i + 1 < end[:, None]
        f0 = tl.load(sdf + i, mask=live, other=0.0)
        f1 = tl.load(sdf + i + 1, mask=section, other=0.0)
        tau = _depth(f0, f1, sharpness, section)
        before = depth[:, None] + (tl.cumsum(tau, 1) - tau)
        tl.store(weights + i, tl.where(section, tl.exp(-before) * _opacity(tau), 0.0).to(tl.float32), mask=live)
        crosses = section & (f0 > 0.0) & (f1 <= 0.0)
        tl.store(crossing + i, tl.where(crosses, f0 / tl.where(crosses, f0 - f1, 1.0), 0.5), mask=live)
        depth += tl.sum(tau, 1)


@_jit
def _sections_backward(sdf, sharpness: tl.float64, offsets, gradient, out, rays, RAYS: tl.constexpr, SAMPLES: tl.constexpr):  # type: ignore[no-untyped-def]
    """dL/df of a sample is s σ(-s f) (dL/dτ of the section it starts - dL/dτ of the one it ends).

    dL/dτᵢ = gᵢ Tᵢ e^-τᵢ - Σ_{j>i} gⱼ wⱼ, the sum being the ray's total less what has passed: one pass for the total, one for the rest.
    """
    ray = tl.program_id(0) * RAYS + tl.arange(0, RAYS)
    begin = tl.load(offsets + ray, mask=ray < rays, other=0)
    end = tl.load(offsets + ray + 1, mask=ray < rays, other=0)
    longest = tl.max(end - begin, 0)
    depth = tl.zeros([RAYS], tl.float64)
    total = tl.zeros([RAYS], tl.float64)
    for start in range(0, longest, SAMPLES):
        i = begin[:, None] + (start + tl.arange(0, SAMPLES))[None, :]
        section = i + 1 < end[:, None]
        f0 = tl.load(sdf + i, mask=section, other=0.0)
        f1 = tl.load(sdf + i + 1, mask=section, other=0.0)
        g = tl.load(gradient + i, mask=section, other=0.0).to(tl.float64)
        tau = _depth(f0, f1, sharpness, section)
        before = depth[:, None] + (tl.cumsum(tau, 1) - tau)
        total += tl.sum(g * tl.exp(-before) * _opacity(tau), 1)
        depth += tl.sum(tau, 1)
    depth = tl.zeros([RAYS], tl.float64)
    done = tl.zeros([RAYS], tl.float64)
    for start in range(0, longest, SAMPLES):
        i = begin[:, None] + (start + tl.arange(0, SAMPLES))[None, :]
        live = i < end[:, None]
        section = i + 1 < end[:, None]
        ending = live & (i > begin[:, None])  # a section ends here
        f = tl.load(sdf + i, mask=live, other=0.0)
        f1 = tl.load(sdf + i + 1, mask=section, other=0.0)
        f0 = tl.load(sdf + i - 1, mask=ending, other=0.0)
        g1 = tl.load(gradient + i, mask=section, other=0.0).to(tl.float64)
        g0 = tl.load(gradient + i - 1, mask=ending, other=0.0).to(tl.float64)
        tau1 = _depth(f, f1, sharpness, section)
        tau0 = _depth(f0, f, sharpness, ending)
        before = depth[:, None] + tl.cumsum(tau0, 1)
        passed0 = g0 * tl.exp(tau0 - before) * _opacity(tau0)
        behind = total[:, None] - done[:, None] - tl.cumsum(passed0, 1)
        transmittance = tl.exp(-before)
        opacity = _opacity(tau1)
        d1 = tl.where(tau1 > 0.0, g1 * transmittance * (1.0 - opacity) - (behind - g1 * transmittance * opacity), 0.0)
        d0 = tl.where(tau0 > 0.0, g0 * transmittance - behind, 0.0)
        slope = sharpness * _sigmoid(-sharpness * f.to(tl.float64))
        tl.store(out + i, (slope * (d1 - d0)).to(tl.float32), mask=live)
        depth += tl.sum(tau0, 1)
        done += tl.sum(passed0, 1)


@_jit
def _surface(  # type: ignore[no-untyped-def]
    positions, scale, inner, outer, table, resolutions, offsets, weight, last, out, count, active,
    UNITS: tl.constexpr, FEATURES: tl.constexpr, BLOCK: tl.constexpr, HIDDEN: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = i < count
    x, y, z = _position(positions, i, live)
    ux = tl.minimum(tl.maximum(x * scale + 0.5, 0.0), 1.0)
    uy = tl.minimum(tl.maximum(y * scale + 0.5, 0.0), 1.0)
    uz = tl.minimum(tl.maximum(z * scale + 0.5, 0.0), 1.0)
    unit = tl.arange(0, HIDDEN)
    exists = unit < UNITS
    inputs = weight + unit  # (inputs, units), transposed: the weights of one input are a few vector loads
    feature = tl.arange(0, FEATURES)[None, :]
    # the hidden layer grows level by level: the encoding is never stored. In float32, not on the tensor cores, whose
    # 10 bits would move the surface
    sums = tl.load(inputs + 3 * UNITS, mask=exists, other=0.0)[None, :] + tl.zeros([BLOCK, HIDDEN], tl.float32)
    sums += x[:, None] * tl.load(inputs, mask=exists, other=0.0)[None, :]
    sums += y[:, None] * tl.load(inputs + UNITS, mask=exists, other=0.0)[None, :]
    sums += z[:, None] * tl.load(inputs + 2 * UNITS, mask=exists, other=0.0)[None, :]
    for level in range(0, active):
        value = _interpolate(ux, uy, uz, table, resolutions, offsets, level, level < active, live, FEATURES)
        for f in tl.static_range(FEATURES):
            one = tl.sum(tl.where(feature == f, value, 0.0), 1)
            sums += one[:, None] * tl.load(inputs + (4 + level * FEATURES + f) * UNITS, mask=exists, other=0.0)[None, :]
    factor = tl.load(last + unit, mask=exists, other=0.0)
    network = tl.sum(tl.where(sums < 0.0, 0.0, sums) * factor[None, :], 1) + tl.load(last + UNITS)
    norm = tl.sqrt(x * x + y * y + z * z)
    tl.store(out + i, network + tl.minimum(norm - inner, outer - norm), mask=live)


@_jit
def _place(ox, oy, oz, dx, dy, dz, t, CONTRACTED: tl.constexpr):  # type: ignore[no-untyped-def]
    """Position on a ray, and its distance from the centre before contraction, at least 1."""
    x, y, z = ox + dx * t, oy + dy * t, oz + dz * t
    reach = tl.maximum(tl.sqrt(x * x + y * y + z * z), 1.0)
    if CONTRACTED:
        factor = (2.0 - 1.0 / reach) / reach
        x, y, z = x * factor, y * factor, z * factor
    return x, y, z, reach


@_jit
def _cell(x, half, extent, grid):  # type: ignore[no-untyped-def]
    return tl.minimum(tl.maximum(((x + extent) * half).to(tl.int32), 0), grid - 1)


@_jit
def _leave(x, velocity, cell, half, extent):  # type: ignore[no-untyped-def]
    """Ray distance to the face of the cell ahead, along one axis."""
    face = (cell + (velocity > 0.0).to(tl.int32)).to(tl.float32) / half - extent
    return tl.where(tl.abs(velocity) > 1e-9, (face - x) / velocity, 1e9)


@_jit
def _advance(  # type: ignore[no-untyped-def]
    ox, oy, oz, dx, dy, dz, t, far, jitter, states, grid, half, extent, step, skip, ONWARD: tl.constexpr, CONTRACTED: tl.constexpr
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
        outside = ahead & (state >= 2)
        leave = tl.minimum(_leave(x, vx, ix, half, extent), _leave(y, vy, iy, half, extent))
        leave = tl.maximum(tl.minimum(leave, _leave(z, vz, iz, half, extent)), 0.0)
        # the cell's certificate may reach beyond it
        leave = tl.maximum(leave, (state - 2).to(tl.float32) / (2.0 * half * speed)) + 0.1 * step / speed
        t = tl.where(outside, tl.maximum(t + tl.minimum(leave, skip * reach), t * ONWARD), t)
        entered = entered | outside
        ahead = outside & (t < far)
    # a ray enters a shell at a random place, so that samples do not all lie on the faces of cells
    t = tl.where(entered & (t < far), t + jitter * step / speed, t)
    x, y, z, _ = _place(ox, oy, oz, dx, dy, dz, t, CONTRACTED)
    return t, x, y, z, reach, speed, state


@_jit
def _round(  # type: ignore[no-untyped-def]
    lanes, sdf, origins, directions, fars, jitters, states, memory, found, counts, where, alive, count, rays, k, grid,
    half, extent, step, skip, stride, soft, grazing, opaque, sharpness: tl.float64,
    MOST: tl.constexpr, ONWARD: tl.constexpr, CONTRACTED: tl.constexpr, LANES: tl.constexpr,
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
    at0 = tl.load(found + ray * MOST + k - 2, mask=several, other=-1.0)
    depth = tl.load(m + 5 * rays, mask=several, other=0.0) + _depth(f0, f, sharpness, several).to(tl.float32)
    slope = tl.where(several, (f0 - f) / ((at - at0) * speed), 1.0)
    jump = step / tl.maximum(slope, grazing)
    jump = tl.where(f > 0.0, tl.maximum(jump, stride * (f - soft)), jump) / speed
    on = before & (depth <= opaque) & ~((state == 1.0) & several)
    t = tl.where(on, tl.where(sampled, at + tl.minimum(jump, skip * reach), at), far)
    ox, oy, oz = _position(origins, ray, live)
    dx, dy, dz = _position(directions, ray, live)
    jitter = tl.load(jitters + ray, mask=live, other=0.0)
    t, x, y, z, reach, speed, found_state = _advance(
        ox, oy, oz, dx, dy, dz, t, far, jitter, states, grid, half, extent, step, skip, ONWARD, CONTRACTED
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
    tl.store(found + ray * MOST + k, t, mask=met)
    tl.store(counts + ray, k + 1, mask=met)


@_jit
def _one(out):  # type: ignore[no-untyped-def]
    tl.store(out, 1.0)


@functools.cache
def _probe() -> tuple[bool, str]:
    # Triton compiles its launcher with the machine's C compiler and Python's headers: only a launch tells whether they are there
    try:
        out = torch.zeros(1, device="cuda")
        _one[(1,)](out)
        return (True, "") if out.item() == 1.0 else (False, "a triton kernel ran, but its result is wrong")
    except Exception as error:  # whatever the compiler, the driver or torch raise: the torch operations do instead
        return False, "no triton kernel can be run: " + (str(error).strip() or type(error).__name__).splitlines()[0]


def available() -> tuple[bool, str]:
    """Whether the operations can run on this machine's GPU; if not, why: one line."""
    if triton is None:
        return False, "triton is not installed"
    if not torch.cuda.is_available():
        return False, "torch sees no CUDA device"
    return _probe()


class _HashEncode(torch.autograd.Function):
    @staticmethod
    def forward(ctx, positions, table, resolutions, offsets, active):  # type: ignore[no-untyped-def]
        count, levels, features = positions.shape[0], resolutions.shape[0], table.shape[1]
        ctx.active = min(active, levels)
        ctx.rows, ctx.features = table.shape
        # the table's values matter to the gradient of the positions alone
        ctx.save_for_backward(positions, table if ctx.needs_input_grad[0] else None, resolutions, offsets)
        out = torch.empty(count, levels * features, device=table.device)
        if out.numel():
            grid = (triton.cdiv(count, _BLOCK), triton.cdiv(levels, _LEVELS))
            with torch.cuda.device_of(table):
                _encode[grid](positions, table, resolutions, offsets, out, count, levels, ctx.active, features, _BLOCK, _LEVELS)
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient):  # type: ignore[no-untyped-def]
        positions, table, resolutions, offsets = ctx.saved_tensors
        count, active, features = positions.shape[0], ctx.active, ctx.features
        to_positions = to_table = None
        if gradient.stride(1) != 1:  # a slice of wider rows is read as it is
            gradient = gradient.contiguous()
        blocks = triton.cdiv(count, _BLOCK)
        with torch.cuda.device_of(positions):
            if ctx.needs_input_grad[0]:
                to_positions = torch.empty_like(positions)
                if count:
                    _encode_backward_positions[(blocks,)](
                        positions, table, gradient, gradient.stride(0), resolutions, offsets, to_positions, count, active, features, _BLOCK
                    )
            if ctx.needs_input_grad[1]:
                to_table = torch.zeros(ctx.rows, features, device=positions.device)
                if count and active:
                    _encode_backward[(blocks, triton.cdiv(active, _LEVELS))](
                        positions, gradient, gradient.stride(0), resolutions, offsets, to_table, count, active, features, _BLOCK, _LEVELS
                    )
        return to_positions, to_table, None, None, None


class _SectionWeights(torch.autograd.Function):
    @staticmethod
    def forward(ctx, sdf, sharpness, offsets):  # type: ignore[no-untyped-def]
        weights, crossing = torch.empty_like(sdf), torch.empty_like(sdf)
        rays = offsets.shape[0] - 1
        if sdf.numel():
            with torch.cuda.device_of(sdf):
                _sections[(triton.cdiv(rays, _RAYS),)](sdf, sharpness, offsets, weights, crossing, rays, _RAYS, _SAMPLES)
        ctx.save_for_backward(sdf, offsets)
        ctx.sharpness = sharpness
        ctx.mark_non_differentiable(crossing)
        return weights, crossing

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient, _):  # type: ignore[no-untyped-def]
        sdf, offsets = ctx.saved_tensors
        out = torch.empty_like(sdf)
        rays = offsets.shape[0] - 1
        if sdf.numel():
            with torch.cuda.device_of(sdf):
                grid = (triton.cdiv(rays, _RAYS),)
                _sections_backward[grid](sdf, ctx.sharpness, offsets, gradient.contiguous(), out, rays, _RAYS, _SAMPLES)
        return out, None, None


def hash_encode(positions: Tensor, table: Tensor, resolutions: Tensor, offsets: Tensor, active: int) -> Tensor:
    """See ``reference.hash_encode``; float32, F a power of two, once differentiable in ``table`` and in ``positions``."""
    return _HashEncode.apply(positions.contiguous(), table.contiguous(), resolutions, offsets, active)


def section_weights(sdf: Tensor, sharpness: float, offsets: Tensor) -> tuple[Tensor, Tensor]:
    """See ``reference.section_weights``; float32 in and out, double inside, once differentiable in ``sdf``."""
    return _SectionWeights.apply(sdf.contiguous(), float(sharpness), offsets)


@torch.no_grad()
def surface_value(surface: Surface, positions: Tensor, active: int) -> Tensor:
    """See ``Surface.forward``; float32, in one kernel, for sampling and rendering: no gradient."""
    count, grid = positions.shape[0], surface.grid
    out = torch.empty(count, device=positions.device)
    if count:
        units, levels = surface.hidden.shape[0], grid.resolutions.shape[0]
        width = triton.next_power_of_2(units)
        warps = min(max(width // 8, 4), 16)  # 32 units a thread: they stay in registers
        with torch.cuda.device_of(out):
            _surface[(triton.cdiv(count, _BLOCK),)](
                positions.contiguous(), 0.5 / grid.extent, *(float(r) for r in surface.spheres), grid.table.contiguous(),
                grid.resolutions, grid.offsets, surface.hidden.T.contiguous(), surface.output_weight, out, count, min(active, levels),
                units, grid.table.shape[1], _BLOCK, width, num_warps=warps,
            )  # fmt: skip
    return out


@torch.no_grad()
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
) -> tuple[Tensor, Tensor, Tensor]:
    """See ``reference.march``; float32. A round is one kernel and ``sdf``; the host waits for the GPU after every ``_ROUNDS``."""
    rays, grid, s = len(origins), states.shape[0], sampling
    origins, directions, far, jitter, states = (x.contiguous() for x in (origins, directions, far, jitter, states))
    found = torch.empty(rays, MOST, device=near.device)
    memory = torch.empty(6, rays, device=near.device)
    counts = torch.zeros(rays, dtype=torch.int64, device=near.device)
    lanes = torch.arange(rays, device=near.device)
    where, alive = torch.empty(rays, 3, device=near.device), torch.empty(rays, dtype=torch.uint8, device=near.device)
    value = memory[0] = near + jitter * s.step
    for k in range(MOST if rays else 0):
        count = len(lanes)
        with torch.cuda.device_of(found):
            _round[(triton.cdiv(count, _LANES),)](
                lanes, value, origins, directions, far, jitter, states, memory, found, counts, where, alive, count, rays, k, grid,
                0.5 * grid / extent, extent, s.step, _SKIP if extent > 1 else math.inf, s.sphere_step_factor,
                3.0 / s.sharpness, s.min_slope, s.max_optical_depth, float(s.sharpness), MOST, _ONWARD, extent > 1, _LANES, num_warps=1,
            )  # fmt: skip
        if k + 1 == MOST:
            break
        if k % _ROUNDS == 0:
            left = torch.nonzero(alive[:count])[:, 0]
            if not len(left):
                break
            if len(left) < count:
                lanes, where = lanes[left], where[left]
        value = sdf(where).contiguous()
    t = found[torch.arange(MOST, device=near.device) < counts[:, None]]
    ray = torch.repeat_interleave(torch.arange(rays, device=near.device), counts, output_size=len(t))
    offsets = torch.zeros(rays + 1, dtype=torch.int64, device=near.device)
    offsets[1:] = counts.cumsum(0)
    return t, ray, offsets
