"""Signed distances in Triton, with their gradients, of positions, of four taps around positions, and of samples along rays.

A block of positions goes through the grid and the hidden layer ``COLUMNS`` features at a time; nothing between is stored, and the backward
pass computes it again: rows of a table come from the cache, a stored layer from memory. Products run on the tensor cores in three parts of
10 bits, which is float32 but for its last bit or two: with one part the surface would move. Gradients of the weights are summed per
program and then over the programs, in order; those of the table are float32 atomics (see ``encoding``), added to ``table.grad`` in place.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from mmsynth.field.kernels.cuda.encoding import encode, scatter, slope, to_frame, unit_cube
from mmsynth.field.kernels.cuda.shared import (
    COLUMNS,
    FIRST_FEATURE_ROW,
    back_to_world,
    constant,
    contracted,
    jit,
    position,
    programs,
    tl,
    triton,
)
from mmsynth.field.kernels.learning import gradient_of
from mmsynth.field.kernels.parameters import GridTable, SurfaceNetwork

BLOCK = 64  # positions per program
# two threads for each position keep all in registers; loads that a loop fetched ahead would not
OPTIONS = {"num_warps": 4, "num_stages": 1}
POINTS, TAPS, RAYS = range(3)  # what a position of the backward kernel is
TAPS_MODE, RAYS_MODE = constant(TAPS), constant(RAYS)
_ROOT3 = constant(3**0.5)


@jit
def _augmented(x, y, z):  # type: ignore[no-untyped-def]
    """x, y, z, 1 as the first of ``COLUMNS`` columns, the rest zeros."""
    c = tl.arange(0, COLUMNS)[None, :]
    return tl.where(c == 0, x[:, None], tl.where(c == 1, y[:, None], tl.where(c == 2, z[:, None], tl.where(c == 3, 1.0, 0.0))))


@jit
def _weights(hidden, width, first, columns, UNITS: tl.constexpr, HIDDEN: tl.constexpr):  # type: ignore[no-untyped-def]
    """Weights of ``columns`` inputs from ``first`` on, (COLUMNS, HIDDEN); zeros beyond."""
    unit, c = tl.arange(0, HIDDEN), tl.arange(0, COLUMNS)
    return tl.load(hidden + unit[None, :] * width + (c + first)[:, None], mask=(unit < UNITS)[None, :] & (c < columns)[:, None], other=0.0)


@jit
def _sums(  # type: ignore[no-untyped-def]
    x, y, z, live, table, resolutions, offsets, active, scale, hidden, width,
    UNITS: tl.constexpr, HIDDEN: tl.constexpr, FEATURES: tl.constexpr,
):  # fmt: skip
    """The hidden layer before its activation, (BLOCK, HIDDEN)."""
    ux, uy, uz = unit_cube(x, y, z, scale)
    sums = tl.dot(_augmented(x, y, z), _weights(hidden, width, 0, FIRST_FEATURE_ROW, UNITS, HIDDEN), input_precision="tf32x3")
    for first in range(0, active, COLUMNS // FEATURES):
        e = encode(ux, uy, uz, live, table, resolutions, offsets, first, active, FEATURES)
        w = _weights(hidden, width, first * FEATURES + FIRST_FEATURE_ROW, (active - first) * FEATURES, UNITS, HIDDEN)
        sums = tl.dot(e, w, sums, input_precision="tf32x3")
    return sums


@jit
def distance(  # type: ignore[no-untyped-def]
    x, y, z, live, table, resolutions, offsets, active, scale, hidden, width, output, inner, outer,
    UNITS: tl.constexpr, HIDDEN: tl.constexpr, FEATURES: tl.constexpr,
):  # fmt: skip
    """Signed distance of positions in the frame of the grid, see ``reference.surface_value``."""
    sums = _sums(x, y, z, live, table, resolutions, offsets, active, scale, hidden, width, UNITS, HIDDEN, FEATURES)
    unit = tl.arange(0, HIDDEN)
    factor = tl.load(output + unit, mask=unit < UNITS, other=0.0)
    network = tl.sum(tl.where(sums < 0.0, 0.0, sums) * factor[None, :], 1) + tl.load(output + UNITS)  # not a maximum, which would hide NaN
    norm = tl.sqrt(x * x + y * y + z * z)
    return network + tl.minimum(norm - inner, outer - norm)


@jit
def _signs(i):  # type: ignore[no-untyped-def]
    """Corner of the tetrahedron of tap i modulo 4, see ``surface._TAPS``."""
    sy, sz = tl.where((i & 2) > 0, 1.0, -1.0), tl.where((i & 1) > 0, 1.0, -1.0)
    return sy * sz, sy, sz


@jit
def _tap(positions, epsilons, stride, i, count):  # type: ignore[no-untyped-def]
    """Tap i, four of a position: its place and signs, the factor of its value, and whether it is asked for: not where epsilon is 0."""
    live = i < count
    epsilon = tl.load(epsilons + (i // 4) * stride, mask=live, other=0.0)
    live = live & (epsilon != 0.0)
    x, y, z = position(positions, i // 4, live)
    sx, sy, sz = _signs(i)
    shift = epsilon / _ROOT3
    factor = tl.where(live, 0.25 / tl.where(live, epsilon, 1.0) * _ROOT3, 0.0)
    return x + sx * shift, y + sy * shift, z + sz * shift, sx, sy, sz, factor, live


@jit
def _of_four(x):  # type: ignore[no-untyped-def]
    """Sum over the taps of each position."""
    return tl.sum(tl.reshape(x, [x.shape[0] // 4, 4]), 1)


@jit
def surface_kernel(  # type: ignore[no-untyped-def]
    positions, scale, inner, outer, table, resolutions, offsets, hidden, output, out, count, width, active,
    UNITS: tl.constexpr, FEATURES: tl.constexpr, BLOCK: tl.constexpr, HIDDEN: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = i < count
    x, y, z = position(positions, i, live)
    f = distance(x, y, z, live, table, resolutions, offsets, active, scale, hidden, width, output, inner, outer, UNITS, HIDDEN, FEATURES)
    tl.store(out + i, f, mask=live)


@jit
def gradient_kernel(  # type: ignore[no-untyped-def]
    positions, epsilons, stride, scale, inner, outer, table, resolutions, offsets, hidden, output, out, count, width, active,
    UNITS: tl.constexpr, FEATURES: tl.constexpr, BLOCK: tl.constexpr, HIDDEN: tl.constexpr,
):  # fmt: skip
    """count: of taps, four of each position."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    x, y, z, sx, sy, sz, factor, live = _tap(positions, epsilons, stride, i, count)
    f = distance(x, y, z, live, table, resolutions, offsets, active, scale, hidden, width, output, inner, outer, UNITS, HIDDEN, FEATURES)
    f = tl.where(live, f * factor, 0.0)
    of = tl.program_id(0) * (BLOCK // 4) + tl.arange(0, BLOCK // 4)
    tl.store(out + 3 * of, _of_four(sx * f), mask=4 * of < count)
    tl.store(out + 3 * of + 1, _of_four(sy * f), mask=4 * of < count)
    tl.store(out + 3 * of + 2, _of_four(sz * f), mask=4 * of < count)


@jit
def surface_backward_kernel(  # type: ignore[no-untyped-def]
    positions, epsilons, stride, rays, times, origins, directions, gradient, total, positions_out, table_out, weights_out,
    scale, inner, outer, table, resolutions, offsets, hidden, output, count, width, active, size,
    MODE: tl.constexpr, CONTRACTED: tl.constexpr, UNITS: tl.constexpr, FEATURES: tl.constexpr, BLOCK: tl.constexpr, HIDDEN: tl.constexpr,
):  # fmt: skip
    """Gradients of distances: to the table, to the weights, a part per program, to positions where ``positions_out`` is.

    What a position is, ``MODE`` says: POINTS: of (N, 3); TAPS: four of each of (N / 4, 3), ``epsilons`` apart, gradient (N / 4, 3) of the
    differences; RAYS: sample of a ray of that number, at that distance, as many as ``total`` says. weights_out: (programs, size), zeros.
    """
    if MODE == RAYS_MODE:
        count = tl.load(total).to(tl.int32)
    unit = tl.arange(0, HIDDEN)
    factor = tl.load(output + unit, mask=unit < UNITS, other=0.0)
    part = weights_out + tl.program_id(0) * size
    to_first = tl.zeros([COLUMNS, HIDDEN], tl.float32)
    to_output = tl.zeros([HIDDEN], tl.float32)
    to_bias = 0.0
    for start in range(tl.program_id(0) * BLOCK, count, tl.num_programs(0) * BLOCK):
        i = start + tl.arange(0, BLOCK)
        live = i < count
        if MODE == TAPS_MODE:
            x, y, z, sx, sy, sz, share, live = _tap(positions, epsilons, stride, i, count)
            gx, gy, gz = position(gradient, i // 4, live)
            g = (sx * gx + sy * gy + sz * gz) * share
        elif MODE == RAYS_MODE:
            ray, t = tl.load(rays + i, mask=live, other=0), tl.load(times + i, mask=live, other=0.0)
            ox, oy, oz = position(origins, ray, live)
            dx, dy, dz = position(directions, ray, live)
            px, py, pz = ox + dx * t, oy + dy * t, oz + dz * t
            x, y, z, _ = contracted(px, py, pz, CONTRACTED)
            g = tl.load(gradient + i, mask=live, other=0.0)
        else:
            x, y, z = position(positions, i, live)
            g = tl.load(gradient + i, mask=live, other=0.0)
        sums = _sums(x, y, z, live, table, resolutions, offsets, active, scale, hidden, width, UNITS, HIDDEN, FEATURES)
        to_output += tl.sum(tl.where(sums < 0.0, 0.0, sums) * g[:, None], 0)
        to_bias += tl.sum(g, 0)
        of_sums = tl.where(sums > 0.0, g[:, None] * factor[None, :], 0.0)
        to_first += tl.dot(tl.trans(_augmented(x, y, z)), of_sums, input_precision="tf32x3")
        ux, uy, uz = unit_cube(x, y, z, scale)
        gx = tl.zeros([BLOCK], tl.float32)
        gy = tl.zeros([BLOCK], tl.float32)
        gz = tl.zeros([BLOCK], tl.float32)
        for first in range(0, active, COLUMNS // FEATURES):
            columns = (active - first) * FEATURES
            begin = first * FEATURES + FIRST_FEATURE_ROW
            e = encode(ux, uy, uz, live, table, resolutions, offsets, first, active, FEATURES)
            c = tl.arange(0, COLUMNS)
            at = part + unit[None, :] * width + (c + begin)[:, None]
            here = (unit < UNITS)[None, :] & (c < columns)[:, None]
            sofar = tl.load(at, mask=here, other=0.0)
            tl.store(at, sofar + tl.dot(tl.trans(e), of_sums, input_precision="tf32x3"), mask=here)
            w = _weights(hidden, width, begin, columns, UNITS, HIDDEN)
            of_features = tl.dot(of_sums, tl.trans(w), input_precision="tf32x3")
            if table_out is not None:
                scatter(ux, uy, uz, of_features, live, table_out, resolutions, offsets, first, active, FEATURES)
            if positions_out is not None:
                ax, ay, az = slope(ux, uy, uz, of_features, live, table, resolutions, offsets, first, active, FEATURES)
                gx, gy, gz = gx + ax, gy + ay, gz + az
        if positions_out is not None:
            gx, gy, gz = to_frame(x, y, z, gx, gy, gz, scale)
            wx = tl.load(hidden + unit * width, mask=unit < UNITS, other=0.0)
            wy = tl.load(hidden + unit * width + 1, mask=unit < UNITS, other=0.0)
            wz = tl.load(hidden + unit * width + 2, mask=unit < UNITS, other=0.0)
            norm = tl.sqrt(x * x + y * y + z * z)
            away = tl.where(outer - norm < norm - inner, -g, g) / tl.maximum(norm, 1e-12)
            gx += tl.sum(of_sums * wx[None, :], 1) + away * x
            gy += tl.sum(of_sums * wy[None, :], 1) + away * y
            gz += tl.sum(of_sums * wz[None, :], 1) + away * z
            if MODE == TAPS_MODE:
                of = start // 4 + tl.arange(0, BLOCK // 4)
                met = 4 * of < count
                gx, gy, gz = _of_four(tl.where(live, gx, 0.0)), _of_four(tl.where(live, gy, 0.0)), _of_four(tl.where(live, gz, 0.0))
            else:
                of, met = i, live
                if MODE == RAYS_MODE:
                    gx, gy, gz = back_to_world(px, py, pz, gx, gy, gz, CONTRACTED)
            tl.store(positions_out + 3 * of, gx, mask=met)
            tl.store(positions_out + 3 * of + 1, gy, mask=met)
            tl.store(positions_out + 3 * of + 2, gz, mask=met)
        tl.debug_barrier()  # the next block reads the part that this one wrote
    c = tl.arange(0, COLUMNS)
    here = (unit < UNITS)[None, :] & (c < FIRST_FEATURE_ROW)[:, None]
    tl.store(part + unit[None, :] * width + c[:, None], to_first, mask=here)
    tl.store(part + UNITS * width + unit, to_output, mask=unit < UNITS)
    tl.store(part + UNITS * width + UNITS, to_bias)


class Launch(NamedTuple):
    """What all kernels of the surface are told of a grid and a network: see their parameters of the same names."""

    scale: float
    inner: float
    outer: float
    table: Tensor
    resolutions: Tensor
    offsets: Tensor
    hidden: Tensor
    output: Tensor


def launch(grid: GridTable, network: SurfaceNetwork) -> Launch:
    return Launch(
        0.5 / grid.extent, network.inner_radius, network.outer_radius, grid.table.detach(), grid.resolutions, grid.offsets,
        network.hidden.detach(), network.output.detach(),
    )  # fmt: skip


def padded_units(units: int) -> int:
    """Hidden units that a program computes: a power of two, and no less than a product on tensor cores has columns."""
    return max(triton.next_power_of_2(units), 16)


def table_gradient(table: Tensor) -> Tensor | None:
    """Where a table's gradient is added to; None: it has none."""
    return gradient_of(table) if table.requires_grad else None


def surface_backward(
    mode: int, grid: GridTable, network: SurfaceNetwork, gradient: Tensor, count: int, blocks: int, *,
    positions: Tensor | None = None, epsilons: Tensor | None = None, samples: tuple[Tensor, ...] | None = None,
    positions_out: Tensor | None = None,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Gradients of the network's weights, and in place those of the table; see ``surface_backward_kernel``.

    Args:
        count: of positions; any number where the device knows it. blocks: of positions at the most.
        samples: rays, times, origins, directions, total.
    """
    units, width = network.hidden.shape
    size = units * width + units + 1
    parts = torch.zeros(min(programs(gradient.device), max(blocks, 1)), size, device=gradient.device)
    hidden = padded_units(units)
    rays, times, origins, directions, total = samples or (None,) * 5
    of = launch(grid, network)
    with torch.cuda.device_of(parts):
        surface_backward_kernel[(len(parts),)](
            positions, epsilons, 0 if epsilons is None or epsilons.dim() == 0 else 1, rays, times, origins, directions, gradient, total,
            positions_out, table_gradient(grid.table), parts, *of, count, width, grid.active, size,
            mode, grid.extent > 1.0, units, grid.table.shape[1], BLOCK, hidden, **OPTIONS,
        )  # fmt: skip
    whole = parts.sum(0)
    return whole[: units * width].view(units, width), whole[units * width :]


def surface_value(positions: Tensor, grid: GridTable, network: SurfaceNetwork) -> Tensor:
    """See ``reference.surface_value``; float32. Differentiable in positions, weights, and, in place, the table."""
    return _Value.apply(positions.contiguous(), None, grid, network, network.hidden, network.output)


def surface_gradient(positions: Tensor, epsilon: float | Tensor, grid: GridTable, network: SurfaceNetwork) -> Tensor:
    """See ``reference.surface_gradient``; float32. Differentiable as ``surface_value``; 0 and free where epsilon (N,) is 0."""
    epsilons = epsilon if isinstance(epsilon, Tensor) else torch.full((), epsilon, device=positions.device)
    return _Value.apply(positions.contiguous(), epsilons, grid, network, network.hidden, network.output)


class _Value(torch.autograd.Function):
    """The distance of positions, or with ``epsilons`` its differences."""

    @staticmethod
    def forward(
        ctx: Any, positions: Tensor, epsilons: Tensor | None, grid: GridTable, network: SurfaceNetwork, hidden: Tensor, output: Tensor
    ) -> Tensor:
        count, (units, width) = len(positions), hidden.shape
        out = torch.empty(count if epsilons is None else (count, 3), device=positions.device)
        if count:
            of = launch(grid, network)
            sizes = units, grid.table.shape[1], BLOCK, padded_units(units)
            with torch.cuda.device_of(out):
                if epsilons is None:
                    blocks = triton.cdiv(count, BLOCK)
                    surface_kernel[(blocks,)](positions, *of, out, count, width, grid.active, *sizes, **OPTIONS)
                else:
                    blocks = triton.cdiv(4 * count, BLOCK)
                    gradient_kernel[(blocks,)](
                        positions, epsilons, min(epsilons.dim(), 1), *of, out, 4 * count, width, grid.active, *sizes, **OPTIONS
                    )
        ctx.grid, ctx.network = grid, network
        ctx.save_for_backward(positions, epsilons, hidden, output)
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        positions, epsilons, hidden, output = ctx.saved_tensors
        network = ctx.network._replace(hidden=hidden, output=output)
        taps = 1 if epsilons is None else 4
        to_positions = torch.empty_like(positions) if ctx.needs_input_grad[0] else None
        weights = surface_backward(
            POINTS if epsilons is None else TAPS, ctx.grid, network, gradient.contiguous(), taps * len(positions),
            triton.cdiv(taps * len(positions), BLOCK), positions=positions, epsilons=epsilons, positions_out=to_positions,
        )  # fmt: skip
        return to_positions, None, None, None, *weights
