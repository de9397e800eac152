"""Which points are near each other."""

from gsseg_core import kernel_cache as _kernel_cache  # noqa: F401 - before any kernel is defined
