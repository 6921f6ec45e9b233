"""The operations for the CPU: what numba compiled, behind torch's autograd.

Tables are the largest tensors of a field and few of their rows are met in one step, so their gradients are *added to*
``table.grad`` in place and not returned to autograd: a dense gradient per call would cost more than the call. Everything else
follows autograd's rules.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numba import get_num_threads, njit, prange
from torch import Tensor

from mmsynth.field.kernels.cpu import rays as cpu_rays
from mmsynth.field.kernels.cpu import shading as cpu_shading
from mmsynth.field.kernels.cpu.blocks import FEATURES
from mmsynth.field.kernels.cpu.rays import CHUNK, MOST, POINTS

if TYPE_CHECKING:
    from mmsynth.field.encoding import HashGrid
    from mmsynth.field.radiance import Shader
    from mmsynth.field.rendering import Sampling
    from mmsynth.field.surface import Surface

PART = 16384  # parameters that Adam takes at a time
_pool: list[tuple[tuple[int, ...], dict[str, np.ndarray]]] = []


class _Store:
    """Arrays of one forward pass, taken from a pool and given back when its autograd node dies: fresh pages are slow."""

    def __init__(self, slots: int, sizes: dict[str, tuple[type, int]]) -> None:
        key = tuple(size for _, size in sizes.values())
        for index, (other, arrays) in enumerate(_pool):
            if other == key and len(next(iter(arrays.values()))) >= slots:
                self.key, self.arrays = key, _pool.pop(index)[1]
                return
        slots = 1 << max(slots - 1, 3).bit_length()
        _pool[:] = [(other, arrays) for other, arrays in _pool if other != key]  # too few slots, and needs grow
        self.key, self.arrays = key, {name: np.empty((slots, size), dtype) for name, (dtype, size) in sizes.items()}

    def take(self, names: str) -> list[np.ndarray]:
        return [self.arrays[n] for n in names.split()]

    def __del__(self) -> None:
        if len(_pool) < 6:
            _pool.append((self.key, self.arrays))


def _network(weight: Tensor) -> dict[str, tuple[type, int]]:
    units, width = weight.shape
    return {"row": (np.float32, POINTS), "weight_out": (np.float32, units * width), "last_out": (np.float32, units + 1)}


def _ray_stores(weight: Tensor, appearance_levels: int) -> dict[str, tuple[type, int]]:
    units, width = weight.shape
    most = CHUNK * MOST
    f, i, d = np.float32, np.int32, np.float64
    samples = {"block": (f, width * most), "hidden": (f, units * most), "sdf": (f, most), "ray_of": (i, most), "time_of": (f, most)}
    rays = {"t_of": (f, most), "f_of": (f, most), "p_of": (d, most), "id_of": (i, most), "counts": (i, CHUNK)}
    sections = {"s_block": (f, (3 + FEATURES * appearance_levels) * most), "s_weight": (f, most), "s_time": (f, most)}
    return {
        **samples, **rays, **sections, "rounds": (i, 1), "sizes": (i, most), "s_ray": (i, most), "s_k": (i, most), "s_count": (i, 1),
        **_network(weight),
    }  # fmt: skip


def _shading_stores(weights: tuple[Tensor, ...]) -> dict[str, tuple[type, int]]:
    hidden, inputs = weights[0].shape
    rows, columns = (-(-n // cpu_shading.WIDE) * cpu_shading.WIDE for n in (hidden, inputs))
    block = rows * cpu_shading.CHUNK
    scratch = {"x": columns * cpu_shading.CHUNK, "h1": block, "h2": block, "g1": block, "g2": block}
    sums = {"first_out": rows * columns, "first_bias_out": rows, "second_out": rows * rows, "second_bias_out": rows}
    heads = {"heads_out": weights[4].numel(), "heads_bias_out": len(weights[4])}
    return {name: (np.float32, size) for name, size in {**scratch, **sums, **heads}.items()}


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()


def _table_gradient(table: Tensor) -> np.ndarray:
    if table.grad is None:
        table.grad = torch.zeros_like(table)
    return table.grad.numpy()


def _grid(grid: HashGrid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return _array(grid.table), grid.resolutions.numpy(), grid.offsets.numpy()


class _Value(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, keep: bool, positions: Tensor, surface: Surface, active: int, weight: Tensor, last: Tensor) -> Tensor:
        count = len(positions)
        chunks = -(-count // POINTS)
        units, width = weight.shape
        sizes = {"block": (np.float32, width * POINTS), "hidden": (np.float32, units * POINTS), **_network(weight)}
        store = _Store(chunks if keep else get_num_threads(), sizes)
        out = torch.empty(count)
        cpu_rays.surface_forward(
            _array(positions), np.float32(surface.grid.extent), surface.spheres, *_grid(surface.grid), active,
            _array(weight), _array(last), keep, *store.take("block hidden"), out.numpy(),
        )  # fmt: skip
        if keep:
            ctx.store, ctx.surface, ctx.active = store, surface, active
            ctx.save_for_backward(weight, last)
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        weight, last = ctx.saved_tensors
        store, surface, count = ctx.store, ctx.surface, len(gradient)
        chunks = -(-count // POINTS)
        extent, grid = np.float32(surface.grid.extent), _grid(surface.grid)
        weight_out, last_out = store.take("weight_out last_out")
        weight_out = weight_out.reshape(len(weight_out), *weight.shape)
        g, w = _array(gradient), _array(weight)
        cpu_rays.surface_backward(g, ctx.active, w, _array(last), *store.take("block hidden row"), weight_out, last_out)
        positions = None
        if ctx.needs_input_grad[1]:
            positions = torch.empty(count, 3)
            cpu_rays.surface_positions(g, extent, surface.spheres, *grid, ctx.active, w, *store.take("block hidden"), positions.numpy())
        if surface.grid.table.requires_grad:
            cpu_rays.surface_scatter(count, extent, *grid[1:], ctx.active, *store.take("block"), _table_gradient(surface.grid.table))
        ctx.store = None
        weights = torch.from_numpy(weight_out[:chunks].sum(0)), torch.from_numpy(last_out[:chunks].sum(0))
        return None, positions, None, None, *weights


class _Trace(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, keep: bool, origins: Tensor, directions: Tensor, near: Tensor, far: Tensor, jitter: Tensor, states: Tensor,
        sampling: Sampling, surface: Surface, appearance: HashGrid, weight: Tensor, last: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
        count = len(origins)
        chunks = -(-count // CHUNK)
        store = _Store(chunks if keep else get_num_threads(), _ray_stores(weight, len(appearance.resolutions)))
        features = torch.empty(count, appearance.width)
        opacity, shown, depth = torch.empty(count), torch.empty(count), torch.empty(count)
        samples = torch.zeros(max(chunks, 1), dtype=torch.int64)
        s, f = sampling, np.float32
        names = "block hidden sdf ray_of time_of t_of f_of p_of id_of counts rounds sizes s_block s_ray s_k s_time s_weight s_count"
        cpu_rays.trace_forward(
            *(_array(x) for x in (origins, directions, near, far, jitter, states)), f(surface.grid.extent), surface.grid.extent > 1.0,
            float(s.sharpness), f(s.step), f(s.sphere_step_factor), f(s.min_slope), f(s.min_section_weight), float(s.max_optical_depth),
            surface.spheres, *_grid(surface.grid), s.active_surface, _array(weight), _array(last), *_grid(appearance), s.active_radiance,
            keep, *store.take(names), features.numpy(), opacity.numpy(), shown.numpy(), depth.numpy(), samples.numpy(),
        )  # fmt: skip
        if keep:
            ctx.store, ctx.parts = store, (surface, appearance, sampling)
            ctx.save_for_backward(weight, last, origins, directions, features, shown)
        ctx.mark_non_differentiable(depth, samples)
        return features, opacity, depth, samples.sum()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, g_features: Tensor, g_opacity: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
        weight, last, origins, directions, features, shown = ctx.saved_tensors
        (surface, appearance, s), store, count = ctx.parts, ctx.store, len(features)
        chunks = -(-count // CHUNK)
        extent, grid, look = np.float32(surface.grid.extent), _grid(surface.grid), _grid(appearance)
        weight_out, last_out = store.take("weight_out last_out")
        weight_out = weight_out.reshape(len(weight_out), *weight.shape)
        cpu_rays.trace_backward(
            count, _array(g_features), _array(g_opacity), _array(features), _array(shown), float(s.sharpness),
            s.active_surface, _array(weight), _array(last), s.active_radiance,
            *store.take("block hidden sdf p_of id_of counts rounds sizes s_block s_ray s_k s_weight s_count row"), weight_out, last_out,
        )  # fmt: skip
        rays: list[Tensor | None] = [None, None]
        if ctx.needs_input_grad[1] or ctx.needs_input_grad[2]:
            rays = [torch.empty_like(origins), torch.empty_like(directions)]
            cpu_rays.trace_rays_backward(
                _array(origins), _array(directions), extent, extent > 1.0, surface.spheres, *grid, s.active_surface, _array(weight),
                *look, s.active_radiance,
                *store.take("block hidden sdf ray_of time_of rounds sizes s_block s_ray s_time s_count"),
                *(_array(r) for r in rays if r is not None),
            )  # fmt: skip
        if surface.grid.table.requires_grad or appearance.table.requires_grad:
            cpu_rays.trace_scatter(
                count, extent, *grid[1:], s.active_surface, *store.take("block rounds sizes"), _table_gradient(surface.grid.table),
                *look[1:], s.active_radiance, *store.take("s_block s_count"), _table_gradient(appearance.table),
            )  # fmt: skip
        ctx.store = None
        weights = torch.from_numpy(weight_out[:chunks].sum(0)), torch.from_numpy(last_out[:chunks].sum(0))
        return None, *rays, *[None] * 7, *weights


class _Compare(torch.autograd.Function):
    """The gradients of a number are known when it is: the forward pass takes them all, the backward pass only scales them."""

    @staticmethod
    def forward(
        ctx: Any, learn: bool, rays: tuple[Tensor, ...], numbers: tuple[Tensor, ...], features: Tensor, opacity: Tensor, gain: Tensor,
        *weights: Tensor,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        chunks = -(-len(features) // cpu_shading.CHUNK)
        store = _Store(max(chunks, get_num_threads()), _shading_stores(weights))
        scratch = [x.reshape(len(x), cpu_shading.CHUNK, -1) for x in store.take("x h1 h2 g1 g2")]
        sums = store.take("first_out first_bias_out second_out second_bias_out heads_out heads_bias_out")
        for i in (0, 2, 4):
            sums[i] = sums[i].reshape(len(sums[i]), sums[i + 1].shape[1], -1)
        loss, squared = np.zeros(chunks), torch.empty(len(numbers[0]))
        gradients = [torch.empty(x.shape) for x in (features, opacity, gain)]
        cpu_shading.compare(
            *(_array(x) for x in (features, opacity, *rays, *numbers, gain, *weights)), learn, *scratch,
            loss, squared.numpy(), *(g.numpy() for g in gradients), *sums,
        )  # fmt: skip
        if learn:
            for total, weight in zip(sums, weights, strict=True):
                whole = total[:chunks].sum(0)
                gradients.append(torch.from_numpy(whole[tuple(slice(n) for n in weight.shape)]))
            ctx.gradients = gradients
        ctx.mark_non_differentiable(squared)
        return torch.tensor(loss.sum(), dtype=torch.float32), squared

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        return None, None, None, *(gradient * g for g in ctx.gradients)


def _kept(*tensors: Tensor) -> bool:
    """Whether a backward pass may follow; within ``forward`` autograd does not tell."""
    return torch.is_grad_enabled() and any(t.requires_grad for t in tensors)


def surface_value(surface: Surface, positions: Tensor, active: int) -> Tensor:
    """See ``Surface.forward``; float32. Differentiable in positions, weights, and, in place, the table."""
    active = min(active, len(surface.grid.resolutions))
    return _Value.apply(_kept(positions, surface.hidden), positions, surface, active, surface.hidden, surface.output_weight)


def trace(
    surface: Surface, appearance: HashGrid, states: Tensor, origins: Tensor, directions: Tensor, near: Tensor, far: Tensor,
    jitter: Tensor, sampling: Sampling,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """See ``rendering.trace``; float32. Differentiable in origins, directions, weights, and, in place, the tables."""
    active = min(sampling.active_surface, len(surface.grid.resolutions)), min(sampling.active_radiance, len(appearance.resolutions))
    sampling = replace(sampling, active_surface=active[0], active_radiance=active[1])
    keep = _kept(origins, directions, surface.hidden)
    return _Trace.apply(
        keep, origins, directions, near, far, jitter, states, sampling, surface, appearance, surface.hidden, surface.output_weight
    )


def compare(
    shader: Shader, features: Tensor, opacity: Tensor, rays: tuple[Tensor, ...], numbers: tuple[Tensor, ...], gain: Tensor | None
) -> tuple[Tensor, Tensor]:
    """See ``losses.compare``; float32. Differentiable in features, opacity, gain and the shader's weights.

    Args:
        rays: directions, degrees, teaches. numbers: target, ray (which never decreases), output, axes, level, saturation, weight.
    """
    weights = tuple(shader.parameters())  # and biases: of the two layers of the trunk, of the heads
    gain = features.new_empty(0) if gain is None else gain
    return _Compare.apply(_kept(features, opacity, gain, *weights), rays, numbers, features, opacity, gain, *weights)


def shade(shader: Shader, features: Tensor, directions: Tensor, degree: int) -> Tensor:
    """See ``Shader.forward``; float32, without a gradient."""
    weights = tuple(shader.parameters())
    outputs = torch.empty(len(features), len(weights[5]))
    cpu_shading.shade(_array(features), _array(directions), degree, *map(_array, weights), outputs.numpy())
    return outputs


@njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def _adam_part(p, g, m, v, rate, beta1, beta2, root, epsilon):  # type: ignore[no-untyped-def]
    one, zero = np.float32(1.0), np.float32(0.0)
    for i in range(p.shape[0]):
        a = beta1 * m[i] + (one - beta1) * g[i]
        b = beta2 * v[i] + (one - beta2) * g[i] * g[i]
        m[i] = a
        v[i] = b
        p[i] -= rate * a / (np.float32(math.sqrt(b)) * root + epsilon)
        g[i] = zero


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def _adam(p, g, m, v, rate, beta1, beta2, root, epsilon):  # type: ignore[no-untyped-def]
    """``rate`` includes the first bias correction, ``root`` is one over the square root of the second."""
    count = p.shape[0]
    for chunk in prange((count + PART - 1) // PART):
        begin = np.int64(chunk) * PART
        end = min(count, begin + PART)
        _adam_part(p[begin:end], g[begin:end], m[begin:end], v[begin:end], rate, beta1, beta2, root, epsilon)


def adam(
    parameter: Tensor, gradient: Tensor, first: Tensor, second: Tensor, rate: float, beta1: float, beta2: float, epsilon: float, count: int
) -> None:
    """See ``reference.adam``; float32."""
    arrays = (x.detach().view(-1).numpy() for x in (parameter, gradient, first, second))
    f = np.float32
    step = _adam if parameter.numel() > PART else _adam_part  # to wake the other threads would take longer than the work
    step(*arrays, f(rate / (1 - beta1**count)), f(beta1), f(beta2), f(1 / math.sqrt(1 - beta2**count)), f(epsilon))  # type: ignore[call-arg]


_KERNELS = (
    cpu_rays.surface_forward, cpu_rays.surface_backward, cpu_rays.surface_scatter, cpu_rays.trace_forward, cpu_rays.trace_backward,
    cpu_rays.trace_scatter, cpu_shading.compare, cpu_shading.shade, _adam, _adam_part,
)  # fmt: skip


def is_compiled() -> bool:
    """Whether every kernel of a fit has code for its usual types, in this process or in the cache on disk."""
    return all(k.signatures or _cached(k) for k in _KERNELS)


def _cached(kernel: Any) -> bool:
    # numba writes one index file per function and source version; it is missing exactly when the kernel was never compiled
    cache = kernel._cache._cache_file
    return bool(cache.load_index() if hasattr(cache, "load_index") else cache._load_index())
