"""The small network that tells from features how surfaces mirror lamps, in Triton; gradients of weights are a row per program."""

from __future__ import annotations

import torch
from torch import Tensor

from mmsynth.field.kernels.cuda.shading import product, store_tile, tile
from mmsynth.field.kernels.cuda.shared import jit, tl, triton
from mmsynth.field.kernels.parameters import LightNetwork

ROWS = 64  # of a program: both of each of ``shading.RAYS`` rays


@jit
def _hidden(features, first, first_bias, row, live, FEATURES: tl.constexpr, WIDTH: tl.constexpr, UNITS: tl.constexpr, LAYER: tl.constexpr):  # type: ignore[no-untyped-def]
    """Features of rows, and the hidden layer."""
    f, u = tl.arange(0, WIDTH), tl.arange(0, LAYER)
    x = tl.load(features + row[:, None] * FEATURES + f[None, :], mask=live[:, None] & (f < FEATURES)[None, :], other=0.0)
    h = product(x, tl.trans(tile(first, u, f, FEATURES, UNITS, FEATURES))) + tl.load(first_bias + u, mask=u < UNITS, other=0.0)[None, :]
    return x, tl.where(h <= 0.0, 0.0, h)


@jit
def light_kernel(  # type: ignore[no-untyped-def]
    features, first, first_bias, second, second_bias, out, rows,
    FEATURES: tl.constexpr, WIDTH: tl.constexpr, UNITS: tl.constexpr, LAYER: tl.constexpr, OUTPUTS: tl.constexpr, HEADS: tl.constexpr,
    ROWS: tl.constexpr,
):  # fmt: skip
    row = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    u, o = tl.arange(0, LAYER), tl.arange(0, HEADS)
    _, h = _hidden(features, first, first_bias, row, row < rows, FEATURES, WIDTH, UNITS, LAYER)
    raw = product(h, tl.trans(tile(second, o, u, UNITS, OUTPUTS, UNITS))) + tl.load(second_bias + o, mask=o < OUTPUTS, other=0.0)[None, :]
    store_tile(out, row, o, OUTPUTS, raw, rows, OUTPUTS)


@jit
def light_backward_kernel(  # type: ignore[no-untyped-def]
    features, first, first_bias, second, gradient, g_features, partial, stride, rows,
    FEATURES: tl.constexpr, WIDTH: tl.constexpr, UNITS: tl.constexpr, LAYER: tl.constexpr, OUTPUTS: tl.constexpr, HEADS: tl.constexpr,
    ROWS: tl.constexpr,
):  # fmt: skip
    """g_features is added to."""
    program = tl.program_id(0)
    row = program * ROWS + tl.arange(0, ROWS)
    f, u, o = tl.arange(0, WIDTH), tl.arange(0, LAYER), tl.arange(0, HEADS)
    x, h = _hidden(features, first, first_bias, row, row < rows, FEATURES, WIDTH, UNITS, LAYER)
    g_raw = tile(gradient, row, o, OUTPUTS, rows, OUTPUTS)
    g = tl.where(h > 0.0, product(g_raw, tile(second, o, u, UNITS, OUTPUTS, UNITS)), 0.0)
    of_first = partial + program.to(tl.int64) * stride
    of_first_bias = of_first + UNITS * FEATURES
    of_second = of_first_bias + UNITS
    of_second_bias = of_second + OUTPUTS * UNITS
    store_tile(of_first, u, f, FEATURES, product(tl.trans(g), x), UNITS, FEATURES)
    tl.store(of_first_bias + u, tl.sum(g, 0), mask=u < UNITS)
    store_tile(of_second, o, u, UNITS, product(tl.trans(g_raw), h), OUTPUTS, UNITS)
    tl.store(of_second_bias + o, tl.sum(g_raw, 0), mask=o < OUTPUTS)
    before = tile(g_features, row, f, FEATURES, rows, FEATURES)
    store_tile(g_features, row, f, FEATURES, before + product(g, tile(first, u, f, FEATURES, UNITS, FEATURES)), rows, FEATURES)


def _sizes(light: LightNetwork) -> tuple[int, ...]:
    (units, features), outputs = light.first.shape, len(light.second)
    width = lambda n: max(16, triton.next_power_of_2(n))
    return features, width(features), units, width(units), outputs, width(outputs), ROWS


def material(light: LightNetwork, features: Tensor) -> Tensor:
    """(H, F) → (H, 5 + L), before the functions that make it a material; one launch."""
    out = features.new_empty(len(features), len(light.second))
    with torch.cuda.device_of(features):
        light_kernel[(triton.cdiv(len(features), ROWS),)](features, *light[:4], out, len(features), *_sizes(light))
    return out


def material_backward(light: LightNetwork, features: Tensor, gradient: Tensor, g_features: Tensor, partial: Tensor) -> None:
    """Gradients of ``material``, of features added to ``g_features``, of weights, in the order of ``LightNetwork``, as rows of ``partial``
    (``-(-H // ROWS)``, W or more); one launch."""
    with torch.cuda.device_of(features):
        light_backward_kernel[(triton.cdiv(len(features), ROWS),)](
            features, *light[:3], gradient, g_features, partial, partial.stride(0), len(features), *_sizes(light)
        )
