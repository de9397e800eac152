"""What a program asks of the C library's allocator, once, before it works on view after view.

The arrays of a view are freed before the next view needs as many. glibc gives such memory back to the system and gets
it again page by page, each of which the system zeroes: up to a fifth of the time in which a mask is fused into a
million Gaussians. Programs keep it instead. A library leaves that choice to the program that it is in.
"""

from __future__ import annotations

import ctypes
import sys

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # malloc.h of glibc

LARGEST_KEPT = 32 << 20
"""Larger arrays are given back at once, in bytes; glibc's own limit."""

KEPT = 2**31 - 1
"""Free memory that is kept, at most, in bytes."""


def keep_freed_memory() -> bool:
    """Keep freed memory for later arrays; returns whether the allocator is one that can (glibc's)."""
    if not sys.platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    return bool(mallopt(_M_MMAP_THRESHOLD, LARGEST_KEPT) and mallopt(_M_TRIM_THRESHOLD, KEPT))
