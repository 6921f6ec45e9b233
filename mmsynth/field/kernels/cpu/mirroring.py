"""Mirrored lamps on the CPU, fused: all numbers measured along a ray at once, and their gradients in the same pass.

A gradient of a measurement is known up to a factor when it is: ``mirror`` gives the numbers, ``mirror_backward`` is given these factors and
goes through the same terms again, which is cheaper than to keep them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from mmsynth.field.kernels.constants import LEAST_ROUGHNESS, REFRACTIVE_INDEX
from mmsynth.field.kernels.cpu.jit import allocating_part, inlined, kernel
from mmsynth.field.kernels.cpu.logistic import softplus
from mmsynth.field.kernels.cpu.shading import first_at
from mmsynth.field.kernels.cpu.tasks import take

CHUNK = 64  # rays
_f = np.float32
_INDEX, _LEAST, _TINY = _f(REFRACTIVE_INDEX), _f(LEAST_ROUGHNESS), _f(1e-12)
_AT_NORMAL = _f(((REFRACTIVE_INDEX - 1.0) / (REFRACTIVE_INDEX + 1.0)) ** 2)
_ZERO, _ONE, _TWO = _f(0.0), _f(1.0), _f(2.0)


class Gradients(NamedTuple):
    """Of ``Mirrors`` per row: material (H, 5 + K), normals (H, 3), share (H,); of the lamps per chunk: position (C, K, 3), spectrum
    (C, K, outputs)."""

    material: np.ndarray
    normals: np.ndarray
    share: np.ndarray
    position: np.ndarray
    spectrum: np.ndarray


@allocating_part()
def _materials(begin, end, mirrors, behind):  # type: ignore[no-untyped-def]
    """log(1 + e^x) and its slope, of the materials x of what some rays meet, ray by ray: (surfaces, 5 + K) each."""
    width, n = mirrors.material.shape[1], 0
    raw = np.empty((2 * (end - begin), width), np.float32)
    for o in range(begin, end):
        for which in range(2 if behind[o] >= 0 else 1):
            row = o if which == 0 else behind[o]
            if mirrors.share[row] <= _ZERO:
                continue
            for j in range(width):
                raw[n, j] = mirrors.material[row, j]
            n += 1
    soft, gate = np.empty_like(raw), np.empty_like(raw)
    softplus(raw.reshape(-1), n * width, soft.reshape(-1), gate.reshape(-1))
    return soft, gate


@inlined()
def _terms(row, k, lamps, mirrors, polarized, out):  # type: ignore[no-untyped-def]
    """See ``mirroring.reflect``, of one surface and lamp.

    polarized: whether axis and degree are needed.
    out: the lamp's direction 0:3 and distance 3, the half vector 4:7 and its length 7, n × h 8:11, off 11, n·l 12, n·v 13, the two factors
    below seen 14, 15 (see ``_amount``), 0.25 F or 0 where h is behind 16, axis 17:20, degree 20.
    """
    px, py, pz = mirrors.points[row, 0], mirrors.points[row, 1], mirrors.points[row, 2]
    vx, vy, vz = -mirrors.directions[row, 0], -mirrors.directions[row, 1], -mirrors.directions[row, 2]
    nx, ny, nz = mirrors.normals[row, 0], mirrors.normals[row, 1], mirrors.normals[row, 2]
    tx, ty, tz = lamps.position[k, 0] - px, lamps.position[k, 1] - py, lamps.position[k, 2] - pz
    distance = max(_f(math.sqrt(tx * tx + ty * ty + tz * tz)), _TINY)
    tx, ty, tz = tx / distance, ty / distance, tz / distance
    hx, hy, hz = tx + vx, ty + vy, tz + vz
    length = max(_f(math.sqrt(hx * hx + hy * hy + hz * hz)), _TINY)
    hx, hy, hz = hx / length, hy / length, hz / length
    wx, wy, wz = ny * hz - nz * hy, nz * hx - nx * hz, nx * hy - ny * hx
    out[0], out[1], out[2], out[3] = tx, ty, tz, distance
    out[4], out[5], out[6], out[7] = hx, hy, hz, length
    out[8], out[9], out[10], out[11] = wx, wy, wz, wx * wx + wy * wy + wz * wz
    out[12] = max(nx * tx + ny * ty + nz * tz, _ZERO)
    out[13] = max(nx * vx + ny * vy + nz * vz, _ZERO)
    incidence = min(max(vx * hx + vy * hy + vz * hz, _ZERO), _ONE)
    away = _ONE - incidence
    fresnel = _ONE + (_ONE / _AT_NORMAL - _ONE) * away * away * away * away * away
    out[16] = _f(0.25) * fresnel if nx * hx + ny * hy + nz * hz > _ZERO else _ZERO
    if not polarized:
        return
    ax, ay, az = vy * hz - vz * hy, vz * hx - vx * hz, vx * hy - vy * hx
    across = max(_f(math.sqrt(ax * ax + ay * ay + az * az)), _TINY)
    out[17], out[18], out[19] = ax / across, ay / across, az / across
    transmitted = _f(math.sqrt(_ONE - (_ONE - incidence * incidence) / (_INDEX * _INDEX)))
    s = (incidence - _INDEX * transmitted) / (incidence + _INDEX * transmitted)
    p = (_INDEX * incidence - transmitted) / (_INDEX * incidence + transmitted)
    out[20] = (s * s - p * p) / (s * s + p * p)


@inlined()
def _amount(alpha, strength, visible, terms):  # type: ignore[no-untyped-def]
    """Relative light of one surface and lamp; fills A and B of the terms."""
    square, c = alpha * alpha, _f(0.5) * alpha
    terms[14] = terms[12] * (_ONE - c) + c
    terms[15] = terms[13] * (_ONE - c) + c
    u = square / (square + (_ONE - square) * terms[11])
    return u * u * terms[12] / (terms[14] * terms[15]) * terms[16] * strength * visible


@inlined()
def _around(row, mirrors, out):  # type: ignore[no-untyped-def]
    """See ``mirroring.surround``, of one surface. out: w 0:3, |w|² 3, F / F(1) 4, D_m and D_t over sin² 5, 6."""
    vx, vy, vz = -mirrors.directions[row, 0], -mirrors.directions[row, 1], -mirrors.directions[row, 2]
    nx, ny, nz = mirrors.normals[row, 0], mirrors.normals[row, 1], mirrors.normals[row, 2]
    wx, wy, wz = vy * nz - vz * ny, vz * nx - vx * nz, vx * ny - vy * nx
    out[0], out[1], out[2], out[3] = wx, wy, wz, wx * wx + wy * wy + wz * wz
    c = min(max(vx * nx + vy * ny + vz * nz, _ZERO), _ONE)
    square, away = _ONE - c * c, _ONE - c
    inner = _f(math.sqrt(_ONE - square / (_INDEX * _INDEX)))
    product, along, less = c * inner, square / _INDEX, inner - c / _INDEX
    out[4] = _ONE + (_ONE / _AT_NORMAL - _ONE) * away * away * away * away * away
    out[5] = _TWO * product / _INDEX / (product * product + along * along)
    out[6] = less * less / (_ONE + (product + along) * (product + along))


@allocating_part()
def _reflect_rows(begin, end, lamps, mirrors, amount, axis, degree):  # type: ignore[no-untyped-def]
    """``reflect`` of some surfaces."""
    count, width = lamps.position.shape[0], mirrors.material.shape[1]
    soft, gate = np.empty((end - begin, width), np.float32), np.empty((end - begin, width), np.float32)
    softplus(mirrors.material[begin:end].reshape(-1), (end - begin) * width, soft.reshape(-1), gate.reshape(-1))
    terms = np.empty(21, np.float32)
    for i in range(end - begin):
        alpha, row = _LEAST + (_ONE - _LEAST) * gate[i, 0], begin + i
        for k in range(count):
            _terms(row, k, lamps, mirrors, True, terms)
            amount[row, k] = _amount(alpha, soft[i, 1], gate[i, 5 + k], terms)
            axis[row, k, 0], axis[row, k, 1], axis[row, k, 2] = terms[17], terms[18], terms[19]
            degree[row, k] = terms[20] * gate[i, 4]


@kernel
def reflect(next_task, lamps, mirrors, amount, axis, degree):  # type: ignore[no-untyped-def]
    """See ``mirroring.reflect``."""
    surfaces = mirrors.points.shape[0]
    begin = take(next_task, 0) * CHUNK
    while begin < surfaces:
        _reflect_rows(begin, min(begin + CHUNK, surfaces), lamps, mirrors, amount, axis, degree)
        begin = take(next_task, 0) * CHUNK


@inlined()
def _passed(terms, axes, number):  # type: ignore[no-untyped-def]
    """Share of the light behind an analyser."""
    e = terms[17] * axes[number, 0] + terms[18] * axes[number, 1] + terms[19] * axes[number, 2]
    return _f(0.5) * (_ONE + terms[20] * (_TWO * e * e - _ONE))


@allocating_part()
def mirror_rays(begin, end, ray0, lamps, mirrors, behind, measured, out):  # type: ignore[no-untyped-def]
    """``mirror`` of some rays; ray0 + begin: the first of them in ``measured.ray``."""
    count, bright = lamps.position.shape[0], len(measured.ray) - len(measured.axes)
    soft, gate = _materials(begin, end, mirrors, behind)
    terms, place = np.empty(21, np.float32), -1
    last = first_at(measured.ray, ray0 + begin)
    for o in range(begin, end):
        first = last
        while last < len(measured.ray) and measured.ray[last] == ray0 + o:
            out[last] = _ZERO
            last += 1
        for which in range(2 if behind[o] >= 0 else 1):
            row = o if which == 0 else behind[o]
            if mirrors.share[row] <= _ZERO:
                continue
            place += 1
            alpha, strength = _LEAST + (_ONE - _LEAST) * gate[place, 0], soft[place, 1]
            if last > bright:
                _around(row, mirrors, terms)
                mirrored, let_through = soft[place, 2] * terms[4], soft[place, 3]
                light, polarized = mirrored + let_through, mirrored * terms[5] - let_through * terms[6]
                for m in range(first, last):
                    e = terms[0] * measured.axes[m - bright, 0] + terms[1] * measured.axes[m - bright, 1]
                    e += terms[2] * measured.axes[m - bright, 2]
                    out[m] += _f(0.5) * mirrors.share[row] * (light + polarized * (_TWO * e * e - terms[3]))
            polarizing = gate[place, 4]
            for k in range(count):
                _terms(row, k, lamps, mirrors, last > bright, terms)
                if last > bright:
                    terms[20] *= polarizing
                amount = mirrors.share[row] * _amount(alpha, strength, gate[place, 5 + k], terms)
                for m in range(first, last):
                    passed = _ONE if m < bright else _passed(terms, measured.axes, m - bright)
                    out[m] += amount * passed * lamps.spectrum[k, measured.output[m]]


@kernel
def mirror(next_task, lamps, mirrors, behind, measured, out):  # type: ignore[no-untyped-def]
    """See ``mirroring.mirror``; ``measured.ray`` never decreases."""
    rays = behind.shape[0]
    begin = take(next_task, 0) * CHUNK
    while begin < rays:
        mirror_rays(begin, min(begin + CHUNK, rays), np.int64(0), lamps, mirrors, behind, measured, out)
        begin = take(next_task, 0) * CHUNK


@allocating_part()
def mirror_rays_backward(begin, end, ray0, chunk, lamps, mirrors, behind, measured, g, out):  # type: ignore[no-untyped-def]
    """``mirror_backward`` of some rays; gradients of the lamps are added to those of the chunk."""
    count, bright = lamps.position.shape[0], len(measured.ray) - len(measured.axes)
    g_material, g_normals, g_share, g_position, g_spectrum = out.material, out.normals, out.share, out.position, out.spectrum
    soft, gate = _materials(begin, end, mirrors, behind)
    terms, place = np.empty(21, np.float32), -1
    last = first_at(measured.ray, ray0 + begin)
    for o in range(begin, end):
        first = last
        while last < len(measured.ray) and measured.ray[last] == ray0 + o:
            last += 1
        for which in range(2 if behind[o] >= 0 else 1):
            row = o if which == 0 else behind[o]
            g_share[row] = _ZERO
            g_normals[row] = _ZERO
            g_material[row] = _ZERO
            share = mirrors.share[row]
            if share <= _ZERO:
                continue
            place += 1
            alpha = _LEAST + (_ONE - _LEAST) * gate[place, 0]
            square, c = alpha * alpha, _f(0.5) * alpha
            strength, slope = soft[place, 1], gate[place, 1]
            g_alpha, g_polarizing, polarizing = _ZERO, _ZERO, gate[place, 4]
            if last > bright:
                _around(row, mirrors, terms)
                wx, wy, wz = terms[0], terms[1], terms[2]
                mirrored, let_through = soft[place, 2] * terms[4], soft[place, 3]
                light, polarized = mirrored + let_through, mirrored * terms[5] - let_through * terms[6]
                gwx, gwy, gwz, whole, turned = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
                for m in range(first, last):
                    ex, ey, ez = measured.axes[m - bright, 0], measured.axes[m - bright, 1], measured.axes[m - bright, 2]
                    e = wx * ex + wy * ey + wz * ez
                    whole += _f(0.5) * g[m]
                    turned += _f(0.5) * g[m] * (_TWO * e * e - terms[3])
                    gwx += g[m] * (_TWO * e * ex - wx)
                    gwy += g[m] * (_TWO * e * ey - wy)
                    gwz += g[m] * (_TWO * e * ez - wz)
                g_share[row] += whole * light + turned * polarized
                g_material[row, 2] += share * (whole + turned * terms[5]) * terms[4] * gate[place, 2]
                g_material[row, 3] += share * (whole - turned * terms[6]) * gate[place, 3]
                # w = v × n
                vx, vy, vz = -mirrors.directions[row, 0], -mirrors.directions[row, 1], -mirrors.directions[row, 2]
                pull = share * polarized
                g_normals[row, 0] += pull * (gwy * vz - gwz * vy)
                g_normals[row, 1] += pull * (gwz * vx - gwx * vz)
                g_normals[row, 2] += pull * (gwx * vy - gwy * vx)
            for k in range(count):
                visible = gate[place, 5 + k]
                _terms(row, k, lamps, mirrors, last > bright, terms)
                amount = _amount(alpha, strength, visible, terms)
                pull, degree = _ZERO, terms[20]
                if last > bright:
                    terms[20] *= polarizing
                for m in range(first, last):
                    passed = g[m]
                    if m >= bright:
                        passed *= _passed(terms, measured.axes, m - bright)
                        e = terms[17] * measured.axes[m - bright, 0] + terms[18] * measured.axes[m - bright, 1]
                        e += terms[19] * measured.axes[m - bright, 2]
                        turned = g[m] * lamps.spectrum[k, measured.output[m]] * _f(0.5) * degree * (_TWO * e * e - _ONE)
                        g_polarizing += share * amount * turned
                    pull += passed * lamps.spectrum[k, measured.output[m]]
                    g_spectrum[chunk, k, measured.output[m]] += passed * share * amount
                g_share[row] += pull * amount
                if terms[16] == _ZERO:
                    continue
                pull *= share
                rest = terms[16] * strength * visible
                off, nl, nv, a, b = terms[11], terms[12], terms[13], terms[14], terms[15]
                under = square + (_ONE - square) * off
                u = square / under
                lobe, seen = u * u, nl / (a * b)
                g_material[row, 1] += pull * terms[16] * visible * lobe * seen * slope
                g_material[row, 5 + k] += pull * rest * lobe * seen * (_ONE - visible)
                g_off = -pull * rest * seen * _TWO * lobe * (_ONE - square) / under
                g_square = pull * rest * seen * _TWO * u * off / (under * under)
                g_nl = pull * rest * lobe * c / (a * a * b) if nl > _ZERO else _ZERO
                g_nv = -pull * rest * lobe * nl * (_ONE - c) / (a * b * b) if nv > _ZERO else _ZERO
                g_c = -pull * rest * lobe * nl * ((_ONE - nl) / (a * a * b) + (_ONE - nv) / (a * b * b))
                g_alpha += g_square * _TWO * alpha + _f(0.5) * g_c
                nx, ny, nz = mirrors.normals[row, 0], mirrors.normals[row, 1], mirrors.normals[row, 2]
                tx, ty, tz, hx, hy, hz = terms[0], terms[1], terms[2], terms[4], terms[5], terms[6]
                wx, wy, wz = terms[8], terms[9], terms[10]
                q = _TWO * g_off
                # |n × h|²: to n it is 2 h × (n × h), to h 2 (n × h) × n
                g_normals[row, 0] += q * (hy * wz - hz * wy) + g_nl * tx - g_nv * mirrors.directions[row, 0]
                g_normals[row, 1] += q * (hz * wx - hx * wz) + g_nl * ty - g_nv * mirrors.directions[row, 1]
                g_normals[row, 2] += q * (hx * wy - hy * wx) + g_nl * tz - g_nv * mirrors.directions[row, 2]
                ghx, ghy, ghz = q * (wy * nz - wz * ny), q * (wz * nx - wx * nz), q * (wx * ny - wy * nx)
                along = ghx * hx + ghy * hy + ghz * hz
                gtx = g_nl * nx + (ghx - along * hx) / terms[7]
                gty = g_nl * ny + (ghy - along * hy) / terms[7]
                gtz = g_nl * nz + (ghz - along * hz) / terms[7]
                along = gtx * tx + gty * ty + gtz * tz
                g_position[chunk, k, 0] += (gtx - along * tx) / terms[3]
                g_position[chunk, k, 1] += (gty - along * ty) / terms[3]
                g_position[chunk, k, 2] += (gtz - along * tz) / terms[3]
            g_material[row, 4] = g_polarizing * polarizing * (_ONE - polarizing)
            g_material[row, 0] = g_alpha * (_ONE - _LEAST) * gate[place, 0] * (_ONE - gate[place, 0])


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
