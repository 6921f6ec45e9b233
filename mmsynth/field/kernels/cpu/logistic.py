"""The logistic distribution of many numbers at once, in double precision: what LLVM does not make vectors of by itself."""

from __future__ import annotations

import math

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

_LOG2E, _LN2_HIGH, _LN2_LOW = 1.4426950408889634, 0.6931471803691238, 1.9082149292705877e-10
_MOST = 700.0  # e^-700 is a number still
_EXP = tuple(1.0 / math.factorial(k) for k in range(12))
_ATANH = tuple(2.0 / (2 * k + 1) for k in range(13))


@intrinsic
def _power_of_two(typingctx, exponent):  # type: ignore[no-untyped-def]
    """2^k of a whole number k >= -1022, from its bits."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        i64 = ir.IntType(64)
        whole = builder.add(builder.fptosi(args[0], i64), ir.Constant(i64, 1023))
        return builder.bitcast(builder.shl(whole, ir.Constant(i64, 52)), ir.DoubleType())

    return types.float64(types.float64), codegen


@njit(cache=True, fastmath={"contract", "nsz"}, nogil=True, error_model="numpy")
def negative_log_cdf(values, n, sharpness, out, density):  # type: ignore[no-untyped-def]
    """-log Φ(s f) = softplus(-s f) of n values f, and minus its slope over s, 1 - Φ(s f); relative error below 1e-11.

    e^-|x| = 2^k e^r with |r| <= ln 2 / 2, by its series; log(1 + e) = 2 artanh(e / (2 + e)), by its.
    """
    for i in range(n):
        x = -sharpness * np.float64(values[i])
        size = min(abs(x), _MOST)  # below, softplus is its argument, or less than 1e-300
        k = math.floor(0.5 - size * _LOG2E)
        r = (-size - k * _LN2_HIGH) - k * _LN2_LOW
        e = _EXP[11]
        for j in range(10, -1, -1):
            e = e * r + _EXP[j]
        e *= _power_of_two(k)
        z = e / (2.0 + e)
        square = z * z
        log1p = _ATANH[12]
        for j in range(11, -1, -1):
            log1p = log1p * square + _ATANH[j]
        out[i] = max(x, 0.0) + z * log1p + 0.0 * x  # what is not finite is seen
        density[i] = (1.0 if x > 0.0 else e) / (1.0 + e)
