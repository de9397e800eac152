"""Threads of a block that take turns, in numba's simulator of a GPU.

numba starts a thread of the operating system for each of a block's 256, asks all of them all the time whether they
wait, and reads source files to find out which array in shared memory is meant: three quarters of its time. Here a
thread runs until it waits for the others, and then the next one does. Every second round goes backwards, and so does
the first one of every second block: of two threads that miss a barrier, each comes first somewhere.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import numpy as np
from greenlet import getcurrent, greenlet
from numba.cuda.simulator import kernel, kernelapi


def take_turns() -> None:
    """Have the simulator of this process run blocks like this."""
    setattr(kernel, "BlockManager", _Block)  # noqa: B010
    setattr(kernel, "swapped_cuda_module", _knowing)  # noqa: B010
    setattr(kernelapi, "threading", SimpleNamespace(current_thread=getcurrent))  # noqa: B010
    setattr(kernelapi.FakeCUDAShared, "array", _shared_array)  # noqa: B010


class _Thread(greenlet):
    """A thread of a block, as kernels ask for it."""

    def __init__(self, run: Callable[[], None], block: tuple[int, ...], number: tuple[int, ...]) -> None:
        super().__init__(run)
        self.blockIdx, self.threadIdx = kernelapi.Dim3(*block), kernelapi.Dim3(*number)
        self.said: bool | None = None

    def syncthreads(self, said: bool | None = None) -> Any:
        self.said = said
        return self.parent.switch()

    def syncthreads_or(self, value: Any) -> Any:
        return self.syncthreads(bool(value))


class _Block:
    """What runs a block's threads, in the place of numba's `BlockManager`."""

    def __init__(self, run: Callable[..., None], grid: Any, threads: tuple[int, ...], debug: bool) -> None:
        self._run, self._threads = run, threads

    def run(self, block: tuple[int, ...], *arguments: Any) -> None:
        """Run all threads to their ends."""
        waiting = [_Thread(lambda: self._run(*arguments), block, number) for number in np.ndindex(*self._threads)]
        if sum(block) % 2:
            waiting.reverse()
        answers: tuple[int, ...] = ()
        while waiting:
            for thread in waiting:
                thread.switch(*answers)
            waiting = [thread for thread in reversed(waiting) if thread]
            said = {thread.said for thread in waiting}
            assert None not in said or said == {None}, "threads wait at different barriers"
            answers = (int(True in said),)


@contextmanager
def _knowing(function: Any, module: Any) -> Iterator[None]:
    """Let a function see this module as `numba.cuda`; numba's own goes through all names of the function's file."""
    names = function.__globals__
    before = names.get("cuda", module)
    names["cuda"] = module
    try:
        yield
    finally:
        names["cuda"] = before


def _shared_array(shared: Any, shape: Any, dtype: Any) -> np.ndarray:
    """An array of the block: one for each line that asks for one."""
    caller = sys._getframe(1)
    key = caller.f_code.co_filename, caller.f_lineno
    if key not in shared._allocations:
        shared._allocations[key] = np.empty(shape, dtype)
    return shared._allocations[key]
