"""How kernels are compiled: what Python calls, and what kernels alone call, which takes less time to compile for it."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

from numba import _dynfunc, njit
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import PassManager, register_pass
from numba.core.typed_passes import NativeLowering

from mmsynth.field.kernels.cpu.caching import KernelCache


class _OnlyLinked(JITCodeLibrary):
    """A part for LLVM. The modules of kernels that call it take it in, optimise it there and make its machine code with their own."""

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalized = True


@register_pass(mutates_CFG=True, analysis_only=False)
class _PartLowering(NativeLowering):
    """As numba's own, without machine code of the part, which would never be called."""

    _name = "lowering_of_a_part"

    def run_pass(self, state: Any) -> bool:
        state.library = _OnlyLinked(state.targetctx.codegen(), state.func_id.func_qualname)
        state.flags.no_compile = True
        super().run_pass(state)
        lowered = state["cr"]
        # numba knows what is called by what Python would call
        for_python = _dynfunc.make_function(lowered.fndesc.lookup_module(), lowered.fndesc.qualname, "", 0, lowered.env, (state.library,))
        state.targetctx.insert_user_function(for_python, lowered.fndesc, [state.library])
        state["cr"] = lowered._replace(cfunc=for_python)
        return True


class _PartCompiler(CompilerBase):
    def define_pipelines(self) -> list[PassManager]:
        passes = PassManager("part of a kernel")
        for each, what in DefaultPassBuilder.define_nopython_pipeline(self.state).passes:
            passes.add_pass(_PartLowering if each is NativeLowering else each, what)
        passes.finalize()
        return [passes]


_common = functools.partial(njit, nogil=True, error_model="numpy", no_cfunc_wrapper=True)


def allocating_kernel(function: Callable[..., Any]) -> Any:
    """What Python calls; its code is kept on disk, with that of all that it calls."""
    return _kept(_common(function))


def kernel(function: Callable[..., Any]) -> Any:
    """The same of a function that makes no arrays but views and those of ``stack``."""
    return _kept(_common(function, _nrt=False))


def _kept(compiled: Any) -> Any:
    compiled._cache = KernelCache(compiled.py_func)
    return compiled


# called from kernels alone: without machine code of its own and the code that takes arguments from Python, which were a third of the time
# to compile. Python that calls one all the same ends in a crash (tests: ``from_python``)
allocating_part = functools.partial(_common, no_cpython_wrapper=True, pipeline_class=_PartCompiler, _nrt=True)

# makes no arrays but views and those of ``stack``, nor does what it calls, but for allocating parts: where none is made none has to be
# counted, which was a third of what LLVM was given. Numba refuses what makes one
part = functools.partial(allocating_part, _nrt=False)

# put into what calls it before types are known
inlined = functools.partial(njit, inline="always", error_model="numpy")
