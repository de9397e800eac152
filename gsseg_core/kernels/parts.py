"""What numba is spared when it compiles kernels: changes to its internals, for the versions that they were tried with.

For numba each function is one that Python, C or other functions may call at any time. So it optimises the body of a
parallel loop as a function, as a ufunc of that, as a parallel kernel of that and once more within the function that has
the loop, makes machine code of each, and of all functions called there; Python then calls one of these. Here only what
Python calls becomes machine code. What it calls is a *part* of it: optimised by itself, and then with the whole. Some
kernels need both rounds: `strongest` of raster/cpu/products.py takes half as long again without the first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

from llvmlite.ir import Module
from numba.core.codegen import JITCodeLibrary, JITCPUCodegen
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import AnalysisPass, PassManager, register_pass
from numba.core.typed_passes import IRLegalization
from numba.parfors.parfor import Parfor

from gsseg_core.kernels.returned import ReturningAPI

_LOOP_WRAPPERS = {"_gufunc_wrapper", "parallel.gufunc.wrapper"}


class _Part(JITCodeLibrary):
    """Code that is handed on to the functions that call it, and becomes machine code there.

    Whoever asks for an address in it gets machine code all the same.
    """

    _wraps_loop = _has_code = False

    def add_ir_module(self, module: Module) -> None:
        self._wraps_loop |= module.name in _LOOP_WRAPPERS
        if module.name != "cfunc_wrapper":  # C calls none of our functions.
            super().add_ir_module(module)

    def _optimize_final_module(self) -> None:
        if not self._wraps_loop:  # A few lines around a loop that is optimised before, and will be with its function.
            super()._optimize_final_module()

    def _finalize_final_module(self) -> None:
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        self._ensure_finalized()
        if not self._has_code and any(function.name == name for function in self.get_defined_functions()):
            self._has_code = True
            super()._finalize_final_module()
        return super().get_pointer_to_function(name)


class _PartsCodegen(JITCPUCodegen):
    """What numba's code generator becomes while a kernel is compiled: all that it is asked for is a part of that."""

    _library_class = _Part

    def set_env(self, name: str, environment: object) -> None:
        if self._engine.is_symbol_defined(name):  # A part without machine code has no variable for it.
            super().set_env(name, environment)


@contextmanager
def taken_for(kind: type[JITCPUCodegen], codegen: JITCPUCodegen) -> Iterator[None]:
    """Within the context, of one thread as all compiling is, the code generator is of this kind."""
    before, codegen.__class__ = codegen.__class__, kind
    try:
        yield
    finally:
        codegen.__class__ = before


@register_pass(mutates_CFG=False, analysis_only=True)
class _BodiesAreParts(AnalysisPass):
    """Have bodies of parallel loops compiled without code for Python to call them by."""

    _name = "gsseg_bodies_are_parts"

    def __init__(self) -> None:
        super().__init__()

    def run_pass(self, state: Any) -> bool:
        flags = state.flags.copy()
        flags.no_cpython_wrapper = True
        for block in state.func_ir.blocks.values():
            for loop in block.find_insts(Parfor):
                loop.flags = flags
        return False


class KernelCompiler(CompilerBase):
    """numba's compiler, for which what a kernel calls is but a part of it."""

    def define_pipelines(self) -> list[PassManager]:
        """List numba's passes, with one more for the bodies of loops."""
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.add_pass_after(_BodiesAreParts, IRLegalization)
        passes.finalize()
        return [passes]

    def compile_extra(self, function: Callable[..., Any]) -> Any:
        """Compile a function; all that it calls is a part of it meanwhile."""
        codegen = self.state.targetctx.codegen()
        self.state.library = JITCodeLibrary(codegen, function.__qualname__)
        self.state.library.enable_object_caching()
        context = self.state.targetctx  # of this compilation alone
        context.get_python_api = partial(ReturningAPI, context)
        with taken_for(_PartsCodegen, codegen):
            return super().compile_extra(function)
