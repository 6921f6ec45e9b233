"""Adam on the CPU."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np
from numba import types
from numba.extending import intrinsic
from numba.np.arrayobj import populate_array
from torch import Tensor

from mmsynth.field.kernels.constants import FEATURES
from mmsynth.field.kernels.cpu.jit import inlined, kernel, part
from mmsynth.field.kernels.cpu.tasks import take, take_all, wait
from mmsynth.field.kernels.parameters import AdamPart, AdamStep

ADAM_CHUNK = 16384  # parameters at a time
_FOR_A_THREAD = 1 << 18  # fewer are done before another thread has begun
_LINE = 16  # of a line of the cache: where none of them has a gradient, the others are not read
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
_FAST = {"reassoc", "nsz", "arcp", "contract", "afn"}  # NaN stays what it is: no gradient of 0


@inlined()
def _step(i, moves, p, g, m, v, rate, beta1, beta2, root, epsilon):  # type: ignore[no-untyped-def]
    """Where nothing moves, the same is stored again: of stores on a condition LLVM makes some under a mask, which take processors of AMD
    without AVX-512 tens of cycles."""
    gradient = g[i]
    a = m[i] + (_ONE - beta1 if moves else _ZERO) * (gradient - m[i])
    b = v[i] + (_ONE - beta2 if moves else _ZERO) * (gradient * gradient - v[i])
    m[i] = a
    v[i] = b
    p[i] -= (rate if moves else _ZERO) * a / (np.float32(math.sqrt(b)) * root + epsilon)
    g[i] = _ZERO


@part(fastmath=_FAST)
def adam_part(p, g, m, v, rate, beta1, beta2, root, epsilon, sparse):  # type: ignore[no-untyped-def]
    """``rate`` includes the first bias correction, ``root`` is one over the square root of the second."""
    lines, all_move = p.shape[0] // _LINE, not sparse
    bits = g[: lines * _LINE].view(np.int64)
    for line in range(lines):  # not by steps of a line, of which LLVM makes no vectors
        any_moves = np.int64(all_move)
        for i in range(_LINE // 2):
            any_moves |= bits[line * (_LINE // 2) + i]
        if any_moves != 0:
            for i in range(line * _LINE, line * _LINE + _LINE):
                _step(i, all_move | (g[i] != _ZERO), p, g, m, v, rate, beta1, beta2, root, epsilon)
    for i in range(lines * _LINE, p.shape[0]):
        _step(i, all_move | (g[i] != _ZERO), p, g, m, v, rate, beta1, beta2, root, epsilon)


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


@part()
def take_parts(next_task, task, others, done, places, numbers):  # type: ignore[no-untyped-def]
    """``adam_part`` of N tensors, from a task that was taken on until there are none; the counter counts so many others before them.

    places: (N, 7) addresses of parameters, gradients and moments, how many, whether sparse, and which of ``done`` says that the gradient is
    known. numbers: (N, 5), the others.
    """
    tensor, before = 0, 0  # tasks of the tensors before
    while True:
        while tensor < len(places) and (task - before) * ADAM_CHUNK >= places[tensor, 4]:
            before += (places[tensor, 4] + ADAM_CHUNK - 1) // ADAM_CHUNK
            tensor += 1
        if tensor == len(places):
            return
        wait(done, places[tensor, 6])
        begin = (task - before) * ADAM_CHUNK
        count, at = min(ADAM_CHUNK, places[tensor, 4] - begin), 4 * begin
        p, g = _at(places[tensor, 0] + at, count), _at(places[tensor, 1] + at, count)
        m, v = _at(places[tensor, 2] + at, count), _at(places[tensor, 3] + at, count)
        rate, beta1, beta2, root, epsilon = numbers[tensor]
        adam_part(p, g, m, v, rate, beta1, beta2, root, epsilon, places[tensor, 5] != 0)
        task = take(next_task, 0) - others


@kernel
def adam_tensor(next_task, p, g, m, v, rate, beta1, beta2, root, epsilon, sparse):  # type: ignore[no-untyped-def]
    """``adam_part`` of a whole tensor (N,)."""
    begin = take(next_task, 0) * ADAM_CHUNK
    while begin < len(p):
        some = slice(begin, begin + ADAM_CHUNK)
        adam_part(p[some], g[some], m[some], v[some], rate, beta1, beta2, root, epsilon, sparse)
        begin = take(next_task, 0) * ADAM_CHUNK


def _numbers(step: AdamStep) -> tuple[float, ...]:
    root = 1 / math.sqrt(1 - step.beta2**step.number)
    return step.rate / (1 - step.beta1**step.number), step.beta1, step.beta2, root, step.epsilon


def places_and_numbers(parts: Sequence[AdamPart], levels: Mapping[int, tuple[np.ndarray, int]]) -> tuple[np.ndarray, np.ndarray]:
    """Of tensors as ``take_parts`` takes them, in the order in which their gradients are known; float32, contiguous.

    levels: of a table, by its address, where its levels in use begin and end, in rows, and which of ``done`` is the first one's.
    """
    found: list[tuple[list[int], tuple[float, ...]]] = []
    for *tensors, step in parts:
        addresses, numbers = [x.data_ptr() for x in tensors], _numbers(step)
        if addresses[0] not in levels:
            found.append(([*addresses, tensors[0].numel(), step.sparse, 0], numbers))
            continue
        offsets, first = levels[addresses[0]]
        for level, (begin, end) in enumerate(itertools.pairwise(offsets.tolist())):
            at = [x + 4 * FEATURES * begin for x in addresses]
            found.append(([*at, FEATURES * (end - begin), step.sparse, first + level], numbers))
    found.sort(key=lambda part: part[0][-1])
    places, of_steps = np.array([part[0] for part in found], np.int64), np.array([part[1] for part in found], np.float32)
    return places.reshape(-1, 7), of_steps.reshape(-1, 5)


def adam(parameter: Tensor, gradient: Tensor, first: Tensor, second: Tensor, step: AdamStep) -> None:
    """See ``reference.adam``; float32."""
    tensors, numbers = (parameter, gradient, first, second), (np.float32(x) for x in _numbers(step))
    flat = (x.detach().view(-1).numpy() for x in tensors)
    take_all(-(-parameter.numel() // _FOR_A_THREAD), adam_tensor, *flat, *numbers, step.sparse)
