"""Rays through the field on the CPU, fused: marching, distances, sections, appearance and composition in one pass.

Work is cut into chunks of ``CHUNK`` rays. Within a chunk up to ``LANES`` rays are under way; each round takes the next sample
of every one of them, so that grid and network see blocks of up to ``LANES`` positions (see ``blocks``), and a lane whose ray has
ended takes the next ray that waits. What the backward pass needs stays where the forward pass wrote it, in the ``RayStore``: in the
chunk's slot when ``keep``, in the thread's otherwise.

Every sum has a fixed order, whatever the number of threads: chunks are summed in order, and tables are filled level by level.
"""

from __future__ import annotations

import math

import numpy as np
from numba import types

from mmsynth.field.kernels.constants import (
    ALONG_FACE,
    FACE_OVERSHOOT,
    FEATURES,
    FIRST_FEATURE_ROW,
    LAYER_GAP,
    LEAST_ADVANCE,
    LEAST_WEIGHT,
    LN2,
    LONGEST_STEP,
    MAX_SAMPLES_PER_RAY,
    NO_CROSSING,
    OUTSIDE,
    SOFT_SURFACE,
    SOLID,
    STAGES,
)
from mmsynth.field.kernels.cpu.blocks import encode_block, surface_block
from mmsynth.field.kernels.cpu.jit import inlined, kernel, part
from mmsynth.field.kernels.cpu.logistic import negative_log_cdf
from mmsynth.field.kernels.cpu.stack import on_stack
from mmsynth.field.kernels.cpu.tasks import take

CHUNK = 128  # rays
LANES = 64
CAPACITY = CHUNK * MAX_SAMPLES_PER_RAY + 8  # samples of a chunk, and room for whole tiles
_LONGEST_STEP = np.float32(LONGEST_STEP)
_LEAST_ADVANCE = np.float32(LEAST_ADVANCE)
_LEAST_WEIGHT = np.float32(LEAST_WEIGHT)
_NO_CROSSING = np.float32(NO_CROSSING)
_FACE_OVERSHOOT = np.float32(FACE_OVERSHOOT)
_numbers_of_rays, _sums_of_rays = on_stack(types.float32, CHUNK), on_stack(types.float64, CHUNK)
_states_of_rays, _flags_of_rays = on_stack(types.uint8, CHUNK), on_stack(types.boolean, CHUNK)
_sums_of_lanes, _rays_of_lanes = on_stack(types.float64, LANES), on_stack(types.int32, LANES)


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


@part()
def _advance(ox, oy, oz, dx, dy, dz, t, jitter, step, states, extent, contracted, skipped):  # type: ignore[no-untyped-def]
    """t, position, distance from the centre, speed and state: at t where a surface may be there, else, with the state of a free cell,
    behind that cell. skipped: whether the ray comes from one."""
    grid = states.shape[0]
    half, width = np.float32(0.5 * grid / extent), np.float32(2.0 * extent / grid)
    x, y, z = ox + dx * t, oy + dy * t, oz + dz * t
    cx, cy, cz, vx, vy, vz, r, speed = x, y, z, dx, dy, dz, np.float32(1.0), np.float32(1.0)
    if contracted:
        square = x * x + y * y + z * z
        if square > np.float32(1.0):  # ``contract`` and ``velocity`` at once, of a direction of unit length
            r = np.float32(math.sqrt(square))
            inverse = np.float32(1.0) / r
            k = (np.float32(2.0) - inverse) * inverse
            along = (x * dx + y * dy + z * dz) * inverse
            radial = along * (inverse * inverse - k) * inverse
            cx, cy, cz = x * k, y * k, z * k
            vx, vy, vz = dx * k + x * radial, dy * k + y * radial, dz * k + z * radial
            # from the parts along the radius and across it: 1 - along² would be rounding alone far away
            along *= inverse
            px, py, pz = dx - x * along, dy - y * along, dz - z * along
            outward = along * inverse
            speed = np.float32(math.sqrt(k * k * (px * px + py * py + pz * pz) + outward * outward))
    ix = min(max(int((cx + extent) * half), 0), grid - 1)
    iy = min(max(int((cy + extent) * half), 0), grid - 1)
    iz = min(max(int((cz + extent) * half), 0), grid - 1)
    state = states[ix, iy, iz]
    if state < OUTSIDE:
        if skipped:  # a ray enters a shell at a random place, so that samples do not all lie on the faces of cells
            t += jitter * step / speed
            x, y, z = ox + dx * t, oy + dy * t, oz + dz * t
            if contracted:
                cx, cy, cz, _ = contract(x, y, z)
            else:
                cx, cy, cz = x, y, z
        return t, cx, cy, cz, r, speed, state
    leave = _NO_CROSSING
    if abs(vx) > ALONG_FACE:
        leave = min(leave, (np.float32(ix + (1 if vx > 0 else 0)) * width - extent - cx) / vx)
    if abs(vy) > ALONG_FACE:
        leave = min(leave, (np.float32(iy + (1 if vy > 0 else 0)) * width - extent - cy) / vy)
    if abs(vz) > ALONG_FACE:
        leave = min(leave, (np.float32(iz + (1 if vz > 0 else 0)) * width - extent - cz) / vz)
    # the cell's certificate may reach beyond it
    leave = max(leave, np.float32(state - OUTSIDE) / (half * speed * np.float32(2.0))) + _FACE_OVERSHOOT * step / speed
    if contracted:
        leave = min(leave, _LONGEST_STEP * max(r, np.float32(1.0)))
    return max(t + leave, t * _LEAST_ADVANCE), cx, cy, cz, r, speed, state


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
    depths, densities = _sums_of_lanes(), _sums_of_lanes()
    block, hidden, sdf = store.block[slot], store.hidden[slot], store.sdf[slot]
    # lanes: the rays under way; a lane whose ray has ended takes the next ray that waits
    where, speed_of, reach_of = _numbers_of_rays(), _numbers_of_rays(), _numbers_of_rays()
    tau_of, state_of, skipped = _sums_of_rays(), _states_of_rays(), _flags_of_rays()
    lanes, todo = _rays_of_lanes(), _rays_of_lanes()
    for i in range(count):
        where[i] = rays.near[begin + i] + rays.jitter[begin + i] * step
        counts[slot, i], tau_of[i], skipped[i] = 0, 0.0, False
    going = 0
    waiting = 0
    used = np.int64(0)
    while going > 0 or waiting < count:
        n = np.int64(0)
        pending = going
        for i in range(going):
            todo[i] = lanes[i]
        while pending < LANES and waiting < count:
            todo[pending] = waiting
            pending += 1
            waiting += 1
        # all lanes go on by a cell in turn, and not one lane by all its cells: reading the states takes long, and so these reads overlap
        while pending > 0:
            left = 0
            for a in range(pending):
                i = todo[a]
                o = begin + i
                t = where[i]
                if not t < rays.far[o]:  # NaN, too: where two samples fell into one place the step between them is not known
                    if waiting < count:
                        todo[left] = waiting
                        left += 1
                        waiting += 1
                    continue
                t, x, y, z, r, speed, state = _advance(
                    origins[o, 0], origins[o, 1], origins[o, 2], directions[o, 0], directions[o, 1], directions[o, 2],
                    t, rays.jitter[o], step, states, grid.extent, contracted, skipped[i],
                )  # fmt: skip
                where[i] = t
                skipped[i] = state >= OUTSIDE
                if state >= OUTSIDE:
                    todo[left] = i
                    left += 1
                elif t < rays.far[o]:
                    speed_of[i], reach_of[i], state_of[i] = speed, r, state
                    lanes[n] = i
                    block[used + n, 0], block[used + n, 1], block[used + n, 2], block[used + n, 3] = x, y, z, np.float32(1.0)
                    n += 1
            pending = left
        if n == 0:
            break
        surface_block(block[used:], hidden[used:], sdf[used:], n, grid, layers)
        negative_log_cdf(sdf[used:], n, sharpness, depths, densities)
        going = 0
        for a in range(n):
            i = lanes[a]
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
            lanes[going] = i
            going += 1
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
