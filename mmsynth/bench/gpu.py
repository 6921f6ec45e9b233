"""``mmsynth bench gpu``: what the GPU kernels take of a GPU, found without one: registers, spills and shared memory as the compiler says,
launches of a step as they are counted (``launches``), and what binds them on paper (``roofline``).

Launches are recorded instead of run: what a kernel is compiled for follows from the arguments of real calls. No kernel's result decides
what is launched next, so calls on CPU tensors launch all that calls on a GPU would.
"""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from mmsynth.bench.launches import device_step, example_trainer, launch_table, step_launches
from mmsynth.bench.machine import measure
from mmsynth.bench.output import Report, write_report
from mmsynth.bench.recording import Launch, recorded_launches
from mmsynth.bench.roofline import roofline_table
from mmsynth.bench.tables import Column, Table
from mmsynth.errors import InputError
from mmsynth.field import kernels
from mmsynth.field.encoding import HashGrid
from mmsynth.field.kernels import cuda
from mmsynth.field.occupancy import Occupancy
from mmsynth.field.surface import Surface

TARGETS = {80: "A100", 90: "H100, H200", 100: "B200"}  # compute capability × 10, and GPUs that have it
_TYPES = {
    torch.float16: "fp16", torch.bfloat16: "bf16", torch.float32: "fp32", torch.float64: "fp64",
    torch.uint8: "u8", torch.uint16: "u16", torch.bool: "i1", torch.int32: "i32", torch.int64: "i64",
}  # fmt: skip


class Resources(NamedTuple):
    """Of a thread: registers; bytes that are stored to and loaded from local memory because registers did not suffice. Of a program:
    shared memory [byte]."""

    registers: int
    spilled: int
    shared: int


def compiled(launch: Launch, target: int) -> tuple[Resources, Any]:
    """A kernel compiled for what a launch gave it and for a GPU of compute capability target / 10: what it takes, Triton's result."""
    import triton
    from triton import knobs
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    signature: dict[str, str] = {}
    constants: dict[tuple[int, ...], Any] = {}
    aligned: dict[tuple[int, ...], Any] = {}
    for i, parameter in enumerate(launch.kernel.params):
        value = launch.arguments[parameter.name]
        if parameter.is_constexpr or value is None:
            signature[parameter.name], constants[(i,)] = "constexpr", value
        elif isinstance(value, Tensor):
            signature[parameter.name], aligned[(i,)] = f"*{_TYPES[value.dtype]}", [["tt.divisibility", 16]]
        else:
            signature[parameter.name] = "i32" if isinstance(value, int) else "fp32"
    log = io.StringIO()
    with knobs.nvidia.scope(), knobs.compilation.scope(), contextlib.redirect_stdout(log):
        knobs.nvidia.dump_ptxas_log = knobs.compilation.always_compile = True
        source = ASTSource(launch.kernel, signature, constants, aligned)
        found = triton.compile(source, target=GPUTarget("cuda", target, 32), options=launch.options)
    number = lambda pattern: sum(map(int, re.findall(pattern, log.getvalue())))
    spilled = number(r"(\d+) bytes spill stores") + number(r"(\d+) bytes spill loads")
    return Resources(number(r"Used (\d+) registers"), spilled, found.metadata.shared), found


def launches_of(call: Callable[[], Any]) -> list[Launch]:
    """What a call launches."""
    with recorded_launches() as launches, torch.enable_grad():
        call()
    return launches


def calls() -> list[Callable[[], Any]]:
    """Calls of all operations that are Triton's, of a field of usual size: as a fit makes them, and with gradients of poses, too."""
    extent, count, levels = 2.0, 64, 8
    surface, appearance = Surface(HashGrid(levels, 12, 16, 512, extent), 32, (0.5, 4.0)), HashGrid(levels, 12, 16, 512, extent)
    states, sampling = Occupancy(8, extent).states, kernels.Sampling(60.0, 0.03, levels, levels)

    def trace(poses: bool) -> None:
        ends = (torch.zeros(count, 3, requires_grad=poses) for _ in range(2))
        hits = cuda.trace(*surface.at(levels), appearance.at(levels), states, kernels.Rays(*ends, *torch.zeros(3, count)), sampling)
        (hits.features.sum() + hits.share.sum()).backward()

    def encode() -> None:
        at = appearance.at(levels)
        cuda.hash_encode(torch.zeros(count, 3), at.table, at.resolutions, at.offsets, levels).sum().backward()

    places = torch.zeros(count, 3)
    return [
        lambda: trace(poses=False),
        lambda: cuda.surface_gradient(places, 0.01, *surface.at(levels)).sum().backward(),
        lambda: cuda.surface_value(places, *surface.at(levels)).sum().backward(),
        encode,
        lambda: trace(poses=True),
    ]


_COLUMNS = (
    Column("Kernel", "kernel"), Column("Warps", "warps"),
    *(Column(f"sm_{t}: registers", f"sm_{t}/registers", "d") for t in TARGETS),
    *(Column(f"sm_{t}: spilled [byte]", f"sm_{t}/spilled", "d") for t in TARGETS),
    *(Column(f"sm_{t}: shared [KiB]", f"sm_{t}/shared", ".1f", 1 / 1024) for t in TARGETS),
)  # fmt: skip


def resource_rows(launches: Sequence[Launch], targets: Sequence[int] = tuple(TARGETS)) -> list[dict[str, Any]]:
    """A row for each kernel, in the order of the first launches, compiled for each target."""
    rows, seen = [], set()
    for launch in launches:
        kind = launch.name, *(v.dtype if isinstance(v, Tensor) else v if p.is_constexpr or v is None else 0 for p, v in _named(launch))
        if kind in seen:
            continue
        seen.add(kind)
        found = {f"sm_{target}": compiled(launch, target)[0]._asdict() for target in targets}
        rows.append({"kernel": _title(launch), "warps": launch.options["num_warps"], **found})
    return rows


def _title(launch: Launch) -> str:
    """The kernel, and what of it this launch asks for."""
    of = {1: " of taps", 2: " of samples"}.get(launch.arguments.get("MODE", 0), "")
    asks = any(launch.arguments.get(name) is not None for name in ("positions_out", "places_out"))
    return f"{launch.name}{of}{' and places' if asks else ''}"


def _named(launch: Launch) -> Iterator[tuple[Any, Any]]:
    return ((p, launch.arguments[p.name]) for p in launch.kernel.params)


def bench_gpu(out: Path, targets: Sequence[int] = tuple(TARGETS)) -> Report:
    """Compile every kernel for GPUs that need not be there, and write what they take.

    Raises:
        InputError: triton is not installed, or ``out`` cannot be written.
    """
    try:
        import triton
    except ImportError:
        raise InputError("bench gpu: triton is not installed; pip install triton==3.6.0.") from None

    trainer = example_trainer()
    launches = [launch for call in calls() for launch in launches_of(call)]
    known = {launch.name for launch in launches}
    launches += [launch for launch in step_launches(device_step(trainer, 3), True, outside=True).calls if launch.name not in known]
    rows = resource_rows(launches, targets)
    names = ", ".join(f"sm_{t} ({TARGETS.get(t, '')})" for t in targets)
    table = Table("Kernels", _COLUMNS, rows, f"Compiled by triton {triton.__version__} for {names}. At most 255 registers a thread.")
    results = {"bench": "gpu", "machine": measure(), "triton": triton.__version__, "rows": rows}
    return write_report(results, [table, launch_table(trainer), roofline_table()], None, out)
