"""Gradients of rays through the field on the CPU, from what ``marching`` stored."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from mmsynth.field.kernels.constants import FEATURES, FIRST_FEATURE_ROW, LEAST_WEIGHT, MAX_SAMPLES_PER_RAY
from mmsynth.field.kernels.cpu.blocks import position_block, scatter_block, surface_block_backward, surface_block_positions
from mmsynth.field.kernels.cpu.marching import CHUNK, LANES

_LEAST_WEIGHT = np.float32(LEAST_WEIGHT)


@njit(cache=True, nogil=True, error_model="numpy")
def rays_backward(  # type: ignore[no-untyped-def]
    begin, count, chunk, behind, g_features, g_weight, features, shown, sharpness, active, network, a_active, store
):
    """``trace_backward`` of the rays of a chunk, of which ``begin`` is the first in ``behind``."""
    size = store.block.shape[1] // (CHUNK * MAX_SAMPLES_PER_RAY)
    units = network.hidden.shape[0]
    sdf, p_of, id_of = store.sdf, store.p_of, store.id_of
    hidden_out, output_out = store.hidden_out, store.output_out
    hidden_out[chunk] = np.float32(0.0)
    output_out[chunk] = np.float32(0.0)
    sections = store.s_count[chunk, 0]
    sf = store.s_block[chunk]
    at = 0
    g_section = np.empty(MAX_SAMPLES_PER_RAY, np.float64)
    for i in range(count):
        o = begin + i
        samples, second = store.counts[chunk, i], store.second[chunk, i]
        for k in range(samples):
            sdf[chunk, id_of[chunk, i * MAX_SAMPLES_PER_RAY + k]] = np.float32(0.0)
            g_section[k] = g_weight[o if k < second else behind[o]]
        while at < sections and store.s_ray[chunk, at] == i:
            row = o if store.s_k[chunk, at] < second else behind[o]
            scale = np.float32(1.0) / max(shown[row], _LEAST_WEIGHT)
            g = g_weight[row]
            w = store.s_weight[chunk, at] * scale
            for j in range(FEATURES * a_active):
                place = (3 + j) * sections + at
                gf = g_features[row, j]
                g += gf * scale * (sf[place] - features[row, j])
                sf[place] = gf * w
            g_section[store.s_k[chunk, at]] = g
            at += 1
        # d loss / d sdf through the weights: first the total of gradient times weight, then what is left behind each section
        tau_sum = 0.0
        total = 0.0
        for k in range(samples - 1):
            tau = max(0.0, p_of[chunk, i * MAX_SAMPLES_PER_RAY + k + 1] - p_of[chunk, i * MAX_SAMPLES_PER_RAY + k])
            total += g_section[k] * math.exp(-tau_sum) * -math.expm1(-tau)
            tau_sum += tau
        tau_sum = 0.0
        for k in range(samples - 1):
            p0, p1 = p_of[chunk, i * MAX_SAMPLES_PER_RAY + k], p_of[chunk, i * MAX_SAMPLES_PER_RAY + k + 1]
            tau = p1 - p0
            if tau > 1e-7:
                transmittance = math.exp(-tau_sum)
                total -= g_section[k] * transmittance * -math.expm1(-tau)
                # p is -log of the sigmoid of s f, so its slope is -s (1 - e^-p)
                d_tau = g_section[k] * transmittance * math.exp(-tau) - total
                sdf[chunk, id_of[chunk, i * MAX_SAMPLES_PER_RAY + k]] += np.float32(d_tau * sharpness * -math.expm1(-p0))
                sdf[chunk, id_of[chunk, i * MAX_SAMPLES_PER_RAY + k + 1]] -= np.float32(d_tau * sharpness * -math.expm1(-p1))
                tau_sum += tau
    used = 0
    for b in range(store.rounds[chunk, 0]):
        n = np.int64(store.sizes[chunk, b])
        surface_block_backward(
            store.block[chunk, used * size :], store.hidden[chunk, used * units :], sdf[chunk, used : used + n], n,
            active, network, store.row[chunk], hidden_out[chunk], output_out[chunk],
        )  # fmt: skip
        used += int(n)


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def trace_backward(  # type: ignore[no-untyped-def]
    behind, g_features, g_weight, features, shown, sharpness, active, network, a_active, store
):
    """Gradients of what ``trace_forward`` stored: weights per chunk; distances and feature rows are replaced by their gradients.

    behind: (R,) rows of ``features`` and of the others, which are as in ``Hits``.
    """
    rays = behind.shape[0]
    for task in prange((rays + CHUNK - 1) // CHUNK):
        chunk = np.int64(task)
        begin = chunk * CHUNK
        rays_backward(
            begin, min(CHUNK, rays - begin), chunk, behind, g_features, g_weight, features, shown, sharpness, active, network, a_active,
            store,
        )  # fmt: skip


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def trace_scatter(rays, grid, appearance, store, gradient, a_gradient):  # type: ignore[no-untyped-def]
    """Both tables' gradients, one task per level and table."""
    size = store.block.shape[1] // (CHUNK * MAX_SAMPLES_PER_RAY)
    chunks = (rays + CHUNK - 1) // CHUNK
    for each in prange(grid.active + appearance.active):
        task = np.int64(each)
        if task < grid.active:
            for chunk in range(chunks):
                used = 0
                for b in range(store.rounds[chunk, 0]):
                    n = np.int64(store.sizes[chunk, b])
                    scatter_block(store.block[chunk, used * size :], n, grid, gradient, task, FIRST_FEATURE_ROW)
                    used += int(n)
        else:
            for chunk in range(chunks):
                scatter_block(store.s_block[chunk], np.int64(store.s_count[chunk, 0]), appearance, a_gradient, task - grid.active, 3)


@njit(cache=True, inline="always", error_model="numpy")
def _back_to_world(x, y, z, gx, gy, gz, contracted):  # type: ignore[no-untyped-def]
    """Gradient to a position from the gradient to its contraction."""
    r = np.float32(math.sqrt(x * x + y * y + z * z))
    if not contracted or r <= np.float32(1.0):
        return gx, gy, gz
    k = (np.float32(2.0) - np.float32(1.0) / r) / r
    change = (np.float32(2.0) - np.float32(2.0) * r) / (r * r * r * r) * (x * gx + y * gy + z * gz)
    return k * gx + change * x, k * gy + change * y, k * gz + change * z


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def trace_rays_backward(origins, directions, grid, network, appearance, store, origins_out, directions_out):  # type: ignore[no-untyped-def]
    """After ``trace_backward``: gradients to origins and directions, with the samples' ray distances held fixed."""
    rays = origins.shape[0]
    size = store.block.shape[1] // (CHUNK * MAX_SAMPLES_PER_RAY)
    units = network.hidden.shape[0]
    contracted = grid.extent > np.float32(1.0)
    for chunk in prange((rays + CHUNK - 1) // CHUNK):
        begin = np.int64(chunk) * CHUNK
        for o in range(begin, min(rays, begin + CHUNK)):
            for a in range(3):
                origins_out[o, a] = np.float32(0.0)
                directions_out[o, a] = np.float32(0.0)
        used = 0
        sections = store.s_count[chunk, 0]
        out = np.zeros(3 * max(np.int64(LANES), np.int64(sections)), np.float32)
        for b in range(store.rounds[chunk, 0] + 1):
            last = b == store.rounds[chunk, 0]
            n = np.int64(sections if last else store.sizes[chunk, b])
            if last:
                out[: 3 * n] = np.float32(0.0)
                position_block(store.s_block[chunk], n, appearance, 3, out)
            else:
                surface_block_positions(
                    store.block[chunk, used * size :], store.hidden[chunk, used * units :], store.sdf[chunk, used : used + n], n,
                    grid, network, out,
                )  # fmt: skip
            for i in range(n):
                o = begin + (store.s_ray[chunk, i] if last else store.ray_of[chunk, used + i])
                t = store.s_time[chunk, i] if last else store.time_of[chunk, used + i]
                gx, gy, gz = _back_to_world(
                    origins[o, 0] + directions[o, 0] * t, origins[o, 1] + directions[o, 1] * t, origins[o, 2] + directions[o, 2] * t,
                    out[i], out[n + i], out[2 * n + i], contracted,
                )  # fmt: skip
                origins_out[o, 0] += gx
                origins_out[o, 1] += gy
                origins_out[o, 2] += gz
                directions_out[o, 0] += t * gx
                directions_out[o, 1] += t * gy
                directions_out[o, 2] += t * gz
            if not last:
                used += int(n)
