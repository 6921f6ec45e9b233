"""Rays through the field on the CPU, fused: marching, distances, sections, appearance and composition in one pass.

Work is cut into chunks of ``CHUNK`` rays. Within a chunk up to ``LANES`` rays are under way; each round takes the next sample
of every one of them, so that grid and network see blocks of up to ``LANES`` positions (see cpu_blocks), and a lane whose ray has
ended takes the next ray that waits. What the backward pass needs stays where the forward pass wrote it: in the chunk's slot of
the stores when ``keep``, in the thread's otherwise.

Every sum has a fixed order, whatever the number of threads: chunks are summed in order, and tables are filled level by level.

Names of the stores, one row per slot. Per sample, in the order of the blocks: block, hidden, sdf, ray_of, time_of. Per ray and
number of the sample (i * MOST + k): t_of, f_of (distance), p_of (softplus of -s f), id_of (place in the order of the blocks);
counts: samples of each ray; rounds, sizes: number and lengths of the blocks. Sections that matter: s_block (position and
features), s_ray, s_k (its first sample), s_time, s_weight, s_count.
"""

from __future__ import annotations

import math

import numpy as np
from numba import get_thread_id, njit, prange

from mmsynth.field.kernels.cpu.blocks import (
    FEATURES,
    FIRST,
    encode_block,
    position_block,
    scatter_block,
    surface_block,
    surface_block_backward,
    surface_block_positions,
)

CHUNK = 256  # rays
LANES = 64
POINTS = 128  # positions of a block when there are no rays
MOST = 96  # samples of one ray
_SKIP = np.float32(0.25)  # of the distance from the centre: the longest step in contracted space
_ONWARD = np.float32(1.0 + 2.0**-22)  # the least that a float32 moves on: a short step far from a ray's origin may round to none


@njit(cache=True, inline="always", error_model="numpy")
def _softplus(x):  # type: ignore[no-untyped-def]
    if abs(x) > 40.0:  # exp(-40) is below the rounding of 1
        return max(x, 0.0)
    return max(x, 0.0) + math.log1p(math.exp(-abs(x)))


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def surface_forward(  # type: ignore[no-untyped-def]
    positions, extent, spheres, table, resolutions, offsets, active, weight, last, keep, block, hidden, out
):  # fmt: skip
    """Signed distance of (N, 3) positions, in blocks of ``POINTS``."""
    count = positions.shape[0]
    for chunk in prange((count + POINTS - 1) // POINTS):
        slot = np.int64(chunk) if keep else np.int64(get_thread_id())
        begin = np.int64(chunk) * POINTS
        n = min(POINTS, count - begin)
        b = block[slot]
        for i in range(n):
            b[i] = positions[begin + i, 0]
            b[n + i] = positions[begin + i, 1]
            b[2 * n + i] = positions[begin + i, 2]
            b[3 * n + i] = np.float32(1.0)
        surface_block(b, hidden[slot], out[begin : begin + n], n, extent, spheres, table, resolutions, offsets, active, weight, last)


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def surface_backward(  # type: ignore[no-untyped-def]
    gradient, active, weight, last, block, hidden, row, weight_out, last_out
):  # fmt: skip
    """Gradients of the weights per chunk; hidden and feature rows become gradients."""
    count = gradient.shape[0]
    for chunk in prange((count + POINTS - 1) // POINTS):
        begin = np.int64(chunk) * POINTS
        n = min(POINTS, count - begin)
        weight_out[chunk] = np.float32(0.0)
        last_out[chunk] = np.float32(0.0)
        g = gradient[begin : begin + n]
        surface_block_backward(block[chunk], hidden[chunk], g, n, active, weight, last, row[chunk], weight_out[chunk], last_out[chunk])


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def surface_positions(  # type: ignore[no-untyped-def]
    gradient, extent, spheres, table, resolutions, offsets, active, weight, block, hidden, positions_out
):
    """After ``surface_backward``: gradients of the positions (N, 3)."""
    count = gradient.shape[0]
    for chunk in prange((count + POINTS - 1) // POINTS):
        begin = np.int64(chunk) * POINTS
        n = min(POINTS, count - begin)
        g = gradient[begin : begin + n]
        out = np.empty(3 * n, np.float32)
        surface_block_positions(block[chunk], hidden[chunk], g, n, extent, spheres, table, resolutions, offsets, active, weight, out)
        for i in range(n):
            for a in range(3):
                positions_out[begin + i, a] = out[a * n + i]


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def surface_scatter(count, extent, resolutions, offsets, active, block, gradient):  # type: ignore[no-untyped-def]
    """The table's gradient, one task per level."""
    for task in prange(active):
        level = np.int64(task)  # unsigned otherwise, and the block would be compiled twice
        for chunk in range((count + POINTS - 1) // POINTS):
            n = min(POINTS, count - chunk * POINTS)
            scatter_block(block[chunk], n, extent, gradient, resolutions, offsets, level, FIRST)


@njit(cache=True, inline="always", error_model="numpy")
def _contract(x, y, z):  # type: ignore[no-untyped-def]
    """Contracted position (mip-NeRF 360, eq. 10) and the distance from the centre."""
    r = np.float32(math.sqrt(x * x + y * y + z * z))
    if r <= np.float32(1.0):
        return x, y, z, r
    k = (np.float32(2.0) - np.float32(1.0) / r) / r
    return x * k, y * k, z * k, r


@njit(cache=True, inline="always", error_model="numpy")
def _velocity(x, y, z, r, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Change of the contracted position per unit of ray distance, for a point at distance r from the centre."""
    if r <= np.float32(1.0):
        return dx, dy, dz
    ux, uy, uz = x / r, y / r, z / r
    along = ux * dx + uy * dy + uz * dz
    across = (np.float32(2.0) * r - np.float32(1.0)) / (r * r)
    radial = along * (np.float32(1.0) / (r * r) - across)
    return dx * across + ux * radial, dy * across + uy * radial, dz * across + uz * radial


@njit(cache=True, nogil=True, error_model="numpy")
def _advance(ox, oy, oz, dx, dy, dz, t, far, jitter, step, states, extent, contracted):  # type: ignore[no-untyped-def]
    """The first place at or after t where a surface may be: t, position, speed there, state; t >= far when there is none."""
    grid = states.shape[0]
    half = np.float32(0.5 * grid / extent)
    skipped = False
    while t < far:
        x, y, z = ox + dx * t, oy + dy * t, oz + dz * t
        r = np.float32(0.0)
        if contracted:
            cx, cy, cz, r = _contract(x, y, z)
            vx, vy, vz = _velocity(x, y, z, r, dx, dy, dz)
        else:
            cx, cy, cz, vx, vy, vz = x, y, z, dx, dy, dz
        speed = np.float32(math.sqrt(vx * vx + vy * vy + vz * vz))
        ix = min(max(int((cx + extent) * half), 0), grid - 1)
        iy = min(max(int((cy + extent) * half), 0), grid - 1)
        iz = min(max(int((cz + extent) * half), 0), grid - 1)
        state = states[ix, iy, iz]
        if state < 2:
            if skipped:  # a ray enters a shell at a random place, so that samples do not all lie on the faces of cells
                t += jitter * step / speed
                x, y, z = ox + dx * t, oy + dy * t, oz + dz * t
                if contracted:
                    cx, cy, cz, _ = _contract(x, y, z)
                else:
                    cx, cy, cz = x, y, z
            return t, cx, cy, cz, r, speed, state
        skipped = True
        leave = np.float32(1e9)
        if abs(vx) > 1e-9:
            leave = min(leave, (np.float32(ix + (1 if vx > 0 else 0)) / half - extent - cx) / vx)
        if abs(vy) > 1e-9:
            leave = min(leave, (np.float32(iy + (1 if vy > 0 else 0)) / half - extent - cy) / vy)
        if abs(vz) > 1e-9:
            leave = min(leave, (np.float32(iz + (1 if vz > 0 else 0)) / half - extent - cz) / vz)
        # the cell's certificate may reach beyond it
        leave = max(leave, np.float32(state - 2) / (half * speed * np.float32(2.0))) + np.float32(0.1) * step / speed
        if contracted:
            leave = min(leave, _SKIP * max(r, np.float32(1.0)))
        t = max(t + leave, t * _ONWARD)
    return far, np.float32(0.0), np.float32(0.0), np.float32(0.0), np.float32(0.0), np.float32(1.0), np.uint8(0)


@njit(cache=True, nogil=True, error_model="numpy")
def _to_rows(block, n):  # type: ignore[no-untyped-def]
    """x y z x y z ... → a row of x, of y, of z."""
    copy = block[: 3 * n].copy()
    for i in range(n):
        block[i] = copy[3 * i]
        block[n + i] = copy[3 * i + 1]
        block[2 * n + i] = copy[3 * i + 2]


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def trace_forward(  # type: ignore[no-untyped-def]
    origins, directions, near, far, jitter, states, extent, contracted, sharpness, step, stride, grazing, significant, opaque,
    spheres, table, resolutions, offsets, active, weight, last,
    a_table, a_resolutions, a_offsets, a_active,
    keep, block, hidden, sdf, ray_of, time_of, t_of, f_of, p_of, id_of, counts, rounds, sizes,
    s_block, s_ray, s_k, s_time, s_weight, s_count, features, opacity, shown, depth, samples,
):  # fmt: skip
    """March, evaluate, weigh and composite; see ``rendering.trace``. Stores: one slot per chunk when ``keep``, else per thread."""
    rays = origins.shape[0]
    levels = a_resolutions.shape[0]
    size = FIRST + FEATURES * resolutions.shape[0]
    units = weight.shape[0]
    for chunk in prange((rays + CHUNK - 1) // CHUNK):
        slot = np.int64(chunk) if keep else np.int64(get_thread_id())
        begin = np.int64(chunk) * CHUNK
        count = min(CHUNK, rays - begin)
        # lanes: the rays under way; a lane whose ray has ended takes the next ray that waits
        where = np.empty(CHUNK, np.float32)
        tau_of = np.empty(CHUNK, np.float64)
        speed_of = np.empty(CHUNK, np.float32)
        reach_of = np.empty(CHUNK, np.float32)
        state_of = np.empty(CHUNK, np.uint8)
        lanes = np.empty(LANES, np.int32)
        going = 0
        waiting = 0
        used = 0
        n_blocks = 0
        while going > 0 or waiting < count:
            n = np.int64(0)
            f = block[slot, used * size :]
            taken = 0
            while n < LANES and (taken < going or waiting < count):
                if taken < going:
                    i = lanes[taken]
                    taken += 1
                else:
                    i = np.int32(waiting)
                    waiting += 1
                    where[i] = near[begin + i] + jitter[begin + i] * step
                    tau_of[i] = 0.0
                    counts[slot, i] = 0
                o = begin + i
                t, x, y, z, r, speed, state = _advance(
                    origins[o, 0], origins[o, 1], origins[o, 2], directions[o, 0], directions[o, 1], directions[o, 2],
                    where[i], far[o], jitter[o], step, states, extent, contracted,
                )  # fmt: skip
                if t >= far[o]:
                    continue
                where[i] = t
                speed_of[i], reach_of[i], state_of[i] = speed, r, state
                lanes[n] = i
                # rows are laid out once n is known
                f[3 * n], f[3 * n + 1], f[3 * n + 2] = x, y, z
                n += 1
            if n == 0:
                break
            _to_rows(f, n)
            for i in range(3 * n, 4 * n):
                f[i] = np.float32(1.0)
            surface_block(
                f, hidden[slot, used * units :], sdf[slot, used : used + n], n, extent, spheres,
                table, resolutions, offsets, active, weight, last,
            )  # fmt: skip
            going = 0
            for a in range(n):
                i = lanes[a]
                k = counts[slot, i]
                value = sdf[slot, used + a]
                t = where[i]
                here = i * MOST + k
                t_of[slot, here] = t
                f_of[slot, here] = value
                p_of[slot, here] = _softplus(-sharpness * np.float64(value))
                id_of[slot, here] = used + a
                ray_of[slot, used + a] = i
                time_of[slot, used + a] = t
                slope = np.float32(1.0)
                if k > 0:
                    tau_of[i] += max(0.0, p_of[slot, here] - p_of[slot, here - 1])
                    slope = (f_of[slot, here - 1] - value) / ((t - t_of[slot, here - 1]) * speed_of[i])
                counts[slot, i] = k + 1
                if tau_of[i] > opaque or k + 1 == MOST or (state_of[i] == 1 and k > 0):
                    continue
                # the step that changes the distance by about ``step``: long where the ray grazes, and long far from the surface
                jump = step / max(slope, grazing)
                if value > 0:
                    jump = max(jump, stride * (value - np.float32(3.0 / sharpness)))
                jump = jump / speed_of[i]
                if contracted:
                    jump = min(jump, _SKIP * max(reach_of[i], np.float32(1.0)))
                where[i] = t + jump
                lanes[going] = i
                going += 1
            sizes[slot, n_blocks] = n
            n_blocks += 1
            used += int(n)
        rounds[slot, 0] = n_blocks
        samples[chunk] = used
        # sections that matter, in the order of the rays
        sections = np.int64(0)  # as a literal, blocks would be compiled for it, too
        for i in range(count):
            o = begin + i
            tau_sum = 0.0
            before = 0.0
            depth[o] = np.float32(np.nan)
            for k in range(counts[slot, i] - 1):
                tau = p_of[slot, i * MOST + k + 1] - p_of[slot, i * MOST + k]
                if tau < 1e-7:
                    continue
                f0 = f_of[slot, i * MOST + k]
                f1 = f_of[slot, i * MOST + k + 1]
                w = math.exp(-tau_sum) * -math.expm1(-tau)
                tau_sum += tau
                if tau_sum > opaque:  # the ray was ended here: what is left belongs to this surface, too
                    w += math.exp(-tau_sum)
                if w > significant or (before < 0.5 and before + w >= 0.5):
                    crossing = np.float32(0.5)
                    if f0 > 0 and f1 <= 0:
                        crossing = f0 / (f0 - f1)
                    t0 = t_of[slot, i * MOST + k]
                    t = t0 + crossing * (t_of[slot, i * MOST + k + 1] - t0)
                    if before < 0.5 and before + w >= 0.5:
                        depth[o] = t
                    if w > significant:
                        x = origins[o, 0] + directions[o, 0] * t
                        y = origins[o, 1] + directions[o, 1] * t
                        z = origins[o, 2] + directions[o, 2] * t
                        if contracted:
                            x, y, z, _ = _contract(x, y, z)
                        s_block[slot, 3 * sections] = x
                        s_block[slot, 3 * sections + 1] = y
                        s_block[slot, 3 * sections + 2] = z
                        s_ray[slot, sections] = i
                        s_k[slot, sections] = k
                        s_time[slot, sections] = t
                        s_weight[slot, sections] = w
                        sections += 1
                before += w
            opacity[o] = before
        s_count[slot, 0] = sections
        _to_rows(s_block[slot], sections)
        encode_block(s_block[slot], sections, extent, a_table, a_resolutions, a_offsets, a_active, 3)
        for i in range(count):
            shown[begin + i] = np.float32(0.0)
            for j in range(FEATURES * levels):
                features[begin + i, j] = np.float32(0.0)
        for s in range(sections):
            o = begin + s_ray[slot, s]
            w = s_weight[slot, s]
            shown[o] += w
            for j in range(FEATURES * a_active):
                features[o, j] += w * s_block[slot, (3 + j) * sections + s]
        for i in range(count):
            scale = np.float32(1.0) / max(shown[begin + i], np.float32(1e-12))
            for j in range(FEATURES * a_active):
                features[begin + i, j] *= scale


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def trace_backward(  # type: ignore[no-untyped-def]
    rays, g_features, g_opacity, features, shown, sharpness,
    active, weight, last, a_active,
    block, hidden, sdf, p_of, id_of, counts, rounds, sizes, s_block, s_ray, s_k, s_weight, s_count, row, weight_out, last_out,
):  # fmt: skip
    """Gradients of what ``trace_forward`` stored: weights per chunk; distances and feature rows are replaced by their gradients."""
    size = block.shape[1] // (CHUNK * MOST)
    units = weight.shape[0]
    for chunk in prange((rays + CHUNK - 1) // CHUNK):
        begin = np.int64(chunk) * CHUNK
        count = min(CHUNK, rays - begin)
        weight_out[chunk] = np.float32(0.0)
        last_out[chunk] = np.float32(0.0)
        sections = s_count[chunk, 0]
        sf = s_block[chunk]
        at = 0
        g_weight = np.empty(MOST, np.float64)
        for i in range(count):
            o = begin + i
            samples = counts[chunk, i]
            for k in range(samples):
                sdf[chunk, id_of[chunk, i * MOST + k]] = np.float32(0.0)
                g_weight[k] = g_opacity[o]
            scale = np.float32(1.0) / max(shown[o], np.float32(1e-12))
            while at < sections and s_ray[chunk, at] == i:
                g = g_opacity[o]
                w = s_weight[chunk, at] * scale
                for j in range(FEATURES * a_active):
                    place = (3 + j) * sections + at
                    gf = g_features[o, j]
                    g += gf * scale * (sf[place] - features[o, j])
                    sf[place] = gf * w
                g_weight[s_k[chunk, at]] = g
                at += 1
            # d loss / d sdf through the weights: first the total of gradient times weight, then what is left behind each section
            tau_sum = 0.0
            total = 0.0
            for k in range(samples - 1):
                tau = max(0.0, p_of[chunk, i * MOST + k + 1] - p_of[chunk, i * MOST + k])
                total += g_weight[k] * math.exp(-tau_sum) * -math.expm1(-tau)
                tau_sum += tau
            tau_sum = 0.0
            for k in range(samples - 1):
                p0, p1 = p_of[chunk, i * MOST + k], p_of[chunk, i * MOST + k + 1]
                tau = p1 - p0
                if tau > 1e-7:
                    transmittance = math.exp(-tau_sum)
                    total -= g_weight[k] * transmittance * -math.expm1(-tau)
                    # p is -log of the sigmoid of s f, so its slope is -s (1 - e^-p)
                    d_tau = g_weight[k] * transmittance * math.exp(-tau) - total
                    sdf[chunk, id_of[chunk, i * MOST + k]] += np.float32(d_tau * sharpness * -math.expm1(-p0))
                    sdf[chunk, id_of[chunk, i * MOST + k + 1]] -= np.float32(d_tau * sharpness * -math.expm1(-p1))
                    tau_sum += tau
        used = 0
        for b in range(rounds[chunk, 0]):
            n = np.int64(sizes[chunk, b])
            surface_block_backward(
                block[chunk, used * size :], hidden[chunk, used * units :], sdf[chunk, used : used + n], n,
                active, weight, last, row[chunk], weight_out[chunk], last_out[chunk],
            )  # fmt: skip
            used += int(n)


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def trace_scatter(  # type: ignore[no-untyped-def]
    rays, extent, resolutions, offsets, active, block, rounds, sizes, gradient,
    a_resolutions, a_offsets, a_active, s_block, s_count, a_gradient,
):  # fmt: skip
    """Both tables' gradients, one task per level and table."""
    size = block.shape[1] // (CHUNK * MOST)
    chunks = (rays + CHUNK - 1) // CHUNK
    for each in prange(active + a_active):
        task = np.int64(each)
        if task < active:
            for chunk in range(chunks):
                used = 0
                for b in range(rounds[chunk, 0]):
                    n = np.int64(sizes[chunk, b])
                    scatter_block(block[chunk, used * size :], n, extent, gradient, resolutions, offsets, task, FIRST)
                    used += int(n)
        else:
            for chunk in range(chunks):
                scatter_block(s_block[chunk], np.int64(s_count[chunk, 0]), extent, a_gradient, a_resolutions, a_offsets, task - active, 3)


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
def trace_rays_backward(  # type: ignore[no-untyped-def]
    origins, directions, extent, contracted, spheres, table, resolutions, offsets, active, weight,
    a_table, a_resolutions, a_offsets, a_active,
    block, hidden, sdf, ray_of, time_of, rounds, sizes, s_block, s_ray, s_time, s_count, origins_out, directions_out,
):  # fmt: skip
    """After ``trace_backward``: gradients to origins and directions, with the samples' ray distances held fixed."""
    rays = origins.shape[0]
    size = block.shape[1] // (CHUNK * MOST)
    units = weight.shape[0]
    for chunk in prange((rays + CHUNK - 1) // CHUNK):
        begin = np.int64(chunk) * CHUNK
        for o in range(begin, min(rays, begin + CHUNK)):
            for a in range(3):
                origins_out[o, a] = np.float32(0.0)
                directions_out[o, a] = np.float32(0.0)
        used = 0
        sections = s_count[chunk, 0]
        out = np.zeros(3 * max(np.int64(LANES), np.int64(sections)), np.float32)
        for b in range(rounds[chunk, 0] + 1):
            last = b == rounds[chunk, 0]
            n = np.int64(sections if last else sizes[chunk, b])
            if last:
                out[: 3 * n] = np.float32(0.0)
                position_block(s_block[chunk], n, extent, a_table, a_resolutions, a_offsets, a_active, 3, out)
            else:
                surface_block_positions(
                    block[chunk, used * size :], hidden[chunk, used * units :], sdf[chunk, used : used + n], n, extent, spheres,
                    table, resolutions, offsets, active, weight, out,
                )  # fmt: skip
            for i in range(n):
                o = begin + (s_ray[chunk, i] if last else ray_of[chunk, used + i])
                t = s_time[chunk, i] if last else time_of[chunk, used + i]
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
