"""What numba compiled, behind torch's autograd.

Tables are the largest tensors of a field and few of their rows are met in one step, so their gradients are *added to*
``table.grad`` in place and not returned to autograd: a dense gradient per call would cost more than the call. Everything else
follows autograd's rules.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from numba import get_num_threads
from torch import Tensor

from mmsynth.field.kernels import reference
from mmsynth.field.kernels.constants import FEATURES
from mmsynth.field.kernels.cpu import learning, marching, mirroring, shading, slopes, surface, tracing_gradients
from mmsynth.field.kernels.cpu.blocks import surface_layers
from mmsynth.field.kernels.cpu.drawing import ToFill, nothing_to_draw, to_fill
from mmsynth.field.kernels.cpu.learning import WeightGradients
from mmsynth.field.kernels.cpu.marching import CHUNK
from mmsynth.field.kernels.cpu.matrices import padded
from mmsynth.field.kernels.cpu.optimiser import places_and_numbers
from mmsynth.field.kernels.cpu.shading import Layers, two_layers
from mmsynth.field.kernels.cpu.stores import (
    RayStore,
    SurfaceStore,
    chunk_scratch,
    light_out,
    ray_store,
    shading_store,
    surface_store,
    table_store,
    tap_store,
)
from mmsynth.field.kernels.cpu.surface import POINTS
from mmsynth.field.kernels.cpu.tasks import take_beside
from mmsynth.field.kernels.learning import gradient_of, no_light
from mmsynth.field.kernels.mirroring import Reflection
from mmsynth.field.kernels.parameters import (
    AdamPart,
    Arranged,
    Cells,
    Drawing,
    GridTable,
    Hits,
    Lamps,
    Learned,
    Measured,
    Mirrors,
    Rays,
    Sampling,
    ShadedRays,
    ShaderWeights,
    Step,
    SurfaceNetwork,
)

P = TypeVar("P", bound=tuple[Any, ...])


class TraceOutputs(NamedTuple):
    """Of rays, (2, R, ...) for the nearest surface of each and what is behind it: features, weight (the share) and distance as in ``Hits``,
    shown: the weight by which features were divided. Of rays: depth. Of chunks: samples."""

    features: np.ndarray
    weight: np.ndarray
    distance: np.ndarray
    shown: np.ndarray
    depth: np.ndarray
    samples: np.ndarray


def _array(tensor: Tensor) -> np.ndarray:
    return (tensor if tensor.is_contiguous() else tensor.contiguous()).numpy(force=True)


def _arrays(parameters: P) -> P:
    """Tensors as arrays, numbers in single precision: the types that the kernels are compiled for."""
    return type(parameters)(*map(_compiled, parameters))


def _compiled(x: Any) -> Any:
    return _array(x) if isinstance(x, Tensor) else np.float32(x) if isinstance(x, float) else x


def _in_double(sampling: Sampling) -> Sampling:
    """Numbers in double precision, even those given as integers."""
    whole = {"active_surface", "active_radiance"}
    values: dict[str, Any] = {name: value if name in whole else float(value) for name, value in sampling._asdict().items()}
    return Sampling(**values)


def _shader_layers(weights: Any) -> tuple[Layers, np.ndarray, np.ndarray]:
    """Hidden layers, heads and their biases of ``ShaderWeights`` of arrays."""
    return two_layers(*weights[:4]), weights.heads, weights.heads_bias


def _kept(*tensors: Tensor) -> bool:
    """Whether a backward pass may follow; within ``forward`` autograd does not tell."""
    return torch.is_grad_enabled() and any(t.requires_grad for t in tensors)


def _summed(arrays: SurfaceStore | RayStore, chunks: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """Gradients of a network's hidden layer, which is like this one, and of its last."""
    units, inputs = like.shape
    hidden, output = arrays.turned_out[:chunks].sum(0)[:inputs, :units].T, arrays.output_out[:chunks].sum(0)
    return torch.from_numpy(np.ascontiguousarray(hidden)), torch.from_numpy(np.append(output[:units], output[-1]))


def surface_value(positions: Tensor, grid: GridTable, network: SurfaceNetwork) -> Tensor:
    """See ``reference.surface_value``; float32. Differentiable in positions, weights, and, in place, the table."""
    keep = _kept(positions, network.hidden)
    return _Value.apply(keep, positions, grid, network, network.hidden, network.output)


class _Value(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, keep: bool, positions: Tensor, grid: GridTable, network: SurfaceNetwork, hidden: Tensor, output: Tensor
    ) -> Tensor:
        store = surface_store(-(-len(positions) // POINTS) if keep else get_num_threads(), len(hidden), len(grid.resolutions))
        out = torch.empty(len(positions))
        surface.surface_forward(_array(positions), _arrays(grid), surface_layers(_arrays(network)), keep, store.arrays, out.numpy())
        if keep:
            ctx.store, ctx.parameters = store, (grid, network)
            ctx.save_for_backward(hidden, output)
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        hidden, output = ctx.saved_tensors
        (grid, network), arrays, count = ctx.parameters, ctx.store.arrays, len(gradient)
        g, table, weights = _array(gradient), _arrays(grid), surface_layers(_arrays(network._replace(hidden=hidden, output=output)))
        surface.surface_backward(g, grid.active, weights, arrays)
        positions = None
        if ctx.needs_input_grad[1]:
            positions = torch.empty(count, 3)
            surface.surface_positions(g, table, weights, arrays, positions.numpy())
        if grid.table.requires_grad:
            surface.surface_scatter(count, table, arrays, gradient_of(grid.table).numpy())
        ctx.store = None
        return None, positions, None, None, *_summed(arrays, -(-count // POINTS), hidden)


def classify(states: Tensor, cells: Cells, grid: GridTable, network: SurfaceNetwork) -> None:
    """See ``reference.classify``, of a surface; float32."""
    threads, side = get_num_threads(), states.shape[0]
    store = surface_store(threads, len(network.hidden), len(grid.resolutions))
    centre = ((torch.arange(side) + 0.5) * (2.0 / side) - 1.0) * cells.extent
    surface.classify(
        threads, np.zeros(2, np.int64), states.view(-1).numpy(), centre.numpy(), _arrays(cells), _arrays(grid),
        surface_layers(_arrays(network)), store.arrays,
    )  # fmt: skip


def trace(grid: GridTable, network: SurfaceNetwork, appearance: GridTable, states: Tensor, rays: Rays, sampling: Sampling) -> Hits:
    """See ``reference.trace``; float32. Differentiable in origins, directions, weights, and, in place, the tables."""
    keep = _kept(rays.origins, rays.directions, network.hidden)
    parameters = grid, network, appearance, states, rays, _in_double(sampling)
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
        store = ray_store(chunks if keep else get_num_threads(), len(hidden), len(grid.resolutions), levels)
        features = torch.empty(2, count, FEATURES * levels)
        weight, distance, shown, depth = torch.empty(2, count), torch.empty(2, count), torch.empty(2, count), torch.empty(count)
        samples = torch.zeros(max(chunks, 1), dtype=torch.int64)
        marching.trace_forward(
            _arrays(rays), _array(states), sampling, _arrays(grid), surface_layers(_arrays(network)), _arrays(appearance), keep,
            store.arrays,
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
        table, look = _arrays(grid), _arrays(appearance)
        weights = surface_layers(_arrays(network._replace(hidden=hidden, output=output)))
        tracing_gradients.trace_backward(
            *map(_array, (behind, g_features, g_weight, features, shown)), sharpness, grid.active, weights, appearance.active, arrays
        )
        to_rays: list[Tensor | None] = [None, None]
        if ctx.needs_input_grad[1] or ctx.needs_input_grad[2]:
            found = torch.empty(origins.shape), torch.empty(directions.shape)
            tracing_gradients.trace_rays_backward(
                _array(origins), _array(directions), table, weights, look, arrays, *(x.numpy() for x in found)
            )
            to_rays = list(found)
        if grid.table.requires_grad or appearance.table.requires_grad:
            gradients = gradient_of(grid.table).numpy(), gradient_of(appearance.table).numpy()
            tracing_gradients.trace_scatter(count, table, look, arrays, *gradients)
        ctx.store = None
        return None, *to_rays, *_summed(arrays, -(-count // CHUNK), hidden), None


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
        chunks = -(-len(rays.behind) // shading.CHUNK)
        tensors = ShaderWeights(*weights)
        arrays = (store := shading_store(max(chunks, get_num_threads()), tensors)).arrays
        loss, squared = np.zeros(chunks), torch.empty(len(measured.target))
        gradients = [torch.empty(x.shape) for x in (features, share, gain, mirrored)]
        shading.compare(
            _arrays(rays), _arrays(measured), _array(gain), _array(mirrored), *_shader_layers(_arrays(tensors)), learn, arrays, loss,
            squared.numpy(), *(g.numpy() for g in gradients),
        )  # fmt: skip
        if learn:
            for name, weight in zip(ShaderWeights._fields, weights, strict=True):
                whole = getattr(arrays, f"{name}_out")[:chunks].sum(0)
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
    outputs = torch.empty(len(features), len(weights.heads_bias))
    layers, heads, biases = _shader_layers(_arrays(weights))
    shading.shade(_array(features), _array(directions), degrees, layers, padded(heads.T), biases, outputs.numpy())
    return outputs


def reflect(position: Tensor, mirrors: Mirrors) -> Reflection:
    """See ``mirroring.reflect``; fused without a gradient."""
    if _kept(position, *mirrors):
        return reference.reflect(position, mirrors)
    surfaces, count = len(mirrors.points), len(position)
    found = Reflection(torch.empty(surfaces, count), torch.empty(surfaces, count, 3), torch.empty(surfaces, count))
    mirroring.reflect(_arrays(Lamps(position, torch.empty(count, 0))), _arrays(mirrors), *(x.numpy() for x in found))
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
        mirrors = mirrors._replace(material=material, normals=normals, share=share)
        mirroring.mirror(_arrays(Lamps(position, spectrum)), _arrays(mirrors), _array(behind), _arrays(measured), out.numpy())
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
        mirroring.mirror_backward(
            _arrays(Lamps(position, spectrum)), _arrays(mirrors), _array(behind), _arrays(measured), _array(gradient),
            mirroring.Gradients(*(x.numpy() for x in (*of_rows, *of_lamps))),
        )  # fmt: skip
        return None, None, None, *(x.sum(0) for x in of_lamps), *of_rows


class _Made(NamedTuple):
    """Of ``Arranged``: the step with arrays in the place of tensors, and what is drawn beside it."""

    step: Any
    ahead: tuple[ToFill, ...]


@torch.no_grad()
def arrange(step: Step, ahead: Sequence[Drawing] = ()) -> Arranged:
    """See ``kernels.arrange``."""
    arrays: list[Any] = [_arrays(x) if isinstance(x, tuple) else _compiled(x) for x in step]
    of_step = Step(*arrays)._replace(sampling=_in_double(step.sampling))
    return Arranged(step, tuple(ahead), _Made(of_step, tuple(to_fill(drawing) for drawing in ahead)))


@torch.no_grad()
def learn(
    arranged: Arranged,
    update: Callable[[], Sequence[AdamPart]] | None = None,
    meanwhile: Callable[[Learned], None] | None = None,
) -> Learned:
    """See ``kernels.learn`` and ``learning.learn``; float32, ``measured.ray`` never decreasing."""
    step, (made, ahead) = arranged.step, arranged.made
    table, network, look, states, shader, light, far_light, rays, view, measured, gains, opacities, eikonal, sampling = made
    count, numbers, points = len(rays.origins), len(measured.target), len(eikonal.points)
    chunks, threads = -(-count // CHUNK), get_num_threads()
    tasks = chunks + -(-points // slopes.POINTS)
    units, levels = len(network.hidden), len(table.resolutions)
    features, hidden, used = FEATURES * len(look.resolutions), len(light.first), light.used
    parts = len(light.second_bias) - len(light.position)
    columns = np.concatenate([np.arange(parts), parts + used])
    lamps = Lamps(light.position[used], np.exp(light.log_spectrum[used]))
    shining = two_layers(light.first, light.first_bias, light.second[columns], light.second_bias[columns])
    gain = np.empty(0, np.float32)
    if len(gains.log_gain):
        of_frames = np.exp(gains.log_gain - np.mean(gains.log_gain, dtype=np.float64)).astype(np.float32)
        gain = of_frames[gains.frame]
    store, taps = ray_store(threads, units, levels, len(look.resolutions)), tap_store(tasks, units, levels)
    kept = table_store(chunks, units, levels, len(look.resolutions))
    weights = shading_store(max(chunks, threads), shader)
    scratch = chunk_scratch(threads, units, features, len(columns), hidden)
    out = light_out(tasks, features, len(columns), hidden, len(used), len(shader.heads_bias))
    squared, mirrored = np.empty(numbers, np.float32), np.empty(numbers if len(used) else 0, np.float32)
    g_mirrored, g_gain, samples = np.empty_like(mirrored), np.empty_like(gain), np.zeros(max(chunks, 1), np.int64)
    first, second = (*(x.arrays for x in ahead), nothing_to_draw(), nothing_to_draw())[:2]
    to_learn = (
        np.zeros(2, np.int64), rays, states, sampling, table, surface_layers(network), look, *_shader_layers(shader), shining, lamps,
        far_light, view, measured, gain, opacities, eikonal, first, second, store.arrays, kept.arrays, taps.arrays, weights.arrays,
        scratch.arrays, out.arrays, samples, squared, mirrored, g_mirrored, g_gain,
    )  # fmt: skip
    sums, done = np.zeros(2), np.zeros(1 + table.active + look.active, np.int64)

    def to_finish() -> tuple[Any, ...]:
        learned = (*step.network[:2], *step.shader, *(step.light[:6] if len(used) else no_light("cpu")[:6]), step.far_light)
        gradients = WeightGradients(*(gradient_of(x).numpy() for x in learned))
        of_levels: dict[int, tuple[Any, int]] = {
            step.grid.table.data_ptr(): (table.offsets[: table.active + 1], 1),
            step.appearance.table.data_ptr(): (look.offsets[: look.active + 1], 1 + table.active),
        }
        return (
            np.zeros(1, np.int64), done, count, points, table, look, kept.arrays, taps.arrays, weights.arrays, out.arrays, columns, used,
            lamps.spectrum, gradient_of(step.grid.table).numpy(), gradient_of(step.appearance.table).numpy(), gradients, sums,
            *places_and_numbers(update() if update is not None else (), of_levels),
        )  # fmt: skip

    finish = take_beside(to_finish, threads, learning.learn_rays, to_learn)
    loss = sums[0] = out.arrays.loss[:tasks].sum()
    if len(gain):
        by_frame = np.bincount(gains.frame, g_gain, len(of_frames)) * of_frames
        of_gains = by_frame - by_frame.mean()
        gradient_of(step.gains.log_gain).numpy()[...] += of_gains.astype(np.float32)
        sums[1] = of_gains.sum()

    def to_tell() -> Learned:
        found = (torch.from_numpy(np.array(x, kind)) for x, kind in ((loss, np.float32), (samples.sum(), np.int64)))
        result = Learned(next(found), torch.from_numpy(sums)[1], torch.from_numpy(squared), next(found), tuple(x.drawn for x in ahead))
        if meanwhile is not None:
            meanwhile(result)
        return result

    return take_beside(to_tell, threads, learning.finish, finish)
