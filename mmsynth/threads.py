"""How many threads a process has."""

from __future__ import annotations

import functools
import os
import threading

_of_this_thread = threading.local()


def usable_cores() -> int:
    """Cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def kernel_threads() -> int:
    """Threads that share the tasks of a kernel on the CPU which this thread calls: as many as ``let_kernels_have`` said here, or else as
    ``OMP_NUM_THREADS`` says, as torch does, as far as there are cores, or else all of these."""
    return getattr(_of_this_thread, "count", 0) or _of_process()


def let_kernels_have(count: int) -> None:
    """Threads for kernels that this thread calls from now on."""
    _of_this_thread.count = count


@functools.cache
def _of_process() -> int:
    # the first of several is for what is not nested; what OpenMP would ignore is ignored
    asked = os.environ.get("OMP_NUM_THREADS", "").split(",")[0].strip()
    return min(int(asked), usable_cores()) if asked.isdecimal() and int(asked) > 0 else usable_cores()
