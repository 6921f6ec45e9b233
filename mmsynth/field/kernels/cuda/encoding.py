"""The multiresolution hash encoding in Triton: device functions that the fused kernels are made of, and the operation itself.

A program looks up ``COLUMNS`` features at a time, of a few levels, for a block of positions: all rows that they need are asked for at once,
which hides the latency of memory, and the features of a row are one vector load. Tables may be of 16 bits, sums are of 32.
Gradients are added to the table with float32 atomics, whose order differs from run to run: gradients of tables are *not*
bit-deterministic, by about float32 rounding.
"""

from __future__ import annotations

import torch
from torch import Tensor

from mmsynth.field.kernels.cuda.shared import COLUMNS, HASH_Y, HASH_Z, jit, position, tl, triton

BLOCK = 64  # positions per program: two threads each, at Triton's default of four warps


@jit
def unit_cube(x, y, z, scale):  # type: ignore[no-untyped-def]
    """From the frame of a grid to [0, 1]³; those outside go to its border."""
    ux = tl.minimum(tl.maximum(x * scale + 0.5, 0.0), 1.0)
    uy = tl.minimum(tl.maximum(y * scale + 0.5, 0.0), 1.0)
    uz = tl.minimum(tl.maximum(z * scale + 0.5, 0.0), 1.0)
    return ux, uy, uz


@jit
def to_frame(x, y, z, gx, gy, gz, scale):  # type: ignore[no-untyped-def]
    """Gradient to positions of the frame of a grid from that to ``unit_cube`` of them: places outside have the features of its border."""
    gx = tl.where(tl.abs(x * scale) < 0.5, gx * scale, 0.0)
    gy = tl.where(tl.abs(y * scale) < 0.5, gy * scale, 0.0)
    gz = tl.where(tl.abs(z * scale) < 0.5, gz * scale, 0.0)
    return gx, gy, gz


@jit
def _axis(unit, resolution, step):  # type: ignore[no-untyped-def]
    """Along one axis: the share of the cell's index in the row number, and where in the cell the position is."""
    scaled = unit[:, None] * resolution
    # NaN > 0 is false: even then the cell is within the table
    base = tl.where(scaled > 0.0, tl.minimum(tl.floor(scaled), resolution - 1.0), 0.0)
    return tl.mul(base.to(tl.int32).to(tl.uint32), step, sanitize_overflow=False), scaled - base


@jit
def cells(ux, uy, uz, resolutions, offsets, first, active, LEVELS: tl.constexpr):  # type: ignore[no-untyped-def]
    """The cells of positions in ``LEVELS`` levels from ``first`` on: (BLOCK, LEVELS) row shares and fractions along x, y, z; and of the
    levels (1, LEVELS): cells per axis, first row, mask of the hash, whether dense, used, and what a step along x, y, z multiplies."""
    level = first + tl.arange(0, LEVELS)[None, :]
    used = level < active
    resolution = tl.load(resolutions + level, mask=used, other=1)
    begin = tl.load(offsets + level, mask=used, other=0)
    rows = tl.load(offsets + level + 1, mask=used, other=1) - begin
    side = resolution + 1
    dense = side * side * side <= rows
    # uint32 throughout: products wrap, as the hash wants, and the low bits are those of the reference's int64
    step_x = tl.where(dense, side * side, 1).to(tl.uint32)
    step_y = tl.where(dense, side, HASH_Y).to(tl.uint32)
    step_z = tl.where(dense, 1, HASH_Z).to(tl.uint32)
    cells_per_axis = resolution.to(tl.float32)
    x, fx = _axis(ux, cells_per_axis, step_x)
    y, fy = _axis(uy, cells_per_axis, step_y)
    z, fz = _axis(uz, cells_per_axis, step_z)
    return x, y, z, fx, fy, fz, cells_per_axis, begin.to(tl.int32), (rows - 1).to(tl.uint32), dense, used, step_x, step_y, step_z


@jit
def _row(x, y, z, begin, mask, dense, step_x, step_y, step_z, CORNER: tl.constexpr):  # type: ignore[no-untyped-def]
    """Table row of one of the eight corners, z fastest. Dense and hashed levels differ in + and ^ alone."""
    if CORNER & 4:
        x = tl.add(x, step_x, sanitize_overflow=False)
    if CORNER & 2:
        y = tl.add(y, step_y, sanitize_overflow=False)
    if CORNER & 1:
        z = tl.add(z, step_z, sanitize_overflow=False)
    total = tl.add(tl.add(x, y, sanitize_overflow=False), z, sanitize_overflow=False)
    return begin + tl.where(dense, total, (x ^ y ^ z) & mask).to(tl.int32)


@jit
def _weight(x, y, z, CORNER: tl.constexpr):  # type: ignore[no-untyped-def]
    """Trilinear weight of one corner."""
    wx = x if CORNER & 4 else 1.0 - x
    wy = y if CORNER & 2 else 1.0 - y
    wz = z if CORNER & 1 else 1.0 - z
    return wx * wy * wz


@jit
def encode(ux, uy, uz, live, table, resolutions, offsets, first, active, FEATURES: tl.constexpr):  # type: ignore[no-untyped-def]
    """Features at unit positions of the levels from ``first`` on, (BLOCK, COLUMNS); zeros where not ``live`` and for an unused level."""
    LEVELS: tl.constexpr = COLUMNS // FEATURES
    x, y, z, fx, fy, fz, _, begin, mask, dense, used, step_x, step_y, step_z = cells(
        ux, uy, uz, resolutions, offsets, first, active, LEVELS
    )
    feature = tl.arange(0, FEATURES)[None, None, :]
    here = (live[:, None] & used)[:, :, None]
    value = tl.zeros([ux.shape[0], LEVELS, FEATURES], tl.float32)
    for c in tl.static_range(8):
        row = _row(x, y, z, begin, mask, dense, step_x, step_y, step_z, c)
        read = tl.load(table + row[:, :, None] * FEATURES + feature, mask=here, other=0.0)
        value += _weight(fx, fy, fz, c)[:, :, None] * read.to(tl.float32)
    return tl.reshape(value, [ux.shape[0], COLUMNS])


@jit
def scatter(ux, uy, uz, g, live, out, resolutions, offsets, first, active, FEATURES: tl.constexpr):  # type: ignore[no-untyped-def]
    """Add gradients (BLOCK, COLUMNS) of ``encode``'s features to the table's."""
    LEVELS: tl.constexpr = COLUMNS // FEATURES
    x, y, z, fx, fy, fz, _, begin, mask, dense, used, step_x, step_y, step_z = cells(
        ux, uy, uz, resolutions, offsets, first, active, LEVELS
    )
    feature = tl.arange(0, FEATURES)[None, None, :]
    g = tl.reshape(g, [ux.shape[0], LEVELS, FEATURES])
    # NaN != 0, so that one is passed on
    some = live[:, None] & used & (tl.sum((g != 0.0).to(tl.int32), 2) > 0)
    for c in tl.static_range(8):
        row = _row(x, y, z, begin, mask, dense, step_x, step_y, step_z, c)
        part = _weight(fx, fy, fz, c)[:, :, None] * g
        tl.atomic_add(out + row[:, :, None] * FEATURES + feature, part, mask=some[:, :, None], sem="relaxed")


@jit
def slope(ux, uy, uz, g, live, table, resolutions, offsets, first, active, FEATURES: tl.constexpr):  # type: ignore[no-untyped-def]
    """Gradient to unit positions from gradients (BLOCK, COLUMNS) of ``encode``'s features: x, y, z."""
    LEVELS: tl.constexpr = COLUMNS // FEATURES
    x, y, z, fx, fy, fz, scale, begin, mask, dense, used, step_x, step_y, step_z = cells(
        ux, uy, uz, resolutions, offsets, first, active, LEVELS
    )
    feature = tl.arange(0, FEATURES)[None, None, :]
    here = (live[:, None] & used)[:, :, None]
    g = tl.reshape(g, [ux.shape[0], LEVELS, FEATURES])
    gx = tl.zeros([ux.shape[0], LEVELS], tl.float32)
    gy = tl.zeros([ux.shape[0], LEVELS], tl.float32)
    gz = tl.zeros([ux.shape[0], LEVELS], tl.float32)
    for c in tl.static_range(8):
        row = _row(x, y, z, begin, mask, dense, step_x, step_y, step_z, c)
        read = tl.load(table + row[:, :, None] * FEATURES + feature, mask=here, other=0.0)
        value = tl.sum(g * read.to(tl.float32), 2) * scale
        wx = fx if c & 4 else 1.0 - fx
        wy = fy if c & 2 else 1.0 - fy
        wz = fz if c & 1 else 1.0 - fz
        gx += value * (wy * wz) * (1.0 if c & 4 else -1.0)
        gy += value * (wx * wz) * (1.0 if c & 2 else -1.0)
        gz += value * (wx * wy) * (1.0 if c & 1 else -1.0)
    return tl.sum(gx, 1), tl.sum(gy, 1), tl.sum(gz, 1)


@jit
def encode_kernel(positions, table, resolutions, offsets, out, count, width, active, FEATURES: tl.constexpr, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = i < count
    x, y, z = position(positions, i, live)
    first = tl.program_id(1) * (COLUMNS // FEATURES)
    column = first * FEATURES + tl.arange(0, COLUMNS)
    value = encode(x, y, z, live, table, resolutions, offsets, first, active, FEATURES)
    tl.store(out + i.to(tl.int64)[:, None] * width + column[None, :], value, mask=live[:, None] & (column < width)[None, :])


@jit
def encode_backward_kernel(  # type: ignore[no-untyped-def]
    positions, table, gradient, stride, resolutions, offsets, table_out, positions_out, count, active,
    FEATURES: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """To the table, to the positions, either may be None."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = i < count
    x, y, z = position(positions, i, live)
    gx = tl.zeros([BLOCK], tl.float32)
    gy = tl.zeros([BLOCK], tl.float32)
    gz = tl.zeros([BLOCK], tl.float32)
    for first in range(0, active, COLUMNS // FEATURES):
        column = first * FEATURES + tl.arange(0, COLUMNS)
        here = live[:, None] & (column < active * FEATURES)[None, :]
        g = tl.load(gradient + i.to(tl.int64)[:, None] * stride + column[None, :], mask=here, other=0.0)
        if table_out is not None:
            scatter(x, y, z, g, live, table_out, resolutions, offsets, first, active, FEATURES)
        if positions_out is not None:
            sx, sy, sz = slope(x, y, z, g, live, table, resolutions, offsets, first, active, FEATURES)
            gx, gy, gz = gx + sx, gy + sy, gz + sz
    if positions_out is not None:
        tl.store(positions_out + 3 * i, gx, mask=live)
        tl.store(positions_out + 3 * i + 1, gy, mask=live)
        tl.store(positions_out + 3 * i + 2, gz, mask=live)


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
            grid = (triton.cdiv(count, BLOCK), triton.cdiv(levels * features, COLUMNS.value))
            with torch.cuda.device_of(table):
                encode_kernel[grid](positions, table, resolutions, offsets, out, count, levels * features, ctx.active, features, BLOCK)
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient):  # type: ignore[no-untyped-def]
        positions, table, resolutions, offsets = ctx.saved_tensors
        count = positions.shape[0]
        if gradient.stride(1) != 1:  # a slice of wider rows is read as it is
            gradient = gradient.contiguous()
        to_positions = torch.empty_like(positions) if ctx.needs_input_grad[0] else None
        to_table = torch.zeros(ctx.rows, ctx.features, device=positions.device) if ctx.needs_input_grad[1] else None
        if count:
            with torch.cuda.device_of(positions):
                encode_backward_kernel[(triton.cdiv(count, BLOCK),)](
                    positions, table, gradient, gradient.stride(0), resolutions, offsets, to_table, to_positions, count, ctx.active,
                    ctx.features, BLOCK,
                )  # fmt: skip
        return to_positions, to_table, None, None, None


def hash_encode(positions: Tensor, table: Tensor, resolutions: Tensor, offsets: Tensor, active: int) -> Tensor:
    """See ``reference.hash_encode``; float32, F a power of two up to 16, once differentiable in ``table`` and in ``positions``."""
    return _HashEncode.apply(positions.contiguous(), table.contiguous(), resolutions, offsets, active)
