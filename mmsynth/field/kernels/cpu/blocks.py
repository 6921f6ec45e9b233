"""Blocks of positions through a hash grid and a small network, on the CPU: what the fused kernels are made of.

A block is a matrix with a row for each of n positions: x, y and z, in the frame of the grid, 1 (so that biases are weights), and then the
features of the levels; rows are as long as whole tiles (see ``matrices``). The features of a level are four numbers, one vector
register, as is a row of its table: LLVM would not find that by itself, so reading, mixing and adding rows is written as vector
instructions.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

from mmsynth.field.kernels.constants import FEATURES, FIRST_FEATURE_ROW, HASH_PRIMES
from mmsynth.field.kernels.cpu.matrices import TILE_COLS, TILE_ROWS, add_product, clear, element, padded, splat, whole

_P1 = np.uint32(HASH_PRIMES[1])
_P2 = np.uint32(HASH_PRIMES[2])
_VECTOR = ir.VectorType(ir.FloatType(), FEATURES)
_I32, _I64 = ir.IntType(32), ir.IntType(64)
_CAREFUL = {"contract", "reassoc", "nsz", "arcp"}  # a gradient that is NaN is not 0


def _row(context, builder, table_type, table, row):  # type: ignore[no-untyped-def]
    data = builder.bitcast(context.make_array(table_type)(context, builder, table).data, ir.IntType(8).as_pointer())
    offset = builder.mul(builder.zext(row, _I64), ir.Constant(_I64, 4 * FEATURES))
    return builder.bitcast(builder.gep(data, [offset]), _VECTOR.as_pointer())


def _features(context, builder, signature, args, block, position, column):  # type: ignore[no-untyped-def]
    """The address of four numbers of a block: of its arguments, which are the block, the position and the column."""
    address, _, _ = element(context, builder, signature.args[block], args[block], args[position], args[column])
    return builder.bitcast(address, _VECTOR.as_pointer())


@intrinsic
def _mix(typingctx, table, rows, weights, block, position, column):  # type: ignore[no-untyped-def]
    """Σ weight · row over eight corners, into the block."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        total = None
        for k in range(8):
            row = _row(context, builder, signature.args[0], args[0], builder.extract_value(args[1], k))
            weight = splat(builder, builder.extract_value(args[2], k), _VECTOR)
            part = builder.fmul(builder.load(row, align=4), weight, flags=("fast",))
            total = part if total is None else builder.fadd(total, part, flags=("fast",))
        builder.store(total, _features(context, builder, signature, args, 3, 4, 5), align=4)
        return context.get_dummy_value()

    return types.void(table, rows, weights, block, position, column), codegen


@intrinsic
def _spread(typingctx, table, rows, weights, block, position, column):  # type: ignore[no-untyped-def]
    """row += weight · gradient, which the block holds, at eight corners."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        vector = builder.load(_features(context, builder, signature, args, 3, 4, 5), align=4)
        for k in range(8):
            row = _row(context, builder, signature.args[0], args[0], builder.extract_value(args[1], k))
            part = builder.fmul(vector, splat(builder, builder.extract_value(args[2], k), _VECTOR), flags=("fast",))
            builder.store(builder.fadd(builder.load(row, align=4), part, flags=("fast",)), row, align=4)
        return context.get_dummy_value()

    return types.void(table, rows, weights, block, position, column), codegen


@intrinsic
def _dots(typingctx, table, rows, block, position, column):  # type: ignore[no-untyped-def]
    """row · gradient, which the block holds, at eight corners: eight numbers."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        vector = builder.load(_features(context, builder, signature, args, 2, 3, 4), align=4)
        out = []
        for k in range(8):
            row = builder.load(_row(context, builder, signature.args[0], args[0], builder.extract_value(args[1], k)), align=4)
            product = builder.fmul(row, vector, flags=("fast",))
            total = ir.Constant(ir.FloatType(), 0.0)
            for j in range(FEATURES):
                total = builder.fadd(total, builder.extract_element(product, ir.Constant(_I32, j)), flags=("fast",))
            out.append(total)
        return context.make_tuple(builder, signature.return_type, out)

    return types.UniTuple(types.float32, 8)(table, rows, block, position, column), codegen


@njit(cache=True, inline="always", error_model="numpy")
def _cell(x, scale, resolution):  # type: ignore[no-untyped-def]
    """Cell index along one axis, where in the cell, for a coordinate of the grid's frame; places outside go to the border."""
    unit = min(max(x * scale + np.float32(0.5), np.float32(0.0)), np.float32(1.0)) * np.float32(resolution)
    index = min(np.int32(unit), resolution - np.int32(1))
    return index, unit - np.float32(index)


@njit(cache=True, inline="always", error_model="numpy")
def _corners(x, y, z, resolution, mask, dense):  # type: ignore[no-untyped-def]
    """Table rows of the eight corners, z fastest (the order of ``_weights``)."""
    if dense:
        side = np.uint32(resolution + 1)
        base = (np.uint32(x) * side + np.uint32(y)) * side + np.uint32(z)
        right = base + side * side
        one = np.uint32(1)
        return base, base + one, base + side, base + side + one, right, right + one, right + side, right + side + one
    x0, x1 = np.uint32(x), np.uint32(x + 1)
    y0 = np.uint32(y) * _P1
    y1 = y0 + _P1
    z0 = np.uint32(z) * _P2
    z1 = z0 + _P2
    a, b, c, d = x0 ^ y0, x0 ^ y1, x1 ^ y0, x1 ^ y1
    return (
        (a ^ z0) & mask,
        (a ^ z1) & mask,
        (b ^ z0) & mask,
        (b ^ z1) & mask,
        (c ^ z0) & mask,
        (c ^ z1) & mask,
        (d ^ z0) & mask,
        (d ^ z1) & mask,
    )


@njit(cache=True, inline="always", error_model="numpy")
def _weights(fx, fy, fz):  # type: ignore[no-untyped-def]
    one = np.float32(1.0)
    gx, gy, gz = one - fx, one - fy, one - fz
    a, b, c, d = gx * gy, gx * fy, fx * gy, fx * fy
    return a * gz, a * fz, b * gz, b * fz, c * gz, c * fz, d * gz, d * fz


@njit(cache=True, inline="always", error_model="numpy")
def _level(grid, level):  # type: ignore[no-untyped-def]
    """Cells per axis, index mask, and whether the level is stored densely."""
    resolution = np.int32(grid.resolutions[level])
    rows = grid.offsets[level + 1] - grid.offsets[level]
    return resolution, np.uint32(rows - 1), (np.int64(resolution) + 1) ** 3 <= rows


class SurfaceLayers(NamedTuple):
    """A ``SurfaceNetwork`` for these blocks: its hidden layer in whole tiles, as it is (H, inputs) and turned (inputs, H)."""

    hidden: np.ndarray
    turned: np.ndarray
    output: np.ndarray
    inner_radius: np.float32
    outer_radius: np.float32


def surface_layers(network: Any) -> SurfaceLayers:
    """Of a ``SurfaceNetwork`` of arrays."""
    units, inputs = network.hidden.shape
    hidden = padded(network.hidden, columns=FIRST_FEATURE_ROW + whole.py_func(inputs - FIRST_FEATURE_ROW, TILE_COLS))
    output = np.zeros(len(hidden) + 1, np.float32)
    output[:units], output[-1] = network.output[:units], network.output[units]
    return SurfaceLayers(hidden, np.ascontiguousarray(hidden.T), output, network.inner_radius, network.outer_radius)


@njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def encode_block(block, n, grid):  # type: ignore[no-untyped-def]
    """Fill the features of n positions."""
    scale = np.float32(0.5 / grid.extent)
    for level in range(grid.active):
        resolution, mask, dense = _level(grid, level)
        part = grid.table[grid.offsets[level] : grid.offsets[level + 1]]
        column = FIRST_FEATURE_ROW + FEATURES * level
        for i in range(n):
            x, fx = _cell(block[i, 0], scale, resolution)
            y, fy = _cell(block[i, 1], scale, resolution)
            z, fz = _cell(block[i, 2], scale, resolution)
            _mix(part, _corners(x, y, z, resolution, mask, dense), _weights(fx, fy, fz), block, np.int64(i), np.int64(column))


@njit(cache=True, fastmath=_CAREFUL, nogil=True, error_model="numpy")
def scatter_block(block, n, grid, gradient, level):  # type: ignore[no-untyped-def]
    """Add the features of one level, which hold gradients now, to the gradient of its table."""
    scale = np.float32(0.5 / grid.extent)
    zero = np.float32(0.0)
    resolution, mask, dense = _level(grid, level)
    part = gradient[grid.offsets[level] : grid.offsets[level + 1]]
    c = np.int64(FIRST_FEATURE_ROW + FEATURES * level)
    for i in range(n):
        if block[i, c] == zero and block[i, c + 1] == zero and block[i, c + 2] == zero and block[i, c + 3] == zero:
            continue
        x, fx = _cell(block[i, 0], scale, resolution)
        y, fy = _cell(block[i, 1], scale, resolution)
        z, fz = _cell(block[i, 2], scale, resolution)
        _spread(part, _corners(x, y, z, resolution, mask, dense), _weights(fx, fy, fz), block, np.int64(i), c)


@njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def position_block(block, n, grid, out):  # type: ignore[no-untyped-def]
    """Add the gradient to the positions that the features, which hold gradients now, imply: out (n, 3)."""
    scale = np.float32(0.5 / grid.extent)
    one = np.float32(1.0)
    for level in range(grid.active):
        resolution, mask, dense = _level(grid, level)
        part = grid.table[grid.offsets[level] : grid.offsets[level + 1]]
        slope = scale * np.float32(resolution)
        column = np.int64(FIRST_FEATURE_ROW + FEATURES * level)
        for i in range(n):
            x, fx = _cell(block[i, 0], scale, resolution)
            y, fy = _cell(block[i, 1], scale, resolution)
            z, fz = _cell(block[i, 2], scale, resolution)
            q0, q1, q2, q3, q4, q5, q6, q7 = _dots(part, _corners(x, y, z, resolution, mask, dense), block, np.int64(i), column)
            gx, gy, gz = one - fx, one - fy, one - fz
            out[i, 0] += slope * (gy * (gz * (q4 - q0) + fz * (q5 - q1)) + fy * (gz * (q6 - q2) + fz * (q7 - q3)))
            out[i, 1] += slope * (gx * (gz * (q2 - q0) + fz * (q3 - q1)) + fx * (gz * (q6 - q4) + fz * (q7 - q5)))
            out[i, 2] += slope * (gx * (gy * (q1 - q0) + fy * (q3 - q2)) + fx * (gy * (q5 - q4) + fy * (q7 - q6)))


@njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def surface_block(block, hidden, out, n, grid, layers):  # type: ignore[no-untyped-def]
    """Signed distance of n positions: grid, one hidden layer of rectified units, a linear layer, and the initial spheres.

    Rows are used up to whole tiles. hidden: (n, H), kept for the backward pass. out: (n,).
    """
    encode_block(block, n, grid)
    output, rows, units = layers.output, whole(n, TILE_ROWS), layers.turned.shape[1]
    inner, outer = layers.inner_radius, layers.outer_radius
    zero = np.float32(0.0)
    clear(hidden, rows, units)
    add_product(block, layers.turned, hidden, rows, FIRST_FEATURE_ROW + FEATURES * grid.active, units)
    for i in range(n):
        x, y, z = block[i, 0], block[i, 1], block[i, 2]
        r = np.float32(math.sqrt(x * x + y * y + z * z))
        h, total = hidden[i], zero
        for k in range(units):
            h[k] = max(h[k], zero)
            total += h[k] * output[k]
        out[i] = total + output[units] + min(r - inner, outer - r)


@njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def surface_block_backward(block, hidden, g, n, active, layers, turned_out, output_out):  # type: ignore[no-untyped-def]
    """Gradients of n positions for gradients g (n,) of their distances.

    The weights' gradients, turned_out (inputs, H) and output_out (H + 1,), are added to. Hidden units and features are replaced by theirs.
    """
    output, rows, units = layers.output, whole(n, TILE_ROWS), layers.turned.shape[1]
    zero = np.float32(0.0)
    for i in range(n):
        h, pull = hidden[i], g[i]
        output_out[units] += pull
        for k in range(units):
            output_out[k] += h[k] * pull
            h[k] = output[k] * pull if h[k] > zero else zero
    inputs = FIRST_FEATURE_ROW + FEATURES * active
    add_product(block.T, hidden, turned_out, inputs, n, units)
    for i in range(n, rows):
        for k in range(units):
            hidden[i, k] = zero
    features, weights = block[:, FIRST_FEATURE_ROW:], layers.hidden[:, FIRST_FEATURE_ROW:]
    clear(features, rows, features.shape[1])
    add_product(hidden, weights, features, rows, units, whole(FEATURES * active, TILE_COLS))


@njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def surface_block_positions(block, hidden, g, n, grid, layers, out):  # type: ignore[no-untyped-def]
    """After ``surface_block_backward``: gradients to the positions, out (n, 3), overwritten."""
    inner, outer = layers.inner_radius, layers.outer_radius
    for i in range(n):
        x, y, z = block[i, 0], block[i, 1], block[i, 2]
        r = np.float32(math.sqrt(x * x + y * y + z * z))
        away = g[i] / max(r, np.float32(1e-12))
        if outer - r < r - inner:
            away = -away
        for a in range(3):
            out[i, a] = away * block[i, a]
        for k in range(layers.turned.shape[1]):
            for a in range(3):
                out[i, a] += layers.turned[a, k] * hidden[i, k]
    position_block(block, n, grid, out)
