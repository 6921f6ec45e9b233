"""The operations for NVIDIA GPUs, compiled by Triton; what is not is the reference's.

No operation waits for the device or asks it for a shape. All is bit-deterministic on one kind of GPU but the gradients of hash tables (see
``encoding``) and of exposures, and which ray of a tile says what residual it has: no other sum uses atomics. The module imports anywhere;
``available`` says whether its operations can run. With TRITON_INTERPRET=1 in the environment before triton is first imported they run,
slowly, on CPU tensors: that is how they are tested without a GPU.
"""

from __future__ import annotations

from mmsynth.field.kernels.cuda.drawing import draw
from mmsynth.field.kernels.cuda.encoding import hash_encode
from mmsynth.field.kernels.cuda.learning import learn
from mmsynth.field.kernels.cuda.mirroring import mirror
from mmsynth.field.kernels.cuda.optimiser import adam
from mmsynth.field.kernels.cuda.shading import compare
from mmsynth.field.kernels.cuda.shared import available, made
from mmsynth.field.kernels.cuda.surface import surface_gradient, surface_value
from mmsynth.field.kernels.cuda.tracing import trace
from mmsynth.field.kernels.reference import march, odds, reflect, section_weights, shade

__all__ = [
    "adam", "available", "compare", "draw", "hash_encode", "learn", "made", "march", "mirror", "odds", "reflect", "section_weights",
    "shade", "surface_gradient", "surface_value", "trace",
]  # fmt: skip
