"""Adam in Triton, and what decides whether a step is taken: on the device, so that no host waits for it."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from mmsynth.field.kernels.cuda.shared import jit, tl, triton
from mmsynth.field.kernels.parameters import AdamStep

_BLOCK = 1024
_CHECKED = 4096  # numbers of a gradient at a time


@jit
def _move(parameter, gradient, first, second, i, take, rate, root, beta1, beta2, epsilon, SPARSE: tl.constexpr):  # type: ignore[no-untyped-def]
    """A step of the numbers i where ``take``; their gradients are cleared. rate, root: with the corrections of the moments' bias."""
    g = tl.load(gradient + i, mask=take, other=0.0)
    moved = take & (g != 0.0) if SPARSE else take
    m = beta1 * tl.load(first + i, mask=moved, other=0.0) + (1.0 - beta1) * g
    v = beta2 * tl.load(second + i, mask=moved, other=0.0) + (1.0 - beta2) * g * g
    p = tl.load(parameter + i, mask=moved, other=0.0)
    tl.store(first + i, m, mask=moved)
    tl.store(second + i, v, mask=moved)
    tl.store(parameter + i, p - rate * m / (tl.sqrt(v) * root + epsilon), mask=moved)


@jit
def adam_kernel(  # type: ignore[no-untyped-def]
    parameter, gradient, first, second, rate, root, beta1, beta2, epsilon, count, SPARSE: tl.constexpr, BLOCK: tl.constexpr
):
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    _move(parameter, gradient, first, second, i, i < count, rate, root, beta1, beta2, epsilon, SPARSE)
    tl.debug_barrier()  # another thread may clear what this one has loaded
    tl.store(gradient + i, 0.0, mask=i < count)


@jit
def guarded_adam_kernel(  # type: ignore[no-untyped-def]
    parameter, gradient, first, second, rates, kinds, factors, betas2, steps, beta1, log_beta1, epsilon, count,
    KIND: tl.constexpr, SPARSE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Rates of the step are rates × factors[kind], β₂ is betas2[kind]. KIND: of all numbers, which have the one rate; -1: each has its own
    rate and kind."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = i < count
    good = tl.load(steps) != 0
    number = tl.load(steps + 1).to(tl.float32)
    if KIND < 0:
        kind = tl.load(kinds + i, mask=live, other=0).to(tl.int32)
        rate, beta2 = tl.load(rates + i, mask=live, other=0.0) * tl.load(factors + kind), tl.load(betas2 + kind)
    else:
        rate, beta2 = tl.load(rates) * tl.load(factors + KIND), tl.load(betas2 + KIND)
    one, two = 1.0 - tl.exp(number * log_beta1), 1.0 - tl.exp(number * tl.log(beta2))
    _move(parameter, gradient, first, second, i, live & good, rate / one, 1.0 / tl.sqrt(two), beta1, beta2, epsilon, SPARSE)
    tl.debug_barrier()
    tl.store(gradient + i, 0.0, mask=live)


@jit
def check_kernel(loss, rows, gradient, count, samples, steps, sums, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    """Whether loss and gradients are finite: steps[0]; steps[1]: how often they were. sums: of steps, of those that were not, of samples
    and of the losses of good steps."""
    k = tl.arange(0, BLOCK)
    total = tl.zeros([BLOCK], tl.float64)
    for begin in range(0, rows, BLOCK):
        total += tl.load(loss + begin + k, mask=begin + k < rows, other=0.0)
    value = tl.sum(total, 0)
    # what is NaN in a sample is NaN in a sum
    found = tl.zeros([BLOCK], tl.float32)
    for begin in range(0, count, BLOCK):
        found += tl.load(gradient + begin + k, mask=begin + k < count, other=0.0)
    whole = tl.sum(found, 0)
    good = (value - value == 0.0) & (whole - whole == 0.0)
    tl.store(steps, good.to(tl.int32))
    tl.store(steps + 1, tl.load(steps + 1) + good.to(tl.int32))
    tl.store(sums, tl.load(sums) + 1.0)
    tl.store(sums + 1, tl.load(sums + 1) + (1 - good.to(tl.int32)).to(tl.float64))
    tl.store(sums + 2, tl.load(sums + 2) + tl.load(samples).to(tl.float64))
    tl.store(sums + 3, tl.load(sums + 3) + tl.where(good, value, 0.0))


def adam(parameter: Tensor, gradient: Tensor, first: Tensor, second: Tensor, step: AdamStep) -> None:
    """See ``reference.adam``; float32, contiguous."""
    rate, beta1, beta2, epsilon, number, sparse = step
    count = parameter.numel()
    if count:
        with torch.cuda.device_of(parameter), torch.no_grad():
            adam_kernel[(triton.cdiv(count, _BLOCK),)](
                parameter, gradient, first, second, rate / (1 - beta1**number), 1 / math.sqrt(1 - beta2**number), beta1, beta2, epsilon,
                count, sparse, _BLOCK,
            )  # fmt: skip


def guarded_adam(
    parameter: Tensor, gradient: Tensor, moments: tuple[Tensor, Tensor], rates: Tensor, kinds: Tensor | int,
    of_kinds: tuple[Tensor, Tensor], steps: Tensor, beta1: float, epsilon: float, sparse: bool = False,
) -> None:  # fmt: skip
    """A step of Adam that the device decides on: parameters and moments stay as they are where ``check`` found it bad; one launch.

    Args:
        rates: (N,), or of all, (1,). kinds: (N,) uint8 or of all: which of ``of_kinds``, (K,) float32 each, is theirs: factors that rates
            are multiplied by, and β₂.
        steps: (2,) int32, of ``check``: whether to step, and the number of the step, 1 at the first.
    """
    count = parameter.numel()
    if count:
        each = isinstance(kinds, Tensor)
        with torch.cuda.device_of(parameter), torch.no_grad():
            guarded_adam_kernel[(triton.cdiv(count, _BLOCK),)](
                parameter, gradient, *moments, rates, kinds if each else rates, *of_kinds, steps, beta1, math.log(beta1), epsilon, count,
                -1 if each else kinds, sparse, _BLOCK,
            )  # fmt: skip


def check(loss: Tensor, gradient: Tensor, samples: Tensor, steps: Tensor, sums: Tensor) -> None:
    """Decide whether a step is taken; one launch.

    Args:
        loss: (rows,) float64, to be summed. gradient: (N,). samples: a number.
        steps: (2,) int32: whether all of this is finite, how often it was. sums: (4,) float64: of steps, of those that were not, of samples
            and of the losses of those that were.
    """
    with torch.cuda.device_of(loss):
        check_kernel[(1,)](loss, len(loss), gradient, gradient.numel(), samples, steps, sums, _CHECKED, num_warps=8)
