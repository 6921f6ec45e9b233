"""Parts of kernels, which kernels alone call, called by tests."""

from collections.abc import Callable
from typing import Any

from numba import njit


def from_python(part: Any) -> Callable[..., Any]:
    @njit(error_model="numpy")
    def call(*arguments: Any) -> Any:
        return part(*arguments)

    return call
