"""The multiresolution hash encoding in Triton.

It runs over (block of samples, group of levels), levels on the slow axis of the grid: the tables of one group stay in the L2 cache while
all samples pass, and a sample's part of a group is one 32-byte sector. Its backward pass adds to the table with float32 atomics, whose
order differs from run to run: gradients of the table are *not* bit-deterministic, by about float32 rounding.
"""

from __future__ import annotations

import torch
from torch import Tensor

from mmsynth.field.kernels.cuda.shared import HASH_Y, HASH_Z, jit, position, tl, triton

BLOCK = 128  # samples per program: one per thread at Triton's default of four warps
_LEVELS = 2  # levels per program: with four features, the 32-byte sector of a sample's row, written and read as a whole


@jit
def _level(resolutions, offsets, level, used):  # type: ignore[no-untyped-def]
    """Of one level: cells per axis, first row, whether it is dense, mask of the hash, and what a step along x, y, z multiplies."""
    resolution = tl.load(resolutions + level, mask=used, other=1)
    begin = tl.load(offsets + level, mask=used, other=0)
    rows = tl.load(offsets + level + 1, mask=used, other=1) - begin
    side = resolution + 1
    dense = side * side * side <= rows
    # uint32 throughout: products wrap, as the hash wants, and the low bits are those of the reference's int64
    step_x = tl.where(dense, side * side, 1).to(tl.uint32)
    step_y = tl.where(dense, side, HASH_Y).to(tl.uint32)
    step_z = tl.where(dense, 1, HASH_Z).to(tl.uint32)
    return resolution.to(tl.float32), begin, dense, (rows - 1).to(tl.uint32), step_x, step_y, step_z


@jit
def _axis(unit, resolution, step):  # type: ignore[no-untyped-def]
    """Along one axis: the share of the cell's index in the row number, and where in the cell the position is."""
    scaled = unit * resolution
    # NaN > 0 is false: even then the cell is within the table
    base = tl.where(scaled > 0.0, tl.minimum(tl.floor(scaled), resolution - 1.0), 0.0)
    return tl.mul(base.to(tl.int32).to(tl.uint32), step, sanitize_overflow=False), scaled - base


@jit
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


@jit
def _weight(x, y, z, CORNER: tl.constexpr):  # type: ignore[no-untyped-def]
    """Trilinear weight of one corner."""
    wx = x if CORNER & 4 else 1.0 - x
    wy = y if CORNER & 2 else 1.0 - y
    wz = z if CORNER & 1 else 1.0 - z
    return wx * wy * wz


@jit
def interpolate(ux, uy, uz, table, resolutions, offsets, level, used, live, FEATURES: tl.constexpr):  # type: ignore[no-untyped-def]
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


@jit
def encode_kernel(  # type: ignore[no-untyped-def]
    positions, table, resolutions, offsets, out, count, levels, active,
    FEATURES: tl.constexpr, BLOCK: tl.constexpr, LEVELS: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = i < count
    x, y, z = position(positions, i, live)
    feature = tl.arange(0, FEATURES)[None, :]
    for k in tl.static_range(LEVELS):
        level = tl.program_id(1) * LEVELS + k
        value = interpolate(x, y, z, table, resolutions, offsets, level, level < active, live, FEATURES)
        tl.store(out + (i * levels + level)[:, None] * FEATURES + feature, value, mask=(live & (level < levels))[:, None])


@jit
def encode_backward_kernel(  # type: ignore[no-untyped-def]
    positions, gradient, stride, resolutions, offsets, out, count, active,
    FEATURES: tl.constexpr, BLOCK: tl.constexpr, LEVELS: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = i < count
    ux, uy, uz = position(positions, i, live)
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


@jit
def encode_positions_backward_kernel(  # type: ignore[no-untyped-def]
    positions, table, gradient, stride, resolutions, offsets, out, count, active, FEATURES: tl.constexpr, BLOCK: tl.constexpr
):
    """A program does all levels, so that a position's gradient is one sum and needs no atomics."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = i < count
    ux, uy, uz = position(positions, i, live)
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
            grid = (triton.cdiv(count, BLOCK), triton.cdiv(levels, _LEVELS))
            with torch.cuda.device_of(table):
                encode_kernel[grid](positions, table, resolutions, offsets, out, count, levels, ctx.active, features, BLOCK, _LEVELS)
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient):  # type: ignore[no-untyped-def]
        positions, table, resolutions, offsets = ctx.saved_tensors
        count, active, features = positions.shape[0], ctx.active, ctx.features
        to_positions = to_table = None
        if gradient.stride(1) != 1:  # a slice of wider rows is read as it is
            gradient = gradient.contiguous()
        blocks = triton.cdiv(count, BLOCK)
        with torch.cuda.device_of(positions):
            if ctx.needs_input_grad[0]:
                to_positions = torch.empty_like(positions)
                if count:
                    encode_positions_backward_kernel[(blocks,)](
                        positions, table, gradient, gradient.stride(0), resolutions, offsets, to_positions, count, active, features, BLOCK
                    )
            if ctx.needs_input_grad[1]:
                to_table = torch.zeros(ctx.rows, features, device=positions.device)
                if count and active:
                    encode_backward_kernel[(blocks, triton.cdiv(active, _LEVELS))](
                        positions, gradient, gradient.stride(0), resolutions, offsets, to_table, count, active, features, BLOCK, _LEVELS
                    )
        return to_positions, to_table, None, None, None


def hash_encode(positions: Tensor, table: Tensor, resolutions: Tensor, offsets: Tensor, active: int) -> Tensor:
    """See ``reference.hash_encode``; float32, F a power of two, once differentiable in ``table`` and in ``positions``."""
    return _HashEncode.apply(positions.contiguous(), table.contiguous(), resolutions, offsets, active)
