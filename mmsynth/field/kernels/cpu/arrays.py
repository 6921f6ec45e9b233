"""What kernels take in the place of tensors: arrays of the same memory."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from torch import Tensor

from mmsynth.field.kernels.cpu.shading import Layers, two_layers
from mmsynth.field.kernels.parameters import Sampling

P = TypeVar("P", bound=tuple[Any, ...])


def as_array(tensor: Tensor) -> np.ndarray:
    return (tensor if tensor.is_contiguous() else tensor.contiguous()).numpy(force=True)


def as_arrays(parameters: P) -> P:
    """Tensors as arrays, numbers in single precision: the types that the kernels are compiled for."""
    return type(parameters)(*map(as_compiled, parameters))


def as_compiled(x: Any) -> Any:
    return as_array(x) if isinstance(x, Tensor) else np.float32(x) if isinstance(x, float) else x


def in_double(sampling: Sampling) -> Sampling:
    """Numbers in double precision, even those given as integers."""
    whole = {"active_surface", "active_radiance"}
    values: dict[str, Any] = {name: value if name in whole else float(value) for name, value in sampling._asdict().items()}
    return Sampling(**values)


def shader_layers(weights: Any) -> tuple[Layers, np.ndarray, np.ndarray]:
    """Hidden layers, heads and their biases of ``ShaderWeights`` of arrays."""
    return two_layers(*weights[:4]), weights.heads, weights.heads_bias
