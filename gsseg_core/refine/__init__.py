"""Learnt probabilities made better by what lies near in space."""

from gsseg_core import kernel_cache as _kernel_cache  # noqa: F401 - before any kernel is defined
