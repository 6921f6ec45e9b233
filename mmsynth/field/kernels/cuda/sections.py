"""Volume-rendering weights of sections in Triton; optical depths are computed in double precision, as on the CPU."""

from __future__ import annotations

import torch
from torch import Tensor

from mmsynth.field.kernels.cuda.shared import jit, tl, triton

_RAYS, _SAMPLES = 4, 32  # rays per program and samples per step: one warp per ray, neighbouring lanes on neighbouring samples


@jit
def _softplus(x):  # type: ignore[no-untyped-def]
    """log(1 + eˣ) in double. Triton has no log1p of its own: below 1e-3 its series, exact to 2e-13 like the logarithm above."""
    e = tl.exp(-tl.abs(x))
    log1p = tl.where(e < 1e-3, e * (1.0 - e * (0.5 - e * (1.0 / 3.0 - e * 0.25))), tl.log(1.0 + e))
    return tl.maximum(x, 0.0) + log1p


@jit
def _sigmoid(x):  # type: ignore[no-untyped-def]
    e = tl.exp(-tl.abs(x))
    return tl.where(x >= 0.0, 1.0, e) / (1.0 + e)


@jit
def _opacity(tau):  # type: ignore[no-untyped-def]
    """1 - e^-τ in double, for τ >= 0; the series as in ``_softplus``."""
    return tl.where(tau < 1e-3, tau * (1.0 - tau * (0.5 - tau * (1.0 / 6.0 - tau * (1.0 / 24.0)))), 1.0 - tl.exp(-tau))


@jit
def optical_depth(f0, f1, sharpness, section):  # type: ignore[no-untyped-def]
    """Optical depth of sections with sdf f0, f1 at their ends, in double; 0 where there is no section."""
    # double: at s = 1e6 single precision would leave 0.1 of noise in the difference
    tau = _softplus(-sharpness * f1.to(tl.float64)) - _softplus(-sharpness * f0.to(tl.float64))
    return tl.where(section & ~(tau < 0.0), tau, 0.0)  # not a maximum, which would hide NaN


@jit
def sections_kernel(sdf, sharpness: tl.float64, offsets, weights, crossing, rays, RAYS: tl.constexpr, SAMPLES: tl.constexpr):  # type: ignore[no-untyped-def]
    ray = tl.program_id(0) * RAYS + tl.arange(0, RAYS)
    begin = tl.load(offsets + ray, mask=ray < rays, other=0)
    end = tl.load(offsets + ray + 1, mask=ray < rays, other=0)
    depth = tl.zeros([RAYS], tl.float64)
    for start in range(0, tl.max(end - begin, 0), SAMPLES):
        i = begin[:, None] + (start + tl.arange(0, SAMPLES))[None, :]
        live = i < end[:, None]
        section = i + 1 < end[:, None]
        f0 = tl.load(sdf + i, mask=live, other=0.0)
        f1 = tl.load(sdf + i + 1, mask=section, other=0.0)
        tau = optical_depth(f0, f1, sharpness, section)
        before = depth[:, None] + (tl.cumsum(tau, 1) - tau)
        tl.store(weights + i, tl.where(section, tl.exp(-before) * _opacity(tau), 0.0).to(tl.float32), mask=live)
        crosses = section & (f0 > 0.0) & (f1 <= 0.0)
        tl.store(crossing + i, tl.where(crosses, f0 / tl.where(crosses, f0 - f1, 1.0), 0.5), mask=live)
        depth += tl.sum(tau, 1)


@jit
def sections_backward_kernel(sdf, sharpness: tl.float64, offsets, gradient, out, rays, RAYS: tl.constexpr, SAMPLES: tl.constexpr):  # type: ignore[no-untyped-def]
    """dL/df of a sample is s σ(-s f) (dL/dτ of the section it starts - dL/dτ of the one it ends).

    dL/dτᵢ = gᵢ Tᵢ e^-τᵢ - Σ_{j>i} gⱼ wⱼ, the sum being the ray's total less what has passed: one pass for the total, one for the rest.
    """
    ray = tl.program_id(0) * RAYS + tl.arange(0, RAYS)
    begin = tl.load(offsets + ray, mask=ray < rays, other=0)
    end = tl.load(offsets + ray + 1, mask=ray < rays, other=0)
    longest = tl.max(end - begin, 0)
    depth = tl.zeros([RAYS], tl.float64)
    total = tl.zeros([RAYS], tl.float64)
    for start in range(0, longest, SAMPLES):
        i = begin[:, None] + (start + tl.arange(0, SAMPLES))[None, :]
        section = i + 1 < end[:, None]
        f0 = tl.load(sdf + i, mask=section, other=0.0)
        f1 = tl.load(sdf + i + 1, mask=section, other=0.0)
        g = tl.load(gradient + i, mask=section, other=0.0).to(tl.float64)
        tau = optical_depth(f0, f1, sharpness, section)
        before = depth[:, None] + (tl.cumsum(tau, 1) - tau)
        total += tl.sum(g * tl.exp(-before) * _opacity(tau), 1)
        depth += tl.sum(tau, 1)
    depth = tl.zeros([RAYS], tl.float64)
    done = tl.zeros([RAYS], tl.float64)
    for start in range(0, longest, SAMPLES):
        i = begin[:, None] + (start + tl.arange(0, SAMPLES))[None, :]
        live = i < end[:, None]
        section = i + 1 < end[:, None]
        ending = live & (i > begin[:, None])  # a section ends here
        f = tl.load(sdf + i, mask=live, other=0.0)
        f1 = tl.load(sdf + i + 1, mask=section, other=0.0)
        f0 = tl.load(sdf + i - 1, mask=ending, other=0.0)
        g1 = tl.load(gradient + i, mask=section, other=0.0).to(tl.float64)
        g0 = tl.load(gradient + i - 1, mask=ending, other=0.0).to(tl.float64)
        tau1 = optical_depth(f, f1, sharpness, section)
        tau0 = optical_depth(f0, f, sharpness, ending)
        before = depth[:, None] + tl.cumsum(tau0, 1)
        passed0 = g0 * tl.exp(tau0 - before) * _opacity(tau0)
        behind = total[:, None] - done[:, None] - tl.cumsum(passed0, 1)
        transmittance = tl.exp(-before)
        opacity = _opacity(tau1)
        d1 = tl.where(tau1 > 0.0, g1 * transmittance * (1.0 - opacity) - (behind - g1 * transmittance * opacity), 0.0)
        d0 = tl.where(tau0 > 0.0, g0 * transmittance - behind, 0.0)
        slope = sharpness * _sigmoid(-sharpness * f.to(tl.float64))
        tl.store(out + i, (slope * (d1 - d0)).to(tl.float32), mask=live)
        depth += tl.sum(tau0, 1)
        done += tl.sum(passed0, 1)


class _SectionWeights(torch.autograd.Function):
    @staticmethod
    def forward(ctx, sdf, sharpness, offsets):  # type: ignore[no-untyped-def]
        weights, crossing = torch.empty_like(sdf), torch.empty_like(sdf)
        rays = offsets.shape[0] - 1
        if sdf.numel():
            with torch.cuda.device_of(sdf):
                sections_kernel[(triton.cdiv(rays, _RAYS),)](sdf, sharpness, offsets, weights, crossing, rays, _RAYS, _SAMPLES)
        ctx.save_for_backward(sdf, offsets)
        ctx.sharpness = sharpness
        ctx.mark_non_differentiable(crossing)
        return weights, crossing

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient, _):  # type: ignore[no-untyped-def]
        sdf, offsets = ctx.saved_tensors
        out = torch.empty_like(sdf)
        rays = offsets.shape[0] - 1
        if sdf.numel():
            with torch.cuda.device_of(sdf):
                grid = (triton.cdiv(rays, _RAYS),)
                sections_backward_kernel[grid](sdf, ctx.sharpness, offsets, gradient.contiguous(), out, rays, _RAYS, _SAMPLES)
        return out, None, None


def section_weights(sdf: Tensor, sharpness: float, offsets: Tensor) -> tuple[Tensor, Tensor]:
    """See ``reference.section_weights``; float32 in and out, double inside, once differentiable in ``sdf``."""
    return _SectionWeights.apply(sdf.contiguous(), float(sharpness), offsets)
