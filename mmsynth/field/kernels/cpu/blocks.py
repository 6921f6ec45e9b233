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
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from mmsynth.field.kernels.constants import FEATURES, FIRST_FEATURE_ROW
from mmsynth.field.kernels.cpu.corners import (
    AT_ONCE,
    add_slopes,
    find_corners,
    find_weights,
    of_axes,
    of_corners,
    places_of_corners,
    same_cell,
    to_unit,
)
from mmsynth.field.kernels.cpu.jit import allocating_kernel, part
from mmsynth.field.kernels.cpu.matrices import TILE_COLS, TILE_ROWS, add_product, clear, element, padded, splat, whole

_VECTOR = ir.VectorType(ir.FloatType(), FEATURES)
_I32, _I64 = ir.IntType(32), ir.IntType(64)
_CAREFUL = {"contract", "reassoc", "nsz", "arcp"}  # a gradient that is NaN is not 0


def _row(context, builder, signature, args, corner):  # type: ignore[no-untyped-def]
    """The address of the row of a corner: of arguments that begin with the table, ``places`` and the position's number there."""
    data = builder.bitcast(context.make_array(signature.args[0])(context, builder, args[0]).data, ir.IntType(8).as_pointer())
    place = _at_corner(context, builder, signature.args[1], args[1], args[2], corner)
    return builder.bitcast(builder.gep(data, [builder.zext(builder.load(place), _I64)]), _VECTOR.as_pointer())


def _at_corner(context, builder, kind, array, position, corner):  # type: ignore[no-untyped-def]
    """The address of a corner's number in an array of ``corners``."""
    data = context.make_array(kind)(context, builder, array).data
    return builder.gep(data, [builder.add(position, ir.Constant(_I64, corner * AT_ONCE))])


def _features(context, builder, signature, args, block, position, column):  # type: ignore[no-untyped-def]
    """The address of four numbers of a block: of its arguments, which are the block, the position and the column."""
    address, _, _ = element(context, builder, signature.args[block], args[block], args[position], args[column])
    return builder.bitcast(address, _VECTOR.as_pointer())


@intrinsic
def _mix(typingctx, table, places, i, weights, block, position, column):  # type: ignore[no-untyped-def]
    """Σ weight · row over eight corners, into the block."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        total = None
        for k in range(8):
            weight = builder.load(_at_corner(context, builder, signature.args[3], args[3], args[2], k))
            row = builder.load(_row(context, builder, signature, args, k), align=4)
            part = builder.fmul(row, splat(builder, weight, _VECTOR), flags=("fast",))
            total = part if total is None else builder.fadd(total, part, flags=("fast",))
        builder.store(total, _features(context, builder, signature, args, 4, 5, 6), align=4)
        return context.get_dummy_value()

    return types.void(table, places, i, weights, block, position, column), codegen


@intrinsic
def _spread(typingctx, table, places, i, weights, block, position, column, count):  # type: ignore[no-untyped-def]
    """row += Σ weight · gradient, which the block holds, at eight corners that so many positions share. The sums stay in registers: what
    was stored a moment ago takes long to read."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        sums = [cgutils.alloca_once_value(builder, ir.Constant(_VECTOR, [0.0] * FEATURES)) for _ in range(8)]
        with cgutils.for_range(builder, args[7]) as loop:
            at, position = builder.add(args[2], loop.index), builder.add(args[5], loop.index)
            vector = builder.load(_features(context, builder, signature, [*args[:5], position, args[6]], 4, 5, 6), align=4)
            for k, total in enumerate(sums):
                weight = builder.load(_at_corner(context, builder, signature.args[3], args[3], at, k))
                part = builder.fmul(vector, splat(builder, weight, _VECTOR), flags=("contract",))
                builder.store(builder.fadd(builder.load(total), part, flags=("contract",)), total)
        rows = [_row(context, builder, signature, args, k) for k in range(8)]
        for row, total in zip(rows, sums, strict=True):
            builder.store(builder.fadd(builder.load(row, align=4), builder.load(total)), row, align=4)
        return context.get_dummy_value()

    return types.void(table, places, i, weights, block, position, column, count), codegen


@intrinsic
def _dots(typingctx, table, places, i, values, block, position, column):  # type: ignore[no-untyped-def]
    """row · gradient, which the block holds, at eight corners, into ``values``."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        vector = builder.load(_features(context, builder, signature, args, 4, 5, 6), align=4)
        for k in range(8):
            row = builder.load(_row(context, builder, signature, args, k), align=4)
            product = builder.fmul(row, vector, flags=("fast",))
            total = ir.Constant(ir.FloatType(), 0.0)
            for j in range(FEATURES):
                total = builder.fadd(total, builder.extract_element(product, ir.Constant(_I32, j)), flags=("fast",))
            builder.store(total, _at_corner(context, builder, signature.args[3], args[3], args[2], k))
        return context.get_dummy_value()

    return types.void(table, places, i, values, block, position, column), codegen


class SurfaceLayers(NamedTuple):
    """A ``SurfaceNetwork`` for these blocks: its hidden layer in whole tiles, as it is (H, inputs) and turned (inputs, H)."""

    hidden: np.ndarray
    turned: np.ndarray
    output: np.ndarray
    inner_radius: np.float32
    outer_radius: np.float32


def surface_layers(network: Any) -> SurfaceLayers:
    """Of a ``SurfaceNetwork`` of arrays."""
    hidden, turned, output = surface_weights(network.hidden, network.output)
    return SurfaceLayers(hidden, turned, output, network.inner_radius, network.outer_radius)


@allocating_kernel
def surface_weights(hidden, output):  # type: ignore[no-untyped-def]
    """The arrays of ``SurfaceLayers``."""
    units, tiles = hidden.shape[0], padded(hidden, FIRST_FEATURE_ROW)
    out = np.zeros(tiles.shape[0] + 1, np.float32)
    for i in range(units):
        out[i] = output[i]
    out[-1] = output[units]
    return tiles, np.ascontiguousarray(tiles.T), out


@part(fastmath=True)
def encode_block(block, n, grid):  # type: ignore[no-untyped-def]
    """Fill the features of n positions."""
    unit, fractions, places, weights = of_axes(), of_axes(), places_of_corners(), of_corners()
    for begin in range(0, n, AT_ONCE):
        some = min(AT_ONCE, n - begin)
        to_unit(block, begin, some, grid.extent, unit)
        for level in range(grid.active):
            part = grid.table[grid.offsets[level] : grid.offsets[level + 1]]
            find_corners(some, unit, grid.resolutions[level], len(part), places, fractions)
            find_weights(some, fractions, weights)
            for i in range(some):
                _mix(part, places, np.int64(i), weights, block, np.int64(begin + i), np.int64(FIRST_FEATURE_ROW + FEATURES * level))


@part(fastmath=_CAREFUL)
def scatter_block(block, n, grid, gradient, level):  # type: ignore[no-untyped-def]
    """Add the features of one level, which hold gradients now, to the gradient of its table."""
    unit, fractions, places, weights = of_axes(), of_axes(), places_of_corners(), of_corners()
    part = gradient[grid.offsets[level] : grid.offsets[level + 1]]
    c = np.int64(FIRST_FEATURE_ROW + FEATURES * level)
    for begin in range(0, n, AT_ONCE):
        some = min(AT_ONCE, n - begin)
        to_unit(block, begin, some, grid.extent, unit)
        find_corners(some, unit, grid.resolutions[level], len(part), places, fractions)
        find_weights(some, fractions, weights)
        i = 0
        while i < some:
            count = 1
            while i + count < some and same_cell(places, i, i + count):
                count += 1
            _spread(part, places, np.int64(i), weights, block, np.int64(begin + i), c, np.int64(count))
            i += count


@part(fastmath=True)
def position_block(block, n, grid, out):  # type: ignore[no-untyped-def]
    """Add the gradient to the positions that the features, which hold gradients now, imply: out (n, 3)."""
    unit, fractions, places, values, slopes = of_axes(), of_axes(), places_of_corners(), of_corners(), of_axes()
    scale = np.float32(0.5 / grid.extent)
    for begin in range(0, n, AT_ONCE):
        some = min(AT_ONCE, n - begin)
        to_unit(block, begin, some, grid.extent, unit)
        slopes[:] = np.float32(0.0)
        for level in range(grid.active):
            part = grid.table[grid.offsets[level] : grid.offsets[level + 1]]
            find_corners(some, unit, grid.resolutions[level], len(part), places, fractions)
            for i in range(some):
                _dots(part, places, np.int64(i), values, block, np.int64(begin + i), np.int64(FIRST_FEATURE_ROW + FEATURES * level))
            add_slopes(some, fractions, values, scale * np.float32(grid.resolutions[level]), slopes)
        for i in range(some):
            for axis in range(3):
                out[begin + i, axis] += slopes[axis * AT_ONCE + i]


@part(fastmath=True)
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


@part(fastmath=True)
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


@part(fastmath=True)
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
