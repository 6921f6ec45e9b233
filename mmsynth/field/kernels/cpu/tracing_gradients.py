"""Gradients of rays through the field on the CPU, from what ``marching`` stored."""

from __future__ import annotations

import math

import numpy as np
from numba import types

from mmsynth.field.kernels.constants import FEATURES, FIRST_FEATURE_ROW, LEAST_WEIGHT, LN2, MAX_SAMPLES_PER_RAY
from mmsynth.field.kernels.cpu.blocks import (
    position_block,
    scatter_block,
    surface_block_backward,
    surface_block_positions,
)
from mmsynth.field.kernels.cpu.jit import allocating_kernel, inlined, kernel, part
from mmsynth.field.kernels.cpu.marching import CHUNK
from mmsynth.field.kernels.cpu.stack import on_stack
from mmsynth.field.kernels.cpu.tasks import take

_LEAST_WEIGHT = np.float32(LEAST_WEIGHT)
_of_samples = on_stack(types.float64, MAX_SAMPLES_PER_RAY)


@part()
def rays_backward(begin, count, chunk, behind, g_features, g_weight, features, shown, sharpness, a_active, store):  # type: ignore[no-untyped-def]
    """Distances and features of the sections become their gradients, of the rays in a slot of the store, of which ``begin`` is the first in
    ``behind``."""
    sdf, p_of, q_of, opacity_of, id_of = store.sdf, store.p_of, store.q_of, store.opacity_of, store.id_of
    sections = store.s_count[chunk, 0]
    sf = store.s_block[chunk]
    at = 0
    g_section = _of_samples()
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
                gf = g_features[row, j]
                g += gf * scale * (sf[at, FIRST_FEATURE_ROW + j] - features[row, j])
                sf[at, FIRST_FEATURE_ROW + j] = gf * w
            g_section[store.s_k[chunk, at]] = g
            at += 1
        # d loss / d sdf through the weights: first the total of gradient times weight, then what is left behind each section
        first = i * MAX_SAMPLES_PER_RAY
        total, transmittance = 0.0, 1.0
        for k in range(samples - 1):
            w = transmittance * opacity_of[chunk, first + k]
            total += g_section[k] * w
            transmittance -= w
        transmittance = 1.0
        for k in range(samples - 1):
            opacity = opacity_of[chunk, first + k]
            if opacity > 0.0:
                w = transmittance * opacity
                total -= g_section[k] * w
                transmittance -= w
                # p is -log of the sigmoid of s f, so its slope is -s (1 - e^-p)
                d_tau = (g_section[k] * transmittance - total) * sharpness
                here, end = first + k, first + k + 1
                if k > 0 or p_of[chunk, here] <= LN2:
                    sdf[chunk, id_of[chunk, here]] += np.float32(d_tau * q_of[chunk, here])
                elif p_of[chunk, here] > p_of[chunk, end]:  # a ray that begins behind a surface: of the end that is deeper
                    end = here
                sdf[chunk, id_of[chunk, end]] -= np.float32(d_tau * q_of[chunk, end])


@kernel
def trace_backward(  # type: ignore[no-untyped-def]
    next_task, behind, g_features, g_weight, features, shown, sharpness, active, layers, a_active, store
):
    """Gradients of what ``trace_forward`` stored: what those of the weights follow from, per chunk; distances and feature rows are replaced
    by theirs.

    behind: (R,) rows of ``features`` and of the others, which are as in ``Hits``.
    """
    rays = behind.shape[0]
    chunk = take(next_task, 0)
    while chunk * CHUNK < rays:
        begin = chunk * CHUNK
        count, pulled_out, bias_out = min(CHUNK, rays - begin), store.pulled_out[chunk], store.bias_out[chunk]
        rays_backward(begin, count, chunk, behind, g_features, g_weight, features, shown, sharpness, a_active, store)
        pulled_out[:], bias_out[:] = np.float32(0.0), np.float32(0.0)
        surface_block_backward(
            store.block[chunk],
            store.gates[chunk],
            store.sdf[chunk],
            np.int64(store.samples[chunk, 0]),
            active,
            layers,
            pulled_out,
            bias_out,
        )
        chunk = take(next_task, 0)


@kernel
def trace_scatter(next_task, rays, grid, appearance, store, gradient, a_gradient):  # type: ignore[no-untyped-def]
    """Both tables' gradients, one task per level and table."""
    chunks, tasks = (rays + CHUNK - 1) // CHUNK, grid.active + appearance.active
    task = tasks - 1 - take(next_task, 0)  # fine levels first, see ``surface_scatter``
    while task >= 0:
        for chunk in range(chunks):
            if task < grid.active:
                scatter_block(store.block[chunk], np.int64(store.samples[chunk, 0]), grid, gradient, task)
            else:
                scatter_block(store.s_block[chunk], np.int64(store.s_count[chunk, 0]), appearance, a_gradient, task - grid.active)
        task = tasks - 1 - take(next_task, 0)


@inlined()
def _back_to_world(x, y, z, gx, gy, gz, contracted):  # type: ignore[no-untyped-def]
    """Gradient to a position from the gradient to its contraction."""
    r = np.float32(math.sqrt(x * x + y * y + z * z))
    if not contracted or r <= np.float32(1.0):
        return gx, gy, gz
    k = (np.float32(2.0) - np.float32(1.0) / r) / r
    change = (np.float32(2.0) - np.float32(2.0) * r) / (r * r * r * r) * (x * gx + y * gy + z * gz)
    return k * gx + change * x, k * gy + change * y, k * gz + change * z


@allocating_kernel
def trace_rays_backward(  # type: ignore[no-untyped-def]
    next_task, origins, directions, grid, layers, appearance, store, origins_out, directions_out
):
    """After ``trace_backward``: gradients to origins and directions, with the samples' ray distances held fixed."""
    rays = origins.shape[0]
    contracted = grid.extent > np.float32(1.0)
    chunk = take(next_task, 0)
    while chunk * CHUNK < rays:
        begin = chunk * CHUNK
        for o in range(begin, min(rays, begin + CHUNK)):
            for a in range(3):
                origins_out[o, a] = np.float32(0.0)
                directions_out[o, a] = np.float32(0.0)
        samples, sections = np.int64(store.samples[chunk, 0]), np.int64(store.s_count[chunk, 0])
        out = np.zeros((max(samples, sections), 3), np.float32)
        for last in (False, True):
            n = sections if last else samples
            if last:
                out[:n] = np.float32(0.0)
                position_block(store.s_block[chunk], n, appearance, out)
            else:
                surface_block_positions(store.block[chunk], store.gates[chunk], store.sdf[chunk], n, grid, layers, out)
            for i in range(n):
                o = begin + (store.s_ray[chunk, i] if last else store.ray_of[chunk, i])
                t = store.s_time[chunk, i] if last else store.time_of[chunk, i]
                gx, gy, gz = _back_to_world(
                    origins[o, 0] + directions[o, 0] * t, origins[o, 1] + directions[o, 1] * t, origins[o, 2] + directions[o, 2] * t,
                    out[i, 0], out[i, 1], out[i, 2], contracted,
                )  # fmt: skip
                origins_out[o, 0] += gx
                origins_out[o, 1] += gy
                origins_out[o, 2] += gz
                directions_out[o, 0] += t * gx
                directions_out[o, 1] += t * gy
                directions_out[o, 2] += t * gz
        chunk = take(next_task, 0)
