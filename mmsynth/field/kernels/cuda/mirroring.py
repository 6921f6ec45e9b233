"""Mirrored lamps in Triton, fused: all numbers measured along a ray at once, and their gradients; both surfaces of a ray are neighbouring
lanes. ``mirror`` gives the numbers; ``mirror_backward_kernel`` is given their gradients and goes through the same terms again, which is
cheaper than to keep them. Gradients of the lamps are sums over the rays of a program, a row per program: no atomics.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from mmsynth.field.kernels.constants import LEAST_ROUGHNESS, REFRACTIVE_INDEX
from mmsynth.field.kernels.cuda.shared import constant, first_number, jit, position, sigmoid, softplus, sum_of_pair, tl, triton
from mmsynth.field.kernels.mirroring import mirror as plain_mirror
from mmsynth.field.kernels.parameters import Lamps, Measured, Mirrors

RAYS = 32  # of a program
LEAST, INDEX = constant(LEAST_ROUGHNESS), constant(REFRACTIVE_INDEX)
GRAZING = constant(((REFRACTIVE_INDEX + 1.0) / (REFRACTIVE_INDEX - 1.0)) ** 2 - 1.0)  # 1 / F(1) - 1
PARTS = constant(5)  # of a material, before the visibilities of lamps
TINY = constant(1e-12)


@jit
def _rows(share, behind, rays, RAYS: tl.constexpr):  # type: ignore[no-untyped-def]
    """Of each lane its ray and its row, whether there is such a ray, whether the row is its nearest, and whether it exists; its share."""
    lane = tl.arange(0, 2 * RAYS)
    r = tl.program_id(0) * RAYS + lane // 2
    live, nearest = r < rays, lane % 2 == 0
    second = tl.load(behind + r, mask=live, other=-1).to(tl.int32)
    exists = live & (nearest | (second >= 0))
    row = tl.where(nearest, r, tl.where(exists, second, rays + r))
    shares = tl.load(share + row, mask=exists, other=0.0)
    return r, row, live, nearest, exists, shares


@jit
def _cross(ax, ay, az, bx, by, bz):  # type: ignore[no-untyped-def]
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@jit
def _unit(x, y, z):  # type: ignore[no-untyped-def]
    length = tl.maximum(tl.sqrt(x * x + y * y + z * z), TINY)
    return x / length, y / length, z / length, length


@jit
def _fresnel(incidence):  # type: ignore[no-untyped-def]
    """Schlick's F / F(1)."""
    away = 1.0 - incidence
    return 1.0 + GRAZING * away * away * away * away * away


@jit
def _around(vx, vy, vz, nx, ny, nz):  # type: ignore[no-untyped-def]
    """See ``mirroring.surround``: w, |w|², F / F(1), D_m and D_t over sin²."""
    wx, wy, wz = _cross(vx, vy, vz, nx, ny, nz)
    c = tl.minimum(tl.maximum(vx * nx + vy * ny + vz * nz, 0.0), 1.0)
    square = 1.0 - c * c
    inner = tl.sqrt(1.0 - square / (INDEX * INDEX))
    product, along, less = c * inner, square / INDEX, inner - c / INDEX
    mirrored = 2.0 * product / INDEX / (product * product + along * along)
    return wx, wy, wz, wx * wx + wy * wy + wz * wz, _fresnel(c), mirrored, less * less / (1.0 + (product + along) * (product + along))


@jit
def _half(px, py, pz, vx, vy, vz, lamp):  # type: ignore[no-untyped-def]
    """Direction to a lamp and its distance, the half vector and its length."""
    tx, ty, tz, distance = _unit(tl.load(lamp) - px, tl.load(lamp + 1) - py, tl.load(lamp + 2) - pz)
    hx, hy, hz, length = _unit(tx + vx, ty + vy, tz + vz)
    return tx, ty, tz, distance, hx, hy, hz, length


@jit
def _polarization(vx, vy, vz, hx, hy, hz, incidence):  # type: ignore[no-untyped-def]
    """Axis and degree of the polarization of mirrored light; Fresnel's equations."""
    ax, ay, az = _cross(vx, vy, vz, hx, hy, hz)
    ax, ay, az, _ = _unit(ax, ay, az)
    transmitted = tl.sqrt(1.0 - (1.0 - incidence * incidence) / (INDEX * INDEX))
    s = (incidence - INDEX * transmitted) / (incidence + INDEX * transmitted)
    p = (INDEX * incidence - transmitted) / (INDEX * incidence + transmitted)
    return ax, ay, az, (s * s - p * p) / (s * s + p * p)


@jit
def _spectrum(spectrum, lamp, column, some, OUTPUTS: tl.constexpr, LOG: tl.constexpr):  # type: ignore[no-untyped-def]
    value = tl.load(spectrum + lamp * OUTPUTS + column, mask=some, other=0.0)
    return tl.exp(value) if LOG else value


@jit
def mirror_kernel(  # type: ignore[no-untyped-def]
    positions, spectrum, used, material, normals, points, directions, share, behind, ray, output, axes, out,
    rays, count, bright, bisections, lamps,
    COLUMNS: tl.constexpr, OUTPUTS: tl.constexpr, LOG: tl.constexpr, POLARIZED: tl.constexpr, PER_ROW: tl.constexpr,
    RAYS: tl.constexpr,
):  # fmt: skip
    """used: (lamps,), which of the rows of ``positions`` and ``spectrum`` there are. LOG: the spectrum's logarithm is given."""
    r, row, live, nearest, exists, shares = _rows(share, behind, rays, RAYS)
    met = exists & (shares > 0.0)
    px, py, pz = position(points, row, met)
    dx, dy, dz = position(directions, row if PER_ROW else r, met)
    nx, ny, nz = position(normals, row, met)
    vx, vy, vz = -dx, -dy, -dz
    raw = material + row * COLUMNS
    alpha = LEAST + (1.0 - LEAST) * sigmoid(tl.load(raw, mask=met, other=0.0))
    strength, _ = softplus(tl.load(raw + 1, mask=met, other=0.0))
    square, c = alpha * alpha, 0.5 * alpha
    to_viewer = tl.maximum(nx * vx + ny * vy + nz * vz, 0.0)
    if POLARIZED:
        wx, wy, wz, ww, schlick, mirrored, transmitted = _around(vx, vy, vz, nx, ny, nz)
        around, _ = softplus(tl.load(raw + 2, mask=met, other=0.0))
        around *= schlick
        through, _ = softplus(tl.load(raw + 3, mask=met, other=0.0))
        polarizing = sigmoid(tl.load(raw + 4, mask=met, other=0.0))
    begin = first_number(ray, r, count, bisections)
    numbers = tl.where(live, first_number(ray, r + 1, count, bisections) - begin, 0)
    for j in range(0, tl.max(numbers, 0)):
        m = begin + j
        some = j < numbers
        column = tl.load(output + m, mask=some, other=0).to(tl.int32)
        value = tl.zeros([2 * RAYS], tl.float32)
        if POLARIZED:
            tensor = some & (m >= bright)
            ex, ey, ez = position(axes, m - bright, tensor)
            e = wx * ex + wy * ey + wz * ez
            value += tl.where(tensor, 0.5 * (around + through + (around * mirrored - through * transmitted) * (2.0 * e * e - ww)), 0.0)
        for k in range(0, lamps):
            lamp = tl.load(used + k).to(tl.int32)
            tx, ty, tz, _, hx, hy, hz, _ = _half(px, py, pz, vx, vy, vz, positions + 3 * lamp)
            ox, oy, oz = _cross(nx, ny, nz, hx, hy, hz)
            u = square / (square + (1.0 - square) * (ox * ox + oy * oy + oz * oz))
            to_lamp = tl.maximum(nx * tx + ny * ty + nz * tz, 0.0)
            seen = to_lamp / ((to_lamp * (1.0 - c) + c) * (to_viewer * (1.0 - c) + c))
            incidence = tl.minimum(tl.maximum(vx * hx + vy * hy + vz * hz, 0.0), 1.0)
            visible = sigmoid(tl.load(raw + PARTS + lamp, mask=met, other=0.0))
            amount = 0.25 * u * u * seen * _fresnel(incidence) * strength * visible
            amount = tl.where(nx * hx + ny * hy + nz * hz > 0.0, amount, 0.0)
            if POLARIZED:
                ax, ay, az, degree = _polarization(vx, vy, vz, hx, hy, hz, incidence)
                along = ax * ex + ay * ey + az * ez
                amount *= tl.where(tensor, 0.5 * (1.0 + degree * polarizing * (2.0 * along * along - 1.0)), 1.0)
            value += amount * _spectrum(spectrum, lamp, column, some, OUTPUTS, LOG)
        tl.store(out + m, sum_of_pair(tl.where(met, shares * value, 0.0), RAYS), mask=some & nearest)


@jit
def mirror_backward_kernel(  # type: ignore[no-untyped-def]
    positions, spectrum, used, material, normals, points, directions, share, behind, ray, output, axes, gradient, trains,
    g_material, g_normals, g_share, partial, stride, rays, rows, count, bright, bisections, lamps,
    COLUMNS: tl.constexpr, WIDTH: tl.constexpr, OUTPUTS: tl.constexpr, HEADS: tl.constexpr, LAMPS: tl.constexpr, PLACES: tl.constexpr,
    LOG: tl.constexpr, POLARIZED: tl.constexpr, TRAINS: tl.constexpr, ADD: tl.constexpr, PER_ROW: tl.constexpr, RAYS: tl.constexpr,
):  # fmt: skip
    """WIDTH, HEADS, PLACES: sizes of the tiles that COLUMNS, OUTPUTS and LAMPS are filled up to. TRAINS: ``trains`` says of which rays
    surfaces are taught. ADD: g_share is added to. partial: of the lamps' positions, then of their (LOG) spectra."""
    r, row, live, _, exists, shares = _rows(share, behind, rays, RAYS)
    met = exists & (shares > 0.0)
    px, py, pz = position(points, row, met)
    dx, dy, dz = position(directions, row if PER_ROW else r, met)
    nx, ny, nz = position(normals, row, met)
    vx, vy, vz = -dx, -dy, -dz
    raw = material + row * COLUMNS
    gate = sigmoid(tl.load(raw, mask=met, other=0.0))
    alpha = LEAST + (1.0 - LEAST) * gate
    strength, slope = softplus(tl.load(raw + 1, mask=met, other=0.0))
    square, c = alpha * alpha, 0.5 * alpha
    nv = tl.maximum(nx * vx + ny * vy + nz * vz, 0.0)
    b = nv * (1.0 - c) + c
    begin = first_number(ray, r, count, bisections)
    numbers = tl.where(met, first_number(ray, r + 1, count, bisections) - begin, 0)
    most = tl.max(numbers, 0)
    w, o, place = tl.arange(0, WIDTH)[None, :], tl.arange(0, HEADS)[None, :], tl.arange(0, PLACES)[:, None]
    of_raw = tl.zeros([2 * RAYS, WIDTH], tl.float32)
    of_position = tl.zeros([PLACES, 4], tl.float32)
    of_spectrum = tl.zeros([PLACES, HEADS], tl.float32)
    of_share = tl.zeros([2 * RAYS], tl.float32)
    of_strength, of_alpha, of_polarizing = of_share, of_share, of_share
    gx, gy, gz = of_share, of_share, of_share
    if POLARIZED:
        polarizing = sigmoid(tl.load(raw + 4, mask=met, other=0.0))
        wx, wy, wz, ww, schlick, mirrored, transmitted = _around(vx, vy, vz, nx, ny, nz)
        around, around_slope = softplus(tl.load(raw + 2, mask=met, other=0.0))
        through, through_slope = softplus(tl.load(raw + 3, mask=met, other=0.0))
        around *= schlick
        light, polarized = around + through, around * mirrored - through * transmitted
        whole, turned = of_share, of_share
        gwx, gwy, gwz = of_share, of_share, of_share
        for j in range(0, most):
            tensor = (j < numbers) & (begin + j >= bright)
            g = tl.load(gradient + begin + j, mask=tensor, other=0.0)
            ex, ey, ez = position(axes, begin + j - bright, tensor)
            e = wx * ex + wy * ey + wz * ez
            whole += 0.5 * g
            turned += 0.5 * g * (2.0 * e * e - ww)
            gwx += g * (2.0 * e * ex - wx)
            gwy += g * (2.0 * e * ey - wy)
            gwz += g * (2.0 * e * ez - wz)
        of_share += whole * light + turned * polarized
        of_raw += tl.where(w == 2, (shares * (whole + turned * mirrored) * schlick * around_slope)[:, None], 0.0)
        of_raw += tl.where(w == 3, (shares * (whole - turned * transmitted) * through_slope)[:, None], 0.0)
        # w = v × n
        cx, cy, cz = _cross(gwx, gwy, gwz, vx, vy, vz)
        gx += shares * polarized * cx
        gy += shares * polarized * cy
        gz += shares * polarized * cz
    for k in range(0, lamps):
        lamp = tl.load(used + k).to(tl.int32)
        tx, ty, tz, distance, hx, hy, hz, length = _half(px, py, pz, vx, vy, vz, positions + 3 * lamp)
        ox, oy, oz = _cross(nx, ny, nz, hx, hy, hz)
        off = ox * ox + oy * oy + oz * oz
        under = square + (1.0 - square) * off
        u = square / under
        nl = tl.maximum(nx * tx + ny * ty + nz * tz, 0.0)
        a = nl * (1.0 - c) + c
        incidence = tl.minimum(tl.maximum(vx * hx + vy * hy + vz * hz, 0.0), 1.0)
        visible = sigmoid(tl.load(raw + PARTS + lamp, mask=met, other=0.0))
        front = tl.where(nx * hx + ny * hy + nz * hz > 0.0, 0.25 * _fresnel(incidence), 0.0)
        lobe, seen = u * u, nl / (a * b)
        amount = lobe * seen * front * strength * visible
        if POLARIZED:
            ax, ay, az, degree = _polarization(vx, vy, vz, hx, hy, hz, incidence)
        pull = tl.zeros([2 * RAYS], tl.float32)
        of_lamp = tl.zeros([1, HEADS], tl.float32)
        for j in range(0, most):
            m = begin + j
            some = j < numbers
            column = tl.load(output + m, mask=some, other=0).to(tl.int32)
            passed = tl.load(gradient + m, mask=some, other=0.0)
            own = _spectrum(spectrum, lamp, column, some, OUTPUTS, LOG)
            if POLARIZED:
                tensor = some & (m >= bright)
                ex, ey, ez = position(axes, m - bright, tensor)
                along = ax * ex + ay * ey + az * ez
                turn = degree * (2.0 * along * along - 1.0)
                of_polarizing += tl.where(tensor, shares * amount * passed * own * 0.5 * turn, 0.0)
                passed *= tl.where(tensor, 0.5 * (1.0 + polarizing * turn), 1.0)
            pull += tl.where(some, passed * own, 0.0)
            of_light = passed * shares * amount
            if LOG:
                of_light *= own
            of_lamp += tl.sum(tl.where((o == column[:, None]) & some[:, None], of_light[:, None], 0.0), 0)[None, :]
        of_spectrum += tl.where(place == lamp, of_lamp, 0.0)
        of_share += pull * amount
        pull *= shares
        rest = front * strength * visible
        of_strength += pull * front * visible * lobe * seen
        of_raw += tl.where(w == PARTS + lamp, (pull * rest * lobe * seen * (1.0 - visible))[:, None], 0.0)
        g_off = -pull * rest * seen * 2.0 * lobe * (1.0 - square) / under
        g_square = pull * rest * seen * 2.0 * u * off / (under * under)
        g_nl = tl.where(nl > 0.0, pull * rest * lobe * c / (a * a * b), 0.0)
        g_nv = tl.where(nv > 0.0, -pull * rest * lobe * nl * (1.0 - c) / (a * b * b), 0.0)
        g_c = -pull * rest * lobe * nl * ((1.0 - nl) / (a * a * b) + (1.0 - nv) / (a * b * b))
        of_alpha += g_square * 2.0 * alpha + 0.5 * g_c
        # |n × h|²: to n it is 2 h × (n × h), to h 2 (n × h) × n
        q = 2.0 * g_off
        cx, cy, cz = _cross(hx, hy, hz, ox, oy, oz)
        gx += q * cx + g_nl * tx + g_nv * vx
        gy += q * cy + g_nl * ty + g_nv * vy
        gz += q * cz + g_nl * tz + g_nv * vz
        cx, cy, cz = _cross(ox, oy, oz, nx, ny, nz)
        along_h = q * (cx * hx + cy * hy + cz * hz)
        gtx = g_nl * nx + (q * cx - along_h * hx) / length
        gty = g_nl * ny + (q * cy - along_h * hy) / length
        gtz = g_nl * nz + (q * cz - along_h * hz) / length
        along_t = gtx * tx + gty * ty + gtz * tz
        axis = tl.arange(0, 4)[None, :]
        mine = place == lamp
        of_position += tl.where(mine & (axis == 0), tl.sum(tl.where(met, (gtx - along_t * tx) / distance, 0.0), 0), 0.0)
        of_position += tl.where(mine & (axis == 1), tl.sum(tl.where(met, (gty - along_t * ty) / distance, 0.0), 0), 0.0)
        of_position += tl.where(mine & (axis == 2), tl.sum(tl.where(met, (gtz - along_t * tz) / distance, 0.0), 0), 0.0)
    of_raw += tl.where(w == 0, (of_alpha * (1.0 - LEAST) * gate * (1.0 - gate))[:, None], 0.0)
    of_raw += tl.where(w == 1, (of_strength * slope)[:, None], 0.0)
    if POLARIZED:
        of_raw += tl.where(w == 4, (of_polarizing * polarizing * (1.0 - polarizing))[:, None], 0.0)
    taught = met
    if TRAINS:
        taught = met & (tl.load(trains + r, mask=live, other=0) != 0)
    written = exists | (live & (rows == 2 * rays))  # zeros, too, for what is not there but has a row of its own
    tl.store(g_material + row[:, None] * COLUMNS + w, tl.where(taught[:, None], of_raw, 0.0), mask=written[:, None] & (w < COLUMNS))
    tl.store(g_normals + 3 * row, tl.where(taught, gx, 0.0), mask=written)
    tl.store(g_normals + 3 * row + 1, tl.where(taught, gy, 0.0), mask=written)
    tl.store(g_normals + 3 * row + 2, tl.where(taught, gz, 0.0), mask=written)
    of_share = tl.where(taught, of_share, 0.0)
    if ADD:
        of_share += tl.load(g_share + row, mask=written, other=0.0)
    tl.store(g_share + row, of_share, mask=written)
    out = partial + tl.program_id(0).to(tl.int64) * stride
    axis = tl.arange(0, 4)[None, :]
    tl.store(out + 3 * place + axis, of_position, mask=(place < LAMPS) & (axis < 3))
    tl.store(out + 3 * LAMPS + place * OUTPUTS + o, of_spectrum, mask=(place < LAMPS) & (o < OUTPUTS))


def launch(  # type: ignore[no-untyped-def]
    lamps: Lamps, used: Tensor, log: bool, mirrors: Mirrors, behind: Tensor, measured: Measured, backward: tuple[Tensor, ...] | None = None,
    add: bool = False,
) -> Tensor:  # fmt: skip
    """``mirror``, or its backward pass: one launch.

    Args:
        lamps: all places of lamps, of which those in ``used`` (K,) are there. log: the logarithm of the spectrum is given.
        mirrors: directions of rows, (H, 3), or of the rays, (R, 3). material: (H, 5 + places).
        backward: gradient (M,), trains (R,) bool or empty, then where gradients go: material, normals, share (``add``: to it) and rows of
            partial sums of the lamps, positions before spectra, (``-(-R // RAYS)``, W or more).
    Returns:
        the numbers (M,), or what of ``backward`` are partial sums.
    """
    rays, numbers, places, columns = len(behind), len(measured.ray), len(lamps.position), mirrors.material.shape[1]
    outputs = lamps.spectrum.shape[1]
    out = torch.empty(numbers, device=behind.device) if backward is None else backward[-1]
    given = (
        lamps.position, lamps.spectrum, used, mirrors.material, mirrors.normals, mirrors.points, mirrors.directions, mirrors.share, behind,
        measured.ray, measured.output, measured.axes,
    )  # fmt: skip
    tiles = lambda n, least: max(least, triton.next_power_of_2(n))
    polarized, grid = len(measured.axes) > 0, (-(-rays // RAYS),)
    per_row = len(mirrors.directions) == len(mirrors.share)
    bright, bisections = numbers - len(measured.axes), numbers.bit_length()
    if rays:
        with torch.cuda.device_of(behind):
            if backward is None:
                mirror_kernel[grid](
                    *given, out, rays, numbers, bright, bisections, len(used), columns, outputs, log, polarized, per_row, RAYS, num_warps=2,
                )  # fmt: skip
            else:
                mirror_backward_kernel[grid](
                    *given, *backward, out.stride(0), rays, len(mirrors.share), numbers, bright, bisections, len(used),
                    columns, tiles(columns, 8), outputs, tiles(outputs, 8), places, tiles(places, 4),
                    log, polarized, len(backward[1]) > 0, add, per_row, RAYS, num_warps=2,
                )  # fmt: skip
    return out


def mirror(lamps: Lamps, mirrors: Mirrors, behind: Tensor, measured: Measured) -> Tensor:
    """See ``mirroring.mirror``; float32, ``measured.ray`` never decreasing. Points and directions with a gradient go to the reference."""
    if torch.is_grad_enabled() and (mirrors.points.requires_grad or mirrors.directions.requires_grad):
        return plain_mirror(lamps, mirrors, behind, measured)
    return _Mirror.apply(behind, measured, mirrors, *lamps, mirrors.material, mirrors.normals, mirrors.share)


class _Mirror(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, behind: Tensor, measured: Measured, mirrors: Mirrors, *differentiable: Tensor) -> Tensor:
        position, spectrum, *rows = (x.contiguous() for x in differentiable)
        mirrors = Mirrors(rows[0], rows[1], mirrors.points.contiguous(), mirrors.directions.contiguous(), rows[2])
        lamps, used = Lamps(position, spectrum), torch.arange(len(position), device=behind.device)
        ctx.constants = used, behind, measured, mirrors.points, mirrors.directions
        ctx.save_for_backward(position, spectrum, *rows)
        return launch(lamps, used, False, mirrors, behind, measured)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        (used, behind, measured, points, directions), (position, spectrum, *rows) = ctx.constants, ctx.saved_tensors
        found = [torch.empty_like(x) for x in rows]
        partial = gradient.new_empty(-(-len(behind) // RAYS), position.numel() + spectrum.numel())
        mirrors = Mirrors(rows[0], rows[1], points, directions, rows[2])
        given = gradient.contiguous(), behind[:0], *found, partial
        whole = launch(Lamps(position, spectrum), used, False, mirrors, behind, measured, given).sum(0)
        of_lamps = whole.split([position.numel(), spectrum.numel()])
        return None, None, None, *(g.view(x.shape) for g, x in zip(of_lamps, (position, spectrum), strict=True)), *found
