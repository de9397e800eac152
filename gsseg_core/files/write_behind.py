"""Files that are written while the work goes on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Concatenate, ParamSpec

from gsseg_core.several_at_once import kernels_run_beside_each_other

Arguments = ParamSpec("Arguments")

WriteBehind = Callable[Concatenate[Callable[Arguments, object], Arguments], None]
"""Has a function that writes a file called with these arguments, now or later."""


@contextmanager
def writing_behind() -> Iterator[WriteBehind[...]]:
    """Yield a function that has files written by two other threads; all are written when the body has ended.

    To compress and to wait for the disk takes little of the cores that the body works on. Nobody may change what a
    writer was given. The first error of a writer is raised with the next call, or at the end. Where kernels of two
    threads cannot run beside each other, the caller's own thread writes: a writer may use a kernel, and numba would end
    the process.
    """
    with ThreadPoolExecutor(2, "gsseg-write") as threads:
        waiting: list[Future[object]] = []

        def write(job: Callable[..., object], *arguments: object, **named: object) -> None:
            if not kernels_run_beside_each_other():
                job(*arguments, **named)
                return
            for done in [future for future in waiting if future.done()]:
                waiting.remove(done)
                done.result()
            waiting.append(threads.submit(job, *arguments, **named))

        yield write
        for future in waiting:
            future.result()
