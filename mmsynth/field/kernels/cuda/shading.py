"""Shading in Triton, fused: from the features of rays to the loss of what was measured along them, and all its gradients, in one pass.

A program takes ``RAYS`` rays, both surfaces of each in neighbouring rows of its matrices. All outputs of the shader are one tile of the
tensor cores; a number takes its own out of it. Gradients of weights are sums over the rays of a program, a row per program, and the rows
are summed in order: no atomics. Of a step, light from beyond everything and what is known of opacity are
terms of the same pass (see ``learning``).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from mmsynth.field.kernels.constants import HARMONICS
from mmsynth.field.kernels.cuda.shared import HUBER, LEAST_WEIGHT, MOSTLY_BLOCKED, first_number, jit, softplus, sum_of_pair, tl, triton
from mmsynth.field.kernels.parameters import Measured, Opacities, ShadedRays, ShaderWeights

RAYS = 32  # of a program: with more, or with its weights' gradients kept in registers over several times as many, registers spill
_WARPS = 4  # a warp has 16 rows of a product: with 8, those of 64 rows end in shared memory that is not theirs (triton 3.6 on sm_90)


@jit
def harmonics(x, y, z, degree):  # type: ignore[no-untyped-def]
    """Real spherical harmonics (see ``shading.spherical_harmonics``) up to the degree of each ray, the others zero: (N, 16)."""
    k = tl.arange(0, 16)[None, :]
    x, y, z, degree = x[:, None], y[:, None], z[:, None], degree[:, None]
    xx, yy, zz = x * x, y * y, z * z
    out = tl.where(k == 0, 0.28209479177387814, 0.0)
    out = tl.where(k == 1, 0.4886025119029199 * y, out)
    out = tl.where(k == 2, 0.4886025119029199 * z, out)
    out = tl.where(k == 3, 0.4886025119029199 * x, out)
    out = tl.where(k == 4, 1.0925484305920792 * x * y, out)
    out = tl.where(k == 5, 1.0925484305920792 * y * z, out)
    out = tl.where(k == 6, 0.31539156525252005 * (3.0 * zz - 1.0), out)
    out = tl.where(k == 7, 1.0925484305920792 * x * z, out)
    out = tl.where(k == 8, 0.5462742152960396 * (xx - yy), out)
    out = tl.where(k == 9, 0.5900435899266435 * y * (3.0 * xx - yy), out)
    out = tl.where(k == 10, 2.890611442640554 * x * y * z, out)
    out = tl.where(k == 11, 0.4570457994644658 * y * (5.0 * zz - 1.0), out)
    out = tl.where(k == 12, 0.3731763325901154 * z * (5.0 * zz - 3.0), out)
    out = tl.where(k == 13, 0.4570457994644658 * x * (5.0 * zz - 1.0), out)
    out = tl.where(k == 14, 1.445305721320277 * z * (xx - yy), out)
    out = tl.where(k == 15, 0.5900435899266435 * x * (xx - 3.0 * yy), out)
    # degree l has the terms from l² on
    return tl.where(k < (degree + 1) * (degree + 1), out, 0.0)


@jit
def product(a, b):  # type: ignore[no-untyped-def]
    """a @ b on the tensor cores, to float32: three products of 10 bits."""
    return tl.dot(a, b, input_precision="tf32x3")


@jit
def tile(matrix, rows, columns, stride, height, width):  # type: ignore[no-untyped-def]
    """``matrix`` at rows × columns; zero from ``height`` and ``width`` on."""
    return tl.load(
        matrix + rows[:, None] * stride + columns[None, :], mask=(rows < height)[:, None] & (columns < width)[None, :], other=0.0
    )


@jit
def store_tile(matrix, rows, columns, stride, values, height, width):  # type: ignore[no-untyped-def]
    """``values`` at rows × columns of ``matrix``, up to ``height`` and ``width``."""
    there = (rows < height)[:, None] & (columns < width)[None, :]
    tl.store(matrix + rows[:, None] * stride + columns[None, :], values, mask=there)


@jit
def _take(raw, column):  # type: ignore[no-untyped-def]
    """Of each row its own column."""
    return tl.sum(tl.where(tl.arange(0, raw.shape[1])[None, :] == column[:, None], raw, 0.0), 1)


@jit
def compare_kernel(  # type: ignore[no-untyped-def]
    features, share, behind, directions, degrees, trains,
    target, ray, output, axes, level, saturation, weight, gain, mirrored,
    first, first_bias, second, second_bias, heads, heads_bias, far, opacity_target, opacity_weight, opacity_linear,
    opacity_blocked, opacity_left, loss, squared, g_features, g_share, g_gain, g_mirrored, partial, stride,
    rays, rows, count, bright, bisections,
    FEATURES: tl.constexpr, WIDTH: tl.constexpr, UNITS: tl.constexpr, LAYER: tl.constexpr, OUTPUTS: tl.constexpr, HEADS: tl.constexpr,
    FAR: tl.constexpr, OPACITY: tl.constexpr, POLARIZED: tl.constexpr, GAIN: tl.constexpr, MIRRORED: tl.constexpr, LEARN: tl.constexpr,
    RAYS: tl.constexpr,
):  # fmt: skip
    """FEATURES, UNITS, OUTPUTS: sizes; WIDTH, LAYER, HEADS: those of the tiles that they are filled up to. stride: of ``partial``."""
    HARMONICS: tl.constexpr = 16
    INPUTS: tl.constexpr = FEATURES + HARMONICS
    program = tl.program_id(0)
    f, d, u, o = tl.arange(0, WIDTH), tl.arange(0, HARMONICS), tl.arange(0, LAYER), tl.arange(0, HEADS)
    # gradients of weights: this program's row of partial sums
    of_first = partial + program.to(tl.int64) * stride
    of_first_bias = of_first + UNITS * INPUTS
    of_second = of_first_bias + UNITS
    of_second_bias = of_second + UNITS * UNITS
    of_heads = of_second_bias + UNITS
    of_heads_bias = of_heads + OUTPUTS * UNITS
    of_far = of_heads_bias + OUTPUTS
    total = tl.zeros([2 * RAYS], tl.float64)
    lane = tl.arange(0, 2 * RAYS)
    nearest = lane % 2 == 0
    r = program * RAYS + lane // 2
    live = r < rays
    second_row = tl.load(behind + r, mask=live, other=-1).to(tl.int32)
    met = live & (nearest | (second_row >= 0))
    row = tl.where(nearest, r, tl.where(met, second_row, rays + r))
    trained = tl.load(trains + r, mask=live, other=0) != 0
    degree = tl.load(degrees + r, mask=live, other=0).to(tl.int32)
    dx = tl.load(directions + 3 * r, mask=live, other=0.0)
    dy = tl.load(directions + 3 * r + 1, mask=live, other=0.0)
    dz = tl.load(directions + 3 * r + 2, mask=live, other=0.0)
    shares = tl.load(share + row, mask=met, other=0.0)
    x = tl.load(features + row[:, None] * FEATURES + f[None, :], mask=met[:, None] & (f < FEATURES)[None, :], other=0.0)
    opacity = sum_of_pair(shares, RAYS)
    if FAR:  # see ``learning.with_far_light``
        last = tl.where(nearest, second_row < 0, met)
        passed = tl.where(last, 1.0 - opacity, 0.0)
        shares += passed
        divisor = tl.maximum(shares, LEAST_WEIGHT)
        mixed = passed / divisor
        beyond = tl.load(far + f, mask=f < FEATURES, other=0.0)[None, :] - x
        x += beyond * mixed[:, None]
    seen_from = harmonics(dx, dy, dz, degree)
    h1 = product(x, tl.trans(tile(first, u, f, INPUTS, UNITS, FEATURES)))
    h1 += product(seen_from, tl.trans(tile(first + FEATURES, u, d, INPUTS, UNITS, HARMONICS)))
    h1 += tl.load(first_bias + u, mask=u < UNITS, other=0.0)[None, :]
    h1 = tl.where(h1 <= 0.0, 0.0, h1)  # not a maximum, which would hide NaN
    h2 = product(h1, tl.trans(tile(second, u, u, UNITS, UNITS, UNITS))) + tl.load(second_bias + u, mask=u < UNITS, other=0.0)[None, :]
    h2 = tl.where(h2 <= 0.0, 0.0, h2)
    raw = product(h2, tl.trans(tile(heads, o, u, UNITS, OUTPUTS, UNITS))) + tl.load(heads_bias + o, mask=o < OUTPUTS, other=0.0)[None, :]
    begin = first_number(ray, r, count, bisections)
    numbers = tl.where(live, first_number(ray, r + 1, count, bisections) - begin, 0)
    g_raw = tl.zeros([2 * RAYS, HEADS], tl.float32)
    of_share = tl.zeros([2 * RAYS], tl.float32)
    for j in range(0, tl.max(numbers, 0)):
        m, some = begin + j, j < numbers
        column = tl.load(output + m, mask=some, other=0).to(tl.int32)
        v0 = _take(raw, column)
        light, slope0 = softplus(v0)
        if POLARIZED:
            tensor = some & (m >= bright)
            e0 = tl.load(axes + 3 * (m - bright), mask=tensor, other=0.0)
            e1 = tl.load(axes + 3 * (m - bright) + 1, mask=tensor, other=0.0)
            e2 = tl.load(axes + 3 * (m - bright) + 2, mask=tensor, other=0.0)
            b, slope_b = softplus(_take(raw, column + 1))
            c, slope_c = softplus(_take(raw, column + 2))
            along0 = light * e0 + _take(raw, column + 3) * e1 + _take(raw, column + 4) * e2
            along1 = b * e1 + _take(raw, column + 5) * e2
            along2 = c * e2
            slope0 = tl.where(tensor, 2.0 * along0 * e0 * slope0, slope0)
            light = tl.where(tensor, along0 * along0 + along1 * along1 + along2 * along2, light)
        seen = sum_of_pair(tl.where(met, light * shares, 0.0), RAYS)
        if MIRRORED:
            seen += tl.load(mirrored + m, mask=some, other=0.0)
        own = tl.load(level + m, mask=some, other=1.0)
        brightness = own
        if GAIN:
            brightness = own * tl.load(gain + m, mask=some, other=0.0)
        wanted = tl.load(target + m, mask=some, other=0.0)
        difference = seen * brightness - wanted
        # a clipped pixel only says "at least"
        clipped = (wanted >= tl.load(saturation + m, mask=some, other=1.0)) & (difference > 0.0)
        difference = tl.where(clipped, 0.0, difference)
        relative = difference / own
        size = tl.abs(relative)
        huber = tl.where(size < HUBER, 0.5 * size * size, HUBER * (size - 0.5 * HUBER))
        w = tl.load(weight + m, mask=some, other=0.0)
        mine = some & nearest
        total += tl.where(mine, w * huber, 0.0).to(tl.float64)
        tl.store(squared + m, difference * difference, mask=mine)
        if LEARN:
            pull = tl.where(some, w / own * tl.minimum(tl.maximum(relative, -HUBER), HUBER), 0.0)
            if GAIN:
                tl.store(g_gain + m, pull * seen * own, mask=mine)
            if MIRRORED:
                tl.store(g_mirrored + m, pull * brightness, mask=mine)
            of_share += tl.where(met & trained, pull * light * brightness, 0.0)
            p = pull * brightness * shares
            g_raw += tl.where(o[None, :] == column[:, None], (p * slope0)[:, None], 0.0)
            if POLARIZED:
                p = tl.where(tensor, 2.0 * p, 0.0)
                g_raw += tl.where(o[None, :] == column[:, None] + 1, (p * along1 * e1 * slope_b)[:, None], 0.0)
                g_raw += tl.where(o[None, :] == column[:, None] + 2, (p * along2 * e2 * slope_c)[:, None], 0.0)
                g_raw += tl.where(o[None, :] == column[:, None] + 3, (p * along0 * e1)[:, None], 0.0)
                g_raw += tl.where(o[None, :] == column[:, None] + 4, (p * along0 * e2)[:, None], 0.0)
                g_raw += tl.where(o[None, :] == column[:, None] + 5, (p * along1 * e2)[:, None], 0.0)
    if OPACITY:
        off = opacity - tl.load(opacity_target + r, mask=live, other=0.0)
        known = tl.load(opacity_weight + r, mask=live, other=0.0)
        linear = tl.load(opacity_linear + r, mask=live, other=0.0)
        solid = live & (opacity > MOSTLY_BLOCKED)
        blocked = tl.load(opacity_blocked + r, mask=solid, other=0.0)
        passed_by = tl.where(solid, 1.0 - opacity + opacity_left, 1.0)
        of_opacity = known * off * off + linear * opacity - blocked * tl.log(passed_by)
        total += tl.where(live & nearest, of_opacity, 0.0).to(tl.float64)
    if LEARN:
        tl.store(of_heads_bias + o, tl.sum(g_raw, 0), mask=o < OUTPUTS)
        store_tile(of_heads, o, u, UNITS, product(tl.trans(g_raw), h2), OUTPUTS, UNITS)
        g2 = product(g_raw, tile(heads, o, u, UNITS, OUTPUTS, UNITS))
        g2 = tl.where((h2 > 0.0) & trained[:, None], g2, 0.0)
        tl.store(of_second_bias + u, tl.sum(g2, 0), mask=u < UNITS)
        store_tile(of_second, u, u, UNITS, product(tl.trans(g2), h1), UNITS, UNITS)
        g1 = product(g2, tile(second, u, u, UNITS, UNITS, UNITS))
        g1 = tl.where(h1 > 0.0, g1, 0.0)
        tl.store(of_first_bias + u, tl.sum(g1, 0), mask=u < UNITS)
        store_tile(of_first, u, f, INPUTS, product(tl.trans(g1), x), UNITS, FEATURES)
        store_tile(of_first + FEATURES, u, d, INPUTS, product(tl.trans(g1), seen_from), UNITS, HARMONICS)
        gx = product(g1, tile(first, u, f, INPUTS, UNITS, FEATURES))
        if FAR:
            tl.store(of_far + f, tl.sum(gx * mixed[:, None], 0), mask=f < FEATURES)
            of_mixed = tl.sum(gx * beyond, 1) / divisor
            gx *= 1.0 - mixed[:, None]
            of_passed = tl.where(last, of_share + of_mixed, 0.0)
            of_share -= tl.where(shares > LEAST_WEIGHT, of_mixed * mixed, 0.0)
            of_share = tl.where(met, of_share - sum_of_pair(of_passed, RAYS), 0.0)
        if OPACITY:
            of_share += tl.where(met, 2.0 * known * off + linear + blocked / passed_by, 0.0)
        written = met | (live & (rows == 2 * rays))  # zeros, too, for what is not met but has a row of its own
        tl.store(g_features + row[:, None] * FEATURES + f[None, :], gx, mask=written[:, None] & (f < FEATURES)[None, :])
        tl.store(g_share + row, of_share, mask=written)
    tl.store(loss + program, tl.sum(total, 0))


class Compared(NamedTuple):
    """What ``compare_all`` finds: loss (programs,) float64, to be summed; squared (M,); gradients of the loss; those of weights (programs,
    W), one after the other as in ``ShaderWeights``, the far light's behind them, to be summed."""

    loss: Tensor
    squared: Tensor
    features: Tensor
    share: Tensor
    gain: Tensor
    mirrored: Tensor
    weights: Tensor


def programs_of(rays: int) -> int:
    """How many programs share the rays: rows of partial sums."""
    return -(-rays // RAYS)


def compare_all(
    weights: ShaderWeights,
    rays: ShadedRays,
    measured: Measured,
    gain: Tensor | None = None,
    mirrored: Tensor | None = None,
    learn: bool = True,
    far_light: Tensor | None = None,
    opacities: Opacities | None = None,
    partial: Tensor | None = None,
    loss: Tensor | None = None,
) -> Compared:
    """See ``reference.compare``; ``measured.ray`` never decreases. One launch.

    Args:
        far_light: (F,), see ``learning.with_far_light``, empty or None: none. opacities: a term of the loss, empty or None: none.
        partial: where sums of the weights' gradients go, (``programs_of`` rays, W or more); loss: of the loss, (``programs_of`` rays,)
            float64; None: anew.
    """
    device, count, none = rays.features.device, len(rays.behind), rays.share
    far_light = none[:0] if far_light is None else far_light
    opacities = Opacities(none[:0], none[:0], none[:0], none[:0], 0.0) if opacities is None else opacities
    programs, sizes = programs_of(count), [w.numel() for w in (*weights, far_light)]
    units, inputs = weights.first.shape
    outputs, features = len(weights.heads), inputs - HARMONICS
    new = lambda *shape: torch.empty(shape, device=device)
    if partial is None:
        partial = new(programs if learn else 0, sum(sizes))
    numbers = len(measured.target)
    out = Compared(
        torch.empty(programs, dtype=torch.float64, device=device) if loss is None else loss,
        new(numbers),
        new(*rays.features.shape) if learn else none,
        new(*rays.share.shape) if learn else none,
        new(numbers) if learn and gain is not None else none,
        new(numbers) if learn and mirrored is not None else none,
        partial,
    )
    width = lambda n: max(16, triton.next_power_of_2(n))
    if not programs:
        return out
    with torch.cuda.device_of(out.squared):
        compare_kernel[(programs,)](
            rays.features.contiguous(), rays.share.contiguous(), rays.behind, rays.directions.contiguous(), rays.degrees,
            rays.trains_geometry, measured.target, measured.ray, measured.output, measured.axes, measured.level, measured.saturation,
            measured.weight, none if gain is None else gain.contiguous(), none if mirrored is None else mirrored.contiguous(),
            *(w.contiguous() for w in weights), far_light, *opacities,
            out.loss, out.squared, out.features, out.share, out.gain, out.mirrored, partial, partial.stride(0),
            count, len(rays.share), numbers, numbers - len(measured.axes), numbers.bit_length(),
            features, width(features), units, width(units), outputs, width(outputs),
            len(far_light) > 0, len(opacities.target) > 0, len(measured.axes) > 0, gain is not None, mirrored is not None, learn,
            RAYS, num_warps=_WARPS,
        )  # fmt: skip
    return out


def compare(
    weights: ShaderWeights, rays: ShadedRays, measured: Measured, gain: Tensor | None = None, mirrored: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """See ``reference.compare``; float32, ``measured.ray`` never decreasing. Differentiable in features, shares, gain, mirrored light and
    weights of the shader."""
    none = rays.features.new_empty(0)
    given = rays.features, rays.share, none if gain is None else gain, none if mirrored is None else mirrored, *weights
    learn = torch.is_grad_enabled() and any(x.requires_grad for x in given)
    return _Compare.apply(learn, rays, measured, gain is not None, mirrored is not None, *given)


class _Compare(torch.autograd.Function):
    """The gradients of a measurement are known when it is: the forward pass takes them all, the backward pass only scales them."""

    @staticmethod
    def forward(
        ctx: Any, learn: bool, rays: ShadedRays, measured: Measured, has_gain: bool, has_light: bool, *given: Tensor
    ) -> tuple[Tensor, Tensor]:
        features, share, gain, mirrored, *weights = given
        found = compare_all(
            ShaderWeights(*weights), rays._replace(features=features, share=share), measured, gain if has_gain else None,
            mirrored if has_light else None, learn,
        )  # fmt: skip
        if learn:
            whole = found.weights.sum(0).split([w.numel() for w in weights])
            ctx.gradients = [found.features, found.share, found.gain if has_gain else None, found.mirrored if has_light else None]
            ctx.gradients += [part.view(w.shape) for part, w in zip(whole, weights, strict=True)]
        ctx.mark_non_differentiable(found.squared)
        return found.loss.sum().float(), found.squared

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        return None, None, None, None, None, *(None if g is None else gradient * g for g in ctx.gradients)
