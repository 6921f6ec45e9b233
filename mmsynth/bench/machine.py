"""The machine that a figure was measured on: what it is, and its memory bandwidth and arithmetic speed, measured beside the figure."""

from __future__ import annotations

import os
import platform
import timeit
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numba
import numpy as np
import torch

from mmsynth.errors import InputError
from mmsynth.threads import kernel_threads, let_kernels_have, usable_cores
from mmsynth.version import __version__

# instruction sets that decide the speed of the kernels
_FLAGS = ("sse4_2", "avx", "avx2", "fma", "avx512f", "avx512bw", "avx512vl", "avx512_bf16", "avx512_vnni", "amx_tile", "neon", "sve")
_REPEATS = 5


def identify() -> dict[str, Any]:
    """What the machine is and what runs on it, without measuring: ``cpu, flags, cores, threads, memory_gb, gpu, versions``."""
    info = _facts(Path("/proc/cpuinfo"))
    versions = {"mmsynth": __version__, "python": platform.python_version()}
    return {
        "cpu": info.get("model name") or platform.processor() or platform.machine(),
        "flags": _flags(info),
        "cores": usable_cores(),
        "threads": torch.get_num_threads(),
        "memory_gb": round(_memory_bytes() / 1e9, 1),
        "gpu": torch.cuda.get_device_name(0) if torch.cuda.is_available() else None,
        "system": platform.system(),
        "versions": versions | {module.__name__: module.__version__ for module in (torch, numba, np)},
    }


def measure() -> dict[str, Any]:
    """``identify`` and the machine's limits, measured now, in about a second.

    ``bandwidth_gb_s`` and ``bandwidth_one_thread_gb_s``: memory traffic of a triad a = b + s c on arrays beyond the caches, counted as
    three arrays (as STREAM does: the read that a store may need is not counted). ``gemm_gflops``: float32 ``torch.mm``, 2 n³ operations.
    Each is the best of five. ``load``: the system's load average over the last minute, before; None where there is none.
    """
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    with use_threads(1):
        alone = _triad()
    return identify() | {"load": load, "bandwidth_gb_s": _triad(), "bandwidth_one_thread_gb_s": alone, "gemm_gflops": _gemm()}


@contextmanager
def use_threads(count: int | None) -> Iterator[None]:
    """Run torch and kernels on ``count`` threads; None: leave them as they are.

    Raises:
        InputError: there are fewer cores.
    """
    if count is None:
        yield
        return
    before, most = (torch.get_num_threads(), kernel_threads()), usable_cores()
    if count > most:
        raise InputError(f"--threads {count}: expected no more than the {most} cores that this process may run on.")
    try:
        torch.set_num_threads(count)
        let_kernels_have(count)
        yield
    finally:
        torch.set_num_threads(before[0])
        let_kernels_have(before[1])


def peak_memory() -> int:
    """Peak resident memory of this process, bytes.

    Not ``ru_maxrss`` on Linux: a child inherits that from the process that started it, so that a small fit started by a large
    process would look large.
    """
    status = _facts(Path("/proc/self/status"))
    if "VmHWM" in status:
        return int(status["VmHWM"].split()[0]) * 1024
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if platform.system() == "Darwin" else peak * 1024


def describe(machine: dict[str, Any]) -> str:
    """What ``measure`` found, as one line."""
    versions = ", ".join(f"{name} {version}" for name, version in machine["versions"].items())
    gpu = f", {machine['gpu']}" if machine["gpu"] else ""
    load = f"; load {machine['load']:.1f} at the start" if machine["load"] is not None else ""
    return (
        f"{machine['cpu']}, {machine['cores']} cores, {machine['threads']} threads, {machine['memory_gb']:g} GB{gpu} "
        f"({' '.join(machine['flags'])}); memory {machine['bandwidth_gb_s']:.1f} GB/s, {machine['bandwidth_one_thread_gb_s']:.1f} on one "
        f"thread; float32 GEMM {machine['gemm_gflops']:.0f} GFLOP/s{load}; {versions}"
    )


def _facts(path: Path) -> dict[str, str]:
    """The first paragraph of a file of /proc, lines of ``key: value``; empty on systems that have none."""
    lines = path.read_text().split("\n\n")[0].splitlines() if path.is_file() else []
    return {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in lines)}


def _flags(info: dict[str, str]) -> list[str]:
    found = set(info.get("flags", info.get("Features", "")).split())
    if "asimd" in found or platform.machine() in ("arm64", "aarch64"):
        found.add("neon")
    # where there is no /proc, torch knows which vector code it chose
    return [flag for flag in _FLAGS if flag in found] or [torch.backends.cpu.get_cpu_capability().lower()]


def _memory_bytes() -> int:
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else 0


def _last_cache_bytes() -> int:
    sizes = [path.read_text().strip() for path in Path("/sys/devices/system/cpu/cpu0/cache").glob("index*/size")]
    return max((int(size[:-1]) * 1024 for size in sizes if size.endswith("K")), default=32 << 20)


def _best_seconds(work: Callable[[], Any]) -> float:
    work()
    return min(timeit.repeat(work, number=1, repeat=_REPEATS))


def _triad() -> float:
    """GB/s on the threads that torch now has."""
    # three arrays of at least twice the last cache, in at most an eighth of the memory
    count = min(max(2 * _last_cache_bytes(), 64 << 20), max(_memory_bytes() // 24, 8 << 20)) // 4
    a, b, c = (torch.ones(count) for _ in range(3))
    return 3 * 4 * count / _best_seconds(lambda: torch.add(b, c, alpha=0.5, out=a)) / 1e9


def _gemm(size: int = 1024) -> float:
    """GFLOP/s of a float32 product of two ``size`` × ``size`` matrices."""
    a, b, out = (torch.rand(size, size) for _ in range(3))
    return 2 * size**3 / _best_seconds(lambda: torch.mm(a, b, out=out)) / 1e9
