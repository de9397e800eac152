"""Expectation maximisation with an error model of every view."""

from gsseg_core import kernel_cache as _kernel_cache  # noqa: F401 - before any kernel is defined
