"""The surface on the CPU: signed distances of positions that lie on no rays, in blocks of ``POINTS``."""

from __future__ import annotations

import numpy as np
from numba import get_thread_id, njit, prange

from mmsynth.field.kernels.cpu.blocks import (
    scatter_block,
    surface_block,
    surface_block_backward,
    surface_block_positions,
)

POINTS = 128  # positions of a block


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def surface_forward(positions, grid, layers, keep, store, out):  # type: ignore[no-untyped-def]
    """Signed distance of (N, 3) positions; store: see ``SurfaceStore``, a slot per block when ``keep``, else per thread."""
    count = positions.shape[0]
    for chunk in prange((count + POINTS - 1) // POINTS):
        slot = np.int64(chunk) if keep else np.int64(get_thread_id())
        begin = np.int64(chunk) * POINTS
        n = min(POINTS, count - begin)
        b = store.block[slot]
        for i in range(n):
            for a in range(3):
                b[i, a] = positions[begin + i, a]
            b[i, 3] = np.float32(1.0)
        surface_block(b, store.hidden[slot], out[begin : begin + n], n, grid, layers)


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def surface_backward(gradient, active, layers, store):  # type: ignore[no-untyped-def]
    """Gradients of the weights per block; hidden units and features become gradients."""
    turned_out, output_out = store.turned_out, store.output_out  # in a parallel loop, numba would not set a tuple's arrays
    count = gradient.shape[0]
    for chunk in prange((count + POINTS - 1) // POINTS):
        begin = np.int64(chunk) * POINTS
        n = min(POINTS, count - begin)
        turned_out[chunk] = np.float32(0.0)
        output_out[chunk] = np.float32(0.0)
        surface_block_backward(
            store.block[chunk], store.hidden[chunk], gradient[begin : begin + n], n, active, layers, turned_out[chunk], output_out[chunk]
        )


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def surface_positions(gradient, grid, layers, store, positions_out):  # type: ignore[no-untyped-def]
    """After ``surface_backward``: gradients of the positions (N, 3)."""
    count = gradient.shape[0]
    for chunk in prange((count + POINTS - 1) // POINTS):
        begin = np.int64(chunk) * POINTS
        n = min(POINTS, count - begin)
        out = positions_out[begin : begin + n]
        surface_block_positions(store.block[chunk], store.hidden[chunk], gradient[begin : begin + n], n, grid, layers, out)


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def surface_scatter(count, grid, store, gradient):  # type: ignore[no-untyped-def]
    """The table's gradient, one task per level."""
    for task in prange(grid.active):
        level = np.int64(task)  # unsigned otherwise, and the block would be compiled twice
        for chunk in range((count + POINTS - 1) // POINTS):
            scatter_block(store.block[chunk], np.int64(min(POINTS, count - chunk * POINTS)), grid, gradient, level)
