"""The pull of the distance's slope towards one, at points and near what rays meet: the surface's gradient by four taps."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import types

from mmsynth.field.kernels.cpu.blocks import surface_block, surface_block_backward
from mmsynth.field.kernels.cpu.jit import part
from mmsynth.field.kernels.cpu.marching import CHUNK, contract
from mmsynth.field.kernels.cpu.roulette import first_chance, least_of, play
from mmsynth.field.kernels.cpu.stack import on_stack
from mmsynth.field.kernels.learning import TAPS

POINTS = 64  # of all space, in a task
TAPPED = 32  # points of a block, which are four positions each
MOST_TAPPED = 2 * CHUNK  # points of a chunk
_TAPS = np.array(TAPS, np.float32)
_f = np.float32
_ZERO, _ONE = _f(0.0), _f(1.0)
_of_taps = on_stack(types.float32, 4 * TAPPED)
_of_points = on_stack(types.float32, MOST_TAPPED)


class TapStore(NamedTuple):
    """Of points at which the surface's gradient is asked for, a slot per chunk: block (see ``blocks``), four rows a point; used: rows;
    pulled_out, bias_out: see ``surface_block_backward``."""

    block: np.ndarray
    used: np.ndarray
    pulled_out: np.ndarray
    bias_out: np.ndarray


@part()
def slopes(at, n, epsilon, grid, surface, taps, slot, gates, found):  # type: ignore[no-untyped-def]
    """See ``learning.surface_gradient``: of n points ``at`` (n, 3), whose taps are kept in the slot of ``taps`` behind what is there."""
    move, scale = epsilon / _f(math.sqrt(3.0)), _f(math.sqrt(3.0)) / (_f(4.0) * epsilon)
    values = _of_taps()
    for begin in range(0, n, TAPPED):
        count, used = np.int64(min(TAPPED, n - begin)), np.int64(taps.used[slot, 0])
        block = taps.block[slot, used:]
        for i in range(count):
            for t in range(4):
                row = 4 * i + t
                for a in range(3):
                    block[row, a] = at[begin + i, a] + move * _TAPS[t, a]
                block[row, 3] = _ONE
        surface_block(block, gates[used:], values, 4 * count, grid, surface)
        for i in range(count):
            for a in range(3):
                total = _ZERO
                for t in range(4):
                    total += values[4 * i + t] * _TAPS[t, a]
                found[begin + i, a] = total * scale
        taps.used[slot, 0] = used + 4 * count


@part()
def slopes_backward(g, n, epsilon, roulette, grid, surface, taps, slot, gates, first):  # type: ignore[no-untyped-def]
    """From gradients g (n, 3) of the slopes, whose taps are kept from ``first`` on: of points that stay in the game (see ``roulette``)
    both move to the front."""
    scale = _f(math.sqrt(3.0)) / (_f(4.0) * epsilon)
    values, sizes, some = _of_taps(), _of_points(), 0
    for i in range(n):
        sizes[i] = _f(math.sqrt(g[i, 0] * g[i, 0] + g[i, 1] * g[i, 1] + g[i, 2] * g[i, 2]))
    least, block = least_of(sizes, n, roulette), taps.block[slot]
    chance = first_chance(least)
    for i in range(n):
        factor, chance = play(sizes[i], least, chance)
        if factor == _ZERO:
            continue
        for a in range(3):
            g[some, a] = g[i, a] * factor
        if some < i:
            for t in range(4):
                here, there = first + 4 * i + t, first + 4 * some + t
                for j in range(block.shape[1]):
                    block[there, j] = block[here, j]
                for j in range(gates.shape[1]):
                    gates[there, j] = gates[here, j]
        some += 1
    taps.used[slot, 0] = first + 4 * some
    for begin in range(0, some, TAPPED):
        count, used = np.int64(min(TAPPED, some - begin)), first + 4 * begin
        for i in range(count):
            for t in range(4):
                total = _ZERO
                for a in range(3):
                    total += g[begin + i, a] * _TAPS[t, a]
                values[4 * i + t] = total * scale
        surface_block_backward(
            taps.block[slot, used:], gates[used:], values, 4 * count, grid.active, surface, taps.pulled_out[slot], taps.bias_out[slot],
        )  # fmt: skip


@part()
def pull_to_one(slope, factor, shallow, g):  # type: ignore[no-untyped-def]
    """``factor`` (|slope| - 1)², times ``shallow`` below 1; its gradient is added to g (3,)."""
    norm = _f(math.sqrt(slope[0] * slope[0] + slope[1] * slope[1] + slope[2] * slope[2]))
    off = norm - _ONE
    factor *= shallow if off < _ZERO else _ONE
    if norm > _ZERO:
        for a in range(3):
            g[a] += _f(2.0) * factor * off * slope[a] / norm
    return np.float64(factor * off * off)


@part()
def is_within(p):  # type: ignore[no-untyped-def]
    return math.sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2]) < _ONE


@part()
def learn_points(chunk, count, points, begin, eikonal, of_pull, roulette, grid, surface, scratch, slot, taps):  # type: ignore[no-untyped-def]
    """The pull at some of the points of all space: its part of the loss."""
    at, found, g = points[begin : begin + count], scratch.found[slot], scratch.at[slot]
    taps.used[chunk, 0] = 0
    taps.pulled_out[chunk], taps.bias_out[chunk] = _ZERO, _ZERO
    slopes(at, count, eikonal.epsilon, grid, surface, taps, chunk, scratch.gates[slot], found)
    loss = 0.0
    for i in range(count):
        g[i, 0], g[i, 1], g[i, 2] = _ZERO, _ZERO, _ZERO
        loss += pull_to_one(found[i], of_pull, eikonal.shallow if is_within(at[i]) else _ONE, g[i])
    slopes_backward(g, count, eikonal.epsilon, roulette, grid, surface, taps, chunk, scratch.gates[slot], 0)
    return loss


@part()
def learn_met(begin, count, total, rays, depth, eikonal, of_pull, roulette, grid, surface, scratch, slot, chunk, taps):  # type: ignore[no-untyped-def]
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
        shallow[n] = eikonal.shallow if is_within(at[n]) else _ONE
        n += 1
    slopes(at, n, eikonal.epsilon, grid, surface, taps, chunk, scratch.gates[slot], found)
    loss = 0.0
    for i in range(n):
        at[i, 0], at[i, 1], at[i, 2] = _ZERO, _ZERO, _ZERO
        loss += pull_to_one(found[i], of_pull, shallow[i], at[i])
    slopes_backward(at, n, eikonal.epsilon, roulette, grid, surface, taps, chunk, scratch.gates[slot], 0)
    return loss
