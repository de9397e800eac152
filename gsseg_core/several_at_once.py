"""Work on several views at once: what one thread alone can do of a view leaves no core idle.

A mask is decoded, cut into regions and counted by one thread, and a view of another step comes out of a file, while the
other cores would wait. On the CPU two views at once have half of the threads each: more would gain little, and each
takes the memory of a view. On a GPU the rest of the work is such work, so there are as many views as threads.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, contextmanager
from typing import TypeVar

import numba

from gsseg_core.progress import Progress, with_progress

T = TypeVar("T")
R = TypeVar("R")


def several_at_once(work: Callable[[T], R], items: Iterable[T], device: str = "cpu") -> Generator[R, None, None]:
    """Give what `work` makes of each item, in their order; the next ones are worked on meanwhile.

    The error that one of them raises comes in its turn, and the work ends. `work` may be called in several threads at
    once; with one core, or where kernels of two threads cannot run beside each other, in none but the caller's.
    """
    threads = numba.get_num_threads()
    if threads == 1 or not kernels_run_beside_each_other():
        yield from map(work, items)
        return
    many = 2 if device == "cpu" else threads
    each, begun = threads // many, deque[Future[R]]()
    beside = max(each, threads // 4)
    with ThreadPoolExecutor(many, "gsseg-view", numba.set_num_threads, (each,)) as pool:
        try:
            for item in items:
                begun.append(pool.submit(work, item))
                if len(begun) > many:
                    yield from _with_threads(beside, begun.popleft().result(), threads)
            while begun:
                yield from _with_threads(beside, begun.popleft().result(), threads)
        finally:
            for future in begun:
                future.cancel()


def each_with_made(
    work: Callable[[T], R], items: Collection[T], device: str, progress: Progress, stage: str
) -> Iterator[tuple[T, R]]:
    """Give each item with what `work` makes of it, several at once as above, and tell how many are done."""
    with closing(several_at_once(work, items, device)) as made:
        yield from zip(with_progress(progress, stage, items), made, strict=True)


@contextmanager
def meanwhile(work: Callable[[], object], device: str) -> Iterator[None]:
    """Do something beside what the body has a GPU do, and be done with it at its end; with none, it is left undone."""
    if device == "cpu" or not kernels_run_beside_each_other():
        yield
        return
    with ThreadPoolExecutor(1, "gsseg-beside") as beside:
        done = beside.submit(work)
        yield
        done.result()


def _with_threads(few: int, made: R, usual: int) -> Generator[R, None, None]:
    """Give something to the caller, whose kernels take few threads until he wants the next: the others have them."""
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
