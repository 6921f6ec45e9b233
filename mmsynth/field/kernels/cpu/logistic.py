"""The logistic distribution of many numbers at once: exponentials that LLVM makes vectors of, as it does not of those of ``math``."""

from __future__ import annotations

import math

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from mmsynth.field.kernels.cpu.jit import inlined, part

_LOG2E, _LN2_HIGH, _LN2_LOW = 1.4426950408889634, 0.6931471803691238, 1.9082149292705877e-10
_MOST = 700.0  # e^-700 is a number still
_EXP = tuple(1.0 / math.factorial(k) for k in range(12))
_ATANH = tuple(2.0 / (2 * k + 1) for k in range(13))


_f = np.float32
_MOST_SINGLE, _LOG2E_SINGLE, _LN2_HIGH_SINGLE, _LN2_LOW_SINGLE = _f(80.0), _f(_LOG2E), _f(0.693359375), _f(-2.12194440e-4)
_EXP_SINGLE, _ATANH_SINGLE = tuple(map(_f, _EXP[:8])), tuple(map(_f, _ATANH[:7]))


@intrinsic
def _power_of_two(typingctx, exponent):  # type: ignore[no-untyped-def]
    """2^k from its bits: in single precision of an int32 k >= -126, in double of an int64 k >= -1022."""
    single = exponent == types.int32
    bias, mantissa = (127, 23) if single else (1023, 52)

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        integer = args[0].type
        whole = builder.add(args[0], ir.Constant(integer, bias))
        return builder.bitcast(builder.shl(whole, ir.Constant(integer, mantissa)), ir.FloatType() if single else ir.DoubleType())

    return (types.float32 if single else types.float64)(exponent), codegen


@part(fastmath={"contract", "nsz"})
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


@inlined()
def _softplus(x):  # type: ignore[no-untyped-def]
    """See ``softplus_of``."""
    one, two, zero = _f(1.0), _f(2.0), _f(0.0)
    size = min(abs(x), _MOST_SINGLE)
    k = np.int32(-np.int32(size * _LOG2E_SINGLE + _f(0.5)))
    r = (-size - _f(k) * _LN2_HIGH_SINGLE) - _f(k) * _LN2_LOW_SINGLE
    e = _EXP_SINGLE[7]
    for j in range(6, -1, -1):
        e = e * r + _EXP_SINGLE[j]
    e *= _power_of_two(k)
    z = e / (two + e)
    square = z * z
    log1p = _ATANH_SINGLE[6]
    for j in range(5, -1, -1):
        log1p = log1p * square + _ATANH_SINGLE[j]
    return max(x, zero) + z * log1p + zero * x, (one if x > zero else e) / (one + e) + zero * x


@part(fastmath={"contract", "nsz"})
def softplus(values, n, out, slope):  # type: ignore[no-untyped-def]
    """``softplus_of`` n numbers at once."""
    for i in range(n):
        out[i], slope[i] = _softplus(values[i])


@part(fastmath={"contract", "nsz"})
def softplus_of(x):  # type: ignore[no-untyped-def]
    """log(1 + e^x) and its slope, 1 / (1 + e^-x), in single precision; see ``negative_log_cdf``."""
    return _softplus(x)
