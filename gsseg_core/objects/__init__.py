"""Objects: found over views, picked, boxed, cut out and taken away."""

from gsseg_core import kernel_cache as _kernel_cache  # noqa: F401 - before any kernel is defined
