"""Decorators of kernels: what Python calls, and what only kernels call."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar, overload

import numba
from numba.core.dispatcher import Dispatcher

from gsseg_core.kernels import kernel_cache

# Before the first kernel loads OpenMP: threads of kernels that wait for others must not spin. Where other programs use
# the cores, too, those would wait for them: observing a view takes four to six times as long then.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

F = TypeVar("F", bound=Callable[..., object])

_njit: Any = numba.njit  # Its types know fewer options than it takes.
_LESS: dict[str, Any] = {}
_enable: Callable[[Dispatcher[Any]], None] = Dispatcher.enable_caching
# Versions that were not tried compile and load in numba's own way, which takes longer and where Ctrl-C may crash.
if numba.__version__.startswith("0.68."):
    from gsseg_core.kernels.loading import enable as _enable
    from gsseg_core.kernels.parts import KernelCompiler

    _LESS = {"no_cfunc_wrapper": True, "pipeline_class": KernelCompiler}


@overload
def kernel(function: F) -> Dispatcher[F]: ...


@overload
def kernel(**options: Any) -> Callable[[F], Dispatcher[F]]: ...


def kernel(function: Callable[..., object] | None = None, **options: Any) -> Any:
    """Compile a function that Python calls, and keep it from one run to the next; other threads run beside it."""
    if function is None:
        return partial(kernel, **options)
    made = _njit(function, nogil=True, **_LESS, **options)
    # With NUMBA_DISABLE_JIT it is the function itself.
    if isinstance(made, Dispatcher):
        kernel_cache.keep(made, _enable)
    return made


def called_by_kernels(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """Compile a function that only kernels call, never Python: without the code that Python would call it by.

    It becomes part of each kernel. A call would count who holds its arrays, atomically: that may take as long as the
    function itself.
    """
    options = {"forceinline": True, **options}
    return _njit(function, no_cpython_wrapper=True, no_cfunc_wrapper=True, **options)
