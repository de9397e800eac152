"""Work on several views at once, so that no core is idle while one thread alone decodes a mask or reads a file.

On the CPU two views are worked on, with half of the threads each: more would gain little, and each takes the memory of
a view. Where a GPU renders, the CPU has nothing but such work of one thread, and there are as many views as threads.
"""

from __future__ import annotations

import traceback
from collections import deque
from collections.abc import Callable, Collection, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import closing, contextmanager
from typing import TypeVar

import numba

from gsseg_core.errors import memory_ran_out
from gsseg_core.progress import Progress, with_progress

T = TypeVar("T")
R = TypeVar("R")


def several_at_once(work: Callable[[T], R], items: Iterable[T], device: str = "cpu") -> Generator[R, None, None]:
    """Give what `work` makes of each item, in their order; the next ones are worked on meanwhile.

    The error that one of them raises comes in its turn, and the work ends. `work` may be called in several threads at
    once; with one core, or where kernels of two threads cannot run beside each other, in none but the caller's. Where a
    GPU has not the memory for so many at once, half as many are worked on from then on, and an item that failed is
    worked on again by itself.
    """
    threads = numba.get_num_threads()
    if threads == 1 or not kernels_run_beside_each_other():
        yield from map(work, items)
        return
    workers = 2 if device == "cpu" else threads
    each, begun = threads // workers, deque[tuple[T, Future[R]]]()
    callers = max(each, threads // 4)
    with ThreadPoolExecutor(workers, "gsseg-view", numba.set_num_threads, (each,)) as pool:

        def first_result() -> R:
            nonlocal workers
            item, future = begun.popleft()
            try:
                return future.result()
            except Exception as error:
                if device == "cpu" or not memory_ran_out(error):
                    raise
            workers = max(workers // 2, 1)
            # What they have made of the GPU's memory is free only once nobody can look into their frames.
            for other in (future, *wait([future for _, future in begun]).done):
                if failed := other.exception():
                    traceback.clear_frames(failed.__traceback__)
            return pool.submit(work, item).result()

        try:
            for item in items:
                begun.append((item, pool.submit(work, item)))
                while len(begun) > workers:
                    yield from _with_threads(callers, first_result(), threads)
            while begun:
                yield from _with_threads(callers, first_result(), threads)
        finally:
            for _, future in begun:
                future.cancel()


def each_with_made(
    work: Callable[[T], R], items: Collection[T], device: str, progress: Progress, stage: str
) -> Iterator[tuple[T, R]]:
    """Give each item with what `work` makes of it, several at once as above, and tell how many are done."""
    with closing(several_at_once(work, items, device)) as made:
        yield from zip(with_progress(progress, stage, items), made, strict=True)


@contextmanager
def beside(work: Callable[[], object]) -> Iterator[None]:
    """Do some work in a thread of its own beside the body, and end with it."""
    with ThreadPoolExecutor(1, "gsseg-beside") as other:
        done = other.submit(work)
        yield
        done.result()


@contextmanager
def meanwhile(work: Callable[[], object], device: str) -> Iterator[None]:
    """Do some work on the CPU while the body has a GPU at work, and end with it; without a GPU, leave it undone."""
    if device == "cpu" or not kernels_run_beside_each_other():
        yield
        return
    with beside(work):
        yield


def _with_threads(few: int, made: R, usual: int) -> Generator[R, None, None]:
    """Give the caller a result, and his kernels only few threads until he asks for the next one."""
    numba.set_num_threads(few)
    try:
        yield made
    finally:
        numba.set_num_threads(usual)


def kernels_run_beside_each_other() -> bool:
    """Tell whether numba's threads are of a kind that serves several callers; it is known after the first kernel."""
    try:
        return bool(numba.threading_layer() != "workqueue")  # type: ignore[attr-defined]
    except ValueError:
        return False
