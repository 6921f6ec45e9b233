"""Where a step asks for the surface's gradient, by four taps: the pull of its length towards one, at points and near what rays meet,
and of neighbouring normals towards each other."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import types

from mmsynth.field.kernels.constants import RAYS_OF_PAIR, SOFT_EDGE
from mmsynth.field.kernels.cpu.blocks import surface_block, surface_block_backward
from mmsynth.field.kernels.cpu.jit import part
from mmsynth.field.kernels.cpu.marching import CHUNK, contract, velocity
from mmsynth.field.kernels.cpu.roulette import first_chance, least_of, play
from mmsynth.field.kernels.cpu.stack import on_stack
from mmsynth.field.kernels.learning import TAPS

POINTS = 64  # of all space, in a task
TAPPED = 32  # points of a block, which are four positions each
MOST_TAPPED = 2 * CHUNK  # points of a chunk
MOST_PAIRED = 2 * (CHUNK // RAYS_OF_PAIR)  # and of its pairs
_TAPS = np.array(TAPS, np.float32)
_f = np.float32
_ZERO, _ONE, _TINY, _SOFT_EDGE = _f(0.0), _f(1.0), _f(1e-12), _f(SOFT_EDGE)
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
def normal_of(point, slope, wide, normal):  # type: ignore[no-untyped-def]
    """See ``learning.normals``; to ``normal`` (3,)."""
    sx, sy, sz = slope[0], slope[1], slope[2]
    if wide:
        px, py, pz = point[0], point[1], point[2]
        r = _f(math.sqrt(px * px + py * py + pz * pz))
        sx, sy, sz = velocity(px, py, pz, r, sx, sy, sz)
    norm = max(_f(math.sqrt(sx * sx + sy * sy + sz * sz)), _TINY)
    normal[0], normal[1], normal[2] = sx / norm, sy / norm, sz / norm


@part()
def normal_backward(point, slope, wide, normal, g_normal, g):  # type: ignore[no-untyped-def]
    """g (3,) becomes the gradient of the slope."""
    sx, sy, sz = slope[0], slope[1], slope[2]
    px, py, pz = point[0], point[1], point[2]
    r = _f(math.sqrt(px * px + py * py + pz * pz))
    if wide:
        sx, sy, sz = velocity(px, py, pz, r, sx, sy, sz)
    norm = max(_f(math.sqrt(sx * sx + sy * sy + sz * sz)), _TINY)
    along = _ZERO
    for a in range(3):
        along += normal[a] * g_normal[a]
    gx, gy = (g_normal[0] - along * normal[0]) / norm, (g_normal[1] - along * normal[1]) / norm
    gz = (g_normal[2] - along * normal[2]) / norm
    if wide:  # symmetric
        gx, gy, gz = velocity(px, py, pz, r, gx, gy, gz)
    g[0], g[1], g[2] = gx, gy, gz


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


@part()
def _put(p, wide, points, at, i):  # type: ignore[no-untyped-def]
    """A point of the world, and of the grid, at row i."""
    x, y, z = p[0], p[1], p[2]
    points[i, 0], points[i, 1], points[i, 2] = x, y, z
    if wide:
        x, y, z, _ = contract(x, y, z)
    at[i, 0], at[i, 1], at[i, 2] = x, y, z


@part()
def learn_pairs(begin, count, total, rays, depth, smooth, roulette, grid, surface, scratch, slot, chunk, taps):  # type: ignore[no-untyped-def]
    """The pull of neighbouring normals, see ``Smooth``: its part of the loss. Blocks are added to ``taps``."""
    wide, n, pairs = grid.extent > _ONE, np.int64(0), np.int64(min(len(smooth.aside), total // RAYS_OF_PAIR))
    at, found, points, normals, g_normals = (
        scratch.at[slot], scratch.found[slot], scratch.points[slot], scratch.normals[slot], scratch.g_normals[slot],
    )  # fmt: skip
    first = np.int64(taps.used[chunk, 0])
    for q in range(pairs):
        i = q * total // pairs - begin
        if i < 0 or i >= count or not math.isfinite(depth[i]):
            continue
        one, other = at[n], at[n + 1]
        for a in range(3):
            one[a] = rays.origins[i, a] + rays.directions[i, a] * depth[i]
        r = _f(math.sqrt(one[0] * one[0] + one[1] * one[1] + one[2] * one[2]))
        for a in range(3):
            other[a] = one[a] + smooth.aside[q, a] * r
        if r <= _ONE or is_within(other):
            continue
        _put(one, wide, points, at, n)
        _put(other, wide, points, at, n + 1)
        n += 2
    slopes(at, n, smooth.epsilon, grid, surface, taps, chunk, scratch.gates[slot], found)
    loss = 0.0
    for i in range(0, n, 2):
        weight = smooth.weight / _f(pairs)
        for k in range(i, i + 2):
            normal_of(points[k], found[k], wide, normals[k])
        apart = _ZERO
        for a in range(3):
            off = normals[i, a] - normals[i + 1, a]
            apart += _f(0.5) * off * off
        soft = apart + _SOFT_EDGE
        loss += np.float64(weight * apart / soft)
        pull = weight * _SOFT_EDGE / (soft * soft)
        for a in range(3):
            g = pull * (normals[i, a] - normals[i + 1, a])
            g_normals[i, a], g_normals[i + 1, a] = g, -g
        for k in range(i, i + 2):
            normal_backward(points[k], found[k], wide, normals[k], g_normals[k], at[k])
    slopes_backward(at, n, smooth.epsilon, roulette, grid, surface, taps, chunk, scratch.gates[slot], first)
    return loss
