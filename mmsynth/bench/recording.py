"""Launches of Triton kernels, recorded and not run: what is compiled, and how many a step has."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any, NamedTuple
from unittest import mock


class Launch(NamedTuple):
    """One call of a Triton kernel. arguments: by name, tensors, numbers and constants. programs: of its grid. options: of the compiler."""

    kernel: Any
    arguments: dict[str, Any]
    programs: tuple[int, ...]
    options: dict[str, int]

    @property
    def name(self) -> str:
        return str(self.kernel.fn.__name__).removesuffix("_kernel")


@contextlib.contextmanager
def recorded_launches() -> Iterator[list[Launch]]:
    """Within, launches of Triton kernels are kept in the list that this gives, and do not run: outputs are whatever memory held."""
    from triton.runtime.jit import JITFunction

    launches: list[Launch] = []

    def run(kernel: Any, *args: Any, grid: Any, warmup: bool, **named: Any) -> None:
        arguments = dict(zip(kernel.arg_names, args, strict=False)) | {k: v for k, v in named.items() if k in kernel.arg_names}
        options = {k: v for k, v in named.items() if k not in kernel.arg_names}
        launches.append(Launch(kernel, arguments, tuple(grid), {"num_warps": 4} | options))

    with mock.patch.object(JITFunction, "run", run):
        yield launches
