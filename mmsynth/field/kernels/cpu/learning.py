"""A step of a fit on the CPU, fused: each chunk of rays passes from its samples to all gradients of its loss in one go, in the caches.

Chunks are tasks that threads take from a counter, so that none waits for another that the machine has slowed; what they leave is per chunk,
and summed in the order of the chunks. That follows when all are done (``finish``): a task for each level of a table, one for the weights,
and then steps of Adam.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import types

from mmsynth.field.kernels.constants import FEATURES, FIRST_FEATURE_ROW, MOSTLY_BLOCKED
from mmsynth.field.kernels.cpu import shading
from mmsynth.field.kernels.cpu.blocks import scatter_block, surface_block_backward
from mmsynth.field.kernels.cpu.drawing import draw_chunk, drawing_tasks
from mmsynth.field.kernels.cpu.jit import kernel, part
from mmsynth.field.kernels.cpu.marching import CAPACITY, CHUNK, composite, find_sections, march_rays
from mmsynth.field.kernels.cpu.matrices import add_sum, add_sums
from mmsynth.field.kernels.cpu.mirrors import mirrors_backward, mix, mix_backward, see_mirrors
from mmsynth.field.kernels.cpu.optimiser import take_parts
from mmsynth.field.kernels.cpu.roulette import first_chance, least_of, play
from mmsynth.field.kernels.cpu.shading import clear_gradients, compare_rays, first_at
from mmsynth.field.kernels.cpu.slopes import POINTS, learn_met, learn_pairs, learn_points
from mmsynth.field.kernels.cpu.stack import on_stack
from mmsynth.field.kernels.cpu.tasks import take, tell, wait
from mmsynth.field.kernels.cpu.tracing_gradients import rays_backward
from mmsynth.field.kernels.cpu.units import add_of_units
from mmsynth.field.kernels.parameters import Rays, ShadedRays

_f = np.float32
_ZERO, _ONE = _f(0.0), _f(1.0)
_MOSTLY_BLOCKED = _f(MOSTLY_BLOCKED)
_of_rays = on_stack(types.float32, CHUNK)
_of_sections = on_stack(types.float32, CAPACITY)


class TableStore(NamedTuple):
    """What tables learn from, a slot per chunk of rays: rows (see ``blocks``) of samples and of sections that have a gradient and stay in
    the game (see ``roulette``); how many; what the gradients of the surface's weights follow from."""

    block: np.ndarray
    samples: np.ndarray
    s_block: np.ndarray
    sections: np.ndarray
    pulled_out: np.ndarray
    bias_out: np.ndarray


class WeightGradients(NamedTuple):
    """Of a surface's network, of ``ShaderWeights``, of ``LightNetwork`` (empty where nothing shines), and of the light from far."""

    hidden: np.ndarray
    output: np.ndarray
    first: np.ndarray
    first_bias: np.ndarray
    second: np.ndarray
    second_bias: np.ndarray
    heads: np.ndarray
    heads_bias: np.ndarray
    light_first: np.ndarray
    light_first_bias: np.ndarray
    light_second: np.ndarray
    light_second_bias: np.ndarray
    position: np.ndarray
    log_spectrum: np.ndarray
    far_light: np.ndarray


@part()
def _learn_rays(  # type: ignore[no-untyped-def]
    chunk, slot, begin, count, total, rays, states, sampling, grid, surface, appearance, layers, heads, heads_bias, light, lamps, far_light,
    view, measured, gain, opacities, eikonal, smooth, roulette, asked, store, kept, taps, shaded, scratch, out, samples, squared, mirrored,
    g_mirrored, g_gain,
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
    opacity = _of_rays()
    loss = 0.0
    for i in range(count):
        behind[i] = CHUNK + i if weight[1, i] != _ZERO else -1
        opacity[i] = weight[0, i] + weight[1, i]
    taps.used[chunk, 0] = 0
    taps.pulled_out[chunk], taps.bias_out[chunk] = _ZERO, _ZERO
    shines, trains = len(lamps.position) > 0, view.trains_geometry[begin:end]
    of_pull = eikonal.weight / _f(max(asked, 1))
    if shines:
        out.first[chunk], out.first_bias[chunk], out.second[chunk], out.second_bias[chunk] = _ZERO, _ZERO, _ZERO, _ZERO
        out.position[chunk], out.spectrum[chunk] = _ZERO, _ZERO
    out.far[chunk] = _ZERO
    clear_gradients(shaded, chunk)
    to_shade, to_share = rows, share
    if len(far_light):
        mix(count, far_light, rows, share, opacity, behind, s.mixed[slot], s.mixed_share[slot])
        to_shade, to_share = s.mixed[slot], s.mixed_share[slot]
    seen = ShadedRays(to_shade, to_share, behind, here.directions, view.degrees[begin:end], trains)
    for sub in range(0, count, shading.CHUNK):
        some = np.int64(min(shading.CHUNK, count - sub))
        first, n = np.int64(taps.used[chunk, 0]), np.int64(0)
        if shines:
            n = see_mirrors(
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
            mix_backward(sub, sub + some, far_light, rows, share, opacity, behind, s.mixed_share[slot], g_features, g_share, out.far[chunk])
        if shines:
            loss += mirrors_backward(
                sub, some, n, first, begin, trains, taps, lamps, light, measured, scratch, slot, chunk, grid, surface, eikonal, of_pull,
                roulette, g_mirrored, out,
            )  # fmt: skip
    if not shines:
        loss += learn_met(begin, count, total, here, depth, eikonal, of_pull, roulette, grid, surface, scratch, slot, chunk, taps)
    loss += learn_pairs(begin, count, total, here, depth, smooth, roulette, grid, surface, scratch, slot, chunk, taps)
    if len(opacities.target):
        for i in range(count):
            off = opacity[i] - opacities.target[begin + i]
            w, along = opacities.weight[begin + i], opacities.linear[begin + i]
            loss += np.float64(w * off * off + along * opacity[i])
            pull = _f(2.0) * w * off + along
            if opacity[i] > _MOSTLY_BLOCKED:
                passed = _ONE - opacity[i] + opacities.left
                loss -= np.float64(opacities.blocked[begin + i] * math.log(passed))
                pull += opacities.blocked[begin + i] / passed
            for which in range(2):
                g_share[which * CHUNK + i] += pull
    rays_backward(0, count, slot, behind, g_features, g_share, rows, shown.reshape(2 * CHUNK), sharpness, appearance.active, store)
    kept.pulled_out[chunk], kept.bias_out[chunk] = _ZERO, _ZERO
    widths = FIRST_FEATURE_ROW + FEATURES * grid.active, FIRST_FEATURE_ROW + FEATURES * appearance.active
    n = _keep(store, kept, slot, chunk, roulette, *widths)
    surface_block_backward(
        kept.block[chunk], store.gates[slot], store.sdf[slot], n, grid.active, surface, kept.pulled_out[chunk], kept.bias_out[chunk]
    )
    return loss


@part()
def _keep(store, kept, slot, chunk, roulette, width, s_width):  # type: ignore[no-untyped-def]
    """Keep what the tables learn from: the first columns of samples (how many), and of sections. Gates and gradients of these samples
    move to the front of their arrays."""
    sdf, block, gates, out = store.sdf[slot], store.block[slot], store.gates[slot], kept.block[chunk]
    n, samples = np.int64(0), store.samples[slot, 0]
    least = least_of(sdf, samples, roulette)
    chance = first_chance(least)
    for i in range(samples):
        factor, chance = play(abs(sdf[i]), least, chance)
        pull = sdf[i] * factor
        if pull == _ZERO:
            continue
        for j in range(width):
            out[n, j] = block[i, j]
        if n < i:
            for j in range(gates.shape[1]):
                gates[n, j] = gates[i, j]
        sdf[n] = pull
        n += 1
    kept.samples[chunk, 0] = n
    s_block, s_out, sections, sizes = store.s_block[slot], kept.s_block[chunk], store.s_count[slot, 0], _of_sections()
    for i in range(sections):
        sizes[i] = _size(s_block[i], s_width)
    least, some = least_of(sizes, sections, roulette), np.int64(0)
    chance = first_chance(least)
    for i in range(sections):
        factor, chance = play(sizes[i], least, chance)
        if factor == _ZERO:
            continue
        for j in range(FIRST_FEATURE_ROW):
            s_out[some, j] = s_block[i, j]
        for j in range(FIRST_FEATURE_ROW, s_width):
            s_out[some, j] = s_block[i, j] * factor
        some += 1
    kept.sections[chunk, 0] = some
    return n


@part(fastmath={"contract", "reassoc", "nsz"})
def _size(row, width):  # type: ignore[no-untyped-def]
    """Of the gradients of a row's features."""
    total = _ZERO
    for j in range(FIRST_FEATURE_ROW, width):
        total += row[j] * row[j]
    return _f(math.sqrt(total))


@kernel
def learn_rays(  # type: ignore[no-untyped-def]
    next_task, rays, states, sampling, grid, surface, appearance, layers, heads, heads_bias, light, lamps, far_light, view, measured, gain,
    opacities, eikonal, smooth, roulette, ahead, ahead_too, store, kept, taps, shaded, scratch, out, samples, squared, mirrored,
    g_mirrored, g_gain,
):  # fmt: skip
    """See ``learning.learn``: what it leaves per chunk, ``finish`` adds up. Chunks of rays, then points, and then rays of the next step to
    draw, until no task is left.

    next_task: (2,), the second number counts threads, each of which has a slot of its own in the stores.
    surface, layers, light: ``SurfaceLayers``, and ``Layers`` of the shader and of the light's network, with the columns of the lamps that
    there are. lamps: those. gain, mirrored: (M,), empty where there are none. ahead, ahead_too: ``ToFill``.
    """
    worker, total, points = take(next_task, 1), rays.origins.shape[0], eikonal.points.shape[0]
    chunks = (total + CHUNK - 1) // CHUNK
    asked = points + (total if len(lamps.position) else len(eikonal.noise))
    while True:
        chunk = take(next_task, 0)
        if chunk < chunks:
            begin = chunk * CHUNK
            out.loss[chunk] = _learn_rays(
                chunk, worker, begin, np.int64(min(CHUNK, total - begin)), total, rays, states, sampling, grid, surface, appearance, layers,
                heads, heads_bias, light, lamps, far_light, view, measured, gain, opacities, eikonal, smooth, roulette, asked, store, kept,
                taps, shaded, scratch, out, samples, squared, mirrored, g_mirrored, g_gain,
            )  # fmt: skip
            continue
        begin = (chunk - chunks) * POINTS
        if begin < points:
            of_pull, some = eikonal.weight / _f(max(asked, 1)), np.int64(min(POINTS, points - begin))
            out.loss[chunk] = learn_points(
                chunk, some, eikonal.points, begin, eikonal, of_pull, roulette, grid, surface, scratch, worker, taps
            )
            continue
        task, first = chunk - chunks - (points + POINTS - 1) // POINTS, drawing_tasks(ahead)
        if task < first:
            draw_chunk(task, ahead)
        elif task - first < drawing_tasks(ahead_too):
            draw_chunk(task - first, ahead_too)
        else:
            return


@part()
def _add_weights(chunks, tasks, network, kept, taps, shaded, out, rows, used, spectrum, gradients):  # type: ignore[no-untyped-def]
    """Add to the gradients of weights, biases and lamps what each chunk found: the sum of all that they are then, finite if each is."""
    g, pulled, bias = gradients, kept.pulled_out[0], kept.bias_out[0]  # the first chunk's become the sums
    for parts, biases in ((kept.pulled_out[1:chunks], kept.bias_out[1:chunks]), (taps.pulled_out[:tasks], taps.bias_out[:tasks])):
        add_sum(parts, pulled)
        add_sums(biases, bias)
    add_of_units(pulled, bias[0], network.hidden, network.output, g.hidden, g.output)
    add_sum(shaded.first_out[:chunks], g.first)
    add_sums(shaded.first_bias_out[:chunks], g.first_bias)
    add_sum(shaded.second_out[:chunks], g.second)
    add_sums(shaded.second_bias_out[:chunks], g.second_bias)
    add_sum(shaded.heads_out[:chunks], g.heads)
    add_sums(shaded.heads_bias_out[:chunks], g.heads_bias)
    if len(used):
        add_sum(out.first[:chunks], g.light_first)
        add_sums(out.first_bias[:chunks], g.light_first_bias)
        for i in range(len(rows)):
            add_sums(out.second[:chunks, i], g.light_second[rows[i]])
            add_sums(out.second_bias[:chunks, i : i + 1], g.light_second_bias[rows[i] : rows[i] + 1])
        for i in range(len(used)):
            add_sums(out.position[:chunks, i], g.position[used[i]])
            for j in range(spectrum.shape[1]):
                total = _ZERO
                for chunk in range(chunks):
                    total += out.spectrum[chunk, i, j]
                g.log_spectrum[used[i], j] += spectrum[i, j] * total
    add_sums(out.far[:chunks], g.far_light)
    sum_of_all = np.float64(0.0)
    for matrix in (g.hidden, g.first, g.second, g.heads, g.light_first, g.light_second, g.position, g.log_spectrum):
        sum_of_all += matrix.sum()
    for vector in (g.output, g.first_bias, g.second_bias, g.heads_bias, g.light_first_bias, g.light_second_bias, g.far_light):
        sum_of_all += vector.sum()
    return sum_of_all


@kernel
def finish(  # type: ignore[no-untyped-def]
    next_task, done, rays, points, grid, network, appearance, kept, taps, shaded, out, rows, used, spectrum, gradient, a_gradient,
    gradients, sums, places, numbers,
):  # fmt: skip
    """Add what ``learn_rays`` found to the gradients of both tables, a task for each level, and of all else, ``WeightGradients``, and then
    take a step of Adam where all are finite: until no task is left.

    rows, used: of the light's second layer and of the lamps those that there are; spectrum: of these lamps. done: (1 + levels,), what has
    its gradients: first the weights, then levels of the surface, then of the appearance. sums: (2,), the loss, and the sum of gradients of
    gains, to which that of all weights is added. places, numbers: see ``take_parts``.
    """
    chunks, point_chunks = (rays + CHUNK - 1) // CHUNK, (points + POINTS - 1) // POINTS
    while True:
        task = take(next_task, 0) - 1
        level = task - grid.active
        if level >= appearance.active:
            break
        if task < 0:
            sums[1] += _add_weights(chunks, chunks + point_chunks, network, kept, taps, shaded, out, rows, used, spectrum, gradients)
        else:
            for chunk in range(chunks):
                if level < 0:
                    scatter_block(kept.block[chunk], kept.samples[chunk, 0], grid, gradient, task)
                else:
                    scatter_block(kept.s_block[chunk], kept.sections[chunk, 0], appearance, a_gradient, level)
            for chunk in range(chunks + point_chunks if level < 0 else 0):
                scatter_block(taps.block[chunk], taps.used[chunk, 0], grid, gradient, task)
        tell(done, task + 1)
    wait(done, 0)
    if math.isfinite(sums[0]) and math.isfinite(sums[1]):
        take_parts(next_task, level - appearance.active, len(done), done, places, numbers)
