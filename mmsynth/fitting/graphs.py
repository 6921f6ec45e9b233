"""Work that a GPU repeats, as one CUDA graph."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch


class Repeated:
    """Work that is done again and again with the same arrays: the first time as it is, then as a graph that is captured once.

    The first time compiles kernels and makes what is made once, which a graph cannot hold. Where there is no GPU, or ``capture`` is off, it
    is done as it is every time.

    Args:
        work: launches kernels and reads nothing back; what it makes on its way is used within it alone.
        pool: memory that graphs share of which one runs at a time, ``torch.cuda.graph_pool_handle``; None: its own.
    """

    def __init__(self, work: Callable[[], None], device: torch.device, capture: bool = True, pool: Any = None) -> None:
        self.work, self.device, self.capture, self.pool = work, device, capture and device.type == "cuda", pool
        self.graph: torch.cuda.CUDAGraph | None = None
        self.calls = 0

    def __call__(self) -> None:
        self.calls += 1
        if not self.capture or self.calls == 1:
            self.work()
            return
        with torch.cuda.device(self.device):
            if self.graph is None:
                self.graph = torch.cuda.CUDAGraph()
                with torch.cuda.graph(self.graph, pool=self.pool):  # records, and does nothing yet
                    self.work()
            self.graph.replay()
