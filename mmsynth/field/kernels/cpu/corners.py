"""Corners of the cells of a hash grid: which rows of a table they are, and their weights, of ``AT_ONCE`` positions together.

Row numbers are much integer arithmetic for each corner: position by position it is most of a look-up's instructions, as vectors over
positions few of them. Arrays have a part of ``AT_ONCE`` for each axis or corner, z fastest, and lie on the stack. Where both kinds of level
set fractions stays written out: through one function LLVM makes no vectors of either (1.2 → 5.6 ns a position).
"""

from __future__ import annotations

import numpy as np
from numba import types

from mmsynth.field.kernels.constants import FEATURES, HASH_PRIMES
from mmsynth.field.kernels.cpu.jit import inlined, part
from mmsynth.field.kernels.cpu.matrices import whole
from mmsynth.field.kernels.cpu.stack import on_stack

AT_ONCE = 64  # positions
LOWER, UPPER = 4, 5  # parts of weights, behind those of the edges
_LANES = 16  # numbers in a vector
_ROW = np.uint32(4 * FEATURES)  # bytes
_P1 = np.uint32(HASH_PRIMES[1])
_P2 = np.uint32(HASH_PRIMES[2])
of_axes = on_stack(types.float32, 3 * AT_ONCE)
of_corners = on_stack(types.float32, 8 * AT_ONCE)
of_weights = on_stack(types.float32, 6 * AT_ONCE)
places_of_corners = on_stack(types.uint32, 8 * AT_ONCE)


@part()
def to_unit(block, begin, n, extent, unit):  # type: ignore[no-untyped-def]
    """Positions of a block from ``begin`` on, in [0, 1]; places outside go to the border."""
    scale, half, zero, one = np.float32(0.5 / extent), np.float32(0.5), np.float32(0.0), np.float32(1.0)
    for axis in range(3):
        for i in range(n):
            unit[axis * AT_ONCE + i] = min(max(block[begin + i, axis] * scale + half, zero), one)
        for i in range(n, whole(n, _LANES)):
            unit[axis * AT_ONCE + i] = zero


@inlined()
def _cell(unit, cells, last):  # type: ignore[no-untyped-def]
    """Cell index along one axis, where in the cell."""
    scaled = unit * cells
    index = max(min(np.int32(scaled), last), np.int32(0))
    return np.uint32(index), scaled - np.float32(index)


@inlined()
def _set(out, i, a, b, c, d, e, f, g, h):  # type: ignore[no-untyped-def]
    out[i], out[AT_ONCE + i], out[2 * AT_ONCE + i], out[3 * AT_ONCE + i] = a, b, c, d
    out[4 * AT_ONCE + i], out[5 * AT_ONCE + i], out[6 * AT_ONCE + i], out[7 * AT_ONCE + i] = e, f, g, h


@inlined()
def in_order(resolution, rows):  # type: ignore[no-untyped-def]
    """Whether a level has a row for each corner: then corners that follow each other along z do so in the table."""
    return (np.int64(resolution) + 1) ** 3 <= rows


@part(fastmath=True)
def find_corners(n, unit, resolution, rows, places, fractions):  # type: ignore[no-untyped-def]
    """Where the rows of the corners begin in the table of a level [bytes], uint32, and where in their cells positions are.

    resolution: cells per axis. rows: of the level.
    """
    cells, last = np.float32(resolution), np.int32(resolution - 1)
    if in_order(resolution, rows):
        side = np.uint32(resolution + 1)
        step_x, step_y, step_z = _ROW * side * side, _ROW * side, _ROW
        for i in range(whole(n, _LANES)):
            x, fx = _cell(unit[i], cells, last)
            y, fy = _cell(unit[AT_ONCE + i], cells, last)
            z, fz = _cell(unit[2 * AT_ONCE + i], cells, last)
            fractions[i], fractions[AT_ONCE + i], fractions[2 * AT_ONCE + i] = fx, fy, fz
            a = np.uint32(x * step_x + y * step_y + z * step_z)
            b, c, d = np.uint32(a + step_y), np.uint32(a + step_x), np.uint32(a + step_x + step_y)
            _set(places, i, a, a + step_z, b, b + step_z, c, c + step_z, d, d + step_z)
        return
    mask = np.uint32(rows - 1)
    for i in range(whole(n, _LANES)):
        x, fx = _cell(unit[i], cells, last)
        y, fy = _cell(unit[AT_ONCE + i], cells, last)
        z, fz = _cell(unit[2 * AT_ONCE + i], cells, last)
        fractions[i], fractions[AT_ONCE + i], fractions[2 * AT_ONCE + i] = fx, fy, fz
        x1, y0, z0 = np.uint32(x + np.uint32(1)), np.uint32(y * _P1), np.uint32(z * _P2)
        y1, z1 = np.uint32(y0 + _P1), np.uint32(z0 + _P2)
        a, b, c, d = x ^ y0, x ^ y1, x1 ^ y0, x1 ^ y1
        _set(
            places, i, ((a ^ z0) & mask) * _ROW, ((a ^ z1) & mask) * _ROW, ((b ^ z0) & mask) * _ROW, ((b ^ z1) & mask) * _ROW,
            ((c ^ z0) & mask) * _ROW, ((c ^ z1) & mask) * _ROW, ((d ^ z0) & mask) * _ROW, ((d ^ z1) & mask) * _ROW,
        )  # fmt: skip


@inlined()
def same_cell(places, i, j):  # type: ignore[no-untyped-def]
    """Whether two positions have the same corners: four of the rows give the others."""
    same = places[i] == places[j] and places[AT_ONCE + i] == places[AT_ONCE + j]
    return same and places[2 * AT_ONCE + i] == places[2 * AT_ONCE + j] and places[4 * AT_ONCE + i] == places[4 * AT_ONCE + j]


@part(fastmath=True)
def find_weights(n, fractions, weights):  # type: ignore[no-untyped-def]
    """Trilinear weights: of the four edges of a cell that run along z, and of their lower and upper ends."""
    one = np.float32(1.0)
    for i in range(whole(n, _LANES)):
        fx, fy, fz = fractions[i], fractions[AT_ONCE + i], fractions[2 * AT_ONCE + i]
        gx, gy = one - fx, one - fy
        weights[i], weights[AT_ONCE + i], weights[2 * AT_ONCE + i], weights[3 * AT_ONCE + i] = gx * gy, gx * fy, fx * gy, fx * fy
        weights[LOWER * AT_ONCE + i], weights[UPPER * AT_ONCE + i] = one - fz, fz


@part(fastmath=True)
def add_slopes(n, fractions, values, slope, out):  # type: ignore[no-untyped-def]
    """Add to ``out`` what numbers ``values`` at the corners say of the slope along each axis; slope: what a cell is [1/cell]."""
    one = np.float32(1.0)
    for i in range(whole(n, _LANES)):
        fx, fy, fz = fractions[i], fractions[AT_ONCE + i], fractions[2 * AT_ONCE + i]
        gx, gy, gz = one - fx, one - fy, one - fz
        q0, q1, q2, q3 = values[i], values[AT_ONCE + i], values[2 * AT_ONCE + i], values[3 * AT_ONCE + i]
        q4, q5, q6, q7 = values[4 * AT_ONCE + i], values[5 * AT_ONCE + i], values[6 * AT_ONCE + i], values[7 * AT_ONCE + i]
        out[i] += slope * (gy * (gz * (q4 - q0) + fz * (q5 - q1)) + fy * (gz * (q6 - q2) + fz * (q7 - q3)))
        out[AT_ONCE + i] += slope * (gx * (gz * (q2 - q0) + fz * (q3 - q1)) + fx * (gz * (q6 - q4) + fz * (q7 - q5)))
        out[2 * AT_ONCE + i] += slope * (gx * (gy * (q1 - q0) + fy * (q3 - q2)) + fx * (gy * (q5 - q4) + fy * (q7 - q6)))
