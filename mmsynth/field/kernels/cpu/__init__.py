"""The operations for float32 on the CPU, fused and compiled by numba; what is not fused is the reference's.

Begin with ``operations``, the autograd functions, and ``steps``, a step of a fit; the kernels are in ``blocks`` (what all are made of),
``surface``, ``marching`` and ``tracing_gradients``, ``shading``, ``mirroring``, ``drawing``, ``optimiser`` and, all together in a step of
a fit, ``learning``; ``tasks`` is how threads share them, ``stack`` where they keep what they make, ``jit`` how they are compiled.
"""

from mmsynth.field.kernels.cpu.caching import kept_in
from mmsynth.field.kernels.cpu.compiled import KERNELS, is_compiled, keep_compiled, remove_old_kernels
from mmsynth.field.kernels.cpu.drawing import draw, odds
from mmsynth.field.kernels.cpu.operations import classify, compare, mirror, reflect, shade, surface_value, trace
from mmsynth.field.kernels.cpu.optimiser import adam
from mmsynth.field.kernels.cpu.steps import arrange, learn
from mmsynth.field.kernels.reference import hash_encode, march, section_weights

__all__ = [
    "KERNELS", "adam", "arrange", "classify", "compare", "draw", "hash_encode", "is_compiled", "keep_compiled", "kept_in", "learn", "march",
    "mirror", "odds", "reflect", "remove_old_kernels", "section_weights", "shade", "surface_value", "trace",
]  # fmt: skip
