"""What a GPU would bind a fit on, on paper: bytes, operations and atomic additions of every kernel of a step, and the time that each of a
GPU's limits asks for them (Williams et al. 2009, "Roofline").

Counts follow from the kernels as they are written, for a field and rays of given sizes; limits are the makers' or, where those give none,
of published microbenchmarks, and are said beside the figures. Kernels run one after the other: a step takes at least the sum of what the
slowest limit of each asks. What is not here is latency: a step that takes several times as long waits for something.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

from mmsynth.bench.tables import Column, Table

_FLOAT, _ROW, _SECTOR = 4, 16, 32  # bytes: a number, a row of a table, what the L2 cache moves at once
_CORNERS, _FEATURES = 8, 4


@dataclass(frozen=True)
class Gpu:
    """Limits: memory, cache [byte/s], float32 and TF32 on tensor cores [operation/s], atomic additions of 16 bytes at most [1/s], seconds
    between two kernels of a graph."""

    name: str
    memory: float
    cache: float
    float32: float
    tensor: float
    atomics: float
    launch: float = 1.5e-6


# memory, float32, tensor: NVIDIA's data sheets (SXM, dense). Cache: about 5.5 TB/s as microbenchmarks of H100 find. Atomics: one sector a
# cycle in each of 80 slices of the L2 cache at 1.7 GHz, an assumption.
GPUS = (
    Gpu("H100", 3.35e12, 5.5e12, 67e12, 494e12, 1.36e11),
    Gpu("H200", 4.8e12, 5.5e12, 67e12, 494e12, 1.36e11),
)


@dataclass(frozen=True)
class Sizes:
    """Of a step and its field; by default those of the bench scene late in a fit: 10 samples a ray, 2 sections of it looked up, every tenth
    ray meets a second surface; numbers: measured along a ray."""

    samples: int = 1 << 18
    samples_per_ray: float = 10.0
    sections_per_ray: float = 2.0
    surfaces_per_ray: float = 1.1
    numbers_per_ray: float = 1.0
    surface_levels: int = 5
    radiance_levels: int = 6
    surface_units: int = 32
    shader_units: int = 64
    outputs: int = 21
    lamps: int = 3
    points: int = 256
    table_numbers: float = 4.0 * (5 * 2**16 + 6 * 2**17)

    @property
    def rays(self) -> float:
        return self.samples / self.samples_per_ray


class Work(NamedTuple):
    """Of a kernel in a step: bytes of memory and cache, operations in float32 and on tensor cores, atomic additions of 16 bytes at most."""

    kernel: str
    memory: float = 0.0
    cache: float = 0.0
    float32: float = 0.0
    tensor: float = 0.0
    atomics: float = 0.0
    launches: int = 1

    def seconds(self, gpu: Gpu) -> dict[str, float]:
        """By limit."""
        return {
            "memory": self.memory / gpu.memory, "L2": self.cache / gpu.cache, "FP32": self.float32 / gpu.float32,
            "tensor": self.tensor / gpu.tensor, "atomics": self.atomics / gpu.atomics, "launches": self.launches * gpu.launch,
        }  # fmt: skip


def works(s: Sizes) -> list[Work]:
    """The kernels of a step in order. Tables, 17 MB by default, and partial sums stay in the L2 cache of 50 MB."""
    gather = _CORNERS * _SECTOR  # bytes of one level: the rows of a cell's corners lie in different sectors, at the worst
    interpolate = _CORNERS * (2 * _FEATURES + 3)  # operations of one level
    n, rays, rows = s.samples, s.rays, 2 * s.rays
    look, taps = s.sections_per_ray * rays, 4 * (s.points + s.surfaces_per_ray * rays)
    columns = 4 + _FEATURES * s.surface_levels
    network = 3 * 2 * s.surface_units * columns  # three products of 10 bits each
    encode = s.surface_levels * interpolate
    features = _FEATURES * s.radiance_levels
    shader = 3 * 2 * s.shader_units * (features + 16 + s.shader_units + 32)
    shader_weights = s.shader_units * (features + 16 + s.shader_units + s.outputs + 2) + s.outputs
    light = 3 * 2 * 32 * (features + 16)
    light_weights = 32 * (features + 12) + 11 * 33 + 6 * (3 + s.outputs)
    programs = rays / 32
    mirror = 120 * s.lamps * s.surfaces_per_ray * s.numbers_per_ray
    number = 9 * _FLOAT * s.numbers_per_ray  # bytes of what was measured
    sums = programs * (shader_weights + light_weights + features) * _FLOAT
    return [
        Work("draw, aim, points", rays * (300 + 2 * number), 16 * rays * 40, 400 * rays, launches=3),
        Work("march", n * 12, n * (s.surface_levels * gather + 40), n * (encode + 150), n * network),
        Work("weigh", n * 20 + rays * 40, 0, n * 120),
        Work("look", rows * features * _FLOAT, look * s.radiance_levels * gather, look * s.radiance_levels * interpolate),
        Work("places, ∇sdf, eikonal", taps * 16, taps * s.surface_levels * gather, taps * encode, taps * network, launches=3),
        Work("light, mirror", rows * (features + 11) * _FLOAT + rays * (number + 100), rays * 400, rays * mirror, rows * light, launches=2),
        Work("compare", rows * 2 * features * _FLOAT + rays * number + sums, programs * shader_weights * 8, rows * 400, rows * 3 * shader),
        Work("mirror, light: backward", rows * (3 * features + 22) * _FLOAT, rays * 400, 3 * rays * mirror, rows * 3 * light, launches=3),
        Work("sums of weights", sums, 0, sums / _FLOAT, launches=3),
        Work("look, backward", rows * features * _FLOAT, 2 * look * s.radiance_levels * gather, 2 * look * s.radiance_levels * interpolate,
             atomics=look * s.radiance_levels * _CORNERS),
        Work("weigh, backward", n * 40, 0, n * 150, launches=3),
        Work("surface, backward", n * 16, 2 * n * s.surface_levels * gather, 2 * n * encode, 3 * n * network,
             n * s.surface_levels * _CORNERS, 4),
        Work("∇sdf, backward", taps * 16, 2 * taps * s.surface_levels * gather, 2 * taps * encode, 3 * taps * network,
             taps * s.surface_levels * _CORNERS, 4),
        Work("check, Adam, tally", s.table_numbers * 8 + 0.5 * s.table_numbers * 24, 0, s.table_numbers * 12, launches=5),
    ]  # fmt: skip


def rows(sizes: Sizes | None = None, gpus: tuple[Gpu, ...] = GPUS) -> list[dict[str, Any]]:
    """A row for each kernel and one for the whole step, of each GPU: microseconds by limit, what binds, samples/s."""
    sizes = sizes or Sizes()
    out = []
    for gpu in gpus:
        least = 0.0
        for work in works(sizes):
            by_limit = work.seconds(gpu)
            binds = max(by_limit, key=lambda limit: by_limit[limit])
            least += by_limit[binds]
            out.append({"gpu": gpu.name, "kernel": work.kernel, "binds": binds, **{k: 1e6 * v for k, v in by_limit.items()}})
        out.append({"gpu": gpu.name, "kernel": "a step", "us": 1e6 * least, "samples_per_s": sizes.samples / least})
    return out


def roofline_table(sizes: Sizes | None = None) -> Table:
    """The table of ``rows``, with what would disprove it."""
    limits = ("memory", "L2", "FP32", "tensor", "atomics", "launches")
    columns = (
        Column("GPU", "gpu"), Column("Kernel", "kernel"), *(Column(f"{limit} [µs]", limit, ".1f") for limit in limits),
        Column("Binds", "binds"), Column("Sum of slowest [µs]", "us", ".0f"), Column("Samples/s", "samples_per_s", ",.0f"),
    )  # fmt: skip
    note = (
        "On paper. Disproved by a step that takes more than four times the sum (then it waits: occupancy, divergence of rays, dependent "
        "loads), by less than 80 % of the tables' reads found in L2, or by a kernel that another limit binds when it is measured."
    )
    return Table("Roofline of a step", columns, rows(sizes), note)
