"""How what a kernel returns becomes objects of Python: without a line of Python, so that Ctrl-C is not heard meanwhile.

numba asks a function of its own for the type of each array and tuple, and a named tuple's class makes the tuple. Ctrl-C
that came while the kernel worked was raised in there, where numba goes on as if nothing were: SystemError came of it,
and where there is a named tuple, the process crashed. Here types are constants of the kernel, as dtypes are for numba,
and KeyboardInterrupt is raised once the kernel has ended. Tried with the versions of `parts`.
"""

from __future__ import annotations

from typing import Any

from numba.core import pythonapi

_API: Any = pythonapi.PythonAPI  # It has no types.


class ReturningAPI(_API):  # type: ignore[misc]
    """What numba writes code with that calls Python, for the function that Python calls a kernel by."""

    _constants: Any = None  # of the kernel, while code is written for what it returns

    def from_native_return(self, typ: Any, val: Any, env_manager: Any) -> Any:
        """Write what makes an object of a kernel's value."""
        self._constants = env_manager
        try:
            return super().from_native_return(typ, val, env_manager)
        finally:
            self._constants = None

    def serialize_object(self, obj: object) -> Any:
        """Take an object for `unserialize`: itself, where it is to be a constant."""
        return obj if self._constants else super().serialize_object(obj)

    def unserialize(self, structptr: Any) -> Any:
        """Write what gives the object that `serialize_object` took."""
        return self._constant(structptr) if self._constants else super().unserialize(structptr)

    def call(self, callee: Any, args: Any = None, kws: Any = None) -> Any:
        """Write what calls something, or makes a named tuple of its class and a tuple, as its `_make` does."""
        if not self._constants:
            return super().call(callee, args, kws)
        new = self._constant(tuple.__new__)
        made = self.call_function_objargs(new, (callee, args))
        self.decref(new)
        return made

    def _constant(self, obj: object) -> Any:
        """Write what gives a constant, with a reference that the caller has to give back."""
        constant = self._constants.read_const(self._constants.add_const(obj))
        self.incref(constant)
        return constant
