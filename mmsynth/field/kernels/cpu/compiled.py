"""The kernels of a fit, and whether they have code."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mmsynth.field.kernels.cpu import (
    blocks,
    drawing,
    learning,
    marching,
    mirroring,
    mirrors,
    optimiser,
    shading,
    surface,
    tracing_gradients,
)
from mmsynth.field.kernels.cpu.caching import publish, remove_old_versions

KERNELS = (
    surface.surface_forward, surface.surface_backward, surface.surface_scatter, surface.classify,
    marching.trace_forward, tracing_gradients.trace_backward, tracing_gradients.trace_rays_backward, tracing_gradients.trace_scatter,
    shading.compare, shading.shade, mirroring.mirror, mirroring.mirror_backward, mirroring.reflect,
    learning.learn_rays, learning.finish, drawing.draw_rays, drawing.fill_odds, optimiser.adam_tensor,
    blocks.surface_weights, shading.two_layers, mirrors.lamps_and_layers,
)  # fmt: skip


def is_compiled() -> bool:
    """Whether every kernel has code for its usual types, in this process or in the cache on disk."""
    return all(k.signatures or _cached(k) for k in KERNELS)


def keep_compiled(folder: Path) -> None:
    """Put kernels that a process compiled with a folder of its own as numba's cache where they are looked for."""
    for kernel in KERNELS:
        kept = Path(kernel._cache._cache_path)
        publish(folder / kept.name, kept, Path(kernel._cache._cache_file._index_name).stem)


def remove_old_kernels() -> None:
    """Of versions before the last few."""
    remove_old_versions(Path(KERNELS[0]._cache._cache_path))


def _cached(kernel: Any) -> bool:
    # one index file per function and source version; a process that is killed leaves an index without the code that it lists, or none
    cache = kernel._cache._cache_file
    listed = (cache.load_index() if hasattr(cache, "load_index") else cache._load_index()).values()
    return bool(listed) and all((Path(cache._cache_path) / name).is_file() for name in listed)
