"""Numba kernels over tiles of 16 x 16 pixels."""

from gsseg_core import kernel_cache as _kernel_cache  # noqa: F401 - before any kernel is defined
