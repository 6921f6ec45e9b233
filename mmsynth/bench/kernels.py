"""``mmsynth bench kernels``: nanoseconds per sample of every backend of every kernel, beside its error and the machine's limits.

Speeds are compared within one run, the backends taking turns, and each is the median of several repeats. Errors are against the torch
reference in float64 on the same inputs. To add a kernel, add an ``Operation`` to ``OPERATIONS``.


The operations, their inputs and how they are timed stand in one file, so that a figure can be read beside what was measured.
"""

from __future__ import annotations

import copy
import functools
import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor, nn

from mmsynth.bench.machine import measure, use_threads
from mmsynth.bench.output import Report, new_figure, write_report
from mmsynth.bench.tables import Column, Table
from mmsynth.field import kernels, rendering
from mmsynth.field.encoding import HashGrid
from mmsynth.field.kernels import Sampling, cpu, cuda, reference
from mmsynth.field.occupancy import Occupancy
from mmsynth.field.radiance import Shader
from mmsynth.field.surface import Surface
from mmsynth.field.warmup import warm_up
from mmsynth.operations.output.progress import Progress
from mmsynth.scene.scene import Sensor

REPEATS = 9
_PER_RAY = 8
_LEVELS = 4, 5  # of the surface and of the appearance
_SAMPLING = Sampling(sharpness=60.0, step=2 / 60, active_surface=_LEVELS[0], active_radiance=_LEVELS[1])
Inputs = dict[str, Any]
Outputs = tuple[Tensor, ...]
# (largest absolute difference, share of rays that cannot be compared) of an output and the float64 reference
Difference = tuple[float, float]


def _largest(output: Outputs, truth: Outputs) -> Difference:
    return (output[0].double() - truth[0]).abs().max().item(), 0.0


def _length(output: Outputs) -> int:
    return len(output[0])


@dataclass(frozen=True)
class Operation:
    """A kernel to time.

    Attributes:
        make: number of samples → inputs by name: float32 tensors and modules on the CPU, integers, numbers; the same in every call.
        calls: backend's name → its implementation, inputs → outputs. Those of "torch" in float64 are the truth; gradients are of the first.
        leaves: inputs → tensors that get a gradient; none: no backward pass.
        difference: output, float64 output → ``Difference``. count: output → the N of "per sample".
        traffic: inputs, N → bytes that a forward, and a forward and backward pass read and write; None: not countable.
    """

    name: str
    make: Callable[[int], Inputs]
    calls: Mapping[str, Callable[[Inputs], Outputs]]
    leaves: Callable[[Inputs], list[Tensor]] | None = None
    difference: Callable[[Outputs, Outputs], Difference] = _largest
    count: Callable[[Outputs], int] = _length
    traffic: Callable[[Inputs, int], tuple[float, float]] | None = None


def available_backends() -> dict[str, str]:
    """Names of those that run on this machine, and their devices; the first is the reference that the others are compared with."""
    found = {"torch": "cpu", "numba": "cpu"}
    if torch.cuda.is_available():
        found["torch cuda"] = "cuda"
        if cuda.available()[0]:
            found["triton"] = "cuda"
    return found


# ---------------------------------------------------------------------------------------------------------------- the operations


def _generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def _rays(samples: int) -> Inputs:
    """Rays from outside the unit ball towards its inside, as cameras have them; about ``_PER_RAY`` samples each."""
    g, count = _generator(), math.ceil(samples / _PER_RAY)
    origins = nn.functional.normalize(torch.randn(count, 3, generator=g), dim=1) * 2.5
    directions = nn.functional.normalize(0.2 * torch.randn(count, 3, generator=g) - origins / 2.5, dim=1)
    near, far = rendering.ball_interval(origins, directions)
    return {"origins": origins, "directions": directions, "near": near, "far": far, "jitter": torch.rand(count, generator=g)}


@functools.cache
def _field() -> Inputs:
    """An uneven ball in the grids of a default fit, and the occupancy that belongs to it."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        surface, appearance = Surface(HashGrid(_LEVELS[0], 16, 16, 128), 32, (0.5, 4.0)), HashGrid(_LEVELS[1], 17, 16, 256)
        nn.init.normal_(surface.grid.table, std=0.05)
        nn.init.normal_(surface.output_weight, std=0.1)
        nn.init.normal_(appearance.table)
        occupancy = Occupancy(64)
        occupancy.update(lambda x: reference.surface_value(x, *surface.at(_LEVELS[0])), _SAMPLING.sharpness)
    return {"surface": surface, "appearance": appearance, "occupancy": occupancy}


def _surface_inputs(samples: int) -> Inputs:
    """Samples along rays through the shell of the ball, as the surface sees them."""
    rays = _rays(samples)
    t = 1.9 + 0.03 * torch.arange(_PER_RAY)
    positions = (rays["origins"][:, None] + rays["directions"][:, None] * t[:, None]).reshape(-1, 3)[:samples]
    return {"surface": _field()["surface"], "positions": positions}


def _surface_traffic(inputs: Inputs, samples: int) -> tuple[float, float]:
    """Positions, eight corners of four floats per level, distances; backwards the same corners are read and written."""
    levels = len(inputs["surface"].grid.resolutions)
    forward = samples * (12 + levels * 128 + 4)
    return forward, forward + samples * (levels * 256 + 4)


def _surface(backend: Any) -> Callable[[Inputs], Outputs]:
    return lambda x: (backend.surface_value(x["positions"], *x["surface"].at(_LEVELS[0])),)


def _trace(backend: Any) -> Callable[[Inputs], Outputs]:
    def trace(x: Inputs) -> Outputs:
        tables = *x["surface"].at(_LEVELS[0]), x["appearance"].at(_LEVELS[1])
        hits = backend.trace(*tables, x["occupancy"].states, _rays_of(x), _SAMPLING)
        nearest = hits.features[: len(hits.opacity)]
        return torch.cat([nearest, hits.opacity[:, None]], 1), hits.samples

    return trace


def _rays_of(x: Inputs) -> kernels.Rays:
    return kernels.Rays(*(x[name] for name in kernels.Rays._fields))


def _compare_inputs(samples: int) -> Inputs:
    """Rays of which each has one number: a channel of a colour mosaic, and for the last half an intensity behind an analyser."""
    g, tensors = _generator(), samples // 2
    sensors = {
        "rgb": Sensor("rgb", ("R", "G", "B"), (None,) * 3),
        "pol": Sensor("pol", ("0", "45", "90", "135"), (None,) * 4, None, (0.0, 45.0, 90.0, 135.0)),
    }
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        shader = Shader(_field()["appearance"].width, 64, sensors, {"rgb": 1.0, "pol": 1.0})
    output = torch.cat([torch.randint(3, (samples - tensors,), generator=g), torch.full((tensors,), 3)])
    unit = lambda count: nn.functional.normalize(torch.randn(count, 3, generator=g), dim=1)
    values = {name: torch.rand(samples, generator=g) for name in ("share", "target")}
    constants = {name: torch.full((samples,), value) for name, value in (("level", 1.0), ("saturation", 0.9), ("weight", 1 / samples))}
    return {
        "shader": shader, "features": torch.randn(samples, _field()["appearance"].width, generator=g),
        "behind": torch.full((samples,), -1), "directions": unit(samples),
        "degrees": torch.full((samples,), 3), "trains_geometry": torch.ones(samples, dtype=torch.bool), "ray": torch.arange(samples),
        "output": output, "axes": unit(tensors), **values, **constants,
    }  # fmt: skip


def _compare(backend: Any) -> Callable[[Inputs], Outputs]:
    def call(x: Inputs) -> Outputs:
        rays, measured = (kind(*(x[name] for name in kind._fields)) for kind in (kernels.ShadedRays, kernels.Measured))
        return backend.compare(x["shader"].weights(), rays, measured)

    return call


def _mirror_inputs(samples: int) -> Inputs:
    """As many rays before three lamps, each with one number, the last half behind analysers."""
    g, tensors = _generator(), samples // 2
    unit = lambda count: nn.functional.normalize(torch.randn(count, 3, generator=g), dim=1)
    normals, one = unit(samples), torch.ones(samples)
    seen = {"target": one, "ray": torch.arange(samples), "level": one, "saturation": one, "weight": one}
    output = torch.cat([torch.randint(3, (samples - tensors,), generator=g), torch.full((tensors,), 3)])
    return {
        "position": 4.0 * unit(3), "spectrum": torch.rand(3, 9, generator=g) + 0.5, "material": torch.randn(samples, 8, generator=g),
        "normals": normals, "points": 0.5 * torch.randn(samples, 3, generator=g), "share": torch.rand(samples, generator=g),
        "directions": nn.functional.normalize(0.7 * unit(samples) - normals, dim=1), "behind": torch.full((samples,), -1),
        "output": output, "axes": unit(tensors), **seen,
    }  # fmt: skip


def _mirror(backend: Any) -> Callable[[Inputs], Outputs]:
    def call(x: Inputs) -> Outputs:
        lamps, mirrors, measured = (
            kind(*(x[name] for name in kind._fields)) for kind in (kernels.Lamps, kernels.Mirrors, kernels.Measured)
        )
        return (backend.mirror(lamps, mirrors, x["behind"], measured),)

    return call


def _adam_inputs(samples: int) -> Inputs:
    g = _generator()
    parameter, gradient, first, second = torch.randn(4, samples, generator=g)
    return {"parameter": parameter, "gradient": gradient, "first": first, "second": second.square()}


def _adam(backend: Any) -> Callable[[Inputs], Outputs]:
    def step(x: Inputs) -> Outputs:
        backend.adam(x["parameter"], x["gradient"], x["first"], x["second"], kernels.AdamStep(1e-2, 0.9, 0.99, 1e-15, 10))
        return (x["parameter"],)

    return step


def _encode_inputs(samples: int) -> Inputs:
    inputs = _surface_inputs(samples)
    grid = inputs["surface"].grid
    positions = (inputs["positions"] * 0.5 + 0.5).clamp(0, 1)
    return {"positions": positions, "table": grid.table.detach(), "resolutions": grid.resolutions, "offsets": grid.offsets}


def _encode(backend: Any) -> Callable[[Inputs], Outputs]:
    return lambda x: (backend.hash_encode(x["positions"], x["table"], x["resolutions"], x["offsets"], _LEVELS[0]),)


def _march(backend: Any) -> Callable[[Inputs], Outputs]:
    def march(x: Inputs) -> Outputs:
        ball = lambda p: torch.linalg.vector_norm(p, dim=-1) - 0.5  # nearly free: it is the march that is timed
        states = x["occupancy"].states
        return backend.march(ball, _rays_of(x), states, 1.0, _SAMPLING)

    return march


def _march_difference(output: Outputs, truth: Outputs) -> Difference:
    """Of the depths of rays with as many samples as the reference's: a sample within rounding of a cell's face may fall either way."""
    (t, ray, offsets), (t64, ray64, offsets64) = output, truth
    same = offsets.diff() == offsets64.diff()
    error = (t[same[ray]].double() - t64[same[ray64]]).abs()
    return error.max().item() if len(error) else 0.0, 1.0 - same.double().mean().item()


def _section_inputs(samples: int) -> Inputs:
    """Rays of 8 samples, the last one shorter, that cross a noisy surface."""
    rays = math.ceil(samples / _PER_RAY)
    noise = 0.02 * torch.randn(samples, generator=_generator())
    along = torch.linspace(0.1, -0.1, _PER_RAY).repeat(rays)[:samples]
    return {"sdf": along + noise, "offsets": torch.arange(rays + 1).mul(_PER_RAY).clamp(max=samples)}


def _sections(backend: Any) -> Callable[[Inputs], Outputs]:
    return lambda x: backend.section_weights(x["sdf"], 100.0, x["offsets"])


OPERATIONS: tuple[Operation, ...] = (
    Operation(
        "surface_value",
        _surface_inputs,
        {"torch": _surface(reference), "numba": _surface(cpu), "torch cuda": _surface(reference), "triton": _surface(cuda)},
        leaves=lambda x: list(x["surface"].parameters()),
        traffic=_surface_traffic,
    ),
    Operation(
        "trace",
        lambda samples: _rays(samples) | _field(),
        {"torch": _trace(reference), "numba": _trace(cpu), "torch cuda": _trace(reference), "triton": _trace(cuda)},
        leaves=lambda x: [*x["surface"].parameters(), x["appearance"].table],
        count=lambda output: int(output[1]),
    ),
    Operation(
        "compare",
        _compare_inputs,
        {"torch": _compare(reference), "numba": _compare(cpu), "torch cuda": _compare(reference), "triton": _compare(cuda)},
        leaves=lambda x: [*x["shader"].parameters(), x["features"], x["share"]],
        count=lambda output: len(output[1]),
    ),
    Operation(
        "mirror",
        _mirror_inputs,
        {"torch": _mirror(reference), "numba": _mirror(cpu), "torch cuda": _mirror(reference), "triton": _mirror(cuda)},
        leaves=lambda x: [x["material"], x["normals"], x["share"], x["position"], x["spectrum"]],
    ),
    Operation(
        "adam",
        _adam_inputs,
        {"torch": _adam(reference), "numba": _adam(cpu), "torch cuda": _adam(reference), "triton": _adam(cuda)},
        traffic=lambda x, samples: (32 * samples, 32 * samples),
    ),
    # the parts of a trace on a GPU; on the CPU they are fused
    Operation(
        "hash_encode",
        _encode_inputs,
        {"torch": _encode(reference), "torch cuda": _encode(reference), "triton": _encode(cuda)},
        leaves=lambda x: [x["table"]],
    ),
    Operation(
        "march",
        lambda samples: _rays(samples) | _field(),
        {"torch": _march(reference), "torch cuda": _march(reference)},
        difference=_march_difference,
    ),
    Operation(
        "section_weights",
        _section_inputs,
        {"torch": _sections(reference), "torch cuda": _sections(reference)},
        leaves=lambda x: [x["sdf"]],
    ),
)


# ------------------------------------------------------------------------------------------------------------------- measuring


@dataclass
class _Entry:
    """One backend's turn at one operation: inputs on its device, and seconds of the repeats so far."""

    backend: str
    device: str
    call: Callable[[Inputs], Outputs]
    inputs: Inputs
    forward: list[float]
    both: list[float]


def bench_kernels(samples: int, out: Path, threads: int | None = None, progress: Progress | None = None) -> Report:
    """Time and check every backend of every operation.

    Args:
        samples: per call. threads: of torch and kernels; None: as they are. progress: called with (operations done, operations in all).
    Raises:
        InputError: more threads than cores; ``out`` cannot be written.
    """
    rows: list[dict[str, Any]] = []
    with use_threads(threads):
        machine = measure()
        warm_up()
        backends = available_backends()
        chosen = [o for o in OPERATIONS if len(o.calls.keys() & backends) > 1]
        for done, operation in enumerate(chosen):
            if progress is not None:
                progress(done, len(chosen))
            rows += time_operation(operation, backends, samples, machine["bandwidth_gb_s"])
    if progress is not None:
        progress(len(chosen), len(chosen))
    results = {"bench": "kernels", "samples": samples, "machine": machine, "rows": rows}
    return write_report(results, [table_of(rows)], plot(rows), out)


def time_operation(operation: Operation, backends: Mapping[str, str], samples: int, bandwidth: float) -> list[dict[str, Any]]:
    """Rows of one operation, one per backend that offers it.

    Args:
        backends: names and devices. bandwidth: GB/s of the CPU's memory, for the share of it that a CPU backend's traffic takes.
    Returns:
        ``operation, backend, samples, forward_ns, both_ns`` (per sample, medians), ``forward_ratio, both_ratio`` (the first backend's time
        over this one's), ``value_error, gradient_error`` (largest absolute difference to the float64 reference), ``value_scale,
        gradient_scale`` (largest absolute value of the reference; of several gradients, those of the one that is worst by its scale),
        ``differing_rays`` (share), ``bandwidth_share``, ``both_bandwidth_share``; what does not apply is left out.
    """
    inputs = operation.make(samples)
    exact = _cast(inputs, "cpu", torch.float64)
    truth = operation.calls["torch"](_cast(inputs, "cpu", torch.float64))
    cotangent = torch.randn(truth[0].shape, generator=_generator()).double()
    gradients = _both(operation, operation.calls["torch"], exact, cotangent)
    count = operation.count(truth)
    offering = [(name, device) for name, device in backends.items() if name in operation.calls]
    entries = [_Entry(name, device, operation.calls[name], _cast(inputs, device), [], []) for name, device in offering]
    rows: list[dict[str, Any]] = [
        {"operation": operation.name, "backend": e.backend, "samples": count, **_errors(operation, e, truth, cotangent, gradients)}
        for e in entries
    ]
    for _ in range(REPEATS):
        for entry in entries:
            _time_once(operation, entry, cotangent)
    for row, entry in zip(rows, entries, strict=True):
        row["forward_ns"] = statistics.median(entry.forward) / count * 1e9
        if entry.both:
            row["both_ns"] = statistics.median(entry.both) / count * 1e9
    for row, entry in zip(rows, entries, strict=True):
        row |= {f"{key}_ratio": rows[0][f"{key}_ns"] / row[f"{key}_ns"] for key in ("forward", "both") if f"{key}_ns" in row}
        if operation.traffic is not None and entry.device == "cpu":
            forward, both = (b / count for b in operation.traffic(inputs, count))
            row["bandwidth_share"] = forward / row["forward_ns"] / bandwidth
            if "both_ns" in row:
                row["both_bandwidth_share"] = both / row["both_ns"] / bandwidth
    return rows


def _errors(operation: Operation, entry: _Entry, truth: Outputs, cotangent: Tensor, gradients: Sequence[Tensor]) -> dict[str, float]:
    """Of first calls: an operation may change its inputs, and later calls warm ones."""
    with torch.no_grad():
        output = tuple(x.cpu() for x in entry.call(entry.inputs))
    error, differing = operation.difference(output, truth)
    found = {"value_error": error, "value_scale": truth[0].abs().max().item()}
    if differing:
        found["differing_rays"] = differing
    ours = _both(operation, entry.call, entry.inputs, cotangent)
    pairs = [((a.cpu().double() - b).abs().max().item(), b.abs().max().item()) for a, b in zip(ours, gradients, strict=True)]
    if pairs:
        found["gradient_error"], found["gradient_scale"] = max(pairs, key=lambda pair: pair[0] / pair[1] if pair[1] else 0.0)
    return found


def _both(operation: Operation, call: Callable[[Inputs], Outputs], inputs: Inputs, cotangent: Tensor) -> list[Tensor]:
    """Gradients of the leaves after one forward and backward pass, none where there is no backward pass."""
    if operation.leaves is None:
        return []
    leaves = operation.leaves(inputs)
    for leaf in leaves:
        leaf.requires_grad_()
        leaf.grad = None
    output = call(inputs)[0]
    output.backward(cotangent.to(output))
    return [torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for leaf in leaves]


def _time_once(operation: Operation, entry: _Entry, cotangent: Tensor) -> None:
    def forward() -> None:
        with torch.no_grad():
            entry.call(entry.inputs)

    # gradients are added to, as in a fit; see ``_errors`` for where they begin
    entry.forward.append(_seconds(forward, entry.device))
    if operation.leaves is not None:
        gradient = cotangent.to(entry.device, torch.float32)
        entry.both.append(_seconds(lambda: entry.call(entry.inputs)[0].backward(gradient), entry.device))


def _seconds(work: Callable[[], Any], device: str) -> float:
    if device == "cuda":
        torch.cuda.synchronize()
    began = time.perf_counter()
    work()
    if device == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter() - began


def _cast(inputs: Inputs, device: str, dtype: torch.dtype = torch.float32) -> Inputs:
    """Copies on a device, floating-point numbers in a type."""

    def one(value: Any) -> Any:
        if isinstance(value, Tensor):
            return value.detach().clone().to(device, dtype if value.is_floating_point() else None)
        return copy.deepcopy(value).to(device, dtype) if isinstance(value, nn.Module) else value

    return {name: one(value) for name, value in inputs.items()}


# ------------------------------------------------------------------------------------------------------------------- the report


def table_of(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Speed beside error, a row per operation and backend."""
    columns = (
        Column("operation", "operation"),
        Column("backend", "backend"),
        Column("samples", "samples", ",d"),
        Column("forward [ns]", "forward_ns", ".1f"),
        Column("× reference", "forward_ratio", ".1f"),
        Column("fwd + bwd [ns]", "both_ns", ".1f"),
        Column("× reference", "both_ratio", ".1f"),
        Column("error", "value_error", ".1e"),
        Column("of", "value_scale", ".2g"),
        Column("gradient error", "gradient_error", ".1e"),
        Column("of", "gradient_scale", ".2g"),
        Column("rays differing", "differing_rays", ".2%"),
        Column("bandwidth", "bandwidth_share", ".0%"),
        Column("fwd + bwd", "both_bandwidth_share", ".0%"),
    )
    note = (
        "ns: per sample, medians of alternating repeats. Error: largest absolute difference to the float64 reference, beside its largest "
        "value. Bandwidth: bytes read and written per second by the measured memory bandwidth; above 100 %, the caches serve them."
    )
    return Table("Kernels", columns, rows, note)


def plot(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Bars of ns per sample (log), per operation and backend; forward beside forward and backward."""
    figure, axes = new_figure(2)
    operations = list(dict.fromkeys(row["operation"] for row in rows))
    backends = list(dict.fromkeys(row["backend"] for row in rows))
    width = 0.8 / len(backends)
    for one, key, label in zip(axes, ("forward_ns", "both_ns"), ("forward", "forward + backward"), strict=True):
        for i, backend in enumerate(backends):
            found = {row["operation"]: row[key] for row in rows if row["backend"] == backend and key in row}
            one.bar([operations.index(o) + i * width for o in found], list(found.values()), width, label=backend)
        one.set_xticks([i + 0.4 - width / 2 for i in range(len(operations))], operations)
        one.set(yscale="log", ylabel=f"{label} [ns per sample]")
        one.legend(frameon=False)
    return figure
