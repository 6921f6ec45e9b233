"""A GPU that is not there: tensors said to be on it lie in the CPU's memory, and what torch would refuse of a real one is refused.

torch's own devices cannot be had without their hardware, and one operation on tensors of two devices is the commonest fault of code that
ran on a CPU alone. What C++ does by itself is not seen: gradients are taken to be where what they are of is.
"""

from __future__ import annotations

import contextlib
import os
from collections import Counter
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any
from unittest import mock

import torch
from torch import Tensor
from torch.multiprocessing.reductions import StorageWeakRef
from torch.overrides import TorchFunctionMode

from mmsynth.bench.launches import READS
from mmsynth.fitting.graphs import Repeated

GPU, CPU = torch.device("cuda", 0), torch.device("cpu")
_DEVICE, _IS_CUDA, _GRAD = torch.Tensor.device.__get__, torch.Tensor.is_cuda.__get__, torch.Tensor.grad.__get__  # type: ignore[attr-defined]
_DATA_IS = torch.Tensor.data.__set__  # type: ignore[attr-defined]
# what takes tensors of two devices: copies, and places in a tensor, which may be the CPU's
_ANY = {"copy_", "__getitem__", "__setitem__", "load_state_dict", "_has_compatible_shallow_copy_type"}
_FROM_HOST = {"tensor", "new_tensor", "as_tensor", "asarray"}
_WAITS = READS | {"nonzero", "equal", "unique"}


class PretendedGpu(TorchFunctionMode):
    """Within, ``device="cuda"`` is a device like any other.

    Attributes:
        captured: whether what is done now is to be a graph: then the host may wait for nothing. captures: how often it was.
        waits: what the host waited for, outside of graphs.
    """

    def __init__(self) -> None:
        super().__init__()
        self.places: dict[int, tuple[StorageWeakRef, torch.device]] = {}  # a reference keeps the storage's address from being used again
        self.captured, self.captures = False, 0
        self.waits: Counter[str] = Counter()

    def place(self, tensor: Tensor) -> torch.device | None:
        """Where it is, None: nobody said."""
        found = self.places.get(tensor.untyped_storage()._cdata)
        return None if found is None else found[1]

    def put(self, tensor: Tensor, where: torch.device) -> Tensor:
        """As being there, if nobody said where it is."""
        storage = tensor.untyped_storage()
        if len(self.places) > 100_000:
            self.places = {k: v for k, v in self.places.items() if not v[0].expired()}
        self.places.setdefault(storage._cdata, (StorageWeakRef(storage), where))
        return tensor

    def is_there(self, tensor: Tensor) -> bool:
        where = self.place(tensor)
        return where == GPU or (where is None and torch._C._current_graph_task_id() != -1)

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs, name = dict(kwargs or {}), getattr(func, "__name__", "")
        if func == _DEVICE:
            return GPU if self.is_there(args[0]) else CPU
        if func == _IS_CUDA:
            return self.is_there(args[0])
        tensors = list(_tensors((args, kwargs)))
        there = [t for t in tensors if self.place(t) == GPU]
        if self.captured:
            self._check_capture(name, tensors, there, kwargs)
        elif there and (name in _WAITS or (name == "__getitem__" and any(t.dtype == torch.bool for t in _tensors(args[1:])))):
            self.waits[name] += 1
        if func == _GRAD:
            return func(*args) if (found := func(*args)) is None or not there else self.put(found, GPU)
        if func == torch.Tensor.backward:
            with self:
                return torch.autograd.backward(args[0], kwargs.get("gradient", args[1] if len(args) > 1 else None))
        if name in ("to", "cpu", "cuda"):
            return self._moved(name, args, kwargs)
        if name == "numpy" and there:
            if not (kwargs.get("force") or True in args[1:]):
                raise TypeError("can't convert cuda:0 device type tensor to numpy.")
            return args[0].detach().clone().numpy(force=True)
        if name == "__array__" and there:
            raise TypeError("can't convert cuda:0 device type tensor to numpy.")
        if func == _DATA_IS or name in _ANY:
            if name == "__getitem__" and there and not self.is_there(args[0]):
                raise RuntimeError("indices should be either on cpu or on the same device as the indexed tensor (cpu)")
            if name == "__getitem__" and there and args[0].dtype == torch.uint16 and any(isinstance(x, Tensor) for x in _tensors(args[1:])):
                raise NotImplementedError("\"index_cuda\" not implemented for 'UInt16'")
            if func == _DATA_IS or name != "__getitem__":
                return func(*args, **kwargs)
        elif there:
            here = [t for t in tensors if t.dim() and self.place(t) in ((CPU,) if torch._C._current_graph_task_id() != -1 else (CPU, None))]
            if here:
                raise RuntimeError(f"{name}: Expected all tensors to be on the same device, but found cuda:0 and cpu!")
        where = kwargs.get("device")
        if where is None:
            target = GPU if there else CPU if torch._C._current_graph_task_id() == -1 or not tensors else None
        else:
            target = GPU if torch.device(where).type == "cuda" else CPU
            kwargs["device"] = "cpu"
        kwargs.pop("pin_memory", None)
        generator = kwargs.get("generator")
        if target == GPU and generator is not None:
            raise RuntimeError("Expected a 'cuda' device type for generator but found 'cpu'")
        before = {t.untyped_storage()._cdata for t in tensors}
        result = func(*args, **kwargs)
        if target is not None:
            for t in _tensors(result):
                if where is not None and target == GPU and t.untyped_storage()._cdata in before and not self.is_there(t):
                    raise AssertionError(f"{name}: a copy to another device shares memory in this pretence")
                self.put(t, target)
        return result

    def _check_capture(self, name: str, tensors: list[Tensor], there: list[Tensor], kwargs: dict[str, Any]) -> None:
        """A graph cannot wait for what the device finds, nor read the host's memory."""
        mixed = name == "copy_" and 0 < len(there) < len(tensors)
        from_host = name in _FROM_HOST and torch.device(kwargs.get("device", "cuda" if there else "cpu")).type == "cuda"
        if mixed or from_host or (there and name in _WAITS):
            raise RuntimeError(f"{name}: operation not permitted when stream is capturing")

    def _moved(self, name: str, args: Any, kwargs: Any) -> Tensor:
        tensor, rest, target = args[0], list(args[1:]), GPU if self.is_there(args[0]) else CPU
        if name != "to":
            target, rest, kwargs = GPU if name == "cuda" else CPU, [], {}
        for holder, key in ((kwargs, "device"), (kwargs, "other"), *((rest, i) for i in range(len(rest)))):
            value = holder.get(key) if isinstance(holder, dict) else holder[key]
            if isinstance(value, str | torch.device):
                target, holder[key] = GPU if torch.device(value).type == "cuda" else CPU, "cpu"
            elif isinstance(value, Tensor):
                target = GPU if self.is_there(value) else CPU
        there = self.is_there(tensor)
        result = torch.Tensor.to(tensor, *rest, **kwargs) if rest or kwargs else tensor
        if (target == GPU) != there:
            if self.captured:
                raise RuntimeError(f"{name}: operation not permitted when stream is capturing")
            result = result.clone() if result.untyped_storage()._cdata == tensor.untyped_storage()._cdata else result
        return self.put(result, target)


def _tensors(found: Any) -> Iterator[Tensor]:
    if isinstance(found, Tensor):
        yield found
    elif isinstance(found, dict):
        for value in found.values():
            yield from _tensors(value)
    elif isinstance(found, tuple | list):
        for value in found:
            yield from _tensors(value)


@contextlib.contextmanager
def pretended_gpu() -> Iterator[PretendedGpu]:
    """Within, torch has one GPU. A graph is what it is captured from, done again: it refuses to wait, and to be given other arrays (of what
    Triton's kernels take, where they are interpreted)."""
    gpu = PretendedGpu()
    event = lambda: SimpleNamespace(record=lambda stream: None, synchronize=lambda: None, query=lambda: True)
    nothing: Callable[..., Any] = lambda *_: contextlib.nullcontext()

    graphs: dict[Repeated, list[Any]] = {}
    launched: list[Any] = []

    def again(repeated: Repeated) -> None:
        repeated.calls += 1
        if not repeated.capture or repeated.calls == 1:
            repeated.work()
            return
        there_before = {key for key, (storage, _) in gpu.places.items() if not storage.expired()}
        launched.clear()
        gpu.captured, gpu.captures = True, gpu.captures + 1
        try:
            repeated.work()
        finally:
            gpu.captured = False
        held = [(kernel, name, place) for kernel, name, storage, place in launched if storage in there_before]
        assert graphs.setdefault(repeated, held) == held, "a graph goes on with arrays that others have taken the place of"

    def noted(run: Callable[..., Any]) -> Callable[..., Any]:
        def launch(kernel: Any, *args: Any, **named: Any) -> Any:
            if gpu.captured:
                tensors = [(n, x) for n, x in zip(kernel.arg_names, args, strict=False) if isinstance(x, Tensor)]
                launched.extend((kernel.__name__, name, x.untyped_storage()._cdata, x.data_ptr()) for name, x in tensors)
            return run(kernel, *args, **named)

        return launch

    has = {
        "is_available": lambda: True, "device_count": lambda: 1, "get_device_name": lambda *_: "a pretence", "Event": event,
        "current_stream": lambda *_: None, "device_of": nothing, "device": nothing, "graph_pool_handle": lambda: None,
        "get_device_capability": lambda *_: (9, 0),
        "get_device_properties": lambda *_: SimpleNamespace(multi_processor_count=1), "synchronize": lambda *_: None,
        "max_memory_reserved": lambda *_: 0,
    }  # fmt: skip
    with contextlib.ExitStack() as stack:
        for name, value in has.items():
            stack.enter_context(mock.patch.object(torch.cuda, name, value))
        stack.enter_context(mock.patch.object(Repeated, "__call__", again))
        if os.environ.get("TRITON_INTERPRET") == "1":
            from triton.runtime.interpreter import InterpretedFunction

            stack.enter_context(mock.patch.object(InterpretedFunction, "run", noted(InterpretedFunction.run)))
        stack.enter_context(gpu)
        yield gpu
