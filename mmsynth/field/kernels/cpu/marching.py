"""Rays through the field on the CPU, fused: marching, distances, sections, appearance and composition in one pass.

Work is cut into chunks of ``CHUNK`` rays, all of which are under way at once: they go through free cells together (see ``cells``), and
grid and network see blocks of the next samples of many (see ``blocks``). What the backward pass needs stays where the forward pass wrote
it, in the ``RayStore``: in the chunk's slot when ``keep``, in the thread's otherwise.

Every sum has a fixed order, whatever the number of threads: chunks are summed in order, and tables are filled level by level.
"""

from __future__ import annotations

import math

import numpy as np
from numba import types

from mmsynth.field.kernels.constants import (
    FEATURES,
    FIRST_FEATURE_ROW,
    LAYER_GAP,
    LEAST_WEIGHT,
    LN2,
    LONGEST_STEP,
    MAX_SAMPLES_PER_RAY,
    OUTSIDE,
    SOFT_SURFACE,
    SOLID,
    STAGES,
)
from mmsynth.field.kernels.cpu import cells
from mmsynth.field.kernels.cpu.blocks import encode_block, surface_block
from mmsynth.field.kernels.cpu.jit import inlined, kernel, part
from mmsynth.field.kernels.cpu.logistic import negative_log_cdf
from mmsynth.field.kernels.cpu.stack import on_stack
from mmsynth.field.kernels.cpu.tasks import take

CHUNK = cells.LANES  # rays
_ENOUGH = CHUNK // 2  # samples of a round
CAPACITY = CHUNK * MAX_SAMPLES_PER_RAY + 8  # samples of a chunk, and room for whole tiles
_LONGEST_STEP = np.float32(LONGEST_STEP)
_LEAST_WEIGHT = np.float32(LEAST_WEIGHT)
_numbers_of_rays, _sums_of_rays = on_stack(types.float32, CHUNK), on_stack(types.float64, CHUNK)
_states_of_rays, _flags_of_rays = on_stack(types.uint8, CHUNK), on_stack(types.boolean, CHUNK)
_places_of_rays = on_stack(types.int32, CHUNK)


@inlined()
def contract(x, y, z):  # type: ignore[no-untyped-def]
    """Contracted position (mip-NeRF 360, eq. 10) and the distance from the centre."""
    r = np.float32(math.sqrt(x * x + y * y + z * z))
    if r <= np.float32(1.0):
        return x, y, z, r
    k = (np.float32(2.0) - np.float32(1.0) / r) / r
    return x * k, y * k, z * k, r


@inlined()
def velocity(x, y, z, r, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Change of the contracted position per unit of ray distance, for a point at distance r from the centre."""
    if r <= np.float32(1.0):
        return dx, dy, dz
    ux, uy, uz = x / r, y / r, z / r
    along = ux * dx + uy * dy + uz * dz
    across = (np.float32(2.0) * r - np.float32(1.0)) / (r * r)
    radial = along * (np.float32(1.0) / (r * r) - across)
    return dx * across + ux * radial, dy * across + uy * radial, dz * across + uz * radial


@inlined()
def section_depth(before, after, first):  # type: ignore[no-untyped-def]
    """See ``reference.section_depth``, of -log Φ(s f) at both ends."""
    rise = after - before
    rise = 0.0 if rise < 0.0 else rise  # not a maximum, which would hide NaN
    return rise + (before - LN2) if first and before > LN2 else rise


@part()
def march_rays(begin, count, slot, rays, states, sampling, grid, layers, store):  # type: ignore[no-untyped-def]
    """Samples of the rays of a chunk and their distances, see ``reference.march``: how many."""
    contracted = grid.extent > np.float32(1.0)
    sharpness, step, factor = sampling.sharpness, np.float32(sampling.step), np.float32(sampling.sphere_step_factor)
    min_slope = np.float32(sampling.min_slope)
    origins, directions = rays.origins, rays.directions
    t_of, f_of, p_of, q_of, counts = store.t_of, store.f_of, store.p_of, store.q_of, store.counts
    depths, densities = _sums_of_rays(), _sums_of_rays()
    block, gates, sdf = store.block[slot], store.gates[slot], store.sdf[slot]
    where, speed_of, reach_of = _numbers_of_rays(), _numbers_of_rays(), _numbers_of_rays()
    tau_of, state_of, skipped = _sums_of_rays(), _states_of_rays(), _flags_of_rays()
    todo, sampled, at = _places_of_rays(), _places_of_rays(), cells.of_lanes()
    for i in range(count):
        where[i] = rays.near[begin + i] + rays.jitter[begin + i] * step
        counts[slot, i], tau_of[i], skipped[i], todo[i] = 0, 0.0, False, i
    pending, used = count, np.int64(0)
    while pending > 0:
        n = np.int64(0)
        # rays without a sample go on by a cell. The last of them wait for the next round: alone they would take as long as many
        while pending > 0 and n < _ENOUGH:
            some = np.int64(0)
            for a in range(pending):
                i = todo[a]
                if not where[i] < rays.far[begin + i]:  # NaN, too: where two samples fell into one place the step between them is not known
                    continue
                todo[some] = i
                for axis in range(3):
                    at[(cells.ORIGIN + axis) * CHUNK + some] = origins[begin + i, axis]
                    at[(cells.DIRECTION + axis) * CHUNK + some] = directions[begin + i, axis]
                at[cells.TIME * CHUNK + some] = where[i]
                at[cells.ENTERS * CHUNK + some] = rays.jitter[begin + i] * step if skipped[i] else np.float32(0.0)
                some += 1
            cells.go_on(some, at, states, grid.extent, step)
            pending = 0
            for a in range(some):
                i, state = todo[a], np.uint8(at[cells.STATE * CHUNK + a])
                where[i] = at[cells.TIME * CHUNK + a]
                skipped[i] = state >= OUTSIDE
                if skipped[i]:
                    todo[pending] = i
                    pending += 1
                elif where[i] < rays.far[begin + i]:
                    speed_of[i], reach_of[i], state_of[i] = at[cells.SPEED * CHUNK + a], at[cells.REACH * CHUNK + a], state
                    for axis in range(3):
                        block[used + n, axis] = at[(cells.PLACE + axis) * CHUNK + a]
                    block[used + n, 3] = np.float32(1.0)
                    sampled[n] = i
                    n += 1
        surface_block(block[used:], gates[used:], sdf[used:], n, grid, layers)
        negative_log_cdf(sdf[used:], n, sharpness, depths, densities)
        for a in range(n):
            i = sampled[a]
            k = counts[slot, i]
            value = sdf[used + a]
            t = where[i]
            here = i * MAX_SAMPLES_PER_RAY + k
            t_of[slot, here] = t
            f_of[slot, here] = value
            p_of[slot, here], q_of[slot, here] = depths[a], densities[a]
            store.id_of[slot, here] = used + a
            store.ray_of[slot, used + a] = i
            store.time_of[slot, used + a] = t
            slope = np.float32(1.0)
            if k > 0:
                tau_of[i] += section_depth(p_of[slot, here - 1], p_of[slot, here], k == 1)
                slope = (f_of[slot, here - 1] - value) / ((t - t_of[slot, here - 1]) * speed_of[i])
            counts[slot, i] = k + 1
            if tau_of[i] > sampling.max_optical_depth or k + 1 == MAX_SAMPLES_PER_RAY or (state_of[i] == SOLID and k > 0):
                continue
            # the step that changes the distance by about ``step``: long where the ray grazes, and long far from the surface
            jump = step / max(slope, min_slope / np.float32(1 << max(0, k * STAGES // MAX_SAMPLES_PER_RAY - 1)))
            if value > 0:
                jump = max(jump, factor * (value - np.float32(SOFT_SURFACE / sharpness)))
            jump = jump / speed_of[i]
            if contracted:
                jump = min(jump, _LONGEST_STEP * max(reach_of[i], np.float32(1.0)))
            where[i] = t + jump
            todo[pending] = i
            pending += 1
        used += n
    store.samples[slot, 0] = used
    return used


@part()
def find_sections(begin, count, slot, rays, contracted, sampling, store, weight, depth):  # type: ignore[no-untyped-def]
    """Weights of the sections of a chunk's rays: depth, and the sections that matter, in the order of the rays: how many.

    weight: (2, R) of the nearest surface of each ray and of what is behind it.
    """
    min_weight = np.float32(sampling.min_section_weight)
    origins, directions = rays.origins, rays.directions
    t_of, f_of, p_of, s_block = store.t_of, store.f_of, store.p_of, store.s_block
    sections = np.int64(0)  # as a literal, blocks would be compiled for it, too
    gap = np.float32(LAYER_GAP / sampling.sharpness)
    for i in range(count):
        o = begin + i
        tau_sum, transmittance = 0.0, 1.0
        before = 0.0
        nearest = -1.0  # the weight of the nearest surface, once there is a second
        first = sections
        store.second[slot, i] = MAX_SAMPLES_PER_RAY
        depth[o] = np.float32(np.nan)
        for k in range(store.counts[slot, i] - 1):
            here = i * MAX_SAMPLES_PER_RAY + k
            tau = section_depth(p_of[slot, here], p_of[slot, here + 1], k == 0)
            store.opacity_of[slot, here] = 0.0
            if tau < 1e-7:
                continue
            f0 = f_of[slot, here]
            f1 = f_of[slot, here + 1]
            opacity = -math.expm1(-tau)
            store.opacity_of[slot, here] = opacity
            w = transmittance * opacity
            transmittance -= w
            tau_sum += tau
            if tau_sum > sampling.max_optical_depth:  # the ray was ended here: what is left belongs to this surface, too
                w += transmittance
            if w > min_weight or (before < 0.5 and before + w >= 0.5):
                crossing = np.float32(0.5)
                if f0 > 0 and f1 <= 0:
                    crossing = f0 / (f0 - f1)
                elif k == 0 and f0 < 0:
                    crossing = np.float32(0.0)
                t0 = t_of[slot, here]
                t = t0 + crossing * (t_of[slot, here + 1] - t0)
                if before < 0.5 and before + w >= 0.5:
                    depth[o] = t
                if w > min_weight:
                    x = origins[o, 0] + directions[o, 0] * t
                    y = origins[o, 1] + directions[o, 1] * t
                    z = origins[o, 2] + directions[o, 2] * t
                    if contracted:
                        x, y, z, _ = contract(x, y, z)
                    if sections > first and nearest < 0.0:
                        last = sections - 1
                        dx, dy, dz = x - s_block[slot, last, 0], y - s_block[slot, last, 1], z - s_block[slot, last, 2]
                        if math.sqrt(dx * dx + dy * dy + dz * dz) > gap:
                            nearest = before
                            store.second[slot, i] = k
                    s_block[slot, sections, 0], s_block[slot, sections, 1], s_block[slot, sections, 2] = x, y, z
                    store.s_ray[slot, sections] = i
                    store.s_k[slot, sections] = k
                    store.s_time[slot, sections] = t
                    store.s_weight[slot, sections] = w
                    sections += 1
            before += w
        weight[0, o] = before if nearest < 0.0 else nearest
        weight[1, o] = 0.0 if nearest < 0.0 else before - nearest
    store.s_count[slot, 0] = sections
    return sections


@part()
def composite(begin, count, slot, sections, appearance, store, features, distance, shown):  # type: ignore[no-untyped-def]
    """Features and distance of a chunk's rays: the mean over the sections of each surface, (2, R, F) and (2, R)."""
    s_block, width = store.s_block[slot], FEATURES * appearance.active
    encode_block(s_block, sections, appearance)
    shown[:, begin : begin + count] = np.float32(0.0)
    features[:, begin : begin + count] = np.float32(0.0)
    distance[:, begin : begin + count] = np.float32(0.0)
    for s in range(sections):
        i = store.s_ray[slot, s]
        which = 1 if store.s_k[slot, s] >= store.second[slot, i] else 0
        w = store.s_weight[slot, s]
        shown[which, begin + i] += w
        distance[which, begin + i] += w * store.s_time[slot, s]
        for j in range(width):
            features[which, begin + i, j] += w * s_block[s, FIRST_FEATURE_ROW + j]
    for i in range(count):
        for which in range(2 if store.second[slot, i] < MAX_SAMPLES_PER_RAY else 1):
            scale = np.float32(1.0) / max(shown[which, begin + i], _LEAST_WEIGHT)
            distance[which, begin + i] *= scale
            for j in range(width):
                features[which, begin + i, j] *= scale


@kernel
def trace_forward(next_task, rays, states, sampling, grid, layers, appearance, keep, store, out):  # type: ignore[no-untyped-def]
    """See ``reference.trace``. store: ``RayStore``, a slot per chunk when ``keep``, else per thread. out: ``TraceOutputs``."""
    total, slot = rays.origins.shape[0], take(next_task, 1)
    chunk = take(next_task, 0)
    while chunk * CHUNK < total:
        if keep:
            slot = chunk
        begin = chunk * CHUNK
        count = min(CHUNK, total - begin)
        out.samples[chunk] = march_rays(begin, count, slot, rays, states, sampling, grid, layers, store)
        contracted = grid.extent > np.float32(1.0)
        sections = find_sections(begin, count, slot, rays, contracted, sampling, store, out.weight, out.depth)
        composite(begin, count, slot, sections, appearance, store, out.features, out.distance, out.shown)
        chunk = take(next_task, 0)
