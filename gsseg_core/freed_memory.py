"""What a program asks of its memory, once, before it works on view after view.

The arrays of a view are freed before the next view needs as many. glibc gives such memory back to the system and gets
it again page by page, each of which the system zeroes: up to a fifth of the time in which a mask is fused into a
million Gaussians. Programs keep it instead. glibc also has up to eight arenas for each core, and memory freed in one
serves only the threads of that arena, while a node answers each request in another thread: programs have two arenas.
A library leaves these choices to the program that it is in.

At its end Python looks through all objects for those that refer to each other in circles, a quarter of a second of
processor time after all that a program imports; the system has the memory of both kinds back a moment later. A program
whose objects have threads of their own, as ROS nodes have, needs that search, or they run on while Python ends; it
leaves out what was imported.
"""

from __future__ import annotations

import atexit
import ctypes
import gc
import sys

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8  # malloc.h of glibc

LARGEST_KEPT = 32 << 20  # bytes: larger arrays are given back at once; glibc's own limit
KEPT = 2**31 - 1  # bytes of free memory that are kept, at most
ARENAS = 2  # large arrays are few, so that no thread waits long for another


def keep_freed_memory() -> bool:
    """Keep freed memory for later arrays; returns whether the allocator is one that can (glibc's)."""
    if not sys.platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    wanted = {_M_MMAP_THRESHOLD: LARGEST_KEPT, _M_TRIM_THRESHOLD: KEPT, _M_ARENA_MAX: ARENAS}
    return all([mallopt(name, value) for name, value in wanted.items()])


def end_without_a_search() -> None:
    """Have this process end without a search for circles of objects, whose finalizers do not run then."""
    atexit.register(gc.freeze)


def search_no_imports_at_the_end() -> None:
    """Have searches for circles of objects, the one at the end among them, leave out all objects that there are now."""
    gc.freeze()
