"""One signature per operation; the backend follows the tensors: numba for float32 on the CPU, torch elsewhere."""

from __future__ import annotations

import sys

import torch
from torch import Tensor

from mmsynth.field.kernels import cpu, reference
from mmsynth.field.kernels.reference import OUTSIDE, SHELL, SOLID, accumulate

__all__ = ["OUTSIDE", "SHELL", "SOLID", "accumulate", "announce_compilation", "hash_encode", "march", "section_weights"]


def _on_cpu(tensor: Tensor) -> bool:
    return tensor.device.type == "cpu" and tensor.dtype == torch.float32


def hash_encode(positions: Tensor, table: Tensor, resolutions: Tensor, offsets: Tensor, active: int) -> Tensor:
    """Multiresolution hash encoding; see ``reference.hash_encode``."""
    backend = cpu if _on_cpu(table) and table.shape[1] == 2 else reference
    return backend.hash_encode(positions, table, resolutions, offsets, active)


def march(
    origins: Tensor, directions: Tensor, near: Tensor, far: Tensor, jitter: Tensor, states: Tensor, step: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Samples of rays through the three-state grid; see ``reference.march``."""
    backend = cpu if _on_cpu(origins) else reference
    return backend.march(origins, directions, near, far, jitter, states, step)


def section_weights(sdf: Tensor, sharpness: float, offsets: Tensor) -> tuple[Tensor, Tensor]:
    """Volume-rendering weights of packed sections; see ``reference.section_weights``."""
    backend = cpu if _on_cpu(sdf) else reference
    return backend.section_weights(sdf, sharpness, offsets)


def announce_compilation() -> None:
    """Compile the CPU kernels now if they never were, and say so: it happens once per machine."""
    if not cpu.is_compiled():
        print("compiling kernels once, ~10 s ...", file=sys.stderr, flush=True)
    cpu.compile_all()
