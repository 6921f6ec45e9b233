"""How many threads a process has."""

from __future__ import annotations

import os
from collections.abc import MutableMapping


def usable_cores() -> int:
    """Cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def let_numba_follow(environment: MutableMapping[str, str]) -> None:
    """Numba takes as many threads as torch where ``OMP_NUM_THREADS`` says how many, as far as there are cores: numba alone would take all
    of these, in each of the processes that torchrun starts, or beside whatever else the limit was meant for. A setting of its own,
    ``NUMBA_NUM_THREADS``, stays. Both are read once, when the library is imported."""
    threads = environment.get("OMP_NUM_THREADS", "")
    if threads.isdecimal() and int(threads) > 0:
        environment.setdefault("NUMBA_NUM_THREADS", str(min(int(threads), usable_cores())))
