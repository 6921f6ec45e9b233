"""The operations for the CPU, compiled by numba.

Forward passes are parallel over samples or rays; the scatter of the encoding's backward pass is parallel over *levels*,
so that no two threads touch one table: no atomics, one table in a core's cache, and the same sum in the same order every
run. Kernels release the GIL and are cached on disk.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

_P1 = np.uint32(2654435761)
_P2 = np.uint32(805459861)
_CHUNK = 512


@njit(cache=True, inline="always")
def _cell(positions, i, resolution):  # type: ignore[no-untyped-def]
    """Cell indices of position i and where in the cell it is; positions are in [0, 1], so truncation is floor."""
    px = positions[i, 0] * np.float32(resolution)
    py = positions[i, 1] * np.float32(resolution)
    pz = positions[i, 2] * np.float32(resolution)
    x = min(np.int32(px), resolution - np.int32(1))
    y = min(np.int32(py), resolution - np.int32(1))
    z = min(np.int32(pz), resolution - np.int32(1))
    return x, y, z, px - np.float32(x), py - np.float32(y), pz - np.float32(z)


@njit(cache=True, inline="always")
def _corners(x, y, z, resolution, mask, dense):  # type: ignore[no-untyped-def]
    """Table rows of the eight corners, z fastest (the order of ``_weights``)."""
    if dense:
        side = np.uint32(resolution + 1)
        base = (np.uint32(x) * side + np.uint32(y)) * side + np.uint32(z)
        right = base + side * side
        one = np.uint32(1)
        return base, base + one, base + side, base + side + one, right, right + one, right + side, right + side + one
    x0, x1 = np.uint32(x), np.uint32(x + 1)
    y0 = np.uint32(y) * _P1
    y1 = y0 + _P1
    z0 = np.uint32(z) * _P2
    z1 = z0 + _P2
    a, b, c, d = x0 ^ y0, x0 ^ y1, x1 ^ y0, x1 ^ y1
    return (
        (a ^ z0) & mask,
        (a ^ z1) & mask,
        (b ^ z0) & mask,
        (b ^ z1) & mask,
        (c ^ z0) & mask,
        (c ^ z1) & mask,
        (d ^ z0) & mask,
        (d ^ z1) & mask,
    )


@njit(cache=True, inline="always")
def _weights(fx, fy, fz):  # type: ignore[no-untyped-def]
    one = np.float32(1.0)
    gx, gy, gz = one - fx, one - fy, one - fz
    a, b, c, d = gx * gy, gx * fy, fx * gy, fx * fy
    return a * gz, a * fz, b * gz, b * fz, c * gz, c * fz, d * gz, d * fz


@njit(cache=True, parallel=True, fastmath=True, nogil=True)
def _encode(positions, tables, resolutions, offsets, active, out):  # type: ignore[no-untyped-def]
    count = positions.shape[0]
    chunks = (count + _CHUNK - 1) // _CHUNK
    for chunk in prange(chunks):
        for level in range(active):
            resolution = np.int32(resolutions[level])
            rows = offsets[level + 1] - offsets[level]
            dense = (np.int64(resolution) + 1) ** 3 <= rows
            mask = np.uint32(rows - 1)
            table = tables[offsets[level] : offsets[level + 1]]
            for i in range(chunk * _CHUNK, min(count, (chunk + 1) * _CHUNK)):
                x, y, z, fx, fy, fz = _cell(positions, i, resolution)
                i0, i1, i2, i3, i4, i5, i6, i7 = _corners(x, y, z, resolution, mask, dense)
                w0, w1, w2, w3, w4, w5, w6, w7 = _weights(fx, fy, fz)
                out[i, 2 * level] = (
                    w0 * table[i0, 0] + w1 * table[i1, 0] + w2 * table[i2, 0] + w3 * table[i3, 0]
                    + w4 * table[i4, 0] + w5 * table[i5, 0] + w6 * table[i6, 0] + w7 * table[i7, 0]
                )  # fmt: skip
                out[i, 2 * level + 1] = (
                    w0 * table[i0, 1] + w1 * table[i1, 1] + w2 * table[i2, 1] + w3 * table[i3, 1]
                    + w4 * table[i4, 1] + w5 * table[i5, 1] + w6 * table[i6, 1] + w7 * table[i7, 1]
                )  # fmt: skip


@njit(cache=True, inline="always")
def _add(table, row, weight, a, b):  # type: ignore[no-untyped-def]
    table[row, 0] += weight * a
    table[row, 1] += weight * b


@njit(cache=True, parallel=True, fastmath=True, nogil=True)
def _encode_backward(positions, gradient, resolutions, offsets, active, out):  # type: ignore[no-untyped-def]
    count = positions.shape[0]
    for level in prange(active):
        resolution = np.int32(resolutions[level])
        rows = offsets[level + 1] - offsets[level]
        dense = (np.int64(resolution) + 1) ** 3 <= rows
        mask = np.uint32(rows - 1)
        table = out[offsets[level] : offsets[level + 1]]
        for i in range(count):
            a = gradient[i, 2 * level]
            b = gradient[i, 2 * level + 1]
            if a == 0.0 and b == 0.0:
                continue
            x, y, z, fx, fy, fz = _cell(positions, i, resolution)
            i0, i1, i2, i3, i4, i5, i6, i7 = _corners(x, y, z, resolution, mask, dense)
            w0, w1, w2, w3, w4, w5, w6, w7 = _weights(fx, fy, fz)
            _add(table, i0, w0, a, b)
            _add(table, i1, w1, a, b)
            _add(table, i2, w2, a, b)
            _add(table, i3, w3, a, b)
            _add(table, i4, w4, a, b)
            _add(table, i5, w5, a, b)
            _add(table, i6, w6, a, b)
            _add(table, i7, w7, a, b)


@njit(cache=True, nogil=True)
def _walk(ox, oy, oz, dx, dy, dz, near, far, jitter, states, step, t_out, write):  # type: ignore[no-untyped-def]
    """One ray of ``march``: returns its sample count and, when asked, writes the samples."""
    grid = states.shape[0]
    half = np.float32(0.5 * grid)
    kept = 0
    k = 0
    while True:
        t = near + (np.float32(k) + jitter) * step
        if not t < far:  # also ends on NaN
            break
        x = min(max(int((ox + dx * t + np.float32(1.0)) * half), 0), grid - 1)
        y = min(max(int((oy + dy * t + np.float32(1.0)) * half), 0), grid - 1)
        z = min(max(int((oz + dz * t + np.float32(1.0)) * half), 0), grid - 1)
        state = states[x, y, z]
        if state == 0:
            # where the ray leaves this cell, less one step for rounding: points of the lattice in between are all outside
            leave = far
            for axis in range(3):
                o = ox if axis == 0 else (oy if axis == 1 else oz)
                d = dx if axis == 0 else (dy if axis == 1 else dz)
                c = x if axis == 0 else (y if axis == 1 else z)
                if abs(d) > 1e-9:
                    face = np.float32(c + (1 if d > 0 else 0)) / half - np.float32(1.0)
                    leave = min(leave, (face - o) / d)
            k += max(1, int((leave - t) / step))
            continue
        if write:
            t_out[kept] = t
        kept += 1
        if state == 2 and kept >= 2:
            break
        k += 1
    return kept


@njit(cache=True, parallel=True, nogil=True)
def _march_count(origins, directions, near, far, jitter, states, step, counts):  # type: ignore[no-untyped-def]
    unused = np.empty(0, np.float32)
    for r in prange(origins.shape[0]):
        o = origins[r]
        d = directions[r]
        counts[r] = _walk(o[0], o[1], o[2], d[0], d[1], d[2], near[r], far[r], jitter[r], states, step, unused, False)


@njit(cache=True, parallel=True, nogil=True)
def _march_fill(origins, directions, near, far, jitter, states, step, offsets, t, ray):  # type: ignore[no-untyped-def]
    for r in prange(origins.shape[0]):
        o = origins[r]
        d = directions[r]
        begin, end = offsets[r], offsets[r + 1]
        _walk(o[0], o[1], o[2], d[0], d[1], d[2], near[r], far[r], jitter[r], states, step, t[begin:end], True)
        ray[begin:end] = r


@njit(cache=True, inline="always")
def _softplus(x):  # type: ignore[no-untyped-def]
    return max(x, 0.0) + math.log1p(math.exp(-abs(x)))


@njit(cache=True, inline="always")
def _sigmoid(x):  # type: ignore[no-untyped-def]
    e = math.exp(-abs(x))
    return 1.0 / (1.0 + e) if x >= 0 else e / (1.0 + e)


@njit(cache=True, parallel=True, nogil=True)
def _sections(sdf, sharpness, offsets, weights, crossing):  # type: ignore[no-untyped-def]
    for r in prange(offsets.shape[0] - 1):
        depth = 0.0
        for i in range(offsets[r], offsets[r + 1]):
            crossing[i] = 0.5
            weights[i] = 0.0
            if i + 1 < offsets[r + 1]:
                f0 = sdf[i]
                f1 = sdf[i + 1]
                # softplus(-s f) differences in double: at s = 1e6 single precision would leave 0.1 of noise
                tau = max(0.0, _softplus(-sharpness * np.float64(f1)) - _softplus(-sharpness * np.float64(f0)))
                weights[i] = math.exp(-depth) * -math.expm1(-tau)
                depth += tau
                if f0 > 0 and f1 <= 0:
                    crossing[i] = f0 / (f0 - f1)


@njit(cache=True, parallel=True, nogil=True)
def _sections_backward(sdf, sharpness, offsets, gradient, out):  # type: ignore[no-untyped-def]
    for r in prange(offsets.shape[0] - 1):
        begin, end = offsets[r], offsets[r + 1]
        for i in range(begin, end):
            out[i] = 0.0
        # first pass forward: the total of gradient times weight; second: what is left behind each section
        depth = 0.0
        total = 0.0
        for i in range(begin, end - 1):
            tau = max(0.0, _softplus(-sharpness * np.float64(sdf[i + 1])) - _softplus(-sharpness * np.float64(sdf[i])))
            total += gradient[i] * math.exp(-depth) * -math.expm1(-tau)
            depth += tau
        depth = 0.0
        for i in range(begin, end - 1):
            tau = _softplus(-sharpness * np.float64(sdf[i + 1])) - _softplus(-sharpness * np.float64(sdf[i]))
            if tau > 0.0:
                transmittance = math.exp(-depth)
                total -= gradient[i] * transmittance * -math.expm1(-tau)
                d_tau = gradient[i] * transmittance * math.exp(-tau) - total
                out[i] += d_tau * sharpness * _sigmoid(-sharpness * np.float64(sdf[i]))
                out[i + 1] -= d_tau * sharpness * _sigmoid(-sharpness * np.float64(sdf[i + 1]))
                depth += tau


class _HashEncode(torch.autograd.Function):
    @staticmethod
    def forward(ctx, positions, table, resolutions, offsets, active):  # type: ignore[no-untyped-def]
        levels = resolutions.shape[0]
        ctx.active = min(active, levels)
        out = torch.empty(positions.shape[0], 2 * levels)
        out[:, 2 * ctx.active :] = 0.0
        _encode(positions.detach().numpy(), table.detach().numpy(), resolutions.numpy(), offsets.numpy(), ctx.active, out.numpy())
        ctx.save_for_backward(positions, resolutions, offsets)
        ctx.rows = table.shape[0]
        return out

    @staticmethod
    def backward(ctx, gradient):  # type: ignore[no-untyped-def]
        positions, resolutions, offsets = ctx.saved_tensors
        out = torch.zeros(ctx.rows, 2)
        arrays = (x.numpy() for x in (positions.detach(), gradient.contiguous(), resolutions, offsets))
        _encode_backward(*arrays, ctx.active, out.numpy())  # type: ignore[call-arg]
        return None, out, None, None, None


class _SectionWeights(torch.autograd.Function):
    @staticmethod
    def forward(ctx, sdf, sharpness, offsets):  # type: ignore[no-untyped-def]
        weights, crossing = torch.empty_like(sdf), torch.empty_like(sdf)
        _sections(sdf.detach().numpy(), sharpness, offsets.numpy(), weights.numpy(), crossing.numpy())
        ctx.save_for_backward(sdf, offsets)
        ctx.sharpness = sharpness
        ctx.mark_non_differentiable(crossing)
        return weights, crossing

    @staticmethod
    def backward(ctx, gradient, _):  # type: ignore[no-untyped-def]
        sdf, offsets = ctx.saved_tensors
        out = torch.empty_like(sdf)
        _sections_backward(sdf.detach().numpy(), ctx.sharpness, offsets.numpy(), gradient.contiguous().numpy(), out.numpy())
        return out, None, None


def hash_encode(positions: Tensor, table: Tensor, resolutions: Tensor, offsets: Tensor, active: int) -> Tensor:
    """See ``reference.hash_encode``; float32, F = 2, differentiable in ``table`` alone."""
    return _HashEncode.apply(positions.contiguous(), table, resolutions, offsets, active)


def march(
    origins: Tensor, directions: Tensor, near: Tensor, far: Tensor, jitter: Tensor, states: Tensor, step: float
) -> tuple[Tensor, Tensor, Tensor]:
    """See ``reference.march``; float32."""
    rays = origins.shape[0]
    arrays = [x.contiguous().numpy() for x in (origins, directions, near, far, jitter, states)]
    counts = np.empty(rays, np.int64)
    _march_count(*arrays, np.float32(step), counts)  # type: ignore[call-arg]
    offsets = np.zeros(rays + 1, np.int64)
    np.cumsum(counts, out=offsets[1:])
    t, ray = np.empty(offsets[-1], np.float32), np.empty(offsets[-1], np.int64)
    _march_fill(*arrays, np.float32(step), offsets, t, ray)  # type: ignore[call-arg]
    return torch.from_numpy(t), torch.from_numpy(ray), torch.from_numpy(offsets)


def section_weights(sdf: Tensor, sharpness: float, offsets: Tensor) -> tuple[Tensor, Tensor]:
    """See ``reference.section_weights``; float32 in and out, double inside."""
    return _SectionWeights.apply(sdf.contiguous(), float(sharpness), offsets)


def is_compiled() -> bool:
    """Whether every kernel has code for its usual types, in this process or in the cache on disk."""
    kernels = (_encode, _encode_backward, _march_count, _march_fill, _sections, _sections_backward)
    return all(k.signatures or _cached(k) for k in kernels)


def _cached(kernel) -> bool:  # type: ignore[no-untyped-def]
    # numba writes one index file per function and source version; it is missing exactly when the kernel was never compiled
    cache = kernel._cache._cache_file
    return bool(cache.load_index() if hasattr(cache, "load_index") else cache._load_index())


def compile_all() -> None:
    """Run every kernel once on a tiny input, so that compilation happens here and not within a timed loop."""
    table = torch.zeros(91, 2, requires_grad=True)
    hash_encode(torch.rand(4, 3), table, torch.tensor([2, 5]), torch.tensor([0, 27, 91]), 2).sum().backward()
    ray = torch.zeros(2, 3), torch.tensor([[0.0, 0.0, 1.0]] * 2), torch.zeros(2), torch.ones(2), torch.rand(2)
    _, _, offsets = march(*ray, torch.ones(4, 4, 4, dtype=torch.uint8), 0.1)
    sdf = torch.linspace(1, -1, int(offsets[-1]), requires_grad=True)
    section_weights(sdf, 10.0, offsets)[0].sum().backward()
