"""Arrays that a forward pass leaves for its backward pass, by slot: a chunk's or block's own, or a thread's scratch."""

from __future__ import annotations

import functools
import itertools
import threading
from collections.abc import Callable
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from mmsynth.field.kernels.constants import FEATURES, FIRST_FEATURE_ROW
from mmsynth.field.kernels.cpu import shading
from mmsynth.field.kernels.cpu.learning import TableStore
from mmsynth.field.kernels.cpu.marching import CAPACITY, CHUNK
from mmsynth.field.kernels.cpu.matrices import TILE_COLS, TILE_ROWS, whole
from mmsynth.field.kernels.cpu.mirrors import ChunkScratch, LightOut
from mmsynth.field.kernels.cpu.slopes import MOST_PAIRED, MOST_TAPPED, TapStore
from mmsynth.field.kernels.cpu.surface import POINTS
from mmsynth.field.kernels.cpu.units import GATES
from mmsynth.field.kernels.parameters import ShaderWeights

S = TypeVar("S", bound=tuple[Any, ...])
_SPARE = 4  # times the slots that are needed: larger arrays are for others
_IDLE = 100  # stores that were asked for since: what was not used again is let go
_TAPS = 4 * (MOST_TAPPED + MOST_PAIRED) + TILE_ROWS  # rows of the points of a chunk
_pool: list[tuple[Any, Any, int]] = []  # of each, when it was given back
_asked = itertools.count()
_changing = threading.RLock()  # of the pool. A thread that holds it may find garbage to give back


class SurfaceStore(NamedTuple):
    """Of positions: block, gates, and what the weights' gradients follow from (see ``blocks``)."""

    block: np.ndarray
    gates: np.ndarray
    pulled_out: np.ndarray
    bias_out: np.ndarray


class RayStore(NamedTuple):
    """Of rays. Per sample, in the order of the blocks: block, gates, sdf, ray_of, time_of. Per ray and number of the sample
    (i * MAX_SAMPLES_PER_RAY + k): t_of, f_of (distance), p_of (softplus of -s f), q_of (minus its slope over s), opacity_of (of the
    section that begins there), id_of (place in the order of the blocks); counts: samples of each ray; second: the sample at which its
    second surface begins; samples: of all. Sections that matter: s_block (a block, too), s_ray, s_k (its first sample), s_time, s_weight,
    s_count. What the weights' gradients follow from."""

    block: np.ndarray
    gates: np.ndarray
    sdf: np.ndarray
    ray_of: np.ndarray
    time_of: np.ndarray
    t_of: np.ndarray
    f_of: np.ndarray
    p_of: np.ndarray
    q_of: np.ndarray
    opacity_of: np.ndarray
    id_of: np.ndarray
    counts: np.ndarray
    second: np.ndarray
    samples: np.ndarray
    s_block: np.ndarray
    s_ray: np.ndarray
    s_k: np.ndarray
    s_time: np.ndarray
    s_weight: np.ndarray
    s_count: np.ndarray
    pulled_out: np.ndarray
    bias_out: np.ndarray


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
Key = tuple[tuple[str, tuple[type, tuple[int, ...]]], ...]  # the same, as what is looked for


class Store(Generic[S]):
    """Arrays of one forward pass, taken from a pool and given back when its autograd node dies: fresh pages are slow."""

    arrays: S

    def __init__(self, slots: int, kind: Callable[..., S], sizes: Key) -> None:
        self.key, now = (kind, sizes), next(_asked)
        slots = 1 << max(slots - 1, 3).bit_length()
        with _changing:
            _pool[:] = [entry for entry in _pool if now - entry[2] <= _IDLE]
            for index in reversed(range(len(_pool))):  # what was used last is used again: others grow idle
                key, arrays, _ = _pool[index]
                if key == self.key and slots <= len(arrays[0]) <= _SPARE * slots:
                    self.arrays = _pool.pop(index)[1]
                    break
            else:
                # smaller ones that the new one stands in for are let go before it is made
                _pool[:] = [e for e in _pool if not (e[0] == self.key and len(e[1][0]) < slots <= _SPARE * len(e[1][0]))]
                self.arrays = kind(**{name: np.empty((slots, *shape), dtype) for name, (dtype, shape) in sizes})
        self.now = now

    def __del__(self) -> None:
        if hasattr(self, "now"):  # none where memory lacked for arrays
            with _changing:
                _pool.append((self.key, self.arrays, self.now))


def _tiles(count: int) -> int:
    return whole.py_func(count, TILE_COLS)


def _network(rows: int, units: int, levels: int) -> Sizes:
    """Rows of blocks of so many levels, gates of hidden units, and what the weights' gradients follow from."""
    f, width, units = np.float32, FIRST_FEATURE_ROW + _tiles(FEATURES * levels), _tiles(units)
    gates = np.uint16, (rows, units // GATES)
    return {"block": (f, (rows, width)), "gates": gates, "pulled_out": (f, (width, units)), "bias_out": (f, (1,))}


def surface_store(slots: int, units: int, levels: int) -> Store[SurfaceStore]:
    """Of a surface of so many hidden units and levels."""
    return Store(slots, SurfaceStore, _surface_sizes(units, levels))


@functools.cache
def _surface_sizes(units: int, levels: int) -> Key:
    return tuple(_network(POINTS, units, levels).items())


def ray_store(slots: int, units: int, levels: int, appearance_levels: int) -> Store[RayStore]:
    """The same, of rays with an appearance."""
    return Store(slots, RayStore, _ray_sizes(units, levels, appearance_levels))


@functools.cache
def _ray_sizes(units: int, levels: int, appearance_levels: int) -> Key:
    f, i, d, most = np.float32, np.int32, np.float64, CAPACITY
    lengths: dict[str, tuple[type, int]] = {
        "sdf": (f, most), "ray_of": (i, most), "time_of": (f, most), "t_of": (f, most), "f_of": (f, most), "p_of": (d, most), "q_of": (d,
        most), "opacity_of": (d, most),
        "id_of": (i, most), "counts": (i, CHUNK), "second": (i, CHUNK), "samples": (i, 1), "s_ray": (i, most), "s_k": (i, most),
        "s_time": (f, most), "s_weight": (f, most), "s_count": (i, 1),
    }  # fmt: skip
    sizes: Sizes = {name: (dtype, (n,)) for name, (dtype, n) in lengths.items()}
    sizes["s_block"] = f, (most, FIRST_FEATURE_ROW + FEATURES * appearance_levels)
    return tuple((sizes | _network(most, units, levels)).items())


def shading_store(slots: int, weights: ShaderWeights) -> Store[ShadingStore]:
    """Matrices have whole tiles."""
    return Store(slots, ShadingStore, _shading_sizes(*weights.first.shape, *weights.heads.shape))


@functools.cache
def _shading_sizes(units: int, inputs: int, outputs: int, width: int) -> Key:
    rows, columns = _tiles(units), _tiles(inputs)
    most = 2 * shading.CHUNK  # surfaces, of which a ray meets two at the most
    block = most, rows
    shapes = {
        "x": (most, columns), "h1": block, "h2": block, "g1": block, "g2": block,
        "first_out": (rows, columns), "first_bias_out": (rows,), "second_out": (rows, rows), "second_bias_out": (rows,),
        "heads_out": (outputs, width), "heads_bias_out": (outputs,),
    }  # fmt: skip
    return tuple((name, (np.float32, shape)) for name, shape in shapes.items())


def tap_store(slots: int, units: int, levels: int) -> Store[TapStore]:
    """Of points at which a surface of so many hidden units and levels is asked for its gradient."""
    return Store(slots, TapStore, _tap_sizes(units, levels))


@functools.cache
def _tap_sizes(units: int, levels: int) -> Key:
    sizes = _network(_TAPS, units, levels)
    del sizes["gates"]
    return tuple({"used": (np.int64, (1,)), **sizes}.items())


def table_store(slots: int, units: int, levels: int, appearance_levels: int) -> Store[TableStore]:
    """Of the samples and sections of rays, of such a surface and an appearance of so many levels."""
    return Store(slots, TableStore, _table_sizes(units, levels, appearance_levels))


@functools.cache
def _table_sizes(units: int, levels: int, appearance_levels: int) -> Key:
    sizes = _network(CAPACITY, units, levels)
    del sizes["gates"]
    sizes["s_block"] = np.float32, (CAPACITY, FIRST_FEATURE_ROW + FEATURES * appearance_levels)
    return tuple({"samples": (np.int64, (1,)), "sections": (np.int64, (1,)), **sizes}.items())


def chunk_scratch(slots: int, units: int, features: int, materials: int, hidden: int) -> Store[ChunkScratch]:
    """Of a surface of so many hidden units, rays with so many features, numbers of a material and hidden units of its network."""
    return Store(slots, ChunkScratch, _scratch_sizes(units, features, materials, hidden))


@functools.cache
def _scratch_sizes(units: int, features: int, materials: int, hidden: int) -> Key:
    f = np.float32
    rows, columns = 2 * CHUNK, (2, CHUNK)
    three, some = (f, (rows, 3)), 2 * shading.CHUNK
    sizes: Sizes = {
        "gates": (np.uint16, (_TAPS, _tiles(units) // GATES)),
        "features": (f, (*columns, features)), "weight": (f, columns), "distance": (f, columns), "shown": (f, columns), "depth": (f,
        (CHUNK,)),
        "behind": (np.int64, (CHUNK,)), "mixed": (f, (rows, features)), "mixed_share": (f, (rows,)), "g_features": (f, (rows, features)),
        "g_share": (f, (rows,)), "material": (f, (rows, materials)), "normals": three, "points": three, "directions": three,
        "g_material": (f, (rows, materials)), "g_normals": three, "mirror_share": (f, (rows,)), "g_mirror_share": (f, (rows,)),
        "at": three, "found": three, "row_of": (np.int64, (rows,)), "shallow": (f, (rows,)),
        "x": (f, (some, _tiles(features))), "h": (f, (some, _tiles(hidden))), "y": (f, (some, _tiles(materials))),
        "gy": (f, (some, _tiles(materials))), "gh": (f, (some, _tiles(hidden))),
    }  # fmt: skip
    return tuple(sizes.items())


def light_out(slots: int, features: int, materials: int, hidden: int, lamps: int, outputs: int) -> Store[LightOut]:
    """Of chunks of such rays, K lamps and the shader's outputs."""
    return Store(slots, LightOut, _light_sizes(features, materials, hidden, lamps, outputs))


@functools.cache
def _light_sizes(features: int, materials: int, hidden: int, lamps: int, outputs: int) -> Key:
    f = np.float32
    sizes: Sizes = {
        "first": (f, (_tiles(hidden), _tiles(features))), "first_bias": (f, (_tiles(hidden),)), "second": (f, (_tiles(materials),
        _tiles(hidden))),
        "second_bias": (f, (materials,)), "position": (f, (lamps, 3)), "spectrum": (f, (lamps, outputs)), "far": (f, (features,)),
        "loss": (np.float64, ()),
    }  # fmt: skip
    return tuple(sizes.items())
