"""What a step on the device has around ``learn``, in Triton: its numbers, where its rays begin and what is known of them, where it asks for
∇sdf, and what is told of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from mmsynth.field.kernels.constants import BLACK
from mmsynth.field.kernels.cuda.drawing import random_bits, unit
from mmsynth.field.kernels.cuda.shared import jit, position, tl, triton
from mmsynth.field.kernels.parameters import Drawn, Opacities, Rays, View

BLOCK = 128
_TWO_PI = 2.0 * math.pi


class Numbers(NamedTuple):
    """What changes from step to step, on the device: sharpness, step (), float64, see ``Sampling``; factors of learning rates and β₂ of
    Adam, (3,) each: of all, of the surface's network, of its table; key (4,) int64 of random numbers, two words for each of two draws."""

    sharpness: Tensor
    step: Tensor
    factors: Tensor
    beta2: Tensor
    key: Tensor


@jit
def numbers_kernel(sharpness, step, factors, beta2, key, a, b, c, d, e, f, g, h, key_0, key_1, key_2, key_3):  # type: ignore[no-untyped-def]
    tl.store(sharpness, a)
    tl.store(step, b)
    tl.store(factors, c)
    tl.store(factors + 1, d)
    tl.store(factors + 2, e)
    tl.store(beta2, f)
    tl.store(beta2 + 1, g)
    tl.store(beta2 + 2, h)
    tl.store(key, key_0)
    tl.store(key + 1, key_1)
    tl.store(key + 2, key_2)
    tl.store(key + 3, key_3)


def new_numbers(device: torch.device) -> Numbers:
    of_sampling = torch.zeros(2, dtype=torch.float64, device=device)
    of_rates = torch.zeros(2, 3, device=device)
    return Numbers(of_sampling[0], of_sampling[1], of_rates[0], of_rates[1], torch.zeros(4, dtype=torch.int64, device=device))


def set_numbers(
    numbers: Numbers, sharpness: float, step: float, factor: float, of_surface: tuple[float, float], beta2: tuple[float, float, float],
    key: Sequence[int],
) -> None:  # fmt: skip
    """By arguments of a kernel, which are on their way when this returns: nothing waits, and nothing is overwritten too early."""
    with torch.cuda.device_of(numbers.key):
        signed = (word - (word >> 31 << 32) for word in key)  # the same bits, and one kernel for all of them
        numbers_kernel[(1,)](*numbers, sharpness, step, factor, *(factor * own for own in of_surface), *beta2, *signed)


@jit
def aim_kernel(  # type: ignore[no-untyped-def]
    origins, directions, alpha, ray_weight, target, level, begins, values_of, degrees_of, trains_of,
    near, far, degrees, trains, opacity_target, opacity_weight, opacity_linear,
    opacity_blocked, count, rays, modalities, alpha_weight, outside_weight, black_weight, blocked_weight, blocked_outside, closest, free,
    farthest, black,
    CONTRACTED: tl.constexpr, OPACITY: tl.constexpr, BLACK: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """count: rays; those from ``rays`` on were drawn where nothing is."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = i < count
    inside = i < rays
    n = i * 0
    for k in range(1, modalities):
        n += (i >= tl.load(begins + k).to(tl.int32)).to(tl.int32)
    ox, oy, oz = position(origins, i, live)
    dx, dy, dz = position(directions, i, live)
    if CONTRACTED:
        begin = tl.maximum(free * (tl.sqrt(ox * ox + oy * oy + oz * oz) - 1.0), closest)
        end = begin * 0.0 + farthest
    else:
        middle = -(ox * dx + oy * dy + oz * dz)
        px, py, pz = ox + middle * dx, oy + middle * dy, oz + middle * dz
        half = tl.sqrt(tl.maximum(1.0 - (px * px + py * py + pz * pz), 0.0))
        begin = tl.maximum(middle - half, 0.0)
        end = tl.maximum(middle + half, begin)
    tl.store(near + i, begin, mask=live)
    tl.store(far + i, end, mask=live)
    tl.store(degrees + i, tl.where(inside, tl.load(degrees_of + n, mask=live, other=0), 0), mask=live)
    tl.store(trains + i, tl.where(inside, tl.load(trains_of + n, mask=live, other=1), 1).to(tl.int1), mask=live)
    if OPACITY:
        w = tl.load(ray_weight + i, mask=live & inside, other=0.0)
        own = tl.load(alpha + i, mask=live & inside, other=0.0)
        known = own == own
        tl.store(opacity_target + i, tl.where(known, own, 0.0), mask=live)
        weight = tl.where(inside, tl.where(known, alpha_weight * w, 0.0), outside_weight)
        linear = 0.0 * w
        blocked = tl.where(inside, tl.where(own == 0.0, blocked_weight * w, 0.0), blocked_outside)
        if BLACK:
            blocked = tl.where(inside, 0.0, blocked_outside)
            weight = tl.where(inside, 0.0, outside_weight)
            values = tl.load(values_of + n, mask=live, other=0)
            first = tl.load(begins + modalities + 1 + n, mask=live, other=0) + (i - tl.load(begins + n, mask=live, other=0)) * values
            brightest = 0.0 * w - 1e30
            for j in range(0, tl.max(values, 0)):
                some = live & inside & (j < values)
                value = tl.load(target + first + j, mask=some, other=-1e30) / tl.load(level + first + j, mask=some, other=1.0)
                brightest = tl.maximum(brightest, value)
            linear = tl.where(inside & (tl.maximum(brightest, 0.0) < black), black_weight * w, 0.0)
        tl.store(opacity_weight + i, weight, mask=live)
        tl.store(opacity_linear + i, linear, mask=live)
        tl.store(opacity_blocked + i, blocked, mask=live)


class Tables(NamedTuple):
    """Of N modalities: values measured along a ray, degrees of direction that are seen, whether they train the geometry: (N,) int32;
    begins (3, N + 1) int64, see ``drawing.begins_of``."""

    values: Tensor
    degrees: Tensor
    trains: Tensor
    begins: Tensor


class Known(NamedTuple):
    """Weights of what is known of opacity, see ``Opacities``: of alpha, of rays where nothing is, of opacity on black pixels; of what
    blocks rays of alpha 0, and rays where nothing is. left: see there. any: whether anything is; black: whether it is black pixels."""

    alpha: float
    outside: float
    linear: float
    blocked: float
    blocked_outside: float
    left: float
    any: bool
    black: bool


def aim(
    drawn: Drawn, origins: Tensor, directions: Tensor, jitter: Tensor, tables: Tables, known: Known, bounds: tuple[float, float, float],
    contracted: bool,
) -> tuple[Rays, View, Opacities]:  # fmt: skip
    """What ``learn`` is told of rays; one launch.

    Args:
        origins, directions, jitter: of those drawn, and behind them of rays where nothing is. bounds: where rays begin and end in
            contracted space: at least this far from the camera, and at this share of the way to the region; the end.
    """
    count, rays = len(origins), len(drawn.alpha)
    new = lambda *shape, dtype=torch.float32: torch.empty(shape, dtype=dtype, device=origins.device)
    near, far, degrees, trains = new(count), new(count), new(count, dtype=torch.int64), new(count, dtype=torch.bool)
    some = count if known.any else 0
    opacities = Opacities(new(some), new(some), new(some), new(some), known.left)
    m = drawn.measured
    with torch.cuda.device_of(origins):
        aim_kernel[(triton.cdiv(count, BLOCK),)](
            origins, directions, drawn.alpha, drawn.ray_weight, m.target, m.level,
            tables.begins, tables.values, tables.degrees, tables.trains, near, far, degrees, trains, *opacities[:4],
            count, rays, len(tables.values), *known[:5], *bounds, BLACK, contracted, known.any, known.black, BLOCK,
        )  # fmt: skip
    return Rays(origins, directions, near, far, jitter), View(degrees, trains), opacities


@jit
def points_kernel(  # type: ignore[no-untyped-def]
    points, noise, aside, key, sharpness, count, asked, pairs, extent, soft, least, most, two_pi, BLOCK: tl.constexpr
):
    """Even in the grid; normal, as wide as the soft surface, by Box and Muller; even over directions and lengths."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    a, b = unit(random_bits(key, i, 3)), unit(random_bits(key, i, 4))
    c, d = unit(random_bits(key, i, 5)), unit(random_bits(key, i, 6))
    tl.store(points + 3 * i, (2.0 * a - 1.0) * extent, mask=i < count)
    tl.store(points + 3 * i + 1, (2.0 * b - 1.0) * extent, mask=i < count)
    tl.store(points + 3 * i + 2, (2.0 * c - 1.0) * extent, mask=i < count)
    width = soft / tl.load(sharpness).to(tl.float32)
    one, two = tl.sqrt(-2.0 * tl.log(1.0 - a)) * width, tl.sqrt(-2.0 * tl.log(1.0 - c)) * width
    tl.store(noise + 3 * i, one * tl.cos(two_pi * b), mask=i < asked)
    tl.store(noise + 3 * i + 1, one * tl.sin(two_pi * b), mask=i < asked)
    tl.store(noise + 3 * i + 2, two * tl.cos(two_pi * d), mask=i < asked)
    up = 2.0 * unit(random_bits(key, i, 7)) - 1.0  # even on the sphere: so is the height
    around = two_pi * unit(random_bits(key, i, 8))
    length = least + (most - least) * unit(random_bits(key, i, 9))
    across = length * tl.sqrt(tl.maximum(1.0 - up * up, 0.0))
    tl.store(aside + 3 * i, across * tl.cos(around), mask=i < pairs)
    tl.store(aside + 3 * i + 1, across * tl.sin(around), mask=i < pairs)
    tl.store(aside + 3 * i + 2, length * up, mask=i < pairs)


def random_points(
    numbers: Numbers, counts: tuple[int, int, int], extent: float, soft: float, beside: tuple[float, float]
) -> tuple[Tensor, Tensor, Tensor]:
    """So many ``Eikonal.points`` and ``noise`` of ``soft`` / sharpness, and ``Smooth.aside`` of lengths from ``beside``, (·, 3) each; one
    launch."""
    points, noise, aside = (torch.empty(n, 3, device=numbers.key.device) for n in counts)
    with torch.cuda.device_of(numbers.key):
        points_kernel[(triton.cdiv(max(*counts, 1), BLOCK),)](
            points, noise, aside, numbers.key, numbers.sharpness, *counts, extent, soft, *beside, _TWO_PI, BLOCK
        )
    return points, noise, aside


@jit
def tally_kernel(  # type: ignore[no-untyped-def]
    squared, level, ray_weight, tile, begins, values_of, steps, residual, errors, kept, BLOCK: tl.constexpr
):
    """A program per modality: the mean squared error of its rays is added to ``errors``; tiles take in their rays' residuals."""
    n, modalities = tl.program_id(0), tl.num_programs(0)
    if tl.load(steps) != 0:
        first, last = tl.load(begins + n).to(tl.int32), tl.load(begins + n + 1).to(tl.int32)
        number, values = tl.load(begins + modalities + 1 + n), tl.load(values_of + n)
        total = tl.zeros([BLOCK], tl.float64)
        for begin in range(first, last, BLOCK):
            i = begin + tl.arange(0, BLOCK)
            live = i < last
            m = number + (i - first).to(tl.int64) * values
            mean = tl.zeros([BLOCK], tl.float32)
            for j in range(0, values):
                mean += tl.load(squared + m + j, mask=live, other=0.0)
            mean /= values.to(tl.float32)
            total += (tl.load(ray_weight + i, mask=live, other=0.0) * mean).to(tl.float64)
            here = residual + tl.load(tile + i, mask=live, other=0)
            before = tl.load(here, mask=live, other=0.0)
            relative = tl.sqrt(mean) / tl.load(level + m, mask=live, other=1.0)
            tl.store(here, kept * before + (1.0 - kept) * relative, mask=live)
        rays = tl.maximum(last - first, 1).to(tl.float64)
        tl.store(errors + n, tl.load(errors + n) + tl.sum(total, 0) / rays)


def tally(drawn: Drawn, squared: Tensor, tables: Tables, steps: Tensor, residual: Tensor, errors: Tensor, kept: float) -> None:
    """What a good step (``optimiser.check``) tells: errors (N,) float64, to which mean squared errors are added; residual (T,) of the
    tiles, of several rays of one tile any counts. One launch."""
    with torch.cuda.device_of(squared):
        tally_kernel[(len(tables.values),)](
            squared, drawn.measured.level, drawn.ray_weight, drawn.tile, tables.begins, tables.values, steps, residual, errors, kept, 1024
        )
