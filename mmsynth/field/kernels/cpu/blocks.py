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
    LOWER,
    UPPER,
    add_slopes,
    find_corners,
    find_weights,
    in_order,
    of_axes,
    of_corners,
    of_weights,
    places_of_corners,
    same_cell,
    to_unit,
)
from mmsynth.field.kernels.cpu.jit import allocating_kernel, part
from mmsynth.field.kernels.cpu.matrices import TILE_COLS, TILE_ROWS, add_product, clear, element, padded, splat, whole
from mmsynth.field.kernels.cpu.stack import on_stack
from mmsynth.field.kernels.cpu.units import let_through, rectify, totals_of_tile

_VECTOR = ir.VectorType(ir.FloatType(), FEATURES)
_PAIR = ir.VectorType(ir.FloatType(), 2 * FEATURES)
_I32, _I64 = ir.IntType(32), ir.IntType(64)
_LANES = ir.VectorType(_I32, FEATURES)
_BOTH = ir.Constant(ir.VectorType(_I32, 2 * FEATURES), list(range(2 * FEATURES)))
_CAREFUL = {"contract", "reassoc", "nsz", "arcp"}  # a gradient that is NaN is not 0
_PULLS = 4096  # numbers: positions whose gradients are found at once, times units
_pulls = on_stack(types.float32, _PULLS)


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


def _weight(context, builder, kind, array, position, part):  # type: ignore[no-untyped-def]
    return builder.load(_at_corner(context, builder, kind, array, position, part))


def _ends(context, builder, kind, array, position):  # type: ignore[no-untyped-def]
    """The weights of the lower and of the upper ends of a cell's edges, for each of the features of both."""
    lower, upper = (splat(builder, _weight(context, builder, kind, array, position, part), _VECTOR) for part in (LOWER, UPPER))
    return builder.shuffle_vector(lower, upper, _BOTH)


def _halves(builder, both):  # type: ignore[no-untyped-def]
    return [builder.shuffle_vector(both, both, ir.Constant(_LANES, list(range(at, at + FEATURES)))) for at in (0, FEATURES)]


def _mix_of(rows_in_order: bool) -> Any:
    @intrinsic
    def mix(typingctx, table, places, i, weights, block, position, column):  # type: ignore[no-untyped-def]
        """Σ weight · row over eight corners, into the block: of both ends of the four edges along z together."""

        def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
            total = None
            for edge in range(4):
                lower = _row(context, builder, signature, args, 2 * edge)
                if rows_in_order:
                    both = builder.load(builder.bitcast(lower, _PAIR.as_pointer()), align=4)
                else:
                    upper = _row(context, builder, signature, args, 2 * edge + 1)
                    both = builder.shuffle_vector(builder.load(lower, align=4), builder.load(upper, align=4), _BOTH)
                weight = splat(builder, _weight(context, builder, signature.args[3], args[3], args[2], edge), _PAIR)
                part = builder.fmul(both, weight, flags=("fast",))
                total = part if total is None else builder.fadd(total, part, flags=("fast",))
            total = builder.fmul(total, _ends(context, builder, signature.args[3], args[3], args[2]), flags=("fast",))
            mixed = builder.fadd(*_halves(builder, total), flags=("fast",))
            builder.store(mixed, _features(context, builder, signature, args, 4, 5, 6), align=4)
            return context.get_dummy_value()

        return types.void(table, places, i, weights, block, position, column), codegen

    return mix


def _spread_of(rows_in_order: bool) -> Any:
    @intrinsic
    def spread(typingctx, table, places, i, weights, block, position, column, count):  # type: ignore[no-untyped-def]
        """row += Σ weight · gradient, which the block holds, at eight corners that so many positions share. The sums stay in registers:
        what was stored a moment ago takes long to read."""

        def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
            sums = [cgutils.alloca_once_value(builder, ir.Constant(_PAIR, [0.0] * _PAIR.count)) for _ in range(4)]
            with cgutils.for_range(builder, args[7]) as loop:
                at, position = builder.add(args[2], loop.index), builder.add(args[5], loop.index)
                vector = builder.load(_features(context, builder, signature, [*args[:5], position, args[6]], 4, 5, 6), align=4)
                twice = builder.shuffle_vector(vector, vector, _BOTH)
                ends = builder.fmul(twice, _ends(context, builder, signature.args[3], args[3], at))
                for edge, total in enumerate(sums):
                    weight = splat(builder, _weight(context, builder, signature.args[3], args[3], at, edge), _PAIR)
                    part = builder.fmul(ends, weight, flags=("contract",))
                    builder.store(builder.fadd(builder.load(total), part, flags=("contract",)), total)
            for edge, total in enumerate(sums):
                if rows_in_order:
                    row = builder.bitcast(_row(context, builder, signature, args, 2 * edge), _PAIR.as_pointer())
                    builder.store(builder.fadd(builder.load(row, align=4), builder.load(total)), row, align=4)
                    continue
                for end, part in enumerate(_halves(builder, builder.load(total))):
                    row = _row(context, builder, signature, args, 2 * edge + end)
                    builder.store(builder.fadd(builder.load(row, align=4), part), row, align=4)
            return context.get_dummy_value()

        return types.void(table, places, i, weights, block, position, column, count), codegen

    return spread


_mix, _mix_in_order, _spread, _spread_in_order = _mix_of(False), _mix_of(True), _spread_of(False), _spread_of(True)


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
    """A ``SurfaceNetwork`` for these blocks: its hidden layer in whole tiles, turned (inputs, H), and as it is (H, inputs) times the output
    weight of each unit; the output weights and bias (H + 1,)."""

    turned: np.ndarray
    weighted: np.ndarray
    output: np.ndarray
    inner_radius: np.float32
    outer_radius: np.float32


def surface_layers(network: Any) -> SurfaceLayers:
    """Of a ``SurfaceNetwork`` of arrays."""
    turned, weighted, output = surface_weights(network.hidden, network.output)
    return SurfaceLayers(turned, weighted, output, network.inner_radius, network.outer_radius)


@allocating_kernel
def surface_weights(hidden, output):  # type: ignore[no-untyped-def]
    """The arrays of ``SurfaceLayers``."""
    units, tiles = hidden.shape[0], padded(hidden, FIRST_FEATURE_ROW)
    turned, out = np.ascontiguousarray(tiles.T), np.zeros(tiles.shape[0] + 1, np.float32)
    for i in range(units):
        out[i] = output[i]
        for j in range(tiles.shape[1]):
            tiles[i, j] *= output[i]
    out[-1] = output[units]
    return turned, tiles, out


@part(fastmath=True)
def encode_block(block, n, grid):  # type: ignore[no-untyped-def]
    """Fill the features of n positions."""
    unit, fractions, places, weights = of_axes(), of_axes(), places_of_corners(), of_weights()
    for begin in range(0, n, AT_ONCE):
        some = min(AT_ONCE, n - begin)
        to_unit(block, begin, some, grid.extent, unit)
        for level in range(grid.active):
            part = grid.table[grid.offsets[level] : grid.offsets[level + 1]]
            find_corners(some, unit, grid.resolutions[level], len(part), places, fractions)
            find_weights(some, fractions, weights)
            c = np.int64(FIRST_FEATURE_ROW + FEATURES * level)
            if in_order(grid.resolutions[level], len(part)):
                for i in range(some):
                    _mix_in_order(part, places, np.int64(i), weights, block, np.int64(begin + i), c)
            else:
                for i in range(some):
                    _mix(part, places, np.int64(i), weights, block, np.int64(begin + i), c)


@part(fastmath=_CAREFUL)
def scatter_block(block, n, grid, gradient, level):  # type: ignore[no-untyped-def]
    """Add the features of one level, which hold gradients now, to the gradient of its table."""
    unit, fractions, places, weights = of_axes(), of_axes(), places_of_corners(), of_weights()
    part = gradient[grid.offsets[level] : grid.offsets[level + 1]]
    c, ordered = np.int64(FIRST_FEATURE_ROW + FEATURES * level), in_order(grid.resolutions[level], len(part))
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
            if ordered:
                _spread_in_order(part, places, np.int64(i), weights, block, np.int64(begin + i), c, np.int64(count))
            else:
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


@part()
def surface_block(block, gates, out, n, grid, layers):  # type: ignore[no-untyped-def]
    """Signed distance of n positions: grid, one hidden layer of rectified units, a linear layer, and the initial spheres.

    Rows are used up to whole tiles. gates: (n, H / GATES), kept for the backward pass (see ``units``). out: (n,).
    """
    encode_block(block, n, grid)
    rows, units, inputs = whole(n, TILE_ROWS), layers.turned.shape[1], FIRST_FEATURE_ROW + FEATURES * grid.active
    inner, outer, bias, totals = layers.inner_radius, layers.outer_radius, layers.output[units], totals_of_tile()
    row = np.int64(0)
    while row < rows:
        some = rectify(block, layers.turned, layers.output, gates, totals, row, rows, np.int64(inputs))
        for i in range(row, min(row + some, n)):
            x, y, z = block[i, 0], block[i, 1], block[i, 2]
            r = np.float32(math.sqrt(x * x + y * y + z * z))
            out[i] = totals[i - row] + bias + min(r - inner, outer - r)
        row += some


@part()
def surface_block_backward(block, gates, g, n, active, layers, pulled_out, bias_out):  # type: ignore[no-untyped-def]
    """Gradients of n positions for gradients g (n,) of their distances: features are replaced by theirs.

    What the weights' gradients follow from (see ``units``), pulled_out (inputs, H), and that of the bias, bias_out (1,), are added to.
    """
    units, inputs = layers.turned.shape[1], np.int64(FIRST_FEATURE_ROW + FEATURES * active)
    at_once = np.int64(_PULLS // units // TILE_ROWS * TILE_ROWS)
    pulls = _pulls()[: at_once * units].reshape(at_once, units)
    weights, width = layers.weighted[:, FIRST_FEATURE_ROW:], np.int64(whole(FEATURES * active, TILE_COLS))
    for begin in range(0, n, at_once):
        some = np.int64(min(at_once, n - begin))
        rows, here = np.int64(whole(some, TILE_ROWS)), block[begin:]
        for i in range(rows):
            pull = g[begin + i] if i < some else np.float32(0.0)
            let_through(gates, begin + i, pull, pulls, i)
            bias_out[0] += pull
        add_product(here.T, pulls, pulled_out, inputs, some, units)
        features = here[:, FIRST_FEATURE_ROW:]
        clear(features, rows, width)
        add_product(pulls, weights, features, rows, units, width)


@part(fastmath=_CAREFUL)
def surface_block_positions(block, gates, g, n, grid, layers, out):  # type: ignore[no-untyped-def]
    """After ``surface_block_backward``: gradients to the positions, out (n, 3), overwritten."""
    inner, outer, units = layers.inner_radius, layers.outer_radius, layers.weighted.shape[0]
    pulls = _pulls()[:units].reshape(1, units)
    for i in range(n):
        x, y, z = block[i, 0], block[i, 1], block[i, 2]
        r = np.float32(math.sqrt(x * x + y * y + z * z))
        away = g[i] / max(r, np.float32(1e-12))
        if outer - r < r - inner:
            away = -away
        let_through(gates, np.int64(i), g[i], pulls, np.int64(0))
        for a in range(3):
            total = away * block[i, a]
            for k in range(units):
                total += pulls[0, k] * layers.weighted[k, a]
            out[i, a] = total
    position_block(block, n, grid, out)
