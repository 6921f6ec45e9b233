"""Adam on the CPU."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from torch import Tensor

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


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def adam_parts(p, g, m, v, rate, beta1, beta2, root, epsilon, sparse):  # type: ignore[no-untyped-def]
    """``adam_part`` of many parameters."""
    count = p.shape[0]
    for chunk in prange((count + ADAM_CHUNK - 1) // ADAM_CHUNK):
        begin = np.int64(chunk) * ADAM_CHUNK
        end = min(count, begin + ADAM_CHUNK)
        adam_part(p[begin:end], g[begin:end], m[begin:end], v[begin:end], rate, beta1, beta2, root, epsilon, sparse)


def adam(parameter: Tensor, gradient: Tensor, first: Tensor, second: Tensor, step: AdamStep) -> None:
    """See ``reference.adam``; float32."""
    arrays = (x.detach().view(-1).numpy() for x in (parameter, gradient, first, second))
    f = np.float32
    rate, beta1, beta2, epsilon, count, sparse = step
    parts = adam_parts if parameter.numel() > ADAM_CHUNK else adam_part  # to wake the other threads would take longer than the work
    parts(*arrays, f(rate / (1 - beta1**count)), f(beta1), f(beta2), f(1 / math.sqrt(1 - beta2**count)), f(epsilon), sparse)  # type: ignore[call-arg]
