"""Adam on the CPU."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numba import get_num_threads, njit, prange, types
from numba.extending import intrinsic
from numba.np.arrayobj import populate_array
from torch import Tensor

from mmsynth.field.kernels.cpu.tasks import take
from mmsynth.field.kernels.parameters import AdamStep

ADAM_CHUNK = 16384  # parameters at a time


_FAST = {"reassoc", "nsz", "arcp", "contract", "afn"}  # NaN stays what it is: no gradient of 0


@njit(cache=True, fastmath=_FAST, nogil=True, error_model="numpy")
def adam_part(p, g, m, v, rate, beta1, beta2, root, epsilon, sparse):  # type: ignore[no-untyped-def]
    """``rate`` includes the first bias correction, ``root`` is one over the square root of the second."""
    one, zero = np.float32(1.0), np.float32(0.0)
    for i in range(p.shape[0]):
        if sparse and g[i] == zero:
            continue
        a = beta1 * m[i] + (one - beta1) * g[i]
        b = beta2 * v[i] + (one - beta2) * g[i] * g[i]
        m[i] = a
        v[i] = b
        p[i] -= rate * a / (np.float32(math.sqrt(b)) * root + epsilon)
        g[i] = zero


@intrinsic
def _at(typingctx, address, count):  # type: ignore[no-untyped-def]
    """So many float32 at an address."""
    kind = types.Array(types.float32, 1, "C")

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        array = context.make_array(kind)(context, builder)
        data = builder.inttoptr(args[0], context.get_value_type(types.float32).as_pointer())
        four = context.get_constant(types.intp, 4)
        populate_array(array, data=data, shape=[args[1]], strides=[four], itemsize=four, meminfo=None)
        return array._getvalue()

    return kind(types.int64, types.int64), codegen


@njit(cache=True, nogil=True, error_model="numpy")
def _take_parts(next_task, places, numbers):  # type: ignore[no-untyped-def]
    tensor, before = 0, 0  # tasks of the tensors before
    while True:
        task = take(next_task, 0)
        while tensor < len(places) and (task - before) * ADAM_CHUNK >= places[tensor, 4]:
            before += (places[tensor, 4] + ADAM_CHUNK - 1) // ADAM_CHUNK
            tensor += 1
        if tensor == len(places):
            return
        begin = (task - before) * ADAM_CHUNK
        count, at = min(ADAM_CHUNK, places[tensor, 4] - begin), 4 * begin
        p, g = _at(places[tensor, 0] + at, count), _at(places[tensor, 1] + at, count)
        m, v = _at(places[tensor, 2] + at, count), _at(places[tensor, 3] + at, count)
        rate, beta1, beta2, root, epsilon = numbers[tensor]
        adam_part(p, g, m, v, rate, beta1, beta2, root, epsilon, places[tensor, 5] != 0)


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def adam_parts(threads, next_task, places, numbers):  # type: ignore[no-untyped-def]
    """``adam_part`` of N tensors. places: (N, 6) addresses of parameters, gradients and moments, how many, whether sparse; numbers: (N, 5),
    the others."""
    next_task[0] = 0
    for _ in prange(threads):
        _take_parts(next_task, places, numbers)


def _numbers(step: AdamStep) -> tuple[float, ...]:
    root = 1 / math.sqrt(1 - step.beta2**step.number)
    return step.rate / (1 - step.beta1**step.number), step.beta1, step.beta2, root, step.epsilon


def adam(parameter: Tensor, gradient: Tensor, first: Tensor, second: Tensor, step: AdamStep) -> None:
    """See ``reference.adam``; float32."""
    adam_together([(parameter, gradient, first, second, step)])


def adam_together(parts: Sequence[tuple[Tensor, Tensor, Tensor, Tensor, AdamStep]]) -> None:
    """``adam`` of many tensors at once; float32, contiguous."""
    if parts:
        places = [(*(x.data_ptr() for x in tensors), tensors[0].numel(), step.sparse) for *tensors, step in parts]
        numbers = [_numbers(part[4]) for part in parts]
        adam_parts(get_num_threads(), np.zeros(1, np.int64), np.array(places, np.int64), np.array(numbers, np.float32))
