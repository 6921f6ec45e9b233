"""One signature per operation; the backend follows the tensors.

numba for float32 on the CPU (fused), Triton for float32 on a GPU where it runs, torch (``reference``) elsewhere.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from types import ModuleType
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mmsynth.field.kernels import cpu, reference
from mmsynth.field.kernels.reference import OUTSIDE, SHELL, SOLID, contract, exclusive_sum

if TYPE_CHECKING:
    from mmsynth.field.rendering import Sampling
    from mmsynth.field.surface import Surface

__all__ = [
    "OUTSIDE",
    "SHELL",
    "SOLID",
    "adam",
    "announce_compilation",
    "contract",
    "cpu",
    "exclusive_sum",
    "hash_encode",
    "march",
    "on_cpu",
    "section_weights",
    "surface_value",
]


def on_cpu(tensor: Tensor) -> bool:
    """Whether the fused kernels of the CPU apply."""
    return tensor.device.type == "cpu" and tensor.dtype == torch.float32


@functools.cache
def _on_gpu() -> ModuleType:
    """What serves float32 tensors on a GPU; where that is not Triton, one line on stderr says so, once."""
    from mmsynth.field.kernels import cuda  # triton takes its time to import

    can, why = cuda.available()
    if not can:
        print(f"GPU kernels unavailable ({why}): using torch operations", file=sys.stderr, flush=True)
    return cuda if can else reference


def _backend(tensor: Tensor) -> ModuleType:
    return _on_gpu() if tensor.device.type == "cuda" and tensor.dtype == torch.float32 else reference


def hash_encode(positions: Tensor, table: Tensor, resolutions: Tensor, offsets: Tensor, active: int) -> Tensor:
    """Multiresolution hash encoding; see ``reference.hash_encode``."""
    return _backend(table).hash_encode(positions, table, resolutions, offsets, active)


def surface_value(surface: Surface, positions: Tensor, active: int) -> Tensor:
    """Signed distances; see ``Surface.forward``."""
    if on_cpu(positions):
        return cpu.surface_value(surface, positions, active)
    backend = reference if torch.is_grad_enabled() else _backend(positions)
    return surface.reference(positions, active) if backend is reference else backend.surface_value(surface, positions, active)


def march(
    sdf: Callable[[Tensor], Tensor],
    origins: Tensor,
    directions: Tensor,
    near: Tensor,
    far: Tensor,
    jitter: Tensor,
    states: Tensor,
    extent: float,
    sampling: Sampling,
) -> tuple[Tensor, Tensor, Tensor]:
    """Samples of rays through the three-state grid; see ``reference.march``."""
    return _backend(origins).march(sdf, origins, directions, near, far, jitter, states, extent, sampling)


def section_weights(sdf: Tensor, sharpness: float, offsets: Tensor) -> tuple[Tensor, Tensor]:
    """Volume-rendering weights of packed sections; see ``reference.section_weights``."""
    return _backend(sdf).section_weights(sdf, sharpness, offsets)


def adam(
    parameter: Tensor, gradient: Tensor, first: Tensor, second: Tensor, rate: float, beta1: float, beta2: float, epsilon: float, count: int
) -> None:
    """One step of Adam; see ``reference.adam``."""
    backend = cpu if on_cpu(parameter) else reference
    backend.adam(parameter, gradient, first, second, rate, beta1, beta2, epsilon, count)


@functools.cache
def announce_compilation() -> None:
    """Compile the CPU kernels of a fit if they never were, and say so, or load them: a tiny fit, so that no timed loop does it."""
    from mmsynth.field.encoding import HashGrid  # the field is made of these kernels
    from mmsynth.field.occupancy import Occupancy
    from mmsynth.field.radiance import Shader
    from mmsynth.field.rendering import Sampling, trace
    from mmsynth.field.surface import Surface
    from mmsynth.scene.scene import Sensor

    if not cpu.is_compiled():
        print("compiling kernels once, ~25 s ...", file=sys.stderr, flush=True)
    with torch.random.fork_rng(devices=[]), torch.enable_grad():
        surface, appearance = Surface(HashGrid(1, 8, 4, 4), 4, (0.5, 4.0)), HashGrid(1, 8, 4, 4)
        origins, directions = torch.tensor([[0.0, 0.0, -2.0]]), torch.tensor([[0.0, 0.0, 1.0]])
        hits = trace(surface, appearance, Occupancy(4), origins, directions, torch.zeros(1), Sampling(20.0, 0.1, 1, 1))
        shader = Shader(4, 4, {"grey": Sensor("grey", ("L",), (None,))}, {"grey": 1.0})
        one, index = torch.ones(1), torch.zeros(1, dtype=torch.int64)
        rays, numbers = (directions, index, index == 0), (one, index, index, torch.empty(0, 3), one, one, one)
        loss, _ = cpu.compare(shader, hits.features, hits.opacity, rays, numbers, None)
        (loss + surface(origins, 1).sum()).backward()
        cpu.shade(shader, hits.features, directions, 0)
    for count in (1, cpu.PART + 1):
        parameter, gradient, first, second = torch.zeros(4, count)
        adam(parameter, gradient, first, second, 1e-3, 0.9, 0.99, 1e-15, 1)
