"""The rectified units of the surface's network, on the CPU: what they give together, and their gradients.

Of a unit one bit is kept, its gate: whether it is above zero. All gradients follow from that. With G = Σ g x of the positions x at which a
unit is above zero, g the gradient of their distance, a unit of weights w and output weight v has the gradients v G and w · G.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from mmsynth.field.kernels.cpu.jit import part
from mmsynth.field.kernels.cpu.matrices import (
    FOUR_AT_ONCE,
    TILE_COLS,
    TILE_ROWS,
    VECTOR,
    add_products,
    after,
    element,
    splat,
    vectors_at,
)
from mmsynth.field.kernels.cpu.stack import on_stack

GATES = TILE_COLS  # bits of a number
MOST = 2 * TILE_ROWS  # rows of a tile
totals_of_tile = on_stack(types.float32, MOST)
_I16, _I32, _I64 = ir.IntType(16), ir.IntType(32), ir.IntType(64)
_ZEROS = ir.Constant(VECTOR, [0.0] * TILE_COLS)


def _tile(height: int, vectors: int) -> Any:
    """An intrinsic of so many positions, and vectors of units at a time."""

    @intrinsic
    def rectify_tile(typingctx, block, turned, output, gates, totals, row, inner):  # type: ignore[no-untyped-def]
        """totals = rectified (block @ turned) @ output, of the rows from ``row`` on; units stay in registers, their gates are kept."""

        def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
            kinds, (row, inner) = signature.args, args[5:]
            zero = ir.Constant(_I64, 0)
            left = element(context, builder, kinds[0], args[0], row, zero)
            right, onward, _ = element(context, builder, kinds[1], args[1], zero, zero)
            gate, down, along = element(context, builder, kinds[3], args[3], row, zero)
            matrix = context.make_array(kinds[1])(context, builder, args[1])
            units = cgutils.unpack_tuple(builder, matrix.shape, 2)[1]
            data = context.make_array(kinds[2])(context, builder, args[2]).data
            weights = builder.bitcast(data, ir.IntType(8).as_pointer())
            found = [cgutils.alloca_once_value(builder, _ZEROS) for _ in range(height)]
            with cgutils.for_range(builder, builder.udiv(units, ir.Constant(_I64, vectors * TILE_COLS))) as loop:
                first = builder.mul(loop.index, ir.Constant(_I64, vectors))
                offset = builder.mul(first, ir.Constant(_I64, 4 * TILE_COLS))
                sums = [[cgutils.alloca_once_value(builder, _ZEROS) for _ in range(vectors)] for _ in range(height)]
                add_products(builder, left, (builder.gep(right, [offset]), onward), inner, sums)
                for v, at in enumerate(vectors_at(builder, builder.gep(weights, [offset]), vectors)):
                    weight = builder.load(at, align=4)
                    column = builder.gep(gate, [builder.mul(along, builder.add(first, ir.Constant(_I64, v)))])
                    for r in range(height):
                        value = builder.load(sums[r][v])
                        is_open = builder.fcmp_unordered(">", value, _ZEROS)  # what is NaN stays it
                        kept = builder.bitcast(is_open, _I16)
                        builder.store(kept, after(builder, column, down, ir.Constant(_I64, r), _I16), align=2)
                        part = builder.fmul(builder.select(is_open, value, _ZEROS), weight, flags=("contract",))
                        builder.store(builder.fadd(builder.load(found[r]), part, flags=("contract",)), found[r])
            total = _totals(builder, [builder.load(vector) for vector in found])
            out = context.make_array(kinds[4])(context, builder, args[4]).data
            builder.store(total, builder.bitcast(out, total.type.as_pointer()), align=4)
            return context.get_dummy_value()

        return types.void(block, turned, output, gates, totals, row, inner), codegen

    return rectify_tile


def _totals(builder, vectors):  # type: ignore[no-untyped-def]
    """The total of each of several vectors, as one: halves of all are added until a number is left of each."""
    width = TILE_COLS
    while width > 1:
        together = len(vectors) > 1
        lanes = vectors[0].type.count
        starts = range(0, 2 * lanes if together else lanes, width)
        low, high = ([start + half + i for start in starts for i in range(width // 2)] for half in (0, width // 2))
        pairs = zip(vectors[::2], vectors[1::2], strict=True) if together else [(vectors[0], ir.Constant(vectors[0].type, ir.Undefined))]
        vectors = [
            builder.fadd(*(builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(_I32, len(lane)), lane)) for lane in (low, high)))
            for a, b in pairs
        ]
        width //= 2
    return vectors[0]


_high_and_wide, _high, _small = _tile(MOST, 2), _tile(MOST, 1), _tile(TILE_ROWS, 1)


@part()
def rectify(block, turned, output, gates, totals, row, rows, inner):  # type: ignore[no-untyped-def]
    """What the units give together at the next of ``rows`` positions (whole tiles), into totals (``MOST``,): of how many.

    block: (n, inputs), of which the first ``inner`` count. turned: (inputs, units). gates: (n, units / ``GATES``).
    """
    if FOUR_AT_ONCE and row + MOST <= rows:
        if turned.shape[1] % (2 * TILE_COLS) == 0:
            _high_and_wide(block, turned, output, gates, totals, row, inner)
        else:
            _high(block, turned, output, gates, totals, row, inner)
        return MOST
    _small(block, turned, output, gates, totals, row, inner)
    return TILE_ROWS


@intrinsic
def let_through(typingctx, gates, i, pull, out, row):  # type: ignore[no-untyped-def]
    """A number where the gates of a position are open, 0 where they are not, into a row of a matrix (n, units)."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        kinds, (i, pull, row) = signature.args, (args[1], args[2], args[4])
        zero = ir.Constant(_I64, 0)
        gate, _, along = element(context, builder, kinds[0], args[0], i, zero)
        target, _, _ = element(context, builder, kinds[3], args[3], row, zero)
        matrix = context.make_array(kinds[0])(context, builder, args[0])
        value = splat(builder, pull, VECTOR)
        with cgutils.for_range(builder, cgutils.unpack_tuple(builder, matrix.shape, 2)[1]) as loop:
            bits = builder.load(after(builder, gate, along, loop.index, _I16), align=2)
            is_open = builder.bitcast(bits, ir.VectorType(ir.IntType(1), GATES))
            (at,) = vectors_at(builder, builder.gep(target, [builder.mul(loop.index, ir.Constant(_I64, 4 * TILE_COLS))]), 1)
            builder.store(builder.select(is_open, value, _ZEROS), at, align=4)
        return context.get_dummy_value()

    return types.void(gates, i, pull, out, row), codegen


@part()
def add_of_units(pulled, bias, hidden, output, g_hidden, g_output):  # type: ignore[no-untyped-def]
    """Add to the gradients of the network's weights what follows from G, (inputs, units), and from the sum of all g, the bias' gradient.

    hidden: (H, inputs), output: (H + 1,); g_hidden, g_output: their gradients, to which is added.
    """
    units, inputs = hidden.shape
    for k in range(units):
        total = np.float32(0.0) * bias  # what is not finite is seen, by units that are not above zero, too
        for j in range(inputs):
            g_hidden[k, j] += output[k] * pulled[j, k]
            total += hidden[k, j] * pulled[j, k]
        g_output[k] += total
    g_output[units] += bias
