"""The operations for NVIDIA GPUs, compiled by Triton; what is not is the reference's, made of these parts.

All but the gradient of the hash table (see ``encoding``) is bit-deterministic: no atomics. The module imports anywhere; ``available`` says
whether its operations can run. With TRITON_INTERPRET=1 in the environment before triton is first imported they run, slowly, on CPU
tensors: that is how they are tested without a GPU.
"""

from __future__ import annotations

import torch
from torch import Tensor

from mmsynth.field.kernels.cuda.encoding import hash_encode
from mmsynth.field.kernels.cuda.marching import march
from mmsynth.field.kernels.cuda.sections import section_weights
from mmsynth.field.kernels.cuda.shared import available
from mmsynth.field.kernels.cuda.surface import surface_value
from mmsynth.field.kernels.mirroring import mirror
from mmsynth.field.kernels.parameters import GridTable, Hits, Rays, Sampling, SurfaceNetwork
from mmsynth.field.kernels.reference import adam, compare, composite, draw, odds, shade

__all__ = [
    "adam",
    "available",
    "compare",
    "draw",
    "hash_encode",
    "march",
    "mirror",
    "odds",
    "section_weights",
    "shade",
    "surface_value",
    "trace",
]


def trace(grid: GridTable, network: SurfaceNetwork, appearance: GridTable, states: Tensor, rays: Rays, sampling: Sampling) -> Hits:
    """See ``reference.trace``; float32."""
    sdf = lambda x: surface_value(x, grid, network)
    with torch.no_grad():
        samples = march(sdf, rays, states, grid.extent, sampling)
    return composite(sdf, appearance, rays, samples, sampling, hash_encode, section_weights)
