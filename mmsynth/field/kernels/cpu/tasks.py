"""Tasks that threads take from a counter: each takes as many as it gets done."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from concurrent import futures
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from mmsynth.field.kernels.cpu.jit import part

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


def take_beside(meanwhile: Callable[[], T], threads: int, kernel: Callable[..., None], arguments: tuple[Any, ...]) -> T:
    """What ``meanwhile`` gives, which a thread of its own does beside the tasks of a kernel; then it takes such tasks, too.

    threads: in all. Each calls the kernel, which takes tasks until none is left and holds no lock of Python's. Numba's own threads would
    need a kernel around it, which takes minutes to compile: all that it calls is made for it again.
    """

    def first_meanwhile() -> T:
        result = meanwhile()
        kernel(*arguments)
        return result

    if threads == 1:
        return first_meanwhile()
    pool = _beside(threads - 1)
    result = pool.submit(first_meanwhile)
    others = [pool.submit(kernel, *arguments) for _ in range(threads - 2)]
    try:
        kernel(*arguments)
    finally:
        futures.wait([result])
        futures.wait(others)
    for other in others:
        other.result()  # raises what it raised
    return result.result()
