"""Russian roulette of gradients on the CPU: what is small is left out or made larger by chance, so that the sum is right in the mean.

Of the rows that a step could add to its tables a few hold nearly all: of the bench room's samples a twentieth has 96 % of the squared
gradient. A row of size below ``least`` stays with a chance of size / least, and is then that large (Arvo and Kirk, Particle transport and
image synthesis, 1990). What is not finite is never left out.
"""

from __future__ import annotations

import math

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from mmsynth.field.kernels.cpu.drawing import scramble
from mmsynth.field.kernels.cpu.jit import inlined, part

_f = np.float32
_ZERO, _ONE = _f(0.0), _f(1.0)


@intrinsic
def _bits(typingctx, number):  # type: ignore[no-untyped-def]
    """Of a float32, as a uint32."""
    return types.uint32(types.float32), lambda context, builder, signature, args: builder.bitcast(args[0], ir.IntType(32))


@part()
def least_of(sizes, n, share):  # type: ignore[no-untyped-def]
    """The size below which chance decides: ``share`` of the root mean square of those of n rows that are not 0, of either sign."""
    squares, some = 0.0, 0
    for i in range(n):
        squares += np.float64(sizes[i]) * np.float64(sizes[i])
        some += sizes[i] != _ZERO
    return share * _f(math.sqrt(squares / max(some, 1)))


@part()
def first_chance(least):  # type: ignore[no-untyped-def]
    """Where chance begins, in [0, 1): scrambled from the bits of a size, so that the same step is the same to the bit."""
    return _f(scramble(_bits(least)) >> np.uint32(8)) * _f(2.0**-24)


@inlined()
def play(size, least, chance):  # type: ignore[no-untyped-def]
    """What the next row is multiplied by, 0 if it is left out, and chance after it: it grows by size / least, and the row stays where that
    makes a whole one. So of rows that follow each other, and are alike, the sum is known to one row (systematic sampling)."""
    if not size < least:
        return _ONE, chance
    chance += size / least
    if chance < _ONE:
        return _ZERO, chance
    return least / size, chance - _ONE
