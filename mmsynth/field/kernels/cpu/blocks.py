"""Blocks of positions through a hash grid and a small network, on the CPU: what the fused kernels are made of.

A block holds n positions as rows of n numbers, in one flat array: row 0 to 2 are x, y and z, in the frame of the grid; in a
block for the network row 3 is all ones (so that biases are weights), and the features of the levels follow. Loops over a row
become vector code. One row of a table is four numbers, one vector register: LLVM would not find that by itself, so reading and
adding rows is written as vector instructions.
"""

from __future__ import annotations

import math

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

from mmsynth.field.kernels.constants import FEATURES, FIRST_FEATURE_ROW, HASH_PRIMES

_P1 = np.uint32(HASH_PRIMES[1])
_P2 = np.uint32(HASH_PRIMES[2])
_VECTOR = ir.VectorType(ir.FloatType(), FEATURES)
_I32, _I64 = ir.IntType(32), ir.IntType(64)


def _row(context, builder, table_type, table, row):  # type: ignore[no-untyped-def]
    data = builder.bitcast(context.make_array(table_type)(context, builder, table).data, ir.IntType(8).as_pointer())
    offset = builder.mul(builder.zext(row, _I64), ir.Constant(_I64, 4 * FEATURES))
    return builder.bitcast(builder.gep(data, [offset]), _VECTOR.as_pointer())


def splat(builder, value, vector):  # type: ignore[no-untyped-def]
    """A vector of this type, full of one number."""
    undefined = ir.Constant(vector, ir.Undefined)
    first = builder.insert_element(undefined, value, ir.Constant(_I32, 0))
    return builder.shuffle_vector(first, undefined, ir.Constant(ir.VectorType(_I32, vector.count), [0] * vector.count))


@intrinsic
def _mix(typingctx, table, rows, weights):  # type: ignore[no-untyped-def]
    """Σ weight · row over eight corners: four numbers."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        total = None
        for k in range(8):
            row = _row(context, builder, signature.args[0], args[0], builder.extract_value(args[1], k))
            weight = splat(builder, builder.extract_value(args[2], k), _VECTOR)
            part = builder.fmul(builder.load(row, align=4), weight, flags=("fast",))
            total = part if total is None else builder.fadd(total, part, flags=("fast",))
        numbers = [builder.extract_element(total, ir.Constant(_I32, k)) for k in range(FEATURES)]
        return context.make_tuple(builder, signature.return_type, numbers)

    return types.UniTuple(types.float32, FEATURES)(table, rows, weights), codegen


@intrinsic
def _spread(typingctx, table, rows, weights, gradient):  # type: ignore[no-untyped-def]
    """row += weight · gradient at eight corners."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        vector = ir.Constant(_VECTOR, ir.Undefined)
        for k in range(FEATURES):
            vector = builder.insert_element(vector, builder.extract_value(args[3], k), ir.Constant(_I32, k))
        for k in range(8):
            row = _row(context, builder, signature.args[0], args[0], builder.extract_value(args[1], k))
            part = builder.fmul(vector, splat(builder, builder.extract_value(args[2], k), _VECTOR), flags=("fast",))
            builder.store(builder.fadd(builder.load(row, align=4), part, flags=("fast",)), row, align=4)
        return context.get_dummy_value()

    return types.void(table, rows, weights, gradient), codegen


@intrinsic
def _dots(typingctx, table, rows, gradient):  # type: ignore[no-untyped-def]
    """row · gradient at eight corners: eight numbers."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        out = []
        for k in range(8):
            row = builder.load(_row(context, builder, signature.args[0], args[0], builder.extract_value(args[1], k)), align=4)
            total = ir.Constant(ir.FloatType(), 0.0)
            for j in range(FEATURES):
                value = builder.extract_element(row, ir.Constant(_I32, j))
                total = builder.fadd(total, builder.fmul(value, builder.extract_value(args[2], j), flags=("fast",)), flags=("fast",))
            out.append(total)
        return context.make_tuple(builder, signature.return_type, out)

    return types.UniTuple(types.float32, 8)(table, rows, gradient), codegen


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


@njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def encode_block(block, n, grid, first):  # type: ignore[no-untyped-def]
    """Fill the feature rows, which begin at row ``first``, from the position rows."""
    scale = np.float32(0.5 / grid.extent)
    xs, ys, zs = block[0:n], block[n : 2 * n], block[2 * n : 3 * n]
    for level in range(grid.active):
        resolution, mask, dense = _level(grid, level)
        part = grid.table[grid.offsets[level] : grid.offsets[level + 1]]
        row = first + FEATURES * level
        a, b = block[row * n : (row + 1) * n], block[(row + 1) * n : (row + 2) * n]
        c, d = block[(row + 2) * n : (row + 3) * n], block[(row + 3) * n : (row + 4) * n]
        for i in range(n):
            x, fx = _cell(xs[i], scale, resolution)
            y, fy = _cell(ys[i], scale, resolution)
            z, fz = _cell(zs[i], scale, resolution)
            a[i], b[i], c[i], d[i] = _mix(part, _corners(x, y, z, resolution, mask, dense), _weights(fx, fy, fz))


@njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def scatter_block(block, n, grid, gradient, level, first):  # type: ignore[no-untyped-def]
    """Add the feature rows of one level, which hold gradients now, to the gradient of its table."""
    scale = np.float32(0.5 / grid.extent)
    zero = np.float32(0.0)
    xs, ys, zs = block[0:n], block[n : 2 * n], block[2 * n : 3 * n]
    resolution, mask, dense = _level(grid, level)
    part = gradient[grid.offsets[level] : grid.offsets[level + 1]]
    row = first + FEATURES * level
    a, b = block[row * n : (row + 1) * n], block[(row + 1) * n : (row + 2) * n]
    c, d = block[(row + 2) * n : (row + 3) * n], block[(row + 3) * n : (row + 4) * n]
    for i in range(n):
        if a[i] == zero and b[i] == zero and c[i] == zero and d[i] == zero:
            continue
        x, fx = _cell(xs[i], scale, resolution)
        y, fy = _cell(ys[i], scale, resolution)
        z, fz = _cell(zs[i], scale, resolution)
        _spread(part, _corners(x, y, z, resolution, mask, dense), _weights(fx, fy, fz), (a[i], b[i], c[i], d[i]))


@njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def position_block(block, n, grid, first, out):  # type: ignore[no-untyped-def]
    """Add the gradient to the positions that the feature rows, which hold gradients now, imply: out is three rows of n."""
    scale = np.float32(0.5 / grid.extent)
    one = np.float32(1.0)
    xs, ys, zs = block[0:n], block[n : 2 * n], block[2 * n : 3 * n]
    for level in range(grid.active):
        resolution, mask, dense = _level(grid, level)
        part = grid.table[grid.offsets[level] : grid.offsets[level + 1]]
        slope = scale * np.float32(resolution)
        row = first + FEATURES * level
        a, b = block[row * n : (row + 1) * n], block[(row + 1) * n : (row + 2) * n]
        c, d = block[(row + 2) * n : (row + 3) * n], block[(row + 3) * n : (row + 4) * n]
        for i in range(n):
            x, fx = _cell(xs[i], scale, resolution)
            y, fy = _cell(ys[i], scale, resolution)
            z, fz = _cell(zs[i], scale, resolution)
            q0, q1, q2, q3, q4, q5, q6, q7 = _dots(part, _corners(x, y, z, resolution, mask, dense), (a[i], b[i], c[i], d[i]))
            gx, gy, gz = one - fx, one - fy, one - fz
            out[i] += slope * (gy * (gz * (q4 - q0) + fz * (q5 - q1)) + fy * (gz * (q6 - q2) + fz * (q7 - q3)))
            out[n + i] += slope * (gx * (gz * (q2 - q0) + fz * (q3 - q1)) + fx * (gz * (q6 - q4) + fz * (q7 - q5)))
            out[2 * n + i] += slope * (gx * (gy * (q1 - q0) + fy * (q3 - q2)) + fx * (gy * (q5 - q4) + fy * (q7 - q6)))


@njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def surface_block(block, hidden, out, n, grid, network):  # type: ignore[no-untyped-def]
    """Signed distance of a block: grid, one hidden layer of rectified units, a linear layer, and the initial spheres.

    H is a multiple of four; the columns of the layer's weights are the rows of the block.
    hidden: H rows, kept for the backward pass. out: (n,).
    """
    encode_block(block, n, grid, FIRST_FEATURE_ROW)
    weight, output = network.hidden, network.output
    units = weight.shape[0]
    zero = np.float32(0.0)
    xs, ys, zs = block[0:n], block[n : 2 * n], block[2 * n : 3 * n]
    inner, outer = network.inner_radius, network.outer_radius
    for i in range(n):
        r = np.float32(math.sqrt(xs[i] * xs[i] + ys[i] * ys[i] + zs[i] * zs[i]))
        out[i] = output[units] + min(r - inner, outer - r)
    for k in range(units):
        h = hidden[k * n : (k + 1) * n]
        w0, w1, w2, w3 = weight[k, 0], weight[k, 1], weight[k, 2], weight[k, 3]
        for i in range(n):
            h[i] = xs[i] * w0 + ys[i] * w1 + zs[i] * w2 + w3
        for j in range(FIRST_FEATURE_ROW, FIRST_FEATURE_ROW + FEATURES * grid.active, 4):
            f0, f1 = block[j * n : (j + 1) * n], block[(j + 1) * n : (j + 2) * n]
            f2, f3 = block[(j + 2) * n : (j + 3) * n], block[(j + 3) * n : (j + 4) * n]
            w0, w1, w2, w3 = weight[k, j], weight[k, j + 1], weight[k, j + 2], weight[k, j + 3]
            for i in range(n):
                h[i] += f0[i] * w0 + f1[i] * w1 + f2[i] * w2 + f3[i] * w3
        w = output[k]
        for i in range(n):
            v = max(h[i], zero)
            h[i] = v
            out[i] += w * v


@njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def surface_block_backward(block, hidden, g, n, active, network, row, hidden_out, output_out):  # type: ignore[no-untyped-def]
    """Gradients of a block for gradients g (n,) of its distances.

    The weights' gradients are added to. Hidden and feature rows are replaced by their gradients. row: scratch of n numbers.
    """
    weight, output = network.hidden, network.output
    units = weight.shape[0]
    zero = np.float32(0.0)
    total = zero
    for i in range(n):
        total += g[i]
    output_out[units] += total
    for k in range(units):
        h = hidden[k * n : (k + 1) * n]
        w = output[k]
        s0, s1 = zero, zero
        for i in range(n):
            s0 += h[i] * g[i]
            h[i] = w * g[i] if h[i] > zero else zero
            s1 += h[i]
        output_out[k] += s0
        hidden_out[k, 3] += s1
    for j in range(FIRST_FEATURE_ROW + FEATURES * active):
        if j == 3:
            continue
        f = block[j * n : (j + 1) * n]
        for i in range(n):
            row[i] = zero
        for k in range(0, units, 4):
            h0, h1 = hidden[k * n : (k + 1) * n], hidden[(k + 1) * n : (k + 2) * n]
            h2, h3 = hidden[(k + 2) * n : (k + 3) * n], hidden[(k + 3) * n : (k + 4) * n]
            w0, w1, w2, w3 = weight[k, j], weight[k + 1, j], weight[k + 2, j], weight[k + 3, j]
            s0, s1, s2, s3 = zero, zero, zero, zero
            for i in range(n):
                v = f[i]
                a, b, c, d = h0[i], h1[i], h2[i], h3[i]
                s0 += a * v
                s1 += b * v
                s2 += c * v
                s3 += d * v
                row[i] += a * w0 + b * w1 + c * w2 + d * w3
            hidden_out[k, j] += s0
            hidden_out[k + 1, j] += s1
            hidden_out[k + 2, j] += s2
            hidden_out[k + 3, j] += s3
        if j >= FIRST_FEATURE_ROW:
            for i in range(n):
                f[i] = row[i]


@njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def surface_block_positions(block, hidden, g, n, grid, network, out):  # type: ignore[no-untyped-def]
    """After ``surface_block_backward``: gradient to the positions, out: three rows of n, overwritten."""
    xs, ys, zs = block[0:n], block[n : 2 * n], block[2 * n : 3 * n]
    inner, outer = network.inner_radius, network.outer_radius
    for i in range(n):
        r = np.float32(math.sqrt(xs[i] * xs[i] + ys[i] * ys[i] + zs[i] * zs[i]))
        away = g[i] / max(r, np.float32(1e-12))
        if outer - r < r - inner:
            away = -away
        out[i], out[n + i], out[2 * n + i] = away * xs[i], away * ys[i], away * zs[i]
    weight = network.hidden
    for k in range(weight.shape[0]):
        h = hidden[k * n : (k + 1) * n]
        w0, w1, w2 = weight[k, 0], weight[k, 1], weight[k, 2]
        for i in range(n):
            out[i] += w0 * h[i]
            out[n + i] += w1 * h[i]
            out[2 * n + i] += w2 * h[i]
    position_block(block, n, grid, FIRST_FEATURE_ROW, out)
