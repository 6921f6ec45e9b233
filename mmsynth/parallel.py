"""Work side by side: tiles of rays, or parts of a picture, each on a core of its own.

A kernel that all cores share is followed by operations that one core does, and by all that Python does between them; tiles side by side
leave no core without work.
"""

from __future__ import annotations

import ctypes
import functools
import itertools
import os
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent import futures
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

from mmsynth.threads import kernel_threads, let_kernels_have

P = TypeVar("P")
T = TypeVar("T")

_AHEAD = 4  # tiles of each thread that are begun before the first of them is asked for


def side_by_side(work: Callable[[P], T], tiles: Iterable[P]) -> Iterator[tuple[P, T]]:
    """What ``work`` makes of each tile, in their order; tiles are made as they are needed. What it makes may not depend on threads.

    Where there are fewer tiles than threads, all threads work on one tile after the other.
    """
    coming, threads = iter(tiles), kernel_threads()
    first = list(itertools.islice(coming, threads))
    if threads == 1 or len(first) < threads:
        for tile in itertools.chain(first, coming):
            yield tile, work(tile)
        return
    pool, begun = _alone(threads), deque[tuple[P, futures.Future[T]]]()

    def oldest() -> tuple[P, T]:
        tile, result = begun.popleft()
        return tile, result.result()

    try:
        for tile in itertools.chain(first, coming):
            begun.append((tile, pool.submit(work, tile)))
            if len(begun) == _AHEAD * threads:
                yield oldest()
        while begun:
            yield oldest()
    finally:  # one has failed, or no more are wanted
        for _, result in begun:
            result.cancel()


def tile_by_tile(device: torch.device, work: Callable[[P], T], tiles: Iterable[P]) -> Iterator[tuple[P, T]]:
    """``side_by_side`` on a CPU; a GPU, which one tile fills, takes one after the other."""
    return side_by_side(work, tiles) if device.type == "cpu" else ((tile, work(tile)) for tile in tiles)


def give_back() -> None:
    """Let the system have what was freed, in milliseconds: glibc keeps it, for each thread apart, where no other thread can use it."""
    if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "malloc_trim"):
        libc.malloc_trim(0)


@functools.cache
def _alone(threads: int) -> ThreadPoolExecutor:
    """So many threads, in each of which torch and kernels have that thread alone."""
    pool, all_there = ThreadPoolExecutor(threads, "tile"), threading.Barrier(threads)
    own = torch.get_num_threads()

    def settle() -> None:
        all_there.wait()
        let_kernels_have(1)
        torch.get_num_threads()  # a thread that has not asked takes on, when it first does, what was set last in any
        torch.set_num_threads(1)

    for started in [pool.submit(settle) for _ in range(threads)]:
        started.result()
    torch.set_num_threads(own)  # of this thread, and of those that begin later
    return pool


if hasattr(os, "register_at_fork"):  # Unix: a forked process has none of its parent's threads
    os.register_at_fork(after_in_child=_alone.cache_clear)
