"""What surfaces of a chunk of rays mirror of lamps, and light from far behind them, forward and backward: parts of ``learning``."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mmsynth.field.kernels.constants import LEAST_WEIGHT
from mmsynth.field.kernels.cpu import mirroring
from mmsynth.field.kernels.cpu.jit import allocating_kernel, part
from mmsynth.field.kernels.cpu.marching import CHUNK, contract
from mmsynth.field.kernels.cpu.matrices import TILE_COLS, TILE_ROWS, add_product, clear, whole
from mmsynth.field.kernels.cpu.mirroring import mirror_rays, mirror_rays_backward
from mmsynth.field.kernels.cpu.shading import layer, layer_backward, two_layers
from mmsynth.field.kernels.cpu.slopes import normal_backward, normal_of, pull_to_one, slopes, slopes_backward
from mmsynth.field.kernels.parameters import Lamps, Mirrors

_f = np.float32
_ZERO, _ONE = _f(0.0), _f(1.0)
_LEAST_WEIGHT = _f(LEAST_WEIGHT)


class ChunkScratch(NamedTuple):
    """Of the rays of a chunk, a slot per thread. Rows: ``CHUNK`` surfaces nearest to the cameras, and ``CHUNK`` behind them."""

    gates: np.ndarray  # of the taps: a row for each of ``TapStore``
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


@allocating_kernel
def lamps_and_layers(light):  # type: ignore[no-untyped-def]
    """Of a ``LightNetwork``: which outputs of its last layer there are (5 + K,), the lamps that there are, its layers with these."""
    parts = len(light.second_bias) - len(light.position)
    columns = np.concatenate((np.arange(parts), parts + light.used))
    lamps = Lamps(light.position[light.used], np.exp(light.log_spectrum[light.used]))
    return columns, lamps, two_layers(light.first, light.first_bias, light.second[columns], light.second_bias[columns])


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


@part()
def mix(count, far_light, features, share, opacity, behind, mixed, mixed_share):  # type: ignore[no-untyped-def]
    """See ``learning.with_far_light``."""
    width = features.shape[1]
    for i in range(count):
        for which in range(2 if behind[i] >= 0 else 1):
            row = i if which == 0 else behind[i]
            mixed_share[row] = share[row]
            for j in range(width):
                mixed[row, j] = features[row, j]
        row = behind[i] if behind[i] >= 0 else i
        passed = _ONE - opacity[i]
        mixed_share[row] += passed
        part = passed / max(mixed_share[row], _LEAST_WEIGHT)
        for j in range(width):
            mixed[row, j] += part * (far_light[j] - mixed[row, j])


@part()
def mix_backward(begin, end, far_light, features, share, opacity, behind, mixed_share, g_features, g_share, g_far):  # type: ignore[no-untyped-def]
    """Gradients of what is shaded, g_features and g_share, become those of what was met, of some of the rays."""
    width = features.shape[1]
    for i in range(begin, end):
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


@part()
def see_mirrors(begin, count, ray0, rays, taps, lamps, light, measured, scratch, slot, chunk, grid, surface, epsilon, mirrored):  # type: ignore[no-untyped-def]
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
    slopes(at, n, epsilon, grid, surface, taps, chunk, scratch.gates[slot], found)
    clear(x, whole(n, TILE_ROWS), x.shape[1])
    for i in range(n):
        row = row_of[i]
        normal_of(points[row], found[i], wide, normals[row])
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


@part()
def mirrors_backward(  # type: ignore[no-untyped-def]
    begin, count, n, first, ray0, trains, taps, lamps, light, measured, scratch, slot, chunk, grid, surface, eikonal, of_pull,
    roulette, g_mirrored, out
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
            normal_backward(points[row], found[i], wide, normals[row], g_normals[row], at[i])
        loss += pull_to_one(found[i], of_pull, _ONE, at[i])
    slopes_backward(at, n, eikonal.mirror_epsilon, roulette, grid, surface, taps, chunk, scratch.gates[slot], first)
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
