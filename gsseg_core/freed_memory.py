"""What a program asks of the C library's allocator, once, before it works on view after view.

The arrays of a view are freed before the next view needs as many. glibc gives such memory back to the system and gets
it again page by page, each of which the system zeroes: up to a fifth of the time in which a mask is fused into a
million Gaussians. Programs keep it instead. And glibc has threads allocate from up to eight pools for each core, of
which each keeps what only its own threads can use again: a node answers one request after the other in other threads.
A library leaves these choices to the program that it is in.
"""

from __future__ import annotations

import ctypes
import sys

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8  # malloc.h of glibc

LARGEST_KEPT = 32 << 20
"""Larger arrays are given back at once, in bytes; glibc's own limit."""

KEPT = 2**31 - 1
"""Free memory that is kept, at most, in bytes."""

POOLS = 2
"""Pools of memory that threads share: large arrays are few, so that no thread waits long for another."""


def keep_freed_memory() -> bool:
    """Keep freed memory for later arrays; returns whether the allocator is one that can (glibc's)."""
    if not sys.platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    wanted = {_M_MMAP_THRESHOLD: LARGEST_KEPT, _M_TRIM_THRESHOLD: KEPT, _M_ARENA_MAX: POOLS}
    return all([mallopt(name, value) for name, value in wanted.items()])
