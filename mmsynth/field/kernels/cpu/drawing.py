"""Drawing photosites on the CPU: a ray is one pass from its random numbers to all that was measured along it."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import types

from mmsynth.field.kernels.constants import DRAW_JITTER, DRAW_PIXEL, DRAW_TILE, PURPOSE_STRIDE, WORD
from mmsynth.field.kernels.cpu.arrays import as_arrays, as_compiled
from mmsynth.field.kernels.cpu.jit import inlined, kernel, part
from mmsynth.field.kernels.cpu.stack import on_stack
from mmsynth.field.kernels.cpu.tasks import take, take_all
from mmsynth.field.kernels.parameters import Cameras, Drawing, Drawn, Frames, Measured, Modalities, Selection

CHUNK = 64  # rays
_u, _f = np.uint32, np.float32
_of_rays = on_stack(types.int64, CHUNK)
_ZERO, _ONE, _TWO, _THREE, _SIX = _f(0.0), _f(1.0), _f(2.0), _f(3.0), _f(6.0)


@inlined()
def scramble(x):  # type: ignore[no-untyped-def]
    """See ``drawing.scramble``."""
    x = _u(_u(x ^ _u(x >> _u(16))) * _u(0x7FEB352D))
    x = _u(_u(x ^ _u(x >> _u(15))) * _u(0x846CA68B))
    return _u(x ^ _u(x >> _u(16)))


@inlined()
def _bits(key, number, purpose):  # type: ignore[no-untyped-def]
    """See ``drawing.random_bits``; as int64."""
    mixed = scramble(_u(np.int64(number) + np.int64(key[0])))
    return np.int64(scramble(_u(mixed ^ _u(np.int64(key[1]) + purpose * PURPOSE_STRIDE))))


@part()
def _first_above(ascending, begin, end, values, n, found):  # type: ignore[no-untyped-def]
    """The first of a range whose number is larger, for each of n values: all of them a step at a time, so that none waits for another."""
    length = end - begin
    for i in range(n):
        found[i] = begin
    while length > 1:
        half = length // 2
        for i in range(n):
            # all ones where it is larger
            larger = (values[i] - np.int64(ascending[found[i] + half - 1])) >> 63
            found[i] += half & ~larger
        length -= half
    for i in range(n):
        found[i] += 1 if length > 0 and ascending[found[i]] <= values[i] else 0


@inlined()
def _set_bit(words, first, kth):  # type: ignore[no-untyped-def]
    """Where the kth bit is that is set, counted from the lowest of word ``first``."""
    at = 0
    while True:
        word = _u(words[first])
        # Hamming weights of pairs, fours, and all
        pairs = _u(word - _u(_u(word >> _u(1)) & _u(0x55555555)))
        fours = _u(_u(pairs & _u(0x33333333)) + _u(_u(pairs >> _u(2)) & _u(0x33333333)))
        held = np.int64(_u(_u(_u(fours + _u(fours >> _u(4))) & _u(0x0F0F0F0F)) * _u(0x01010101)) >> _u(24))
        if kth < held:
            break
        kth -= held
        first += 1
        at += WORD
    while True:
        if word & _u(1):
            if kth == 0:
                return at
            kth -= 1
        word = _u(word >> _u(1))
        at += 1


@inlined()
def _decoded(frames, kind, at):  # type: ignore[no-untyped-def]
    if kind == 0:
        return _f(frames.codes8[at]) / _f(255.0)
    if kind == 1:
        return _f(frames.codes16[at]) / _f(65535.0)
    return frames.floats[at]


@inlined()
def _cubic(t):  # type: ignore[no-untyped-def]
    """Weights of four nodes at 0, 1, 2, 3."""
    a, b, c = t - _ONE, t - _TWO, t - _THREE
    return -a * b * c / _SIX, t * b * c / _TWO, -t * a * c / _TWO, t * a * b / _SIX


@inlined()
def _in_camera(cameras, camera, row, column):  # type: ignore[no-untyped-def]
    """The direction of a pixel in the camera's axes."""
    step, across, first, nodes = np.int64(cameras.step[camera]), np.int64(cameras.across[camera]), cameras.first[camera], cameras.nodes
    if step == 1:
        node = first + row * across + column
        return nodes[node, 0], nodes[node, 1], nodes[node, 2]
    left = min(max(column // step - 1, 0), across - 4)
    top = min(max(row // step - 1, 0), np.int64(cameras.down[camera]) - 4)
    columns = _cubic(_f(column) / _f(step) - _f(left))
    rows = _cubic(_f(row) / _f(step) - _f(top))
    x, y, z = _ZERO, _ZERO, _ZERO
    for j in range(4):
        node = first + (top + j) * across + left
        for i in range(4):
            share = rows[j] * columns[i]
            x += share * nodes[node + i, 0]
            y += share * nodes[node + i, 1]
            z += share * nodes[node + i, 2]
    length = _f(math.sqrt(x * x + y * y + z * z))
    return x / length, y / length, z / length


@part()
def drawing_tasks(to_fill):  # type: ignore[no-untyped-def]
    """How many there are."""
    return (to_fill.drawn.jitter.shape[0] + CHUNK - 1) // CHUNK


@part()
def draw_chunk(chunk, to_fill):  # type: ignore[no-untyped-def]
    """A task: some of the rays, those of each modality together."""
    rays, values = to_fill.drawing.rays, to_fill.drawing.modalities.values
    n, rays_begin, numbers_begin = np.int64(0), np.int64(0), np.int64(0)
    first, end = chunk * CHUNK, min(to_fill.drawn.jitter.shape[0], (chunk + 1) * CHUNK)
    while first < end:
        while first >= rays_begin + rays[n]:
            rays_begin, numbers_begin, n = rays_begin + rays[n], numbers_begin + rays[n] * values[n], n + 1
        some = min(end, rays_begin + rays[n]) - first
        _draw_some(n, first, some, numbers_begin + (first - rays_begin) * values[n], to_fill)
        first += some


@part()
def _draw_some(n, first, count, first_number, to_fill):  # type: ignore[no-untyped-def]
    """``count`` rays of modality n from ``first`` on, whose numbers begin at ``first_number``. Each thing of all rays, and then the next: a
    ray waits for memory at every turn, and others do meanwhile."""
    modalities, selection, rays, key = to_fill.drawing[2:]
    drawn, measured = to_fill.drawn, to_fill.drawn.measured
    bits, tile, frame, row, column = _of_rays(), _of_rays(), _of_rays(), _of_rays(), _of_rays()
    for i in range(count):
        bits[i] = _bits(key, first + i, DRAW_TILE)
    _first_above(selection.ends, np.int64(modalities.first_tile[n]), np.int64(modalities.first_tile[n + 1]) - 1, bits, count, tile)
    _find_pixels(n, first, count, to_fill.drawing, bits, tile, frame, row, column)
    n_drawn = 0
    for of_modality in rays:
        n_drawn += of_modality > 0
    values = np.int64(modalities.values[n])
    of_all = _f(n_drawn * rays[n] * values)
    for i in range(count):
        ray = first + i
        drawn.jitter[ray] = _f(_bits(key, ray, DRAW_JITTER) >> 8) * _f(2.0**-24)
        drawn.tile[ray], drawn.ray_weight[ray] = tile[i], selection.weight[tile[i]]
        for j in range(values):
            number = first_number + i * values + j
            measured.ray[number], drawn.frame[number] = ray, frame[i]
            measured.level[number], measured.saturation[number] = modalities.level[n], modalities.saturation[n]
            measured.weight[number] = drawn.ray_weight[ray] / of_all
    _find_directions(first, count, to_fill, frame, row, column)
    _read(n, first, count, first_number, to_fill, frame, row, column)


@part()
def _find_pixels(n, first, count, drawing, bits, tile, frame, row, column):  # type: ignore[no-untyped-def]
    """Frame, row and column of each of some rays of modality n; bits: scratch."""
    frames, cameras, modalities, selection, _, key = drawing
    _first_above(frames.first_tile, np.int64(modalities.first_frame[n]), np.int64(modalities.first_frame[n + 1]), tile, count, frame)
    tile_width, tile_height, first_word = np.int64(modalities.tile_width[n]), np.int64(modalities.tile_height[n]), selection.first_word[n]
    for i in range(count):
        bits[i] = (_bits(key, first + i, DRAW_PIXEL) * np.int64(selection.pixels[tile[i]])) >> 32
    if first_word >= 0:
        per_tile = (tile_width * tile_height) // WORD
        for i in range(count):
            bits[i] = _set_bit(selection.words, first_word + (tile[i] - np.int64(modalities.first_tile[n])) * per_tile, bits[i])
    for i in range(count):
        frame[i] -= 1
        width, local = np.int64(cameras.width[frames.camera[frame[i]]]), tile[i] - frames.first_tile[frame[i]]
        tiles_across = (width + tile_width - 1) // tile_width
        down, across = local // tiles_across, local % tiles_across
        columns = tile_width if first_word >= 0 else min(tile_width, width - across * tile_width)
        row[i], column[i] = down * tile_height + bits[i] // columns, across * tile_width + bits[i] % columns


@part()
def _find_directions(first, count, to_fill, frame, row, column):  # type: ignore[no-untyped-def]
    """Origins and directions of some rays."""
    frames, cameras, directions, origins = to_fill.drawing.frames, to_fill.drawing.cameras, to_fill.drawn.directions, to_fill.drawn.origins
    for i in range(count):
        ray = first + i
        x, y, z = _in_camera(cameras, frames.camera[frame[i]], row[i], column[i])
        turn, from_ = frames.rotation[frame[i]], frames.origin[frame[i]]
        directions[ray, 0] = turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z
        directions[ray, 1] = turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z
        directions[ray, 2] = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z
        origins[ray, 0], origins[ray, 1], origins[ray, 2] = from_[0], from_[1], from_[2]


@part()
def _read(n, first, count, first_number, to_fill, frame, row, column):  # type: ignore[no-untyped-def]
    """What was measured along some rays of modality n, and by what."""
    frames, cameras, modalities = to_fill.drawing.frames, to_fill.drawing.cameras, to_fill.drawing.modalities
    directions, alphas, measured = to_fill.drawn.directions, to_fill.drawn.alpha, to_fill.drawn.measured
    values, mosaic, analyser = np.int64(modalities.values[n]), np.int64(modalities.pattern_first[n]), np.int64(modalities.analyser_first[n])
    high, wide = np.int64(modalities.pattern_height[n]), np.int64(modalities.pattern_width[n])
    axes, axes_begin = measured.axes, len(measured.target) - len(measured.axes)
    for i in range(count):
        kind, stride = frames.kind[frame[i]], np.int64(frames.stride[frame[i]])
        at, alpha = frames.start[frame[i]] + (row[i] * cameras.width[frames.camera[frame[i]]] + column[i]) * stride, _ONE
        if stride > values:
            alpha = _decoded(frames, kind, at + values)
            alphas[first + i] = alpha
        else:
            alphas[first + i] = modalities.opaque[n]
        for j in range(values):
            measured.target[first_number + i * values + j] = _decoded(frames, kind, at + j) * alpha
    for i in range(count):
        ray, turn = first + i, frames.rotation[frame[i]]
        if analyser >= 0:
            dx, dy, dz = directions[ray, 0], directions[ray, 1], directions[ray, 2]
            along = turn[0, 0] * dx + turn[1, 0] * dy + turn[2, 0] * dz
            rx, ry, rz = turn[0, 0] - along * dx, turn[1, 0] - along * dy, turn[2, 0] - along * dz
            length = _f(math.sqrt(rx * rx + ry * ry + rz * rz))
            rx, ry, rz = rx / length, ry / length, rz / length
            ux, uy, uz = ry * dz - rz * dy, rz * dx - rx * dz, rx * dy - ry * dx
        for j in range(values):
            number, channel = first_number + i * values + j, np.int64(j)
            if mosaic >= 0:
                channel = np.int64(modalities.pattern[mosaic + row[i] % high * wide + column[i] % wide])
            measured.output[number] = modalities.output[n]
            if analyser >= 0:
                cos, sin, e = modalities.analysers[analyser + channel, 0], modalities.analysers[analyser + channel, 1], number - axes_begin
                axes[e, 0], axes[e, 1], axes[e, 2] = cos * rx + sin * ux, cos * ry + sin * uy, cos * rz + sin * uz
            else:
                measured.output[number] += channel


@kernel
def draw_rays(next_task, to_fill):  # type: ignore[no-untyped-def]
    """Fills what is drawn."""
    chunk = take(next_task, 0)
    while chunk < drawing_tasks(to_fill):
        draw_chunk(chunk, to_fill)
        chunk = take(next_task, 0)


@kernel
def fill_odds(residual, count, first_tile, evenly, ends, weight):  # type: ignore[no-untyped-def]
    """See ``drawing.odds``; ``evenly``: float64. By one thread: others learn meanwhile."""
    for n in range(first_tile.shape[0] - 1):
        begin, end = first_tile[n], first_tile[n + 1]
        pixels, total = 0, 0.0
        for tile in range(begin, end):
            pixels += count[tile]
            total += np.float64(residual[tile]) * count[tile]
        if total > 0.0:
            base, slope = evenly, (1.0 - evenly) * pixels / total
        else:
            base, slope = 1.0, 0.0
        whole, upto, before, last = 0.0, 0.0, np.int64(0), begin
        for tile in range(begin, end):
            whole += (base + slope * residual[tile]) * count[tile]
            if count[tile] > 0:
                last = tile
        for tile in range(begin, end):
            upto += (base + slope * residual[tile]) * count[tile]
            here = np.int64(upto / whole * 4294967296.0) if tile < last else np.int64(1) << 32
            ends[tile] = here
            weight[tile] = _f(count[tile] * 4294967296.0 / (np.float64(here - before) * pixels)) if here > before else _ZERO
            before = here


class ToFill(NamedTuple):
    """What kernels take: a ``Drawing`` and the ``Drawn`` that they fill, of arrays, rays (N,) and key (2,) among them."""

    drawing: Any
    drawn: Any


def room_for(drawing: Drawing) -> tuple[ToFill, Drawn]:
    """For what is drawn, and the same as tensors."""
    *tables, rays, key = drawing
    modalities = drawing.modalities
    values = modalities.values.tolist()
    count, numbers = sum(rays), sum(r * k for r, k in zip(rays, values, strict=True))
    polarized = sum(r * k for r, k, a in zip(rays, values, modalities.analyser_first.tolist(), strict=True) if a >= 0)
    single, whole = torch.empty, lambda length: torch.empty(length, dtype=torch.int64)
    measured = Measured(
        single(numbers), whole(numbers), whole(numbers), single(polarized, 3), single(numbers), single(numbers), single(numbers)
    )
    drawn = Drawn(single(count, 3), single(count, 3), single(count), single(count), single(count), whole(count), whole(numbers), measured)
    told: list[Any] = [*map(as_arrays, tables), np.array(rays, np.int64), np.array(key, np.int64)]
    filled: list[Any] = [*map(as_compiled, drawn[:-1]), as_arrays(measured)]
    return ToFill(Drawing(*told), Drawn(*filled)), drawn


@functools.cache
def nothing_to_draw() -> ToFill:
    """Of no frame."""
    long, whole, single = (torch.empty(0, dtype=kind) for kind in (torch.int64, torch.int32, torch.float32))
    stored = whole.view(torch.uint8), whole.view(torch.uint16), single
    frames = Frames(long, whole, whole, whole, whole, single.view(0, 3, 3), single.view(0, 3), *stored)
    cameras, selection = Cameras(whole, whole, long, whole, whole, single.view(0, 3)), Selection(long, single, whole, long, whole)
    modalities = Modalities(*(whole,) * 10, single, single, single, whole, single.view(0, 2))  # type: ignore[call-arg]
    return room_for(Drawing(frames, cameras, modalities, selection, [], (0, 0)))[0]


def draw(
    frames: Frames, cameras: Cameras, modalities: Modalities, selection: Selection, rays: Sequence[int], key: tuple[int, int]
) -> Drawn:
    """See ``drawing.draw``; float32."""
    to_fill, drawn = room_for(Drawing(frames, cameras, modalities, selection, rays, key))
    take_all(-(-len(drawn.jitter) // CHUNK), draw_rays, to_fill)
    return drawn


def odds(residual: torch.Tensor, count: torch.Tensor, first_tile: torch.Tensor, evenly: float) -> tuple[torch.Tensor, torch.Tensor]:
    """See ``drawing.odds``; float32."""
    ends, weight = torch.empty_like(residual, dtype=torch.int64), torch.empty_like(residual)
    fill_odds(residual.numpy(), count.numpy(), first_tile.numpy(), float(evenly), ends.numpy(), weight.numpy())
    return ends, weight
