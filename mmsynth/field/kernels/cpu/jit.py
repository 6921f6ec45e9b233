"""How kernels are compiled: what Python calls, and what kernels alone call, which takes less time to compile for it."""

from __future__ import annotations

import functools

from numba import njit

_common = functools.partial(njit, nogil=True, error_model="numpy", no_cfunc_wrapper=True)

# called from Python; its code is kept on disk, with that of all that it calls
kernel = functools.partial(_common, cache=True)

# called from kernels alone: without the code that takes arguments from Python, which is most of a small function's and made for each type.
# Python that calls it all the same ends in a crash
part = functools.partial(_common, no_cpython_wrapper=True)

# put into what calls it before types are known: as fast, also in a loop, where arguments are many and the function small
inlined = functools.partial(njit, inline="always", error_model="numpy")
