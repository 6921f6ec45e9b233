"""The surface on the CPU: signed distances of positions that lie on no rays, in blocks of ``POINTS``."""

from __future__ import annotations

import numpy as np
from numba import get_thread_id, njit, prange

from mmsynth.field.kernels.constants import FIRST_FEATURE_ROW
from mmsynth.field.kernels.cpu.blocks import scatter_block, surface_block, surface_block_backward, surface_block_positions

POINTS = 128  # positions of a block


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def surface_forward(positions, grid, network, keep, store, out):  # type: ignore[no-untyped-def]
    """Signed distance of (N, 3) positions; store: see ``SurfaceStore``, a slot per block when ``keep``, else per thread."""
    count = positions.shape[0]
    for chunk in prange((count + POINTS - 1) // POINTS):
        slot = np.int64(chunk) if keep else np.int64(get_thread_id())
        begin = np.int64(chunk) * POINTS
        n = min(POINTS, count - begin)
        b = store.block[slot]
        for i in range(n):
            b[i] = positions[begin + i, 0]
            b[n + i] = positions[begin + i, 1]
            b[2 * n + i] = positions[begin + i, 2]
            b[3 * n + i] = np.float32(1.0)
        surface_block(b, store.hidden[slot], out[begin : begin + n], n, grid, network)


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def surface_backward(gradient, active, network, store):  # type: ignore[no-untyped-def]
    """Gradients of the weights per block; hidden and feature rows become gradients."""
    hidden_out, output_out = store.hidden_out, store.output_out  # in a parallel loop, numba would not set a tuple's arrays
    count = gradient.shape[0]
    for chunk in prange((count + POINTS - 1) // POINTS):
        begin = np.int64(chunk) * POINTS
        n = min(POINTS, count - begin)
        hidden_out[chunk] = np.float32(0.0)
        output_out[chunk] = np.float32(0.0)
        surface_block_backward(
            store.block[chunk], store.hidden[chunk], gradient[begin : begin + n], n, active, network,
            store.row[chunk], hidden_out[chunk], output_out[chunk],
        )  # fmt: skip


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def surface_positions(gradient, grid, network, store, positions_out):  # type: ignore[no-untyped-def]
    """After ``surface_backward``: gradients of the positions (N, 3)."""
    count = gradient.shape[0]
    for chunk in prange((count + POINTS - 1) // POINTS):
        begin = np.int64(chunk) * POINTS
        n = min(POINTS, count - begin)
        g = gradient[begin : begin + n]
        out = np.empty(3 * n, np.float32)
        surface_block_positions(store.block[chunk], store.hidden[chunk], g, n, grid, network, out)
        for i in range(n):
            for a in range(3):
                positions_out[begin + i, a] = out[a * n + i]


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def surface_scatter(count, grid, store, gradient):  # type: ignore[no-untyped-def]
    """The table's gradient, one task per level."""
    for task in prange(grid.active):
        level = np.int64(task)  # unsigned otherwise, and the block would be compiled twice
        for chunk in range((count + POINTS - 1) // POINTS):
            n = min(POINTS, count - chunk * POINTS)
            scatter_block(store.block[chunk], n, grid, gradient, level, FIRST_FEATURE_ROW)
