"""The operations that a field is made of: tensors in, tensors out. The back end follows the tensors.

numba for float32 on the CPU (``cpu``), Triton for float32 on a GPU where it runs (``cuda``), torch elsewhere. ``reference``, with
``shading``, ``mirroring`` and ``drawing``, defines every operation; docstrings are there. Each back end has all of them under the same
names: its own, the reference's, or the reference's made of its own parts. ``parameters`` says what they take, ``constants`` what they
agree on. README.md says how to add one.
"""

from __future__ import annotations

import functools
import math
import sys
from collections.abc import Callable, Sequence
from types import ModuleType

import torch
from torch import Tensor

from mmsynth.field.kernels import cpu, learning, reference
from mmsynth.field.kernels.constants import OUTSIDE, SHELL, SOLID
from mmsynth.field.kernels.learning import no_light
from mmsynth.field.kernels.mirroring import Reflection, Surroundings, surround
from mmsynth.field.kernels.parameters import (
    AdamPart,
    AdamStep,
    Arranged,
    Cameras,
    Cells,
    Drawing,
    Drawn,
    Eikonal,
    Frames,
    Gains,
    GridTable,
    Hits,
    Lamps,
    Learned,
    LightNetwork,
    Measured,
    Mirrors,
    Modalities,
    Opacities,
    Rays,
    Samples,
    Sampling,
    Selection,
    ShadedRays,
    ShaderWeights,
    Smooth,
    Step,
    SurfaceNetwork,
    View,
)
from mmsynth.field.kernels.reference import contract, contracted_velocity
from mmsynth.field.kernels.shading import intensity, photometric, predict, radiance, rays_of, residual

__all__ = [
    "OUTSIDE",
    "SHELL",
    "SOLID",
    "AdamPart",
    "AdamStep",
    "Arranged",
    "Cameras",
    "Cells",
    "Drawing",
    "Drawn",
    "Eikonal",
    "Frames",
    "Gains",
    "GridTable",
    "Hits",
    "Lamps",
    "Learned",
    "LightNetwork",
    "Measured",
    "Mirrors",
    "Modalities",
    "Opacities",
    "Rays",
    "Reflection",
    "Samples",
    "Sampling",
    "Selection",
    "ShadedRays",
    "ShaderWeights",
    "Smooth",
    "Step",
    "SurfaceNetwork",
    "Surroundings",
    "View",
    "adam",
    "arrange",
    "classify",
    "compare",
    "contract",
    "contracted_velocity",
    "draw",
    "fused_on_gpu",
    "hash_encode",
    "intensity",
    "learn",
    "made_on_gpu",
    "march",
    "mirror",
    "no_light",
    "odds",
    "photometric",
    "predict",
    "radiance",
    "rays_of",
    "reflect",
    "residual",
    "section_weights",
    "shade",
    "surface_value",
    "surround",
    "trace",
]  # fmt: skip


@functools.cache
def _on_gpu() -> ModuleType:
    """What serves float32 tensors on a GPU; where that is not Triton, one line on stderr says so, once."""
    from mmsynth.field.kernels import cuda  # triton takes its time to import

    can, why = cuda.available()
    if not can:
        print(f"GPU kernels unavailable ({why}): using torch operations", file=sys.stderr, flush=True)
    return cuda if can else reference


def fused_on_gpu() -> bool:
    """Whether Triton serves this machine's GPU."""
    return _on_gpu() is not reference


def made_on_gpu() -> int:
    """How many kernels Triton compiled, or loaded, until now: what asked for them waited."""
    backend = _on_gpu()
    return 0 if backend is reference else int(backend.made())


def _backend(tensor: Tensor) -> ModuleType:
    if tensor.dtype != torch.float32:
        return reference
    return cpu if tensor.device.type == "cpu" else _on_gpu() if tensor.device.type == "cuda" else reference


def hash_encode(positions: Tensor, table: Tensor, resolutions: Tensor, offsets: Tensor, active: int) -> Tensor:
    """Features of unit positions from a multiresolution hash grid."""
    return _backend(table).hash_encode(positions, table, resolutions, offsets, active)


def surface_value(positions: Tensor, grid: GridTable, network: SurfaceNetwork) -> Tensor:
    """Signed distances of positions."""
    return _backend(positions).surface_value(positions, grid, network)


def classify(states: Tensor, cells: Cells, grid: GridTable, network: SurfaceNetwork) -> None:
    """States of the cells of a three-state grid, in place, by a surface."""
    if _backend(network.hidden) is cpu:
        cpu.classify(states, cells, grid, network)
        return
    reference.classify(states, cells, lambda positions: surface_value(positions, grid, network))


def march(sdf: Callable[[Tensor], Tensor], rays: Rays, states: Tensor, extent: float, sampling: Sampling) -> Samples:
    """Samples of rays through the three-state grid."""
    return _backend(rays.origins).march(sdf, rays, states, extent, sampling)


def section_weights(sdf: Tensor, sharpness: float, offsets: Tensor) -> tuple[Tensor, Tensor]:
    """Volume-rendering weights of packed sections, and where each crosses the surface."""
    return _backend(sdf).section_weights(sdf, sharpness, offsets)


def trace(grid: GridTable, network: SurfaceNetwork, appearance: GridTable, states: Tensor, rays: Rays, sampling: Sampling) -> Hits:
    """What rays meet: marched, evaluated, weighed and composited."""
    return _backend(rays.origins).trace(grid, network, appearance, states, rays, sampling)


def shade(weights: ShaderWeights, features: Tensor, directions: Tensor, degrees: Tensor | int) -> Tensor:
    """The shader's outputs for rays."""
    return _backend(features).shade(weights, features, directions, degrees)


def compare(
    weights: ShaderWeights, rays: ShadedRays, measured: Measured, gain: Tensor | None = None, mirrored: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """The photometric loss of what was measured along rays, and all squared residuals."""
    return _backend(rays.features).compare(weights, rays, measured, gain, mirrored)


def mirror(lamps: Lamps, mirrors: Mirrors, behind: Tensor, measured: Measured) -> Tensor:
    """Mirrored light in each measured number."""
    return _backend(mirrors.share).mirror(lamps, mirrors, behind, measured)


def reflect(position: Tensor, mirrors: Mirrors) -> Reflection:
    """What surfaces mirror of each lamp."""
    return _backend(mirrors.share).reflect(position, mirrors)


def arrange(step: Step, ahead: Sequence[Drawing] = ()) -> Arranged:
    """What ``learn`` takes. It may be made while the step before is learned: what is in the tensors may change in place until then.

    Args:
        ahead: what is drawn beside the step, two drawings at the most.
    """
    return cpu.arrange(step, ahead) if _backend(step.rays.origins) is cpu else Arranged(step, tuple(ahead))


def learn(
    arranged: Arranged,
    update: Callable[[], Sequence[AdamPart]] | None = None,
    meanwhile: Callable[[Learned], None] | None = None,
) -> Learned:
    """A step's loss, its gradients, added to ``grad`` of what is learned, and a step of Adam. Python has its time beside the kernels.

    Args:
        update: gives what moves by its gradient, which is cleared; where the loss or a gradient is not finite nothing moves, and they stay.
        meanwhile: called with what was learned, before or while that moves: the sum of all gradients may not be known then.
    """
    step, ahead, _ = arranged
    backend = _backend(step.rays.origins)
    if backend is cpu:
        return cpu.learn(arranged, update, meanwhile)
    learned: Learned = learning.learn(step) if backend is reference else backend.learn(step)
    learned = learned._replace(drawn=tuple(draw(*drawing) for drawing in ahead))
    if meanwhile is not None:
        meanwhile(learned)
    if update is not None and math.isfinite(learned.loss) and math.isfinite(learned.gradients):
        with torch.no_grad():
            for part in update():
                adam(*part)
    return learned


def draw(
    frames: Frames, cameras: Cameras, modalities: Modalities, selection: Selection, rays: Sequence[int], key: tuple[int, int]
) -> Drawn:
    """Random photosites, the rays through them, and what was measured along these."""
    return _backend(frames.origin).draw(frames, cameras, modalities, selection, rays, key)


def odds(residual: Tensor, count: Tensor, first_tile: Tensor, evenly: float) -> tuple[Tensor, Tensor]:
    """How often each tile of the frames is drawn, and the weights of its rays."""
    return _backend(residual).odds(residual, count, first_tile, evenly)


def adam(parameter: Tensor, gradient: Tensor, first: Tensor, second: Tensor, step: AdamStep) -> None:
    """One step of Adam, in place."""
    _backend(parameter).adam(parameter, gradient, first, second, step)
