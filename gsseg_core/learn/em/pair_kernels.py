"""The kernels of EM by device: those that go through the (Gaussian, label) pairs of a view, where the pairs are."""

from __future__ import annotations

import importlib
from types import ModuleType


def kernels_on(device: str) -> ModuleType:
    """Return the module whose functions work on a device: `em_cpu_kernels`, or its like for a GPU."""
    return importlib.import_module(f"gsseg_core.learn.em.{'em_cpu_kernels' if device == 'cpu' else 'em_gpu_kernels'}")
