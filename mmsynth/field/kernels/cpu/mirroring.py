"""Mirrored lamps on the CPU, fused: all numbers measured along a ray at once, and their gradients in the same pass.

The surfaces that a chunk of rays meets go through the formulas as vectors: numbers of surfaces are arrays on the stack that have a part of
``SURFACES`` for each quantity, whole vectors of them in use. Only what was measured is gone through one by one.

A gradient of a measurement is known up to a factor when it is: ``mirror`` gives the numbers, ``mirror_backward`` is given these factors and
goes through the same terms again, which is cheaper than to keep them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import types

from mmsynth.field.kernels.constants import LEAST_ROUGHNESS, REFRACTIVE_INDEX
from mmsynth.field.kernels.cpu.jit import inlined, kernel, part
from mmsynth.field.kernels.cpu.logistic import softplus
from mmsynth.field.kernels.cpu.matrices import whole
from mmsynth.field.kernels.cpu.shading import first_at
from mmsynth.field.kernels.cpu.stack import on_stack
from mmsynth.field.kernels.cpu.tasks import take

CHUNK = 64  # rays
SURFACES = 2 * CHUNK  # that they meet, at the most
_S, _LANES = SURFACES, 16
_f = np.float32
_INDEX, _LEAST, _TINY = _f(REFRACTIVE_INDEX), _f(LEAST_ROUGHNESS), _f(1e-12)
_AT_NORMAL = _f(((REFRACTIVE_INDEX - 1.0) / (REFRACTIVE_INDEX + 1.0)) ** 2)
_HALF, _ZERO, _ONE, _TWO = _f(0.5), _f(0.0), _f(1.0), _f(2.0)
_FAST = {"contract", "nsz", "arcp"}  # NaN stays NaN
# parts of arrays: of surfaces, of their material (softplus and its slope) ...
_POINT, _VIEW, _NORMAL, _SHARE, _ALPHA = 0, 3, 6, 9, 10
_ROUGHNESS, _STRENGTH, _SURROUNDINGS, _TRANSMITTED, _POLARIZING, _VISIBLE = range(6)
# ... of surfaces and a lamp: toward it, half of the way to the viewer, n × h; what is seen of it, its axis and degree of polarization ...
_TOWARD, _DISTANCE, _H, _LENGTH, _SINE, _OFF, _TO_LAMP, _TO_VIEWER, _FRESNEL = 0, 3, 4, 7, 8, 11, 12, 13, 14
_AMOUNT, _AXIS, _DEGREE = 15, 16, 19
# ... of what is all around: w, |w|², F / F(1), D_m and D_t over sin², light, polarized ...
_W, _SQUARE, _SCHLICK, _MIRRORED, _LET_THROUGH, _LIGHT, _POLARIZED = 0, 3, 4, 5, 6, 7, 8
# ... and of gradients
_G_NORMAL, _G_SHARE, _G_ALPHA, _G_STRENGTH, _G_SURROUNDINGS, _G_TRANSMITTED, _G_POLARIZING = 0, 3, 4, 5, 6, 7, 8
_WHOLE, _TURNED, _G_W = 0, 1, 2
_of_each, _of_materials, _of_lamps = on_stack(types.float32, 11 * _S), on_stack(types.float32, 6 * _S), on_stack(types.float32, 20 * _S)
_gradients, _sums, _numbers = on_stack(types.float32, 9 * _S), on_stack(types.float32, 5 * _S), on_stack(types.float32, _S)
_rows, _places = on_stack(types.int64, _S), on_stack(types.int64, _S)


class Gradients(NamedTuple):
    """Of ``Mirrors`` per row: material (H, 5 + K), normals (H, 3), share (H,); of the lamps per chunk: position (C, K, 3), spectrum
    (C, K, outputs)."""

    material: np.ndarray
    normals: np.ndarray
    share: np.ndarray
    position: np.ndarray
    spectrum: np.ndarray


@part()
def _met(begin, end, share, behind, row_of, place_of):  # type: ignore[no-untyped-def]
    """The rows of what some rays meet, how many; place_of: of each ray, the places of its two surfaces among these, -1 = nothing."""
    n = np.int64(0)
    for o in range(begin, end):
        for which in range(2):
            row, place = o if which == 0 else behind[o], 2 * (o - begin) + which
            place_of[place] = -1
            if row >= 0 and not share[row] <= _ZERO:  # what is NaN is seen
                row_of[n], place_of[place] = row, n
                n += 1
    return n


@part()
def _read_material(column, number, n, row_of, mirrors, raw, soft, gate):  # type: ignore[no-untyped-def]
    """log(1 + e^x) of a number x of the materials of n surfaces, and its slope, into a column of parts; zeros up to whole vectors."""
    lanes = whole(n, _LANES)
    for i in range(n):
        raw[i] = mirrors.material[row_of[i], number]
    for i in range(n, lanes):
        raw[i] = _ZERO
    softplus(raw, lanes, soft[column * _S :], gate[column * _S :])


@part(fastmath=_FAST)
def _read(n, row_of, mirrors, polarized, of, raw, soft, gate):  # type: ignore[no-untyped-def]
    """Numbers of n surfaces; zeros up to whole vectors. polarized: whether what polarizes is needed."""
    lanes = whole(n, _LANES)
    for i in range(n):
        row = row_of[i]
        for a in range(3):
            of[(_POINT + a) * _S + i] = mirrors.points[row, a]
            of[(_VIEW + a) * _S + i] = -mirrors.directions[row, a]
            of[(_NORMAL + a) * _S + i] = mirrors.normals[row, a]
        of[_SHARE * _S + i] = mirrors.share[row]
    for j in range(_SHARE + 1):
        for i in range(n, lanes):
            of[j * _S + i] = _ZERO
    for column in range(_VISIBLE if polarized else _SURROUNDINGS):
        _read_material(column, column, n, row_of, mirrors, raw, soft, gate)
    for i in range(lanes):
        of[_ALPHA * _S + i] = _LEAST + (_ONE - _LEAST) * gate[_ROUGHNESS * _S + i]


@part(fastmath=_FAST)
def _reflect_lamp(n, x, y, z, of, soft, gate, polarized, terms):  # type: ignore[no-untyped-def]
    """See ``mirroring.reflect``, of n surfaces, whole vectors, and the lamp at x, y, z."""
    for i in range(n):
        nx, ny, nz = of[_NORMAL * _S + i], of[(_NORMAL + 1) * _S + i], of[(_NORMAL + 2) * _S + i]
        vx, vy, vz = of[_VIEW * _S + i], of[(_VIEW + 1) * _S + i], of[(_VIEW + 2) * _S + i]
        tx, ty, tz = x - of[_POINT * _S + i], y - of[(_POINT + 1) * _S + i], z - of[(_POINT + 2) * _S + i]
        distance = max(_f(math.sqrt(tx * tx + ty * ty + tz * tz)), _TINY)
        tx, ty, tz = tx / distance, ty / distance, tz / distance
        hx, hy, hz = tx + vx, ty + vy, tz + vz
        length = max(_f(math.sqrt(hx * hx + hy * hy + hz * hz)), _TINY)
        hx, hy, hz = hx / length, hy / length, hz / length
        wx, wy, wz = ny * hz - nz * hy, nz * hx - nx * hz, nx * hy - ny * hx
        off = wx * wx + wy * wy + wz * wz
        to_lamp, to_viewer = max(nx * tx + ny * ty + nz * tz, _ZERO), max(nx * vx + ny * vy + nz * vz, _ZERO)
        away = _ONE - min(max(vx * hx + vy * hy + vz * hz, _ZERO), _ONE)
        fresnel = _f(0.25) * (_ONE + (_ONE / _AT_NORMAL - _ONE) * away * away * away * away * away)
        fresnel = fresnel if nx * hx + ny * hy + nz * hz > _ZERO else _ZERO
        terms[_TOWARD * _S + i], terms[(_TOWARD + 1) * _S + i], terms[(_TOWARD + 2) * _S + i] = tx, ty, tz
        terms[_DISTANCE * _S + i], terms[_LENGTH * _S + i] = distance, length
        terms[_H * _S + i], terms[(_H + 1) * _S + i], terms[(_H + 2) * _S + i] = hx, hy, hz
        terms[_SINE * _S + i], terms[(_SINE + 1) * _S + i], terms[(_SINE + 2) * _S + i] = wx, wy, wz
        terms[_OFF * _S + i], terms[_TO_LAMP * _S + i], terms[_TO_VIEWER * _S + i] = off, to_lamp, to_viewer
        terms[_FRESNEL * _S + i] = fresnel
        alpha = of[_ALPHA * _S + i]
        square, c = alpha * alpha, _HALF * alpha
        u = square / (square + (_ONE - square) * off)
        seen = to_lamp / ((to_lamp * (_ONE - c) + c) * (to_viewer * (_ONE - c) + c))
        terms[_AMOUNT * _S + i] = u * u * seen * fresnel * soft[_STRENGTH * _S + i] * gate[_VISIBLE * _S + i]
    if polarized:
        for i in range(n):
            vx, vy, vz = of[_VIEW * _S + i], of[(_VIEW + 1) * _S + i], of[(_VIEW + 2) * _S + i]
            hx, hy, hz = terms[_H * _S + i], terms[(_H + 1) * _S + i], terms[(_H + 2) * _S + i]
            ax, ay, az = vy * hz - vz * hy, vz * hx - vx * hz, vx * hy - vy * hx
            across = max(_f(math.sqrt(ax * ax + ay * ay + az * az)), _TINY)
            terms[_AXIS * _S + i], terms[(_AXIS + 1) * _S + i], terms[(_AXIS + 2) * _S + i] = ax / across, ay / across, az / across
            incidence = min(max(vx * hx + vy * hy + vz * hz, _ZERO), _ONE)
            transmitted = _f(math.sqrt(_ONE - (_ONE - incidence * incidence) / (_INDEX * _INDEX)))
            s = (incidence - _INDEX * transmitted) / (incidence + _INDEX * transmitted)
            p = (_INDEX * incidence - transmitted) / (_INDEX * incidence + transmitted)
            terms[_DEGREE * _S + i] = (s * s - p * p) / (s * s + p * p)


@part(fastmath=_FAST)
def _surround(n, of, soft, terms):  # type: ignore[no-untyped-def]
    """See ``mirroring.surround``, of n surfaces, whole vectors."""
    for i in range(n):
        vx, vy, vz = of[_VIEW * _S + i], of[(_VIEW + 1) * _S + i], of[(_VIEW + 2) * _S + i]
        nx, ny, nz = of[_NORMAL * _S + i], of[(_NORMAL + 1) * _S + i], of[(_NORMAL + 2) * _S + i]
        wx, wy, wz = vy * nz - vz * ny, vz * nx - vx * nz, vx * ny - vy * nx
        terms[_W * _S + i], terms[(_W + 1) * _S + i], terms[(_W + 2) * _S + i] = wx, wy, wz
        terms[_SQUARE * _S + i] = wx * wx + wy * wy + wz * wz
        c = min(max(vx * nx + vy * ny + vz * nz, _ZERO), _ONE)
        square, away = _ONE - c * c, _ONE - c
        inner = _f(math.sqrt(_ONE - square / (_INDEX * _INDEX)))
        product, along, less = c * inner, square / _INDEX, inner - c / _INDEX
        schlick = _ONE + (_ONE / _AT_NORMAL - _ONE) * away * away * away * away * away
        mirrored = _TWO * product / _INDEX / (product * product + along * along)
        let_through = less * less / (_ONE + (product + along) * (product + along))
        terms[_SCHLICK * _S + i], terms[_MIRRORED * _S + i], terms[_LET_THROUGH * _S + i] = schlick, mirrored, let_through
        mirror, transmitted = soft[_SURROUNDINGS * _S + i] * schlick, soft[_TRANSMITTED * _S + i]
        terms[_LIGHT * _S + i], terms[_POLARIZED * _S + i] = mirror + transmitted, mirror * mirrored - transmitted * let_through


@inlined()
def _along(terms, axis, i, axes, number):  # type: ignore[no-untyped-def]
    """Of a surface's axis along an analyser's."""
    e = terms[axis * _S + i] * axes[number, 0] + terms[(axis + 1) * _S + i] * axes[number, 1]
    return e + terms[(axis + 2) * _S + i] * axes[number, 2]


@part()
def _reflect_rows(begin, end, lamps, mirrors, amount, axis, degree):  # type: ignore[no-untyped-def]
    """``reflect`` of at most ``SURFACES`` surfaces."""
    of, soft, gate, terms, raw, row_of = _of_each(), _of_materials(), _of_materials(), _of_lamps(), _numbers(), _rows()
    n = np.int64(end - begin)
    for i in range(n):
        row_of[i] = begin + i
    _read(n, row_of, mirrors, True, of, raw, soft, gate)
    for k in range(lamps.position.shape[0]):
        _read_material(_VISIBLE, _VISIBLE + k, n, row_of, mirrors, raw, soft, gate)
        x, y, z = lamps.position[k, 0], lamps.position[k, 1], lamps.position[k, 2]
        _reflect_lamp(whole(n, _LANES), x, y, z, of, soft, gate, True, terms)
        for i in range(n):
            row = begin + i
            amount[row, k], degree[row, k] = terms[_AMOUNT * _S + i], terms[_DEGREE * _S + i] * gate[_POLARIZING * _S + i]
            for a in range(3):
                axis[row, k, a] = terms[(_AXIS + a) * _S + i]


@kernel
def reflect(next_task, lamps, mirrors, amount, axis, degree):  # type: ignore[no-untyped-def]
    """See ``mirroring.reflect``."""
    surfaces = mirrors.points.shape[0]
    begin = take(next_task, 0) * SURFACES
    while begin < surfaces:
        _reflect_rows(begin, min(begin + SURFACES, surfaces), lamps, mirrors, amount, axis, degree)
        begin = take(next_task, 0) * SURFACES


@part(fastmath=_FAST)
def mirror_rays(begin, end, ray0, lamps, mirrors, behind, measured, out):  # type: ignore[no-untyped-def]
    """``mirror`` of at most ``CHUNK`` rays; ray0 + begin: the first of them in ``measured.ray``."""
    of, soft, gate, terms, raw = _of_each(), _of_materials(), _of_materials(), _of_lamps(), _numbers()
    row_of, place_of, axes, bright = _rows(), _places(), measured.axes, len(measured.ray) - len(measured.axes)
    first, last = first_at(measured.ray, ray0 + begin), first_at(measured.ray, ray0 + end)
    polarized, n = last > bright, _met(begin, end, mirrors.share, behind, row_of, place_of)
    lanes = whole(n, _LANES)
    _read(n, row_of, mirrors, polarized, of, raw, soft, gate)
    for m in range(first, last):
        out[m] = _ZERO
    if polarized:
        _surround(lanes, of, soft, terms)
        for m in range(max(first, bright), last):
            for which in range(2):
                i = place_of[2 * (measured.ray[m] - ray0 - begin) + which]
                if i >= 0:
                    e = _along(terms, _W, i, axes, m - bright)
                    light = terms[_LIGHT * _S + i] + terms[_POLARIZED * _S + i] * (_TWO * e * e - terms[_SQUARE * _S + i])
                    out[m] += _HALF * of[_SHARE * _S + i] * light
    for k in range(lamps.position.shape[0]):
        _read_material(_VISIBLE, _VISIBLE + k, n, row_of, mirrors, raw, soft, gate)
        _reflect_lamp(lanes, lamps.position[k, 0], lamps.position[k, 1], lamps.position[k, 2], of, soft, gate, polarized, terms)
        for m in range(first, last):
            seen = _ZERO
            for which in range(2):
                i = place_of[2 * (measured.ray[m] - ray0 - begin) + which]
                if i >= 0:
                    light = of[_SHARE * _S + i] * terms[_AMOUNT * _S + i]
                    if m >= bright:
                        e = _along(terms, _AXIS, i, axes, m - bright)
                        degree = terms[_DEGREE * _S + i] * gate[_POLARIZING * _S + i]
                        light *= _HALF + _HALF * degree * (_TWO * e * e - _ONE)
                    seen += light
            out[m] += seen * lamps.spectrum[k, measured.output[m]]


@kernel
def mirror(next_task, lamps, mirrors, behind, measured, out):  # type: ignore[no-untyped-def]
    """See ``mirroring.mirror``; ``measured.ray`` never decreases."""
    rays = behind.shape[0]
    begin = take(next_task, 0) * CHUNK
    while begin < rays:
        mirror_rays(begin, min(begin + CHUNK, rays), np.int64(0), lamps, mirrors, behind, measured, out)
        begin = take(next_task, 0) * CHUNK


@part(fastmath=_FAST)
def _surround_backward(n, of, gate, terms, sums, into):  # type: ignore[no-untyped-def]
    """Add gradients of n surfaces, whole vectors: from what was measured of their surroundings, see ``mirror_rays_backward``."""
    for i in range(n):
        share, all_of, turned = of[_SHARE * _S + i], sums[_WHOLE * _S + i], sums[_TURNED * _S + i]
        into[_G_SHARE * _S + i] += all_of * terms[_LIGHT * _S + i] + turned * terms[_POLARIZED * _S + i]
        mirrored = all_of + turned * terms[_MIRRORED * _S + i]
        into[_G_SURROUNDINGS * _S + i] += share * mirrored * terms[_SCHLICK * _S + i] * gate[_SURROUNDINGS * _S + i]
        into[_G_TRANSMITTED * _S + i] += share * (all_of - turned * terms[_LET_THROUGH * _S + i]) * gate[_TRANSMITTED * _S + i]
        # w = v × n
        pull = share * terms[_POLARIZED * _S + i]
        vx, vy, vz = of[_VIEW * _S + i], of[(_VIEW + 1) * _S + i], of[(_VIEW + 2) * _S + i]
        gx, gy, gz = sums[_G_W * _S + i], sums[(_G_W + 1) * _S + i], sums[(_G_W + 2) * _S + i]
        into[_G_NORMAL * _S + i] += pull * (gy * vz - gz * vy)
        into[(_G_NORMAL + 1) * _S + i] += pull * (gz * vx - gx * vz)
        into[(_G_NORMAL + 2) * _S + i] += pull * (gx * vy - gy * vx)


@part(fastmath=_FAST)
def _reflect_lamp_backward(n, of, soft, gate, terms, pulls, into, g_visible, g_toward):  # type: ignore[no-untyped-def]
    """Add gradients of n surfaces, whole vectors: from those of the amounts of ``_reflect_lamp``. g_visible: to the number of the material,
    g_toward: to the lamp's position, by surface."""
    for i in range(n):
        share, strength, visible = of[_SHARE * _S + i], soft[_STRENGTH * _S + i], gate[_VISIBLE * _S + i]
        pull = share * pulls[i]
        into[_G_SHARE * _S + i] += pulls[i] * terms[_AMOUNT * _S + i]
        off, nl, nv, fresnel = terms[_OFF * _S + i], terms[_TO_LAMP * _S + i], terms[_TO_VIEWER * _S + i], terms[_FRESNEL * _S + i]
        alpha = of[_ALPHA * _S + i]
        square, c = alpha * alpha, _HALF * alpha
        a, b, under = nl * (_ONE - c) + c, nv * (_ONE - c) + c, square + (_ONE - square) * off
        of_both, of_under = _ONE / (a * b), _ONE / under
        of_a, of_b, u = b * of_both, a * of_both, square * of_under
        lobe, seen = u * u, nl * of_both
        light = pull * fresnel * visible * lobe * seen
        into[_G_STRENGTH * _S + i] += light * gate[_STRENGTH * _S + i]
        g_visible[i] = light * strength * (_ONE - visible)
        rest = pull * fresnel * strength * visible
        g_off = -_TWO * rest * seen * lobe * (_ONE - square) * of_under
        g_square = _TWO * rest * seen * u * off * of_under * of_under
        g_nl = rest * lobe * c * of_a * of_both if nl > _ZERO else _ZERO
        g_nv = -rest * lobe * nl * (_ONE - c) * of_b * of_both if nv > _ZERO else _ZERO
        g_c = -rest * lobe * nl * ((_ONE - nl) * of_a + (_ONE - nv) * of_b) * of_both
        into[_G_ALPHA * _S + i] += g_square * _TWO * alpha + _HALF * g_c
        nx, ny, nz = of[_NORMAL * _S + i], of[(_NORMAL + 1) * _S + i], of[(_NORMAL + 2) * _S + i]
        vx, vy, vz = of[_VIEW * _S + i], of[(_VIEW + 1) * _S + i], of[(_VIEW + 2) * _S + i]
        tx, ty, tz = terms[_TOWARD * _S + i], terms[(_TOWARD + 1) * _S + i], terms[(_TOWARD + 2) * _S + i]
        hx, hy, hz = terms[_H * _S + i], terms[(_H + 1) * _S + i], terms[(_H + 2) * _S + i]
        wx, wy, wz = terms[_SINE * _S + i], terms[(_SINE + 1) * _S + i], terms[(_SINE + 2) * _S + i]
        q = _TWO * g_off
        # |n × h|²: to n it is 2 h × (n × h), to h 2 (n × h) × n
        into[_G_NORMAL * _S + i] += q * (hy * wz - hz * wy) + g_nl * tx + g_nv * vx
        into[(_G_NORMAL + 1) * _S + i] += q * (hz * wx - hx * wz) + g_nl * ty + g_nv * vy
        into[(_G_NORMAL + 2) * _S + i] += q * (hx * wy - hy * wx) + g_nl * tz + g_nv * vz
        ghx, ghy, ghz = q * (wy * nz - wz * ny), q * (wz * nx - wx * nz), q * (wx * ny - wy * nx)
        along, length, distance = ghx * hx + ghy * hy + ghz * hz, terms[_LENGTH * _S + i], terms[_DISTANCE * _S + i]
        gtx = g_nl * nx + (ghx - along * hx) / length
        gty = g_nl * ny + (ghy - along * hy) / length
        gtz = g_nl * nz + (ghz - along * hz) / length
        along = gtx * tx + gty * ty + gtz * tz
        g_toward[i] = (gtx - along * tx) / distance
        g_toward[_S + i] = (gty - along * ty) / distance
        g_toward[2 * _S + i] = (gtz - along * tz) / distance


@part(fastmath={"reassoc", "nsz"})
def _total(values, n):  # type: ignore[no-untyped-def]
    total = _ZERO
    for i in range(n):
        total += values[i]
    return total


@part(fastmath=_FAST)
def mirror_rays_backward(begin, end, ray0, chunk, lamps, mirrors, behind, measured, g, out):  # type: ignore[no-untyped-def]
    """``mirror_backward`` of at most ``CHUNK`` rays; gradients of the lamps are added to those of the chunk."""
    of, soft, gate, terms, raw = _of_each(), _of_materials(), _of_materials(), _of_lamps(), _numbers()
    into, sums, g_visible = _gradients(), _sums(), _numbers()
    row_of, place_of, axes, bright = _rows(), _places(), measured.axes, len(measured.ray) - len(measured.axes)
    first, last = first_at(measured.ray, ray0 + begin), first_at(measured.ray, ray0 + end)
    polarized, n = last > bright, _met(begin, end, mirrors.share, behind, row_of, place_of)
    lanes = whole(n, _LANES)
    for o in range(begin, end):
        for which in range(2 if behind[o] >= 0 else 1):
            row = o if which == 0 else behind[o]
            out.share[row], out.normals[row], out.material[row] = _ZERO, _ZERO, _ZERO
    _read(n, row_of, mirrors, polarized, of, raw, soft, gate)
    into[:] = _ZERO
    if polarized:
        _surround(lanes, of, soft, terms)
        sums[:] = _ZERO
        for m in range(max(first, bright), last):
            for which in range(2):
                i = place_of[2 * (measured.ray[m] - ray0 - begin) + which]
                if i >= 0:
                    e = _along(terms, _W, i, axes, m - bright)
                    sums[_WHOLE * _S + i] += _HALF * g[m]
                    sums[_TURNED * _S + i] += _HALF * g[m] * (_TWO * e * e - terms[_SQUARE * _S + i])
                    for a in range(3):
                        sums[(_G_W + a) * _S + i] += g[m] * (_TWO * e * axes[m - bright, a] - terms[(_W + a) * _S + i])
        _surround_backward(lanes, of, gate, terms, sums, into)
    for k in range(lamps.position.shape[0]):
        _read_material(_VISIBLE, _VISIBLE + k, n, row_of, mirrors, raw, soft, gate)
        _reflect_lamp(lanes, lamps.position[k, 0], lamps.position[k, 1], lamps.position[k, 2], of, soft, gate, polarized, terms)
        raw[:] = _ZERO  # pulls
        for m in range(first, last):
            column = measured.output[m]
            pull, seen = g[m] * lamps.spectrum[k, column], _ZERO
            for which in range(2):
                i = place_of[2 * (measured.ray[m] - ray0 - begin) + which]
                if i >= 0:
                    light, passed = of[_SHARE * _S + i] * terms[_AMOUNT * _S + i], _ONE
                    if m >= bright:
                        e = _along(terms, _AXIS, i, axes, m - bright)
                        turned = _HALF * terms[_DEGREE * _S + i] * (_TWO * e * e - _ONE)
                        into[_G_POLARIZING * _S + i] += pull * light * turned
                        passed = _HALF + turned * gate[_POLARIZING * _S + i]
                    raw[i] += pull * passed
                    seen += light * passed
            out.spectrum[chunk, k, column] += g[m] * seen
        _reflect_lamp_backward(lanes, of, soft, gate, terms, raw, into, g_visible, sums)
        for i in range(n):
            out.material[row_of[i], _VISIBLE + k] = g_visible[i]
        for a in range(3):
            out.position[chunk, k, a] += _total(sums[a * _S :], lanes)
    for i in range(n):
        row, rough = row_of[i], gate[_ROUGHNESS * _S + i]
        out.share[row] = into[_G_SHARE * _S + i]
        for a in range(3):
            out.normals[row, a] = into[(_G_NORMAL + a) * _S + i]
        out.material[row, _ROUGHNESS] = into[_G_ALPHA * _S + i] * (_ONE - _LEAST) * rough * (_ONE - rough)
        out.material[row, _STRENGTH] = into[_G_STRENGTH * _S + i]
        if polarized:
            polarizing = gate[_POLARIZING * _S + i]
            out.material[row, _SURROUNDINGS] = into[_G_SURROUNDINGS * _S + i]
            out.material[row, _TRANSMITTED] = into[_G_TRANSMITTED * _S + i]
            out.material[row, _POLARIZING] = into[_G_POLARIZING * _S + i] * polarizing * (_ONE - polarizing)


@kernel
def mirror_backward(next_task, lamps, mirrors, behind, measured, g, out):  # type: ignore[no-untyped-def]
    """g: (M,) gradients of the numbers; out: ``Gradients``."""
    rays = behind.shape[0]
    chunk = take(next_task, 0)
    while chunk * CHUNK < rays:
        begin = chunk * CHUNK
        out.position[chunk], out.spectrum[chunk] = _ZERO, _ZERO
        mirror_rays_backward(begin, min(begin + CHUNK, rays), np.int64(0), chunk, lamps, mirrors, behind, measured, g, out)
        chunk = take(next_task, 0)
