"""Tasks that threads take from a counter: each takes as many as it gets done."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic


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


@njit(cache=True, nogil=True, error_model="numpy")
def wait(flags, index):  # type: ignore[no-untyped-def]
    """Until ``tell`` was called. It spins: for what another thread has begun already, and is about to end."""
    while _told(flags, index) == 0:
        pass


_threads: list[ThreadPoolExecutor] = []
os.register_at_fork(after_in_child=_threads.clear)


def beside(call: Callable[..., Any], *arguments: Any) -> Future[Any]:
    """Call it in a thread of its own, which stays."""
    if not _threads:
        _threads.append(ThreadPoolExecutor(1, "kernels"))
    return _threads[0].submit(call, *arguments)
