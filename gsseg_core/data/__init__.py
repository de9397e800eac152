"""Posed views with their masks: dataset folders, label images, soft masks, and what labels say of classes."""

from gsseg_core import kernel_cache as _kernel_cache  # noqa: F401 - before any kernel is defined
