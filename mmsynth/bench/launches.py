"""What a step on a GPU launches, and whether the host waits in it, counted without a GPU: on CPU tensors, Triton's kernels recorded instead
of run. No value of a step decides what it launches next, so the count is that of a GPU."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from mmsynth.bench.gpu import recorded_launches

_READS = {"item", "tolist", "numpy", "cpu", "__bool__", "__int__", "__float__", "__index__", "__array__"}
_WAITS = {"_local_scalar_dense", "nonzero", "is_nonzero", "equal", "masked_select", "unique_dim", "_unique2", "repeat_interleave"}
# what makes no kernel: memory, and other views of it
_NOTHING = {
    "empty",
    "empty_like",
    "empty_strided",
    "new_empty",
    "new_empty_strided",
    "detach",
    "alias",
    "_unsafe_view",
    "lift_fresh",
    "set_",
}


class Counted(NamedTuple):
    """By name: kernels of Triton; kernels of torch, one for each operation that makes one; what the host would wait for."""

    triton: Counter[str]
    torch: Counter[str]
    waits: Counter[str]

    @property
    def launches(self) -> int:
        return self.triton.total() + self.torch.total()


class _Operations(TorchDispatchMode):
    def __init__(self, counted: Counted) -> None:
        super().__init__()
        self.counted = counted

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func.overloadpacket.__name__
        if name in _WAITS:
            self.counted.waits[name] += 1
        elif not func.is_view and name not in _NOTHING:
            self.counted.torch[name] += 1
        return func(*args, **(kwargs or {}))


class _Reads(TorchFunctionMode):
    def __init__(self, counted: Counted) -> None:
        super().__init__()
        self.counted = counted

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = getattr(func, "__name__", "")
        if name in _READS:
            self.counted.waits[name] += 1
        return func(*args, **(kwargs or {}))


def count(work: Callable[[], Any]) -> Counted:
    """What ``work`` launches and where it waits; its results are whatever memory held."""
    counted = Counted(Counter(), Counter(), Counter())
    with recorded_launches() as launches, _Operations(counted), _Reads(counted):
        work()
    counted.triton.update(launch.name for launch in launches)
    return counted
