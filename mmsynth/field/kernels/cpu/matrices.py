"""Products of small matrices on the CPU, in tiles that stay in registers.

Matrices are padded to whole tiles: rows to a multiple of ``TILE_ROWS``, columns to one of ``TILE_COLS``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import binding, ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from mmsynth.field.kernels.cpu.jit import allocating_part, inlined, part
from mmsynth.field.kernels.cpu.stack import on_stack

TILE_ROWS, TILE_COLS = 4, 16
# Sums of four tiles at once fit into AVX-512's 32 registers of 16 numbers. AVX2 has 16 of 8, half of them for one tile: more would spill,
# at a third of the speed.
FOUR_AT_ONCE = bool(binding.get_host_cpu_features().get("avx512f"))
VECTOR = ir.VectorType(ir.FloatType(), TILE_COLS)
_TOTALS = 64  # columns that are summed at once
_totals = on_stack(types.float32, _TOTALS)
_BYTE, _I32, _I64 = ir.IntType(8), ir.IntType(32), ir.IntType(64)


def splat(builder, value, vector):  # type: ignore[no-untyped-def]
    """A vector of this type, full of one number."""
    undefined = ir.Constant(vector, ir.Undefined)
    first = builder.insert_element(undefined, value, ir.Constant(_I32, 0))
    return builder.shuffle_vector(first, undefined, ir.Constant(ir.VectorType(_I32, vector.count), [0] * vector.count))


def element(context, builder, kind, array, i, j):  # type: ignore[no-untyped-def]
    """Address of an element of a matrix, in bytes, and the matrix's strides."""
    matrix = context.make_array(kind)(context, builder, array)
    strides = cgutils.unpack_tuple(builder, matrix.strides, 2)
    data = builder.bitcast(matrix.data, _BYTE.as_pointer())
    return builder.gep(data, [builder.add(builder.mul(i, strides[0]), builder.mul(j, strides[1]))]), *strides


def after(builder, address, stride, count, kind):  # type: ignore[no-untyped-def]
    """The address of a number, or of a vector, so many strides behind an address in bytes."""
    return builder.bitcast(builder.gep(address, [builder.mul(stride, count)]), kind.as_pointer())


def vectors_at(builder, address, vectors):  # type: ignore[no-untyped-def]
    """Addresses of the vectors of columns that lie one after the other at an address in bytes."""
    return [builder.bitcast(builder.gep(address, [ir.Constant(_I64, 4 * TILE_COLS * v)]), VECTOR.as_pointer()) for v in range(vectors)]


def add_products(builder, left, right, inner, sums):  # type: ignore[no-untyped-def]
    """Add to a tile of sums, [rows][vectors] of addresses, what ``inner`` columns of a times rows of b are. left: address in a, strides
    of rows and columns; right: address in b, stride of rows. Sums stay in registers."""
    a, down, along = left
    b, onward = right
    with cgutils.for_range(builder, inner) as loop:
        begin = builder.gep(b, [builder.mul(onward, loop.index)])
        factors = [builder.load(at, align=4) for at in vectors_at(builder, begin, len(sums[0]))]
        values = builder.gep(a, [builder.mul(along, loop.index)])
        for r, line in enumerate(sums):
            value = splat(builder, builder.load(after(builder, values, down, ir.Constant(_I64, r), ir.FloatType())), VECTOR)
            for factor, total in zip(factors, line, strict=True):
                product = builder.fmul(value, factor, flags=("contract",))
                builder.store(builder.fadd(builder.load(total), product, flags=("contract",)), total)


def _tile(height: int, vectors: int) -> Any:
    """An intrinsic of tiles of so many rows and vectors of columns."""

    @intrinsic
    def add_tile(typingctx, a, b, out, row, inner, column):  # type: ignore[no-untyped-def]
        """out += a @ b, for the tile of ``out`` that begins at (row, column). Its sums stay in registers: LLVM would not find that."""

        def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
            row, inner, column = args[3:]
            zero = ir.Constant(_I64, 0)
            left = element(context, builder, signature.args[0], args[0], row, zero)
            right, onward, _ = element(context, builder, signature.args[1], args[1], zero, column)
            tile, across, _ = element(context, builder, signature.args[2], args[2], row, column)
            lines = [after(builder, tile, across, ir.Constant(_I64, r), _BYTE) for r in range(height)]
            targets = [vectors_at(builder, line, vectors) for line in lines]
            sums = [[cgutils.alloca_once_value(builder, builder.load(t, align=4)) for t in line] for line in targets]
            add_products(builder, left, (right, onward), inner, sums)
            for line, totals in zip(targets, sums, strict=True):
                for target, total in zip(line, totals, strict=True):
                    builder.store(builder.load(total), target, align=4)
            return context.get_dummy_value()

        return types.void(a, b, out, row, inner, column), codegen

    return add_tile


_high_and_wide, _high, _wide, _small = _tile(8, 2), _tile(8, 1), _tile(4, 2), _tile(4, 1)


@part()
def add_product(a, b, out, rows, inner, columns):  # type: ignore[no-untyped-def]
    """out += a @ b, of the first ``rows``, ``inner`` and ``columns``; whole tiles."""
    row = 0
    while row < rows:
        high = FOUR_AT_ONCE and row + 8 <= rows
        column = 0
        while column < columns:
            wide = FOUR_AT_ONCE and column + 2 * TILE_COLS <= columns
            if high and wide:
                _high_and_wide(a, b, out, row, inner, column)
            elif high:
                _high(a, b, out, row, inner, column)
            elif wide:
                _wide(a, b, out, row, inner, column)
            else:
                _small(a, b, out, row, inner, column)
            column += 2 * TILE_COLS if wide else TILE_COLS
        row += 8 if high else TILE_ROWS


@part()
def clear(out, rows, columns):  # type: ignore[no-untyped-def]
    for i in range(rows):
        for j in range(columns):
            out[i, j] = np.float32(0.0)


@part()
def add_sum(parts, out):  # type: ignore[no-untyped-def]
    """out += the sum of matrices (N, ≥ rows, ≥ columns) in their order."""
    rows, columns = out.shape
    total = _totals()
    for i in range(rows):
        for begin in range(0, columns, _TOTALS):
            some = min(_TOTALS, columns - begin)
            total[:] = np.float32(0.0)
            for n in range(parts.shape[0]):
                for j in range(some):
                    total[j] += parts[n, i, begin + j]
            for j in range(some):
                out[i, begin + j] += total[j]


@part()
def add_sums(parts, out):  # type: ignore[no-untyped-def]
    """The same of vectors (N, ≥ columns)."""
    for j in range(out.shape[0]):
        total = np.float32(0.0)
        for n in range(parts.shape[0]):
            total += parts[n, j]
        out[j] += total


@inlined(cache=True)
def whole(count, of):  # type: ignore[no-untyped-def]
    """``count`` rounded up to a multiple."""
    return (count + of - 1) // of * of


@allocating_part()
def padded(matrix, first=0):  # type: ignore[no-untyped-def]
    """A copy of whole tiles, whichever way round it is used; of the columns those behind the ``first``."""
    rows, width = matrix.shape
    out = np.zeros((whole(rows, TILE_COLS), first + whole(width - first, TILE_COLS)), np.float32)
    for i in range(rows):
        for j in range(width):
            out[i, j] = matrix[i, j]
    return out
