"""Rays through the field in Triton, behind torch's autograd: four kernels forward, four backward, no shape that the host has to ask for.

Hits have a row for the nearest surface of each ray and one for what is behind it, whether there is or not. Scratch has room for
MAX_SAMPLES samples of each ray; only what is used of it is read or written.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from mmsynth.field.kernels.constants import MAX_SAMPLES_PER_RAY
from mmsynth.field.kernels.cuda import sections
from mmsynth.field.kernels.cuda.appearance import look_backward_kernel, look_kernel
from mmsynth.field.kernels.cuda.marching import LANES as MARCH_LANES
from mmsynth.field.kernels.cuda.marching import OPTIONS as MARCH_OPTIONS
from mmsynth.field.kernels.cuda.marching import PER_CORE, SKIPS, enter_kernel, march_kernel
from mmsynth.field.kernels.cuda.shared import COLUMNS, programs, scalar, triton
from mmsynth.field.kernels.cuda.surface import BLOCK, OPTIONS, RAYS, launch, padded_units, surface_backward, table_gradient
from mmsynth.field.kernels.parameters import GridTable, Hits, Rays, Sampling, SurfaceNetwork

LANES = 32  # rays per program of the kernels that go along the sections of rays: one warp, and four where they look up features


class _Traced(NamedTuple):
    """What the backward pass needs beside the inputs; see the kernels' parameters of the same names."""

    found: Tensor
    counts: Tensor
    sections: Tensor
    section_k: Tensor
    section_count: Tensor
    second: Tensor
    touched: Tensor
    shown: Tensor
    sharpness: Tensor


def trace(grid: GridTable, network: SurfaceNetwork, appearance: GridTable, states: Tensor, rays: Rays, sampling: Sampling) -> Hits:
    """See ``reference.trace``; float32. Hits have 2 R rows, R + r what is behind the nearest surface of ray r, zeros where nothing is.
    Differentiable in origins, directions, weights, and, in place, the tables. ``sharpness`` and ``step`` may be float64 tensors ()."""
    learned = rays.origins, rays.directions, network.hidden, network.output
    return Hits(*_Trace.apply(*learned, grid, network, appearance, states, rays, sampling))


class _Trace(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, origins: Tensor, directions: Tensor, hidden: Tensor, output: Tensor,
        grid: GridTable, network: SurfaceNetwork, appearance: GridTable, states: Tensor, rays: Rays, sampling: Sampling,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        origins, directions, near, far, jitter = (x.detach().contiguous() for x in rays)
        count, device, s = len(origins), origins.device, sampling
        (units, width), columns = hidden.shape, appearance.table.shape[1] * len(appearance.resolutions)
        new = lambda *shape, dtype=torch.float32: torch.empty(shape, dtype=dtype, device=device)
        queue, entries = new(2, dtype=torch.int32) if count else torch.zeros(2, dtype=torch.int32, device=device), new(count)
        sharpness, step = scalar(s.sharpness, device), scalar(s.step, device)
        section_count, second, touched, counts = (new(count, dtype=torch.int32) for _ in range(4))
        section_k = new(MAX_SAMPLES_PER_RAY, count, dtype=torch.int32)
        t = _Traced(
            new(3, MAX_SAMPLES_PER_RAY, count), counts, new(2, MAX_SAMPLES_PER_RAY, count), section_k, section_count, second, touched,
            new(2 * count), sharpness,
        )  # fmt: skip
        features = new(2 * count, columns)
        share, distance, depth, opacity = new(2 * count), new(2 * count), new(count), new(count)
        behind = new(count, dtype=torch.int64)
        bent = grid.extent > 1.0
        if count:
            blocks = triton.cdiv(count, LANES)
            with torch.cuda.device_of(origins):
                states = states.contiguous()
                enter_kernel[(blocks,)](
                    origins, directions, near, far, jitter, states, queue, entries, t.counts, step, count, states.shape[0],
                    float(grid.extent), bent, LANES, num_warps=1,
                )  # fmt: skip
                march_kernel[(min(programs(device, PER_CORE), triton.cdiv(count, MARCH_LANES)),)](
                    origins, directions, far, jitter, states, queue, entries, t.found, t.counts, sharpness, step,
                    *launch(grid, network), count, width, grid.active, states.shape[0], float(grid.extent),
                    s.sphere_step_factor, s.min_slope, s.max_optical_depth,
                    bent, units, grid.table.shape[1], SKIPS, MARCH_LANES, padded_units(units), **MARCH_OPTIONS,
                )  # fmt: skip
                sections.weigh_kernel[(blocks,)](
                    origins, directions, t.found, t.counts, sharpness, t.sections, t.section_k, t.section_count, t.second, t.touched,
                    share, t.shown, distance, depth, opacity, behind, queue[1:], count, s.min_section_weight, s.max_optical_depth,
                    bent, LANES, num_warps=1,
                )  # fmt: skip
                look_kernel[(blocks, triton.cdiv(columns, COLUMNS.value))](
                    origins, directions, t.sections, t.section_k, t.section_count, t.second, t.shown,
                    appearance.table.detach(), appearance.resolutions, appearance.offsets, features, 0.5 / appearance.extent,
                    count, columns, appearance.active, bent, appearance.table.shape[1], LANES, **OPTIONS,
                )  # fmt: skip
        ctx.parameters = grid, network, appearance
        ctx.traced = t
        ctx.save_for_backward(origins, directions, hidden, output, features)
        ctx.mark_non_differentiable(distance, behind, depth, samples := queue[1])
        ctx.set_materialize_grads(False)
        return features, share, distance, behind, opacity, depth, samples

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> Any:
        (grid, network, appearance), t = ctx.parameters, ctx.traced
        origins, directions, hidden, output, features = ctx.saved_tensors
        count, device = len(origins), origins.device
        g_features, g_share, g_opacity = (None if g is None else g.contiguous() for g in (gradients[0], gradients[1], gradients[4]))
        bent, to_rays = grid.extent > 1.0, ctx.needs_input_grad[0] or ctx.needs_input_grad[1]
        new = lambda *shape, dtype=torch.float32: torch.empty(shape, dtype=dtype, device=device)
        ends = t.touched.cumsum(0)
        room = count * MAX_SAMPLES_PER_RAY
        ray, time, gradient = new(room, dtype=torch.int32), new(room), new(room)
        g_section = None if g_features is None else new(MAX_SAMPLES_PER_RAY, count)
        of_sections = new(3, MAX_SAMPLES_PER_RAY, count) if to_rays and g_features is not None else None
        of_samples = new(room, 3) if to_rays else None
        blocks = triton.cdiv(count, LANES)
        if count:
            with torch.cuda.device_of(origins):
                if g_features is not None:
                    look_backward_kernel[(blocks,)](
                        origins, directions, t.sections, t.section_k, t.section_count, t.second, t.shown, features, g_features,
                        appearance.table.detach(), appearance.resolutions, appearance.offsets, table_gradient(appearance.table),
                        g_section, of_sections, 0.5 / appearance.extent, count, features.shape[1], appearance.active,
                        bent, appearance.table.shape[1], LANES, **OPTIONS,
                    )  # fmt: skip
                sections.weigh_backward_kernel[(blocks,)](
                    t.found, t.counts, t.sharpness, t.section_k, t.section_count, t.second, ends, t.touched, g_section, g_share, g_opacity,
                    ray, time, gradient, count, LANES, num_warps=1,
                )  # fmt: skip
        if count:
            weights = surface_backward(
                RAYS, grid, network._replace(hidden=hidden, output=output), gradient, 0, triton.cdiv(room, BLOCK),
                samples=(ray, time, origins, directions, ends[-1:]), positions_out=of_samples,
            )  # fmt: skip
        else:
            weights = torch.zeros_like(hidden), torch.zeros_like(output)
        found: tuple[Tensor | None, Tensor | None] = (None, None)
        if to_rays:
            found = torch.empty_like(origins), torch.empty_like(directions)
            if count:
                with torch.cuda.device_of(origins):
                    sections.rays_backward_kernel[(blocks,)](
                        ends, t.touched, time, of_samples, t.sections, t.section_count, of_sections, *found, count,
                        LANES, num_warps=1,
                    )  # fmt: skip
        ctx.traced = None
        return *found, *weights, None, None, None, None, None, None
