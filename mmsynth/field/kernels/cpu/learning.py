"""A step of a fit on the CPU, fused: each chunk of rays passes from its samples to all gradients of its loss in one go, in the caches.

Chunks are tasks that threads take from a counter, so that none waits for another that the machine has slowed; what they leave is per chunk,
and summed in the order of the chunks. The tables follow when all chunks are done: a task for each level (``learn_tables``).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit, prange

from mmsynth.field.kernels.constants import FEATURES, FIRST_FEATURE_ROW, LEAST_WEIGHT
from mmsynth.field.kernels.cpu import mirroring, shading
from mmsynth.field.kernels.cpu.blocks import SurfaceLayers, padded_output, scatter_block, surface_block, surface_block_backward
from mmsynth.field.kernels.cpu.marching import CHUNK, composite, contract, find_sections, march_rays, velocity
from mmsynth.field.kernels.cpu.matrices import TILE_COLS, TILE_ROWS, add_product, clear, padded, padded_to, whole
from mmsynth.field.kernels.cpu.mirroring import mirror_rays, mirror_rays_backward
from mmsynth.field.kernels.cpu.shading import Layers, clear_gradients, compare_rays, first_at, layer, layer_backward
from mmsynth.field.kernels.cpu.tasks import take
from mmsynth.field.kernels.cpu.tracing_gradients import rays_backward, samples_backward
from mmsynth.field.kernels.learning import TAPS
from mmsynth.field.kernels.parameters import Mirrors, Rays, ShadedRays

POINTS = 64  # of all space, in a task
TAPPED = 32  # points of a block, which are four positions each
MOST_TAPPED = 2 * CHUNK  # points of a chunk
_TAPS = np.array(TAPS, np.float32)
_f = np.float32
_ZERO, _ONE = _f(0.0), _f(1.0)
_LEAST_WEIGHT, _TINY = _f(LEAST_WEIGHT), _f(1e-12)


class TapStore(NamedTuple):
    """Of points at which the surface's gradient is asked for, a slot per chunk: block (see ``blocks``), four rows a point; used: rows; the
    weights' gradients."""

    block: np.ndarray
    used: np.ndarray
    turned_out: np.ndarray
    output_out: np.ndarray


class TableStore(NamedTuple):
    """What tables learn from, a slot per chunk of rays: of the samples that have a gradient, their rows (see ``blocks``), and of the sections;
    how many; the gradients of the surface's weights."""

    block: np.ndarray
    samples: np.ndarray
    s_block: np.ndarray
    sections: np.ndarray
    turned_out: np.ndarray
    output_out: np.ndarray


class ChunkScratch(NamedTuple):
    """Of the rays of a chunk, a slot per thread. Rows: ``CHUNK`` surfaces nearest to the cameras, and ``CHUNK`` behind them."""

    hidden: np.ndarray  # of the taps: a row for each of ``TapStore``
    features: np.ndarray  # (2, CHUNK, F)
    weight: np.ndarray  # (2, CHUNK)
    distance: np.ndarray
    shown: np.ndarray
    depth: np.ndarray  # (CHUNK,)
    behind: np.ndarray
    mixed: np.ndarray  # (2 CHUNK, F), features and share with the light from far
    mixed_share: np.ndarray
    g_features: np.ndarray
    g_share: np.ndarray
    material: np.ndarray  # (2 CHUNK, 5 + K)
    normals: np.ndarray  # (2 CHUNK, 3)
    points: np.ndarray
    directions: np.ndarray
    slopes: np.ndarray
    g_material: np.ndarray
    g_normals: np.ndarray
    mirror_share: np.ndarray
    g_mirror_share: np.ndarray
    at: np.ndarray  # (MOST_TAPPED, 3), points in the frame of the grid, and what is asked of them
    found: np.ndarray
    row_of: np.ndarray  # (MOST_TAPPED,)
    shallow: np.ndarray
    x: np.ndarray  # of the light's network: matrices of whole tiles
    h: np.ndarray
    y: np.ndarray
    gy: np.ndarray
    gh: np.ndarray


class LightOut(NamedTuple):
    """Gradients of the lamps and of their network per chunk, and of the light from far; of losses."""

    first: np.ndarray
    first_bias: np.ndarray
    second: np.ndarray
    second_bias: np.ndarray
    position: np.ndarray
    spectrum: np.ndarray
    far: np.ndarray
    loss: np.ndarray


class LightLayers(NamedTuple):
    """The light's network, padded to whole tiles, (units, inputs) and turned to (inputs, units)."""

    first: np.ndarray
    first_turned: np.ndarray
    first_bias: np.ndarray
    second: np.ndarray
    second_turned: np.ndarray
    second_bias: np.ndarray


@njit(cache=True, nogil=True, error_model="numpy")
def _slopes(at, n, epsilon, grid, surface, taps, slot, hidden, found):  # type: ignore[no-untyped-def]
    """See ``learning.surface_gradient``: of n points ``at`` (n, 3), whose taps are kept in the slot of ``taps`` behind what is there."""
    move, scale = epsilon / _f(math.sqrt(3.0)), _f(math.sqrt(3.0)) / (_f(4.0) * epsilon)
    values = np.empty(4 * TAPPED, np.float32)
    for begin in range(0, n, TAPPED):
        count, used = np.int64(min(TAPPED, n - begin)), np.int64(taps.used[slot, 0])
        block = taps.block[slot, used:]
        for i in range(count):
            for t in range(4):
                row = 4 * i + t
                for a in range(3):
                    block[row, a] = at[begin + i, a] + move * _TAPS[t, a]
                block[row, 3] = _ONE
        surface_block(block, hidden[used:], values, 4 * count, grid, surface)
        for i in range(count):
            for a in range(3):
                total = _ZERO
                for t in range(4):
                    total += values[4 * i + t] * _TAPS[t, a]
                found[begin + i, a] = total * scale
        taps.used[slot, 0] = used + 4 * count


@njit(cache=True, nogil=True, error_model="numpy")
def _slopes_backward(g, n, epsilon, grid, surface, taps, slot, hidden, first):  # type: ignore[no-untyped-def]
    """From gradients g (n, 3) of the slopes, whose taps are kept from ``first`` on."""
    scale = _f(math.sqrt(3.0)) / (_f(4.0) * epsilon)
    values = np.empty(4 * TAPPED, np.float32)
    for begin in range(0, n, TAPPED):
        count, used = np.int64(min(TAPPED, n - begin)), first + 4 * begin
        for i in range(count):
            for t in range(4):
                total = _ZERO
                for a in range(3):
                    total += g[begin + i, a] * _TAPS[t, a]
                values[4 * i + t] = total * scale
        surface_block_backward(
            taps.block[slot, used:], hidden[used:], values, 4 * count, grid.active, surface, taps.turned_out[slot],
            taps.output_out[slot],
        )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def _pull(slope, factor, shallow, g):  # type: ignore[no-untyped-def]
    """``factor`` (|slope| - 1)², times ``shallow`` below 1; its gradient is added to g (3,)."""
    norm = _f(math.sqrt(slope[0] * slope[0] + slope[1] * slope[1] + slope[2] * slope[2]))
    off = norm - _ONE
    factor *= shallow if off < _ZERO else _ONE
    if norm > _ZERO:
        for a in range(3):
            g[a] += _f(2.0) * factor * off * slope[a] / norm
    return np.float64(factor * off * off)


@njit(cache=True, nogil=True, error_model="numpy")
def _is_within(p):  # type: ignore[no-untyped-def]
    return math.sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2]) < _ONE


@njit(cache=True, nogil=True, error_model="numpy")
def _learn_points(chunk, count, points, begin, eikonal, factor, grid, surface, scratch, slot, taps):  # type: ignore[no-untyped-def]
    """The pull at some of the points of all space: its part of the loss."""
    at, found = points[begin : begin + count], scratch.found[slot]
    taps.used[chunk, 0] = 0
    taps.turned_out[chunk], taps.output_out[chunk] = _ZERO, _ZERO
    _slopes(at, count, eikonal.epsilon, grid, surface, taps, chunk, scratch.hidden[slot], found)
    loss, g = 0.0, np.zeros((count, 3), np.float32)
    for i in range(count):
        loss += _pull(found[i], factor, eikonal.shallow if _is_within(at[i]) else _ONE, g[i])
    _slopes_backward(g, count, eikonal.epsilon, grid, surface, taps, chunk, scratch.hidden[slot], 0)
    return loss


@njit(cache=True, nogil=True, error_model="numpy")
def _mix(count, far_light, features, share, opacity, behind, mixed, mixed_share):  # type: ignore[no-untyped-def]
    """See ``learning.with_far_light``."""
    width = features.shape[1]
    for i in range(count):
        for which in range(2 if behind[i] >= 0 else 1):
            row = i if which == 0 else behind[i]
            mixed_share[row] = share[row]
            mixed[row] = features[row]
        row = behind[i] if behind[i] >= 0 else i
        passed = _ONE - opacity[i]
        mixed_share[row] += passed
        part = passed / max(mixed_share[row], _LEAST_WEIGHT)
        for j in range(width):
            mixed[row, j] += part * (far_light[j] - mixed[row, j])


@njit(cache=True, nogil=True, error_model="numpy")
def _mix_backward(count, far_light, features, share, opacity, behind, mixed_share, g_features, g_share, g_far):  # type: ignore[no-untyped-def]
    """Gradients of what is shaded, g_features and g_share, become those of what was met."""
    width = features.shape[1]
    for i in range(count):
        row = behind[i] if behind[i] >= 0 else i
        passed = _ONE - opacity[i]
        total = mixed_share[row]
        part = passed / max(total, _LEAST_WEIGHT)
        g_part = _ZERO
        for j in range(width):
            g = g_features[row, j]
            g_part += g * (far_light[j] - features[row, j])
            g_far[j] += part * g
            g_features[row, j] = g * (_ONE - part)
        g_passed = g_part / max(total, _LEAST_WEIGHT)
        if total > _LEAST_WEIGHT:
            g_share[row] -= g_part * passed / (total * total)
        g_passed += g_share[row]
        g_share[i] -= g_passed
        if behind[i] >= 0:
            g_share[behind[i]] -= g_passed


@njit(cache=True, nogil=True, error_model="numpy")
def _see_mirrors(begin, count, ray0, rays, taps, lamps, light, measured, scratch, slot, chunk, grid, surface, epsilon, mirrored):  # type: ignore[no-untyped-def]
    """Surfaces of some rays as mirrors: points, slopes, normals, material, and the light that they mirror. Blocks are added to ``taps``."""
    s, behind = scratch, scratch.behind[slot]
    material, normals, points, directions = s.material[slot], s.normals[slot], s.points[slot], s.directions[slot]
    features, distance = s.features[slot].reshape(2 * CHUNK, -1), s.distance[slot].reshape(2 * CHUNK)
    at, found, row_of, share = s.at[slot], s.found[slot], s.row_of[slot], s.weight[slot].reshape(2 * CHUNK)
    x, h, y = s.x[slot], s.h[slot], s.y[slot]
    wide = grid.extent > _ONE
    width, n = features.shape[1], np.int64(0)
    for which in range(2):
        for i in range(begin, begin + count):
            if which == 1 and behind[i] < 0:
                continue
            row = i if which == 0 else behind[i]
            for a in range(3):
                directions[row, a] = rays.directions[i, a]
                points[row, a] = rays.origins[i, a] + rays.directions[i, a] * distance[row]
                normals[row, a] = _ZERO
            s.mirror_share[slot][row] = _ZERO
            if distance[row] > _ZERO:
                s.mirror_share[slot][row] = share[row]
                px, py, pz = points[row, 0], points[row, 1], points[row, 2]
                if wide:
                    px, py, pz, _ = contract(px, py, pz)
                at[n, 0], at[n, 1], at[n, 2] = px, py, pz
                row_of[n] = row
                n += 1
    _slopes(at, n, epsilon, grid, surface, taps, chunk, scratch.hidden[slot], found)
    clear(x, whole(n, TILE_ROWS), x.shape[1])
    for i in range(n):
        row = row_of[i]
        sx, sy, sz = found[i, 0], found[i, 1], found[i, 2]
        if wide:
            px, py, pz = points[row, 0], points[row, 1], points[row, 2]
            r = _f(math.sqrt(px * px + py * py + pz * pz))
            sx, sy, sz = velocity(px, py, pz, r, sx, sy, sz)
        norm = max(_f(math.sqrt(sx * sx + sy * sy + sz * sz)), _TINY)
        normals[row, 0], normals[row, 1], normals[row, 2] = sx / norm, sy / norm, sz / norm
        for j in range(width):
            x[i, j] = features[row, j]
    layer(n, x, whole(width, TILE_COLS), light.first_turned, light.first_bias, h)
    rows = whole(n, TILE_ROWS)
    clear(y, rows, y.shape[1])
    add_product(h, light.second_turned, y, rows, h.shape[1], y.shape[1])
    for i in range(n):
        for k in range(material.shape[1]):
            material[row_of[i], k] = y[i, k] + light.second_bias[k]
    mirrors = Mirrors(material, normals, points, directions, s.mirror_share[slot])
    mirror_rays(begin, begin + count, ray0, lamps, mirrors, behind, measured, mirrored)
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def _mirrors_backward(  # type: ignore[no-untyped-def]
    begin, count, n, first, ray0, trains, taps, lamps, light, measured, scratch, slot, chunk, grid, surface, eikonal, factor, g_mirrored, out
):  # fmt: skip
    """Gradients of ``_see_mirrors``, of whose n points ``first`` is the first block, and the pull at them: its part of the loss."""
    s, behind = scratch, scratch.behind[slot]
    normals, points, found, row_of = s.normals[slot], s.points[slot], s.found[slot], s.row_of[slot]
    g_material, g_normals, g_share = s.g_material[slot], s.g_normals[slot], s.g_mirror_share[slot]
    mirrors = Mirrors(s.material[slot], normals, points, s.directions[slot], s.mirror_share[slot])
    gradients = mirroring.Gradients(g_material, g_normals, g_share, out.position, out.spectrum)
    mirror_rays_backward(begin, begin + count, ray0, chunk, lamps, mirrors, behind, measured, g_mirrored, gradients)
    x, h, gy, gh, at = s.x[slot], s.h[slot], s.gy[slot], s.gh[slot], s.at[slot]
    rows, wide, loss = whole(n, TILE_ROWS), grid.extent > _ONE, 0.0
    clear(gy, rows, gy.shape[1])
    for i in range(n):
        row = row_of[i]
        teaches = trains[row if row < CHUNK else row - CHUNK]
        for a in range(3):
            at[i, a] = _ZERO
        if teaches:
            for k in range(g_material.shape[1]):
                gy[i, k] = g_material[row, k]
                out.second_bias[chunk, k] += gy[i, k]
            sx, sy, sz = found[i, 0], found[i, 1], found[i, 2]
            px, py, pz = points[row, 0], points[row, 1], points[row, 2]
            r = _f(math.sqrt(px * px + py * py + pz * pz))
            if wide:
                sx, sy, sz = velocity(px, py, pz, r, sx, sy, sz)
            norm = max(_f(math.sqrt(sx * sx + sy * sy + sz * sz)), _TINY)
            along = _ZERO
            for a in range(3):
                along += normals[row, a] * g_normals[row, a]
            gx = (g_normals[row, 0] - along * normals[row, 0]) / norm
            gy_, gz = (g_normals[row, 1] - along * normals[row, 1]) / norm, (g_normals[row, 2] - along * normals[row, 2]) / norm
            if wide:  # symmetric
                gx, gy_, gz = velocity(px, py, pz, r, gx, gy_, gz)
            at[i, 0], at[i, 1], at[i, 2] = gx, gy_, gz
        loss += _pull(found[i], factor, _ONE, at[i])
    _slopes_backward(at, n, eikonal.mirror_epsilon, grid, surface, taps, chunk, scratch.hidden[slot], first)
    add_product(gy.T, h, out.second[chunk], gy.shape[1], n, h.shape[1])
    clear(gh, rows, gh.shape[1])
    add_product(gy, light.second, gh, rows, gy.shape[1], gh.shape[1])
    layer_backward(n, x, x.shape[1], gh, h, out.first[chunk], out.first_bias[chunk])
    clear(x, rows, x.shape[1])
    add_product(gh, light.first, x, rows, gh.shape[1], x.shape[1])
    g_features, g_met = s.g_features[slot], s.g_share[slot]
    for i in range(n):
        row = row_of[i]
        if trains[row if row < CHUNK else row - CHUNK]:
            g_met[row] += g_share[row]
            for j in range(g_features.shape[1]):
                g_features[row, j] += x[i, j]
    return loss


@njit(cache=True, nogil=True, error_model="numpy")
def _learn_rays(  # type: ignore[no-untyped-def]
    chunk, slot, begin, count, total, rays, states, sampling, grid, surface, appearance, layers, heads, heads_bias, light, lamps, far_light,
    view, measured, gain, opacities, eikonal, asked, store, kept, taps, shaded, scratch, out, samples, squared, mirrored, g_mirrored, g_gain,
):  # fmt: skip
    """All of a chunk of rays, of which ``begin`` is the first: its loss."""
    s, sharpness = scratch, sampling.sharpness
    end = begin + count
    here = Rays(rays.origins[begin:end], rays.directions[begin:end], rays.near[begin:end], rays.far[begin:end], rays.jitter[begin:end])
    features, weight, distance, shown, depth = s.features[slot], s.weight[slot], s.distance[slot], s.shown[slot], s.depth[slot]
    behind, g_features, g_share = s.behind[slot], s.g_features[slot], s.g_share[slot]
    wide = grid.extent > _ONE
    samples[chunk] = march_rays(0, count, slot, here, states, sampling, grid, surface, store)
    sections = find_sections(0, count, slot, here, wide, sampling, store, weight, depth)
    composite(0, count, slot, sections, appearance, store, features, distance, shown)
    share, rows = weight.reshape(2 * CHUNK), features.reshape(2 * CHUNK, -1)
    opacity = np.empty(CHUNK, np.float32)
    loss = 0.0
    for i in range(count):
        behind[i] = CHUNK + i if weight[1, i] != _ZERO else -1
        opacity[i] = weight[0, i] + weight[1, i]
    taps.used[chunk, 0] = 0
    taps.turned_out[chunk], taps.output_out[chunk] = _ZERO, _ZERO
    shines, trains = len(lamps.position) > 0, view.trains_geometry[begin:end]
    factor = eikonal.weight / _f(max(asked, 1))
    if shines:
        out.first[chunk], out.first_bias[chunk], out.second[chunk], out.second_bias[chunk] = _ZERO, _ZERO, _ZERO, _ZERO
        out.position[chunk], out.spectrum[chunk] = _ZERO, _ZERO
    out.far[chunk] = _ZERO
    clear_gradients(shaded, chunk)
    to_shade, to_share = rows, share
    if len(far_light):
        _mix(count, far_light, rows, share, opacity, behind, s.mixed[slot], s.mixed_share[slot])
        to_shade, to_share = s.mixed[slot], s.mixed_share[slot]
    seen = ShadedRays(to_shade, to_share, behind, here.directions, view.degrees[begin:end], trains)
    for sub in range(0, count, shading.CHUNK):
        some = np.int64(min(shading.CHUNK, count - sub))
        first, n = np.int64(taps.used[chunk, 0]), np.int64(0)
        if shines:
            n = _see_mirrors(
                sub, some, begin, here, taps, lamps, light, measured, scratch, slot, chunk, grid, surface, eikonal.mirror_epsilon,
                mirrored,
            )  # fmt: skip
        for i in range(sub, sub + some):
            for which in range(2):
                g_share[which * CHUNK + i] = _ZERO
                g_features[which * CHUNK + i] = _ZERO
        if first_at(measured.ray, begin + sub) < first_at(measured.ray, begin + sub + some):
            loss += compare_rays(
                np.int64(sub), some, begin, slot, chunk, seen, measured, gain, mirrored, layers, heads, heads_bias, True, shaded, squared,
                g_features, g_share, g_gain, g_mirrored,
            )  # fmt: skip
        if len(far_light):
            _mix_backward(
                some, far_light, rows[sub:], share[sub:], opacity[sub:], _shifted(behind, sub, some), s.mixed_share[slot][sub:],
                g_features[sub:], g_share[sub:], out.far[chunk],
            )  # fmt: skip
        if shines:
            loss += _mirrors_backward(
                sub, some, n, first, begin, trains, taps, lamps, light, measured, scratch, slot, chunk, grid, surface, eikonal, factor,
                g_mirrored, out,
            )  # fmt: skip
    if not shines:
        loss += _learn_met(begin, count, total, here, depth, eikonal, factor, grid, surface, scratch, slot, chunk, taps)
    if len(opacities.target):
        for i in range(count):
            off = opacity[i] - opacities.target[begin + i]
            w, along = opacities.weight[begin + i], opacities.linear[begin + i]
            loss += np.float64(w * off * off + along * opacity[i])
            for which in range(2):
                g_share[which * CHUNK + i] += _f(2.0) * w * off + along
    rays_backward(0, count, slot, behind, g_features, g_share, rows, shown.reshape(2 * CHUNK), sharpness, appearance.active, store)
    kept.turned_out[chunk], kept.output_out[chunk] = _ZERO, _ZERO
    n = _keep(store, kept, slot, chunk, FIRST_FEATURE_ROW + FEATURES * grid.active, FIRST_FEATURE_ROW + FEATURES * appearance.active)
    samples_backward(
        kept.block[chunk], store.hidden[slot], store.sdf[slot], n, grid.active, surface, kept.turned_out[chunk], kept.output_out[chunk]
    )
    return loss


@njit(cache=True, nogil=True, error_model="numpy")
def _keep(store, kept, slot, chunk, width, s_width):  # type: ignore[no-untyped-def]
    """Keep what the tables learn from: the first columns of samples that have a gradient (how many), and of sections. Hidden units and
    gradients of these samples move to the front of their arrays."""
    sdf, block, hidden, out = store.sdf[slot], store.block[slot], store.hidden[slot], kept.block[chunk]
    n = np.int64(0)
    for i in range(store.samples[slot, 0]):
        if sdf[i] == _ZERO:
            continue
        for j in range(width):
            out[n, j] = block[i, j]
        if n < i:
            hidden[n] = hidden[i]
            sdf[n] = sdf[i]
        n += 1
    kept.samples[chunk, 0] = n
    sections = store.s_count[slot, 0]
    kept.sections[chunk, 0] = sections
    for i in range(sections):
        for j in range(s_width):
            kept.s_block[chunk, i, j] = store.s_block[slot, i, j]
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def _shifted(behind, sub, some):  # type: ignore[no-untyped-def]
    """Rows from the ``sub``-th on."""
    out = np.empty(some, np.int64)
    for i in range(some):
        out[i] = behind[sub + i] - sub if behind[sub + i] >= 0 else -1
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _learn_met(begin, count, total, rays, depth, eikonal, factor, grid, surface, scratch, slot, chunk, taps):  # type: ignore[no-untyped-def]
    """The pull near the surfaces that some of the rays meet (see ``learning.asked_rays``): its part of the loss."""
    wide, n, asked = grid.extent > _ONE, np.int64(0), np.int64(min(len(eikonal.noise), total))
    at, found, shallow = scratch.at[slot], scratch.found[slot], scratch.shallow[slot]
    for q in range(asked):
        i = q * total // asked - begin
        if i < 0 or i >= count or not math.isfinite(depth[i]):
            continue
        t = depth[i]
        px, py, pz = (
            rays.origins[i, 0] + rays.directions[i, 0] * t,
            rays.origins[i, 1] + rays.directions[i, 1] * t,
            rays.origins[i, 2] + rays.directions[i, 2] * t,
        )
        if wide:
            px, py, pz, _ = contract(px, py, pz)
        at[n, 0], at[n, 1], at[n, 2] = px + eikonal.noise[q, 0], py + eikonal.noise[q, 1], pz + eikonal.noise[q, 2]
        shallow[n] = eikonal.shallow if _is_within(at[n]) else _ONE
        n += 1
    _slopes(at, n, eikonal.epsilon, grid, surface, taps, chunk, scratch.hidden[slot], found)
    loss = 0.0
    for i in range(n):
        at[i, 0], at[i, 1], at[i, 2] = _ZERO, _ZERO, _ZERO
        loss += _pull(found[i], factor, shallow[i], at[i])
    _slopes_backward(at, n, eikonal.epsilon, grid, surface, taps, chunk, scratch.hidden[slot], 0)
    return loss


@njit(cache=True, nogil=True, error_model="numpy")
def _work(  # type: ignore[no-untyped-def]
    worker, next_task, rays, states, sampling, grid, surface, appearance, layers, heads, heads_bias, light, lamps, far_light, view, measured,
    gain, opacities, eikonal, store, kept, taps, shaded, scratch, out, samples, squared, mirrored, g_mirrored, g_gain,
):  # fmt: skip
    """Take chunks of rays, and then points, until there are none."""
    total, points = rays.origins.shape[0], eikonal.points.shape[0]
    chunks = (total + CHUNK - 1) // CHUNK
    asked = points + (total if len(lamps.position) else len(eikonal.noise))
    while True:
        chunk = take(next_task, 0)
        if chunk < chunks:
            begin = chunk * CHUNK
            out.loss[chunk] = _learn_rays(
                chunk, worker, begin, np.int64(min(CHUNK, total - begin)), total, rays, states, sampling, grid, surface, appearance, layers,
                heads, heads_bias, light, lamps, far_light, view, measured, gain, opacities, eikonal, asked, store, kept, taps, shaded, scratch, out,
                samples, squared, mirrored, g_mirrored, g_gain,
            )  # fmt: skip
            continue
        begin = (chunk - chunks) * POINTS
        if begin >= points:
            return
        factor = eikonal.weight / _f(max(asked, 1))
        out.loss[chunk] = _learn_points(
            chunk, np.int64(min(POINTS, points - begin)), eikonal.points, begin, eikonal, factor, grid, surface, scratch, worker, taps
        )


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def learn_rays(  # type: ignore[no-untyped-def]
    threads, next_task, rays, states, sampling, grid, network, appearance, shader, light, lamps, far_light, view, measured, gain, opacities, eikonal,
    store, kept, taps, shaded, scratch, out, samples, squared, mirrored, g_mirrored, g_gain,
):  # fmt: skip
    """See ``learning.learn``: all but the gradients of the tables, which ``learn_tables`` adds up.

    light: its network with the columns of the lamps that there are. lamps: those. gain, mirrored: (M,), empty where there are none.
    """
    layers = Layers(
        padded(shader.first), padded(shader.first.T), shader.first_bias,
        padded(shader.second), padded(shader.second.T), shader.second_bias,
    )  # fmt: skip
    inputs, units = store.block.shape[2], store.hidden.shape[2]
    surface = SurfaceLayers(
        padded_to(network.hidden, units, inputs), padded_to(network.hidden.T, inputs, units), padded_output(network.output, units),
        network.inner_radius, network.outer_radius,
    )  # fmt: skip
    network_of_light = LightLayers(
        padded(light.first), padded(light.first.T), light.first_bias,
        padded(light.second), padded(light.second.T), light.second_bias,
    )  # fmt: skip
    next_task[0] = 0
    for worker in prange(threads):
        _work(
            np.int64(worker), next_task, rays, states, sampling, grid, surface, appearance, layers, shader.heads, shader.heads_bias,
            network_of_light, lamps, far_light, view, measured, gain, opacities, eikonal, store, kept, taps, shaded, scratch, out, samples, squared,
            mirrored, g_mirrored, g_gain,
        )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def _add_levels(next_task, chunks, point_chunks, grid, appearance, kept, taps, gradient, a_gradient):  # type: ignore[no-untyped-def]
    """Take levels, of the surface's table and then of the appearance's, until there are none."""
    while True:
        task = take(next_task, 0)
        level = task - grid.active
        if level >= appearance.active:
            return
        for chunk in range(chunks):
            if level < 0:
                scatter_block(kept.block[chunk], kept.samples[chunk, 0], grid, gradient, task)
            else:
                scatter_block(kept.s_block[chunk], kept.sections[chunk, 0], appearance, a_gradient, level)
        for chunk in range(chunks + point_chunks if level < 0 else 0):
            scatter_block(taps.block[chunk], taps.used[chunk, 0], grid, gradient, task)


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def learn_tables(threads, next_task, rays, points, grid, appearance, kept, taps, gradient, a_gradient):  # type: ignore[no-untyped-def]
    """Add what ``learn_rays`` found to the gradients of both tables, a task for each level."""
    chunks, point_chunks = (rays + CHUNK - 1) // CHUNK, (points + POINTS - 1) // POINTS
    next_task[0] = 0
    for _ in prange(threads):
        _add_levels(next_task, chunks, point_chunks, grid, appearance, kept, taps, gradient, a_gradient)
