"""Tasks that threads take from a counter: each takes as many as it gets done."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from mmsynth.field.kernels.cpu.jit import part
from mmsynth.threads import kernel_threads

T = TypeVar("T")


@intrinsic
def take(typingctx, counter, index):  # type: ignore[no-untyped-def]
    """counter[index]++, atomically: the value before. counter: (N,) int64."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        place = builder.gep(data, [args[1]])
        return builder.atomic_rmw("add", place, ir.Constant(ir.IntType(64), 1), "monotonic")

    return types.int64(counter, types.int64), codegen


@intrinsic
def tell(typingctx, flags, index):  # type: ignore[no-untyped-def]
    """flags[index] = 1, to be seen after all that was written before. flags: (N,) int64."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        builder.store_atomic(ir.Constant(ir.IntType(64), 1), builder.gep(data, [args[1]]), "release", 8)
        return context.get_dummy_value()

    return types.void(flags, types.int64), codegen


@intrinsic
def _told(typingctx, flags, index):  # type: ignore[no-untyped-def]
    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        return builder.load_atomic(builder.gep(data, [args[1]]), "acquire", 8)

    return types.int64(flags, types.int64), codegen


@part()
def wait(flags, index):  # type: ignore[no-untyped-def]
    """Until ``tell`` was called. It spins: for what another thread has begun already, and is about to end."""
    while _told(flags, index) == 0:
        pass


@functools.cache
def _beside(threads: int) -> ThreadPoolExecutor:
    """They stay: starting one takes as long as what it does."""
    return ThreadPoolExecutor(threads, "beside")


if hasattr(os, "register_at_fork"):  # Unix: a forked process has none of its parent's threads
    os.register_at_fork(after_in_child=_beside.cache_clear)


def take_all(tasks: int, kernel: Callable[..., None], *arguments: Any) -> None:
    """Call a kernel by as many threads as it may have here (``kernel_threads``), but no more than it has tasks.

    Each takes tasks until none is left and holds no lock of Python's. Numba's own threads would need a kernel around it, for which all that
    it calls is compiled again; some of their kinds may not be called by several threads.

    Args:
        arguments: behind the kernel's first, which are the counters (2,) of tasks that were taken, and of threads, each of which has a slot
            of its own in stores.
    """
    take_beside(lambda: None, min(tasks, kernel_threads()), kernel, (np.zeros(2, np.int64), *arguments))


def take_beside(meanwhile: Callable[[], T], threads: int, kernel: Callable[..., None], arguments: tuple[Any, ...]) -> T:
    """What ``meanwhile`` gives, which a thread of its own does beside the tasks of a kernel; then it takes such tasks, too.

    threads: in all. What has not begun when no task is left, because its thread is busy with other work, does not begin: this thread does
    what is ``meanwhile`` then. So work that a pool's thread does may call kernels itself.
    """

    def first_meanwhile() -> T:
        result = meanwhile()
        kernel(*arguments)
        return result

    if threads <= 1:
        return first_meanwhile()
    pool = _beside(threads - 1)
    result = pool.submit(first_meanwhile)
    others: list[Future[Any]] = [result, *(pool.submit(kernel, *arguments) for _ in range(threads - 2))]
    try:
        kernel(*arguments)
    finally:
        begun = [other for other in others if not other.cancel()]
        for other in begun:
            other.exception()  # waits
    for other in begun:
        other.result()  # raises what it raised
    return meanwhile() if result.cancelled() else result.result()
