"""How kernels are compiled: what Python calls, and what kernels alone call, which takes less time to compile for it."""

from __future__ import annotations

import functools

from numba import njit

_common = functools.partial(njit, nogil=True, error_model="numpy", no_cfunc_wrapper=True)

# called from Python; its code is kept on disk, with that of all that it calls
kernel = functools.partial(_common, cache=True)

# called from kernels alone: without the code that takes arguments from Python, a tenth of the time to compile. Python that calls one all
# the same ends in a crash (tests: ``from_python``)
part = functools.partial(_common, no_cpython_wrapper=True)

# put into what calls it before types are known
inlined = functools.partial(njit, inline="always", error_model="numpy")
