"""The surface on the CPU: signed distances of positions that lie on no rays, in blocks of ``POINTS``."""

from __future__ import annotations

import numpy as np
from numba import types

from mmsynth.field.kernels.constants import OUTSIDE, SHELL, SOLID
from mmsynth.field.kernels.cpu.blocks import (
    scatter_block,
    surface_block,
    surface_block_backward,
    surface_block_positions,
)
from mmsynth.field.kernels.cpu.jit import kernel, part
from mmsynth.field.kernels.cpu.stack import on_stack
from mmsynth.field.kernels.cpu.tasks import take

POINTS = 128  # positions of a block
CELLS = 8192  # of a task of ``classify``
_f = np.float32
_ZERO, _ONE, _MOST = _f(0.0), _f(1.0), _f(253 - OUTSIDE)
_places, _values = on_stack(types.int64, POINTS), on_stack(types.float32, POINTS)


@kernel
def surface_forward(next_task, positions, grid, layers, keep, store, out):  # type: ignore[no-untyped-def]
    """Signed distance of (N, 3) positions; store: see ``SurfaceStore``, a slot per block when ``keep``, else per thread."""
    count, slot = positions.shape[0], take(next_task, 1)
    chunk = take(next_task, 0)
    while chunk * POINTS < count:
        if keep:
            slot = chunk
        begin = chunk * POINTS
        n = min(POINTS, count - begin)
        b = store.block[slot]
        for i in range(n):
            for a in range(3):
                b[i, a] = positions[begin + i, a]
            b[i, 3] = np.float32(1.0)
        surface_block(b, store.gates[slot], out[begin : begin + n], n, grid, layers)
        chunk = take(next_task, 0)


@kernel
def surface_backward(next_task, gradient, active, layers, store):  # type: ignore[no-untyped-def]
    """What the gradients of the weights follow from, per block; features become gradients."""
    count = gradient.shape[0]
    chunk = take(next_task, 0)
    while chunk * POINTS < count:
        begin = chunk * POINTS
        n = min(POINTS, count - begin)
        pulled_out, bias_out = store.pulled_out[chunk], store.bias_out[chunk]
        pulled_out[:], bias_out[:] = _ZERO, _ZERO
        surface_block_backward(store.block[chunk], store.gates[chunk], gradient[begin : begin + n], n, active, layers, pulled_out, bias_out)
        chunk = take(next_task, 0)


@kernel
def surface_positions(next_task, gradient, grid, layers, store, positions_out):  # type: ignore[no-untyped-def]
    """After ``surface_backward``: gradients of the positions (N, 3)."""
    count = gradient.shape[0]
    chunk = take(next_task, 0)
    while chunk * POINTS < count:
        begin = chunk * POINTS
        n = min(POINTS, count - begin)
        out = positions_out[begin : begin + n]
        surface_block_positions(store.block[chunk], store.gates[chunk], gradient[begin : begin + n], n, grid, layers, out)
        chunk = take(next_task, 0)


@kernel
def surface_scatter(next_task, count, grid, store, gradient):  # type: ignore[no-untyped-def]
    """The table's gradient, one task per level."""
    level = grid.active - 1 - take(next_task, 0)  # fine ones first: they take longest
    while level >= 0:
        for chunk in range((count + POINTS - 1) // POINTS):
            scatter_block(store.block[chunk], np.int64(min(POINTS, count - chunk * POINTS)), grid, gradient, level)
        level = grid.active - 1 - take(next_task, 0)


@part()
def _classify_block(n, where, states, cells, grid, layers, block, gates, value):  # type: ignore[no-untyped-def]
    """States of n cells, whose centres the block holds."""
    surface_block(block, gates, value, n, grid, layers)
    for i in range(n):
        if value[i] > cells.margin:
            states[where[i]] = np.uint8(_f(OUTSIDE) + min(max((value[i] - cells.margin) * cells.halves, _ZERO), _MOST))
        else:
            states[where[i]] = np.uint8(SOLID if value[i] < -cells.margin else SHELL)


@kernel
def classify(next_task, states, centre, cells, grid, layers, store):  # type: ignore[no-untyped-def]
    """See ``reference.classify``. states: (G³,). centre: (G,), of cells along an axis. store: a slot for each thread."""
    slot, side, n = take(next_task, 1), len(centre), 0
    block, gates = store.block[slot], store.gates[slot]
    where, value = _places(), _values()
    while True:
        begin = take(next_task, 0) * CELLS
        if begin >= len(states):
            break
        again = cells.first + (begin - cells.first + cells.every - 1) // cells.every * cells.every  # the next that is looked at anyway
        for cell in range(begin, min(begin + CELLS, len(states))):
            if cell == again:
                again += cells.every
            elif states[cell] != SHELL:
                continue
            block[n, 0], block[n, 1], block[n, 2] = centre[cell // (side * side)], centre[cell // side % side], centre[cell % side]
            block[n, 3] = _ONE
            where[n] = cell
            n += 1
            if n == POINTS:
                _classify_block(n, where, states, cells, grid, layers, block, gates, value)
                n = 0
    _classify_block(n, where, states, cells, grid, layers, block, gates, value)
