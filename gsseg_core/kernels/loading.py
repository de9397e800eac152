"""What numba is spared when it loads kernels that it compiled before: for the versions that this was tried with.

Of a kernel in the cache there is machine code, and bitcode for other kernels that call it. numba reads the bitcode of
each, lists its symbols, makes itself ready to compile, and imports the modules of all functions that it calls. That is
three quarters of the time in which all kernels load, for which every process that segments waits. Here a kernel that is
loaded is its machine code; its bitcode is read when another that calls it is compiled.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import llvmlite.binding as llvm
from numba.core.caching import CompileResultCacheImpl, FunctionCache
from numba.core.codegen import JITCodeLibrary, JITCPUCodegen
from numba.core.dispatcher import Dispatcher
from numba.core.environment import Environment, lookup_environment
from numba.core.runtime.nrt import rtsys
from numba.np.ufunc.parallel import _launch_threads

from gsseg_core.kernels import kernel_cache
from gsseg_core.kernels.parts import taken_for
from gsseg_core.kernels.stamps import stamp_of


class _Loaded(JITCodeLibrary):
    """Machine code from the cache, with its bitcode unread."""

    _bitcode: bytes

    @classmethod
    def _unserialize(cls, codegen: JITCPUCodegen, state: tuple[str, str, tuple[bytes, bytes]]) -> _Loaded:
        name, _, (code, bitcode) = state
        library = cls(codegen, name)
        library.enable_object_caching()
        library._set_compiled_object(code)
        library._bitcode = bitcode
        library._finalize_final_module()
        return library

    def get_pointer_to_function(self, name: str) -> int:
        # numba asks its list of symbols first; of a kernel it wants that alone which Python calls, and which is there.
        return self._codegen._engine.get_function_address(name)

    def _get_module_for_linking(self) -> llvm.ModuleRef:
        if self._shared_module is None:
            self._shared_module = llvm.parse_bitcode(self._bitcode)
        return self._shared_module


class _LoadingCodegen(JITCPUCodegen):
    """What numba's code generator becomes while a kernel is loaded."""

    _library_class = _Loaded


class _FileOfKernel(CompileResultCacheImpl):
    """What is kept of a kernel, in files of its own: numba could not read them."""

    def get_filename_base(self, fullname: str, abiflags: str) -> str:
        return "kernel." + str(super().get_filename_base(fullname, abiflags))

    def reduce(self, cres: Any) -> Any:
        *rest, environments = super().reduce(cres)
        return *rest, tuple(_Environment(one) for one in environments)

    def rebuild(self, target_context: Any, payload: Any) -> Any:
        with taken_for(_LoadingCodegen, target_context.codegen()):
            return super().rebuild(target_context, payload)


class _Environment:
    """Pickles the environment of a function that a kernel calls.

    Machine code reads constants in it. numba imports the function's module, too, for what it compiles as plain Python:
    of NumPy's functions that is a part of numba which loads SciPy.
    """

    def __init__(self, environment: Environment) -> None:
        self.environment = environment

    def __reduce__(self) -> tuple[Any, ...]:
        one = self.environment
        return _environment, (one.env_name, one.globals["__name__"], one.consts)


def _environment(name: str, module: str, constants: list[object]) -> Environment:
    known = lookup_environment(name)
    if known is not None:
        return known
    made = Environment({"__name__": module})
    made.env_name = name
    made.consts[:] = constants
    Environment._memo[name] = made
    return made


class _KernelCache(FunctionCache):
    _impl_class = _FileOfKernel

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._cache_file._source_stamp = stamp_of(function)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        rtsys.initialize(target_context)  # All that machine code needs of what numba makes ready to compile.
        # Of a kernel that calls one whose loops are parallel, numba may not have noted that it needs threads.
        _launch_threads()
        try:
            return self._load_overload(sig, target_context)
        except OSError:  # Somebody else's, who lets nobody read it.
            return None
        except (AttributeError, ImportError, *kernel_cache.NOT_WHOLE):  # Or compiled for a type that has gone since.
            with suppress(OSError):
                self.flush()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        except OSError:
            kernel_cache.INCOMPLETE = True


def enable(kernel: Dispatcher[Any]) -> None:
    """Keep what is compiled of a kernel from one run to the next."""
    kernel._cache = _KernelCache(kernel.py_func)  # type: ignore[attr-defined]
