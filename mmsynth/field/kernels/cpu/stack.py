"""Arrays on the stack of the function that asks for them: nothing is allocated, and nobody has to count who still needs them."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numba.np.arrayobj import populate_array


def on_stack(kind: types.Type, count: int) -> Any:
    """An intrinsic that gives an array (count,), as long as the function runs that it is called in; what is in it is undefined."""

    @intrinsic
    def array_on_stack(typingctx):  # type: ignore[no-untyped-def]
        array_kind = types.Array(kind, 1, "C")

        def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
            number = context.get_data_type(kind)
            data = cgutils.alloca_once(builder, ir.ArrayType(number, count))
            array = context.make_array(array_kind)(context, builder)
            shape = [context.get_constant(types.intp, count)]
            size = context.get_constant(types.intp, context.get_abi_sizeof(number))
            first = builder.bitcast(data, number.as_pointer())
            populate_array(array, data=first, shape=shape, strides=[size], itemsize=size, meminfo=None)
            return array._getvalue()

        return array_kind(), codegen

    return array_on_stack
