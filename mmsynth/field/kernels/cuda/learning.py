"""A step of a fit in Triton: see ``learning.learn``. Shapes follow from what is given, the host reads nothing: a CUDA graph can hold it.

What a step computes are arrays that kernels hand to each other; autograd sees two operations, the trace and ∇sdf. Gradients of the shader
and the light are rows of partial sums, one for each of their programs, and one sum.
"""

from __future__ import annotations

import torch
from torch import Tensor

from mmsynth.field.kernels.cuda import mirroring
from mmsynth.field.kernels.cuda.light import material, material_backward
from mmsynth.field.kernels.cuda.shading import compare_all, programs_of
from mmsynth.field.kernels.cuda.shared import jit, tl, triton
from mmsynth.field.kernels.cuda.slopes import normals_backward, places, slopes_programs, terms_of_slopes
from mmsynth.field.kernels.cuda.surface import surface_gradient
from mmsynth.field.kernels.cuda.tracing import trace
from mmsynth.field.kernels.learning import gradient_of, sum_of_gradients
from mmsynth.field.kernels.parameters import Gains, Lamps, Learned, Mirrors, ShadedRays, Step

_BLOCK = 1024
_ROWS, _COLUMNS = 64, 32  # of partial sums at a time


@jit
def _mean(values, count, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    total = tl.zeros([BLOCK], tl.float32)
    for begin in range(0, count, BLOCK):
        i = begin + tl.arange(0, BLOCK)
        total += tl.load(values + i, mask=i < count, other=0.0)
    return tl.sum(total, 0) / count


@jit
def gains_kernel(log_gain, frame, out, count, rows, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    """exp(log_gain[frame] - mean): of ``count`` numbers and ``rows`` frames."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    own = tl.load(log_gain + tl.load(frame + i, mask=i < count, other=0), mask=i < count, other=0.0)
    tl.store(out + i, tl.exp(own - _mean(log_gain, rows, BLOCK)), mask=i < count)


@jit
def gains_by_frame_kernel(gain, gradient, frame, out, count, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    g = tl.load(gradient + i, mask=i < count, other=0.0) * tl.load(gain + i, mask=i < count, other=0.0)
    tl.atomic_add(out + tl.load(frame + i, mask=i < count, other=0), g, mask=i < count, sem="relaxed")


@jit
def mean_free_kernel(values, rows, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    """Take their mean from all values."""
    mean = _mean(values, rows, BLOCK)
    for begin in range(0, rows, BLOCK):
        i = begin + tl.arange(0, BLOCK)
        tl.store(values + i, tl.load(values + i, mask=i < rows, other=0.0) - mean, mask=i < rows)


@jit
def add_rows_kernel(parts, stride, rows, first, second, size, count, ROWS: tl.constexpr, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    """Add the sum of the rows of ``parts``, in order, to ``first`` (size,) and ``second``, of ``count`` numbers together."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = i < count
    total = tl.zeros([ROWS, BLOCK], tl.float32)
    for begin in range(0, rows, ROWS):
        row = begin + tl.arange(0, ROWS)
        at = parts + row.to(tl.int64)[:, None] * stride + i[None, :]
        total += tl.load(at, mask=(row < rows)[:, None] & live[None, :], other=0.0)
    whole = tl.sum(total, 0)
    near, far = live & (i < size), live & (i >= size)
    tl.store(first + i, whole + tl.load(first + i, mask=near, other=0.0), mask=near)
    tl.store(second + i - size, whole + tl.load(second + i - size, mask=far, other=0.0), mask=far)


def _gain_of(gains: Gains) -> Tensor:
    """The factor of each number, (M,)."""
    count = len(gains.frame)
    out = gains.log_gain.new_empty(count)
    with torch.cuda.device_of(out):
        gains_kernel[(triton.cdiv(count, _BLOCK),)](gains.log_gain, gains.frame, out, count, len(gains.log_gain), _BLOCK)
    return out


def _gain_backward(gains: Gains, gain: Tensor, gradient: Tensor) -> None:
    """Add to the gradient of log_gain; by atomics, whose order differs from run to run. Exposures are relative to their mean, so what was
    there and what is added are free of a mean."""
    out = gradient_of(gains.log_gain)
    with torch.cuda.device_of(out):
        gains_by_frame_kernel[(triton.cdiv(len(gain), _BLOCK),)](gain, gradient, gains.frame, out, len(gain), _BLOCK)
        mean_free_kernel[(1,)](out, len(out), _BLOCK)


def _add_rows(parts: Tensor, first: Tensor, second: Tensor) -> None:
    """Add the sum of (P, W + V) over its rows to (W,) and (V,); one launch."""
    rows, count = parts.shape
    if rows:
        with torch.cuda.device_of(parts):
            add_rows_kernel[(triton.cdiv(count, _COLUMNS),)](
                parts, count, rows, first, second, len(first), count, _ROWS, _COLUMNS, num_warps=8
            )


def learn_all(step: Step, of_shader: Tensor, of_light: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """``learn``, of which gradients are added to the ``grad`` of what is left, and those of

        of_shader: the shader's weights and the far light, one after the other, as they are given, to this array (W,).
        of_light: the first six parts of the light, one after the other, to this one (V,), empty without lamps.

    Returns:
        the loss (n,) float64, to be summed; squared and samples, see ``Learned``.
    """
    grid, network, appearance, states, shader, light, far_light, rays, view, measured, gains, opacities, eikonal, smooth, sampling, _ = step
    with torch.enable_grad():
        hits = trace(grid, network, appearance, states, rays, sampling)
    features, share, shines = hits.features.detach(), hits.share.detach(), len(light.used) > 0
    where = places(hits, rays, eikonal, smooth, grid.extent, shines)
    with torch.enable_grad():
        slopes = surface_gradient(where.at, where.epsilons, grid, network)
    programs = programs_of(len(rays.origins))
    loss = torch.empty(programs + sum(slopes_programs(where)), dtype=torch.float64, device=features.device)
    found = terms_of_slopes(slopes.detach(), where, eikonal, smooth, grid.extent, loss[programs:])
    gain = _gain_of(gains) if len(gains.log_gain) else None
    mirrored = None
    if shines:
        raw = material(light, features)
        lamps, mirrors = Lamps(light.position, light.log_spectrum), Mirrors(raw, found.normals, where.points, rays.directions, where.share)
        mirrored = mirroring.launch(lamps, light.used, True, mirrors, hits.behind, measured)
    partial = features.new_empty(programs, len(of_shader) + len(of_light))
    seen = ShadedRays(features, share, hits.behind, rays.directions, view.degrees, view.trains_geometry)
    compared = compare_all(shader, seen, measured, gain, mirrored, True, far_light, opacities, partial, loss[:programs])
    if shines:
        own, of_material, of_normals = partial[:, len(of_shader) :], torch.empty_like(raw), torch.empty_like(found.normals)
        of_lamps = own[:, sum(w.numel() for w in light[:4]) :]
        backward = compared.mirrored, view.trains_geometry, of_material, of_normals, compared.share, of_lamps
        mirroring.launch(lamps, light.used, True, mirrors, hits.behind, measured, backward, add=True)
        material_backward(light, features, of_material, compared.features, own)
        normals_backward(slopes.detach(), where, of_normals, found.gradient, grid.extent)
    if gain is not None:
        _gain_backward(gains, gain, compared.gain)
    _add_rows(partial, of_shader, of_light)
    torch.autograd.backward([hits.features, hits.share, slopes], [compared.features, compared.share, found.gradient])
    return loss, compared.squared, hits.samples


def learn(step: Step) -> Learned:
    """See ``learning.learn``; float32, ``measured.ray`` never decreasing."""
    weights = [*step.shader, step.far_light], [*(step.light[:6] if len(step.light.used) else ())]
    sums = [step.rays.origins.new_zeros(sum(w.numel() for w in some)) for some in weights]
    loss, squared, samples = learn_all(step, *sums)
    for some, whole in zip(weights, sums, strict=True):
        for weight, part in zip(some, whole.split([w.numel() for w in some]) if some else (), strict=True):
            if weight.numel():
                gradient_of(weight).add_(part.view_as(weight))
    learned = *step.network[:2], *step.shader, *step.light[:-1], step.far_light, step.gains.log_gain
    return Learned(loss.sum().float(), sum_of_gradients(learned), squared, samples)
