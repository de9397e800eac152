"""A GPU as kernels see it: numba compiles them for it, and their arrays are PyTorch's tensors.

Where the environment says NUMBA_ENABLE_CUDASIM=1, numba interprets the kernels on the CPU instead, and tensors lie
there. That takes a hundred thousand times as long, and lets tests run every line of them on any machine.
"""

from __future__ import annotations

import functools
import importlib.util
import threading
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

import numba
import numpy as np
import torch
from numba import cuda as _cuda

from gsseg_core.errors import SettingsError
from gsseg_core.kernels import kernel_cache

cuda: Any = _cuda  # which has no types

SIMULATED = bool(numba.config.ENABLE_CUDASIM)  # type: ignore[attr-defined]

if not SIMULATED:
    # A small image starts few blocks, which nobody needs to be warned of.
    cuda.dispatcher.config.CUDA_LOW_OCCUPANCY_WARNINGS = 0


def gpu_kernel(function: Callable[..., Any]) -> Any:
    """Compile a kernel for the GPU, to be started by `launch`, and keep it from one run to the next if that can be."""
    made = cuda.jit(function, fastmath=True)
    if not SIMULATED:
        kernel_cache.keep(made, _enable)
    return made


def _enable(kernel: Any) -> None:
    kernel.enable_caching()
    kernel._cache.load_overload = functools.partial(_whole, kernel._cache, kernel._cache.load_overload)


def _whole(cache: Any, load: Callable[..., Any], *of_kernel: Any) -> Any:
    """Load a kernel as numba does; None, so that it is compiled anew, where its file is not whole."""
    try:
        return load(*of_kernel)
    except kernel_cache.NOT_WHOLE:
        cache.flush()
        return None


called_by_kernels: Callable[..., Any] = functools.partial(cuda.jit, device=True, fastmath=True)

NEEDED = "numba-cuda: pip install 'gsseg[cuda12]' or, with a driver of CUDA 13, 'gsseg[cuda13]'"


@gpu_kernel
def _try(number: np.ndarray) -> None:
    number[0] = 1


@functools.cache
def find_gpu(device: str) -> torch.device:
    """Find the GPU that is called 'cuda', the first one, or 'cuda:1' and so on.

    Raises `SettingsError` where there is none of this name, or something that it needs is missing.
    """
    if SIMULATED:
        return torch.device("cpu")
    found = f"device is {device!r}"
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if count == 0:
        raise SettingsError(
            f"{found}, but PyTorch {torch.__version__} sees no GPU; expected an NVIDIA GPU, its driver and a CUDA "
            "build of PyTorch, or the device 'cpu'"
        )
    number = int(device.partition(":")[2] or 0)
    if number >= count:
        raise SettingsError(f"{found}, but PyTorch sees {count} GPUs; expected 'cuda:0' to 'cuda:{count - 1}'")
    if importlib.util.find_spec("numba_cuda") is None:
        raise SettingsError(f"{found}, and the package 'numba_cuda' is missing; expected {NEEDED}")
    gpu = torch.device("cuda", number)
    try:
        launch(_try, 1, 1, torch.zeros(1, device=gpu))
    except Exception as error:  # What is missing of CUDA shows in as many kinds of errors as it has parts.
        first = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise SettingsError(f"{found}, but numba compiles nothing for it: {first}; expected {NEEDED}") from error
    return gpu


def launch(kernel: Any, blocks: int, threads: int, *arguments: Any) -> None:
    """Start a kernel on the GPU where its tensors lie; it may still run on return."""
    if blocks == 0:
        return
    where = next(argument.device for argument in arguments if isinstance(argument, torch.Tensor))
    # With two threads at once numba loads a kernel twice, which is an error, and interprets none.
    with _STARTING, torch.cuda.device(where) if where.type == "cuda" else nullcontext():
        kernel[blocks, threads](*(_as_taken(a) if isinstance(a, torch.Tensor) else a for a in arguments))


def launch_each(kernel: Any, count: int, *arguments: Any) -> None:
    """Start a kernel with a thread for each of so many Gaussians."""
    launch(kernel, -(-count // _THREADS), _THREADS, *arguments)


_THREADS = 128  # of a block, where each does its work alone
_STARTING = threading.Lock()
_as_taken: Callable[[torch.Tensor], Any] = torch.Tensor.numpy if SIMULATED else cuda.as_cuda_array


def on_device(array: np.ndarray, device: torch.device) -> torch.Tensor:
    """Copy an array to a device; on return the array may be changed."""
    here = torch.from_numpy(np.require(array, requirements=["C", "W"]))  # PyTorch warns of what is read-only.
    # Ordinary memory is read at once, and what the device has still to do is not waited for.
    return here.to(device, copy=True, non_blocking=not here.is_pinned())


def to_cpu(tensor: torch.Tensor) -> np.ndarray:
    """Copy a tensor to the CPU, into memory that a GPU writes to directly: ten times as fast as into any other."""
    array = torch.empty(tensor.shape, dtype=tensor.dtype, pin_memory=tensor.is_cuda)
    return np.asarray(array.copy_(tensor).numpy())
