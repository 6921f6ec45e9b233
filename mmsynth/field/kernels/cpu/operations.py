"""What numba compiled, behind torch's autograd.

Tables are the largest tensors of a field and few of their rows are met in one step, so their gradients are *added to*
``table.grad`` in place and not returned to autograd: a dense gradient per call would cost more than the call. Everything else
follows autograd's rules.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from mmsynth.field.kernels import reference
from mmsynth.field.kernels.constants import FEATURES
from mmsynth.field.kernels.cpu import marching, mirroring, shading, surface, tracing_gradients
from mmsynth.field.kernels.cpu.arrays import as_array, as_arrays, in_double, shader_layers
from mmsynth.field.kernels.cpu.blocks import surface_layers
from mmsynth.field.kernels.cpu.marching import CHUNK
from mmsynth.field.kernels.cpu.stores import (
    RayStore,
    SurfaceStore,
    ray_store,
    shading_store,
    surface_store,
)
from mmsynth.field.kernels.cpu.surface import POINTS
from mmsynth.field.kernels.cpu.tasks import take_all
from mmsynth.field.kernels.learning import gradient_of
from mmsynth.field.kernels.mirroring import Reflection
from mmsynth.field.kernels.parameters import (
    Cells,
    GridTable,
    Hits,
    Lamps,
    Measured,
    Mirrors,
    Rays,
    Sampling,
    ShadedRays,
    ShaderWeights,
    SurfaceNetwork,
)
from mmsynth.threads import kernel_threads


class TraceOutputs(NamedTuple):
    """Of rays, (2, R, ...) for the nearest surface of each and what is behind it: features, weight (the share) and distance as in ``Hits``,
    shown: the weight by which features were divided. Of rays: depth. Of chunks: samples."""

    features: np.ndarray
    weight: np.ndarray
    distance: np.ndarray
    shown: np.ndarray
    depth: np.ndarray
    samples: np.ndarray


def _kept(*tensors: Tensor) -> bool:
    """Whether a backward pass may follow; within ``forward`` autograd does not tell."""
    return torch.is_grad_enabled() and any(t.requires_grad for t in tensors)


def _summed(arrays: SurfaceStore | RayStore, chunks: int, hidden: Tensor, output: Tensor) -> tuple[Tensor, Tensor]:
    """Gradients of a network's hidden layer and of its last, see ``units``."""
    units, inputs = hidden.shape
    pulled, bias = arrays.pulled_out[:chunks].sum(0)[:inputs, :units].T, arrays.bias_out[:chunks].sum(dtype=np.float32)
    # what is not finite is seen, by units that are not above zero, too
    to_output = (as_array(hidden) * pulled).sum(1) + np.float32(0.0) * bias
    return torch.from_numpy(as_array(output)[:units, None] * pulled), torch.from_numpy(np.append(to_output, bias))


def surface_value(positions: Tensor, grid: GridTable, network: SurfaceNetwork) -> Tensor:
    """See ``reference.surface_value``; float32. Differentiable in positions, weights, and, in place, the table."""
    keep = _kept(positions, network.hidden)
    return _Value.apply(keep, positions, grid, network, network.hidden, network.output)


class _Value(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, keep: bool, positions: Tensor, grid: GridTable, network: SurfaceNetwork, hidden: Tensor, output: Tensor
    ) -> Tensor:
        chunks = -(-len(positions) // POINTS)
        store = surface_store(chunks if keep else kernel_threads(), len(hidden), len(grid.resolutions))
        out, weights = torch.empty(len(positions)), surface_layers(as_arrays(network))
        take_all(chunks, surface.surface_forward, as_array(positions), as_arrays(grid), weights, keep, store.arrays, out.numpy())
        if keep:
            ctx.store, ctx.parameters = store, (grid, network)
            ctx.save_for_backward(hidden, output)
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        hidden, output = ctx.saved_tensors
        (grid, network), arrays, count = ctx.parameters, ctx.store.arrays, len(gradient)
        chunks = -(-count // POINTS)
        g, table, weights = as_array(gradient), as_arrays(grid), surface_layers(as_arrays(network._replace(hidden=hidden, output=output)))
        take_all(chunks, surface.surface_backward, g, grid.active, weights, arrays)
        positions = None
        if ctx.needs_input_grad[1]:
            positions = torch.empty(count, 3)
            take_all(chunks, surface.surface_positions, g, table, weights, arrays, positions.numpy())
        if grid.table.requires_grad:
            take_all(grid.active, surface.surface_scatter, count, table, arrays, gradient_of(grid.table).numpy())
        ctx.store = None
        return None, positions, None, None, *_summed(arrays, chunks, hidden, output)


def classify(states: Tensor, cells: Cells, grid: GridTable, network: SurfaceNetwork) -> None:
    """See ``reference.classify``, of a surface; float32."""
    side = states.shape[0]
    store = surface_store(kernel_threads(), len(network.hidden), len(grid.resolutions))
    centre = ((torch.arange(side) + 0.5) * (2.0 / side) - 1.0) * cells.extent
    take_all(
        -(-states.numel() // surface.CELLS), surface.classify, states.view(-1).numpy(), centre.numpy(), as_arrays(cells), as_arrays(grid),
        surface_layers(as_arrays(network)), store.arrays,
    )  # fmt: skip


def trace(grid: GridTable, network: SurfaceNetwork, appearance: GridTable, states: Tensor, rays: Rays, sampling: Sampling) -> Hits:
    """See ``reference.trace``; float32. Differentiable in origins, directions, weights, and, in place, the tables."""
    keep = _kept(rays.origins, rays.directions, network.hidden)
    parameters = grid, network, appearance, states, rays, in_double(sampling)
    features, weight, distance, behind, depth, samples = _Trace.apply(
        keep, rays.origins, rays.directions, network.hidden, network.output, parameters
    )
    count = len(depth)
    opacity = weight[:count]
    if len(weight) > count:
        opacity = opacity.index_add(0, torch.nonzero(behind >= 0)[:, 0], weight[count:])
    return Hits(features, weight, distance, behind, opacity, depth, samples)


class _Trace(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, keep: bool, origins: Tensor, directions: Tensor, hidden: Tensor, output: Tensor, parameters: tuple[Any, ...]
    ) -> tuple[Tensor, ...]:
        grid, network, appearance, states, rays, sampling = parameters
        count, levels = len(origins), len(appearance.resolutions)
        chunks = -(-count // CHUNK)
        store = ray_store(chunks if keep else kernel_threads(), len(hidden), len(grid.resolutions), levels)
        features = torch.empty(2, count, FEATURES * levels)
        weight, distance, shown, depth = torch.empty(2, count), torch.empty(2, count), torch.empty(2, count), torch.empty(count)
        samples = torch.zeros(max(chunks, 1), dtype=torch.int64)
        take_all(
            chunks, marching.trace_forward, as_arrays(rays), as_array(states), sampling, as_arrays(grid),
            surface_layers(as_arrays(network)), as_arrays(appearance), keep, store.arrays,
            TraceOutputs(*(x.numpy() for x in (features, weight, distance, shown, depth, samples))),
        )  # fmt: skip
        behind = torch.full((count,), -1)
        met_twice = torch.nonzero(weight[1])[:, 0]
        behind[met_twice] = torch.arange(count, count + len(met_twice))
        features, weight, distance, shown = (torch.cat([x[0], x[1, met_twice]]) for x in (features, weight, distance, shown))
        if keep:
            ctx.store, ctx.parameters = store, (grid, network, appearance, sampling.sharpness)
            ctx.save_for_backward(hidden, output, origins, directions, features, shown, behind)
        ctx.mark_non_differentiable(distance, behind, depth, samples)
        return features, weight, distance, behind, depth, samples.sum()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, g_features: Tensor, g_weight: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
        hidden, output, origins, directions, features, shown, behind = ctx.saved_tensors
        (grid, network, appearance, sharpness), arrays, count = ctx.parameters, ctx.store.arrays, len(origins)
        table, look, chunks = as_arrays(grid), as_arrays(appearance), -(-count // CHUNK)
        weights = surface_layers(as_arrays(network._replace(hidden=hidden, output=output)))
        take_all(
            chunks, tracing_gradients.trace_backward, *map(as_array, (behind, g_features, g_weight, features, shown)), sharpness,
            grid.active, weights, appearance.active, arrays,
        )  # fmt: skip
        to_rays: list[Tensor | None] = [None, None]
        if ctx.needs_input_grad[1] or ctx.needs_input_grad[2]:
            found = torch.empty(origins.shape), torch.empty(directions.shape)
            take_all(
                chunks, tracing_gradients.trace_rays_backward, as_array(origins), as_array(directions), table, weights, look, arrays,
                *(x.numpy() for x in found),
            )  # fmt: skip
            to_rays = list(found)
        if grid.table.requires_grad or appearance.table.requires_grad:
            gradients = gradient_of(grid.table).numpy(), gradient_of(appearance.table).numpy()
            take_all(grid.active + appearance.active, tracing_gradients.trace_scatter, count, table, look, arrays, *gradients)
        ctx.store = None
        return None, *to_rays, *_summed(arrays, chunks, hidden, output), None


def compare(
    weights: ShaderWeights, rays: ShadedRays, measured: Measured, gain: Tensor | None = None, mirrored: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """See ``reference.compare``; float32, ``measured.ray`` never decreasing. Differentiable in features, shares, gain, mirrored light and
    weights of the shader."""
    none = rays.features.new_empty(0)
    gain, mirrored = none if gain is None else gain, none if mirrored is None else mirrored
    learn = _kept(rays.features, rays.share, gain, mirrored, *weights)
    return _Compare.apply(learn, rays, measured, rays.features, rays.share, gain, mirrored, *weights)


class _Compare(torch.autograd.Function):
    """The gradients of a measurement are known when it is: the forward pass takes them all, the backward pass only scales them."""

    @staticmethod
    def forward(
        ctx: Any,
        learn: bool,
        rays: ShadedRays,
        measured: Measured,
        features: Tensor,
        share: Tensor,
        gain: Tensor,
        mirrored: Tensor,
        *weights: Tensor,
    ) -> tuple[Tensor, Tensor]:
        tasks = -(-len(rays.behind) // (shading.TOGETHER * shading.CHUNK))
        tensors = ShaderWeights(*weights)
        arrays = (store := shading_store(max(tasks if learn else 0, kernel_threads()), tensors)).arrays
        loss, squared = np.empty(tasks), torch.empty(len(measured.target))
        gradients = [torch.empty(x.shape) for x in (features, share, gain, mirrored)]
        take_all(
            tasks, shading.compare, as_arrays(rays), as_arrays(measured), as_array(gain), as_array(mirrored),
            *shader_layers(as_arrays(tensors)), learn, arrays, loss, squared.numpy(), *(g.numpy() for g in gradients),
        )  # fmt: skip
        if learn:
            for name, weight in zip(ShaderWeights._fields, weights, strict=True):
                whole = getattr(arrays, f"{name}_out")[:tasks].sum(0)
                gradients.append(torch.from_numpy(whole[tuple(slice(n) for n in weight.shape)]))
            ctx.gradients = gradients
        del store  # not before its arrays were read
        ctx.mark_non_differentiable(squared)
        return torch.tensor(loss.sum(), dtype=torch.float32), squared

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        return None, None, None, *(gradient * g for g in ctx.gradients)


def shade(weights: ShaderWeights, features: Tensor, directions: Tensor, degrees: Tensor | int) -> Tensor:
    """See ``reference.shade``; fused for rays of one degree, without a gradient."""
    if isinstance(degrees, Tensor) or torch.is_grad_enabled():
        return reference.shade(weights, features, directions, degrees)
    outputs, layers = torch.empty(len(features), len(weights.heads_bias)), shader_layers(as_arrays(weights))
    take_all(-(-len(features) // shading.CHUNK), shading.shade, as_array(features), as_array(directions), degrees, *layers, outputs.numpy())
    return outputs


def reflect(position: Tensor, mirrors: Mirrors) -> Reflection:
    """See ``mirroring.reflect``; fused without a gradient."""
    if _kept(position, *mirrors):
        return reference.reflect(position, mirrors)
    surfaces, count = len(mirrors.points), len(position)
    found = Reflection(torch.empty(surfaces, count), torch.empty(surfaces, count, 3), torch.empty(surfaces, count))
    lamps = as_arrays(Lamps(position, torch.empty(count, 0)))
    take_all(-(-surfaces // mirroring.SURFACES), mirroring.reflect, lamps, as_arrays(mirrors), *(x.numpy() for x in found))
    return found


def mirror(lamps: Lamps, mirrors: Mirrors, behind: Tensor, measured: Measured) -> Tensor:
    """See ``mirroring.mirror``; float32, ``measured.ray`` never decreasing. Points and directions with a gradient go to the reference."""
    if _kept(mirrors.points, mirrors.directions):
        return reference.mirror(lamps, mirrors, behind, measured)
    return _Mirror.apply(behind, measured, mirrors, *lamps, mirrors.material, mirrors.normals, mirrors.share)


class _Mirror(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, behind: Tensor, measured: Measured, mirrors: Mirrors, *differentiable: Tensor) -> Tensor:
        position, spectrum, material, normals, share = differentiable
        out = torch.empty(len(measured.ray))
        lamps, mirrors = Lamps(position, spectrum), mirrors._replace(material=material, normals=normals, share=share)
        take_all(
            -(-len(behind) // mirroring.CHUNK), mirroring.mirror, as_arrays(lamps), as_arrays(mirrors), as_array(behind),
            as_arrays(measured), out.numpy(),
        )  # fmt: skip
        ctx.constants = behind, measured, mirrors.points, mirrors.directions
        ctx.save_for_backward(*differentiable)
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        (behind, measured, points, directions), (position, spectrum, material, normals, share) = ctx.constants, ctx.saved_tensors
        chunks = -(-len(behind) // mirroring.CHUNK)
        of_rows = [torch.empty(x.shape) for x in (material, normals, share)]
        of_lamps = [torch.empty(chunks, *x.shape) for x in (position, spectrum)]
        mirrors = Mirrors(material, normals, points, directions, share)
        take_all(
            chunks, mirroring.mirror_backward, as_arrays(Lamps(position, spectrum)), as_arrays(mirrors), as_array(behind),
            as_arrays(measured), as_array(gradient), mirroring.Gradients(*(x.numpy() for x in (*of_rows, *of_lamps))),
        )  # fmt: skip
        return None, None, None, *(x.sum(0) for x in of_lamps), *of_rows
