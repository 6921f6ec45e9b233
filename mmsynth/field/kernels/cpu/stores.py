"""Arrays that a forward pass leaves for its backward pass, by slot: a chunk's or block's own, or a thread's scratch."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from mmsynth.field.kernels.constants import FEATURES, MAX_SAMPLES_PER_RAY
from mmsynth.field.kernels.cpu import shading
from mmsynth.field.kernels.cpu.marching import CHUNK
from mmsynth.field.kernels.cpu.surface import POINTS
from mmsynth.field.kernels.parameters import ShaderWeights

S = TypeVar("S", bound=tuple[Any, ...])
_POOLED = 6
_pool: list[tuple[Any, Any]] = []


class SurfaceStore(NamedTuple):
    """Of positions: block, hidden (see ``blocks``), row (scratch), and the weights' gradients."""

    block: np.ndarray
    hidden: np.ndarray
    row: np.ndarray
    hidden_out: np.ndarray
    output_out: np.ndarray


class RayStore(NamedTuple):
    """Of rays. Per sample, in the order of the blocks: block, hidden, sdf, ray_of, time_of. Per ray and number of the sample
    (i * MAX_SAMPLES_PER_RAY + k): t_of, f_of (distance), p_of (softplus of -s f), id_of (place in the order of the blocks); counts: samples
    of each ray; second: the sample at which its second surface begins; rounds, sizes: number and lengths of the blocks. Sections that
    matter: s_block (position and features), s_ray, s_k (its first sample), s_time, s_weight, s_count. row: scratch; the
    weights' gradients."""

    block: np.ndarray
    hidden: np.ndarray
    sdf: np.ndarray
    ray_of: np.ndarray
    time_of: np.ndarray
    t_of: np.ndarray
    f_of: np.ndarray
    p_of: np.ndarray
    id_of: np.ndarray
    counts: np.ndarray
    second: np.ndarray
    rounds: np.ndarray
    sizes: np.ndarray
    s_block: np.ndarray
    s_ray: np.ndarray
    s_k: np.ndarray
    s_time: np.ndarray
    s_weight: np.ndarray
    s_count: np.ndarray
    row: np.ndarray
    hidden_out: np.ndarray
    output_out: np.ndarray


class ShadingStore(NamedTuple):
    """Of shaded rays: scratch x (what goes into the shader), h1, h2 (its hidden layers), g1, g2 (their gradients); gradients of weights."""

    x: np.ndarray
    h1: np.ndarray
    h2: np.ndarray
    g1: np.ndarray
    g2: np.ndarray
    first_out: np.ndarray
    first_bias_out: np.ndarray
    second_out: np.ndarray
    second_bias_out: np.ndarray
    heads_out: np.ndarray
    heads_bias_out: np.ndarray


Sizes = dict[str, tuple[type, tuple[int, ...]]]  # by name: dtype and shape of one slot


class Store(Generic[S]):
    """Arrays of one forward pass, taken from a pool and given back when its autograd node dies: fresh pages are slow."""

    arrays: S

    def __init__(self, slots: int, kind: Callable[..., S], sizes: Sizes) -> None:
        self.key = kind, tuple(sizes.items())
        for index, (key, arrays) in enumerate(_pool):
            if key == self.key and len(arrays[0]) >= slots:
                self.arrays = _pool.pop(index)[1]
                return
        slots = 1 << max(slots - 1, 3).bit_length()
        _pool[:] = [(key, arrays) for key, arrays in _pool if key != self.key]  # too few slots, and needs grow
        self.arrays = kind(**{name: np.empty((slots, *shape), dtype) for name, (dtype, shape) in sizes.items()})

    def __del__(self) -> None:
        if len(_pool) < _POOLED and hasattr(self, "arrays"):  # none where memory lacked for them
            _pool.append((self.key, self.arrays))


def surface_store(slots: int, units: int, width: int) -> Store[SurfaceStore]:
    """Of a hidden layer of ``units`` times ``width`` weights."""
    sizes: Sizes = {"block": (np.float32, (width * POINTS,)), "hidden": (np.float32, (units * POINTS,)), **_network(units, width)}
    return Store(slots, SurfaceStore, sizes)


def ray_store(slots: int, units: int, width: int, appearance_levels: int) -> Store[RayStore]:
    """The same, of rays with an appearance."""
    f, i, d = np.float32, np.int32, np.float64
    most = CHUNK * MAX_SAMPLES_PER_RAY
    lengths: dict[str, tuple[type, int]] = {
        "block": (f, width * most), "hidden": (f, units * most), "sdf": (f, most), "ray_of": (i, most), "time_of": (f, most),
        "t_of": (f, most), "f_of": (f, most), "p_of": (d, most), "id_of": (i, most),
        "counts": (i, CHUNK), "second": (i, CHUNK), "rounds": (i, 1), "sizes": (i, most),
        "s_block": (f, (3 + FEATURES * appearance_levels) * most), "s_ray": (i, most), "s_k": (i, most), "s_time": (f, most),
        "s_weight": (f, most), "s_count": (i, 1),
    }  # fmt: skip
    return Store(slots, RayStore, {**{name: (dtype, (n,)) for name, (dtype, n) in lengths.items()}, **_network(units, width)})


def _network(units: int, width: int) -> Sizes:
    return {"row": (np.float32, (POINTS,)), "hidden_out": (np.float32, (units, width)), "output_out": (np.float32, (units + 1,))}


def shading_store(slots: int, weights: ShaderWeights) -> Store[ShadingStore]:
    """Matrices have whole tiles."""
    rows, columns = (-(-n // shading.TILE_COLS) * shading.TILE_COLS for n in weights.first.shape)
    most = 2 * shading.CHUNK  # surfaces, of which a ray meets two at the most
    block, heads = (most, rows), weights.heads.shape
    shapes = {
        "x": (most, columns), "h1": block, "h2": block, "g1": block, "g2": block,
        "first_out": (rows, columns), "first_bias_out": (rows,), "second_out": (rows, rows), "second_bias_out": (rows,),
        "heads_out": tuple(heads), "heads_bias_out": (heads[0],),
    }  # fmt: skip
    return Store(slots, ShadingStore, {name: (np.float32, shape) for name, shape in shapes.items()})
