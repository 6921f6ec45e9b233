"""Signed distances in Triton."""

from __future__ import annotations

import torch
from torch import Tensor

from mmsynth.field.kernels import reference
from mmsynth.field.kernels.cuda.encoding import BLOCK, hash_encode, interpolate
from mmsynth.field.kernels.cuda.shared import FIRST_FEATURE_ROW, jit, position, tl, triton
from mmsynth.field.kernels.parameters import GridTable, SurfaceNetwork


@jit
def surface_kernel(  # type: ignore[no-untyped-def]
    positions, scale, inner, outer, table, resolutions, offsets, weight, last, out, count, active,
    UNITS: tl.constexpr, FEATURES: tl.constexpr, BLOCK: tl.constexpr, HIDDEN: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = i < count
    x, y, z = position(positions, i, live)
    ux = tl.minimum(tl.maximum(x * scale + 0.5, 0.0), 1.0)
    uy = tl.minimum(tl.maximum(y * scale + 0.5, 0.0), 1.0)
    uz = tl.minimum(tl.maximum(z * scale + 0.5, 0.0), 1.0)
    unit = tl.arange(0, HIDDEN)
    exists = unit < UNITS
    inputs = weight + unit  # (inputs, units), transposed: the weights of one input are a few vector loads
    feature = tl.arange(0, FEATURES)[None, :]
    # the hidden layer grows level by level: the encoding is never stored. In float32, not on the tensor cores, whose
    # 10 bits would move the surface
    sums = tl.load(inputs + 3 * UNITS, mask=exists, other=0.0)[None, :] + tl.zeros([BLOCK, HIDDEN], tl.float32)
    sums += x[:, None] * tl.load(inputs, mask=exists, other=0.0)[None, :]
    sums += y[:, None] * tl.load(inputs + UNITS, mask=exists, other=0.0)[None, :]
    sums += z[:, None] * tl.load(inputs + 2 * UNITS, mask=exists, other=0.0)[None, :]
    for level in range(0, active):
        value = interpolate(ux, uy, uz, table, resolutions, offsets, level, level < active, live, FEATURES)
        for f in tl.static_range(FEATURES):
            one = tl.sum(tl.where(feature == f, value, 0.0), 1)
            sums += one[:, None] * tl.load(inputs + (FIRST_FEATURE_ROW + level * FEATURES + f) * UNITS, mask=exists, other=0.0)[None, :]
    factor = tl.load(last + unit, mask=exists, other=0.0)
    network = tl.sum(tl.where(sums < 0.0, 0.0, sums) * factor[None, :], 1) + tl.load(last + UNITS)
    norm = tl.sqrt(x * x + y * y + z * z)
    tl.store(out + i, network + tl.minimum(norm - inner, outer - norm), mask=live)


def surface_value(positions: Tensor, grid: GridTable, network: SurfaceNetwork) -> Tensor:
    """See ``reference.surface_value``; float32. One kernel where no gradient can be asked for, as in sampling and rendering; else single
    operations."""
    if torch.is_grad_enabled():
        return reference.surface_value(positions, grid, network, hash_encode)
    count, units = positions.shape[0], network.hidden.shape[0]
    out = torch.empty(count, device=positions.device)
    if count:
        width = triton.next_power_of_2(units)
        warps = min(max(width // 8, 4), 16)  # 32 units a thread: they stay in registers
        with torch.cuda.device_of(out):
            surface_kernel[(triton.cdiv(count, BLOCK),)](
                positions.contiguous(), 0.5 / grid.extent, network.inner_radius, network.outer_radius, grid.table.contiguous(),
                grid.resolutions, grid.offsets, network.hidden.T.contiguous(), network.output, out, count, grid.active,
                units, grid.table.shape[1], BLOCK, width, num_warps=warps,
            )  # fmt: skip
    return out
