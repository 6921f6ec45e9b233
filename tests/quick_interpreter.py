"""Triton's interpreter (of 3.6) with the same results in less time, and with numpy 2.4; imported in its own process alone."""

from __future__ import annotations

from collections.abc import Iterable
from types import FunctionType
from typing import Any

import numpy as np
from triton.language import core
from triton.language.semantic import TritonSemantic
from triton.runtime import interpreter

from mmsynth.field.kernels.cuda import tracing

# a round takes it as long for one ray as for many
tracing.MARCH_LANES = 128


# --- numpy 2.4 has no int() of arrays of one element, which it takes for the bounds of a loop

_patch_tensor, _patch_language = interpreter._patch_lang_tensor, interpreter._patch_lang


def _patch_tensor_and_index(tensor: object, scope: interpreter._LangPatchScope) -> None:
    _patch_tensor(tensor, scope)
    scope.set_attr(tensor, "__index__", lambda self: int(self.handle.data.item()))


interpreter._patch_lang_tensor = _patch_tensor_and_index


# --- functions look for what to patch each time one is called; nobody here needs the language as it was

_patched: set[str] = set()


def _patch_once(function: FunctionType) -> object:
    if function.__module__ not in _patched:
        _patched.add(function.__module__)
        _patch_language(function)
    return interpreter._LangPatchScope()  # has nothing to restore


interpreter._patch_lang = _patch_once


# --- names of types, which nobody reads, and a table of all types for each look at one


def _name_of(self: Any) -> str:
    return "[" + ",".join(f"{field}:{kind}" for field, kind in zip(self.fields, self.types, strict=True)) + "]"


def _keep_types(self: Any, types: Any, fields: Any = None) -> None:
    self.types, self.fields = types, fields or [""] * len(types)


def _keep_values(self: Any, args: Iterable[Any], type: Any = None) -> None:
    self.values = list(args)
    self.known_type = type if type is None or isinstance(type, core.tuple_type) else core.tuple_type(type)


def _type_of(self: Any) -> Any:
    if self.known_type is None:
        self.known_type = core._type_for_tuple_values(self.values)
    return self.known_type


core.tuple_type.__init__, core.tuple_type.name = _keep_types, property(_name_of)
core.tuple.__init__, core.tuple.type = _keep_values, property(_type_of, lambda self, type: setattr(self, "known_type", type))
_find_dtype, _dtypes = interpreter._get_np_dtype, {}


def _dtype_of(kind: Any) -> np.dtype[Any]:
    name = kind.scalar.name
    if name not in _dtypes:
        _dtypes[name] = _find_dtype(kind.scalar)
    return _dtypes[name]


interpreter._get_np_dtype = _dtype_of


# --- each result has a type of its own, of a shape that is unwrapped and checked anew

_blocks: dict[tuple[str, tuple[int, ...]], dict[str, Any]] = {}
_make_block = core.block_type.__init__


def _known_block(self: Any, element_ty: Any, shape: Any) -> None:
    key = element_ty.name, tuple(size.value if isinstance(size, core.constexpr) else size for size in shape)
    if key not in _blocks:
        _make_block(self, element_ty, shape)
        sizes = core.tuple([core.constexpr(size) for size in self.shape])
        _blocks[key] = vars(self) | {"of_tensor": (sizes, core.constexpr(self.numel))}
    self.__dict__ = _blocks[key]


_NO_SIZES = core.tuple([]), core.constexpr(1)


def _keep_handle(self: Any, handle: Any, type: Any) -> None:
    self.handle, self.type, self.dtype = handle, type, type.scalar
    self.shape, self.numel = type.of_tensor if isinstance(type, core.block_type) else _NO_SIZES


core.block_type.__init__, core.tensor.__init__ = _known_block, _keep_handle
_broadcast = TritonSemantic.broadcast_impl_value


def _broadcast_others(self: TritonSemantic, lhs: Any, rhs: Any) -> tuple[Any, Any]:
    return (lhs, rhs) if lhs.shape is rhs.shape else _broadcast(self, lhs, rhs)


TritonSemantic.broadcast_impl_value = _broadcast_others


# --- whether sums and products of integers overflow, by operations of its own on each


def _no_overflow(self: TritonSemantic, lhs: Any, rhs: Any, binary_op: Any) -> None:
    kind = lhs.type.scalar
    if kind.int_bitwidth < 64:
        operation = {"add": np.add, "sub": np.subtract, "mul": np.multiply}[binary_op.__name__]
        exact = operation(lhs.handle.data, rhs.handle.data, dtype=np.int64)
        fits = exact.size == 0 or (exact.min() >= kind.get_int_min_value() and exact.max() <= kind.get_int_max_value())
        assert fits, f"int{kind.int_bitwidth} overflow detected for operation {binary_op.__name__}"


TritonSemantic.binary_op_sanitize_overflow_impl = _no_overflow
