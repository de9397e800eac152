"""Selects the EM kernels for a device; they process the (Gaussian, label) pairs of a view where these are stored."""

from __future__ import annotations

import importlib
from types import ModuleType
from typing import Any

import numpy as np

from gsseg_core.csr_rows import CSRRows
from gsseg_core.learn.em.confusion_model import ErrorModel
from gsseg_core.raster.observation import Observation


def kernels_on(device: str) -> ModuleType:
    """Return the module with the kernels for a device: `em_kernels` for the CPU, `em_gpu_kernels` for a GPU."""
    return importlib.import_module(f"gsseg_core.learn.em.{'em_kernels' if device == 'cpu' else 'em_gpu_kernels'}")


def rows_on(rows: CSRRows, device: str) -> tuple[Any, ModuleType]:
    """Return rows on a device, and the module with the kernels for it."""
    backend = kernels_on(device)
    return backend.put(rows, device), backend


def codes_without(
    observation: Observation, model: ErrorModel, codes: CSRRows, gradient: np.ndarray, prior: np.ndarray,
    device: str = "cpu",
) -> CSRRows:  # fmt: skip
    """Take an M-step without one view: return class probabilities of the M Gaussians that it sees, M rows.

    The gradient is that of all views at these codes and models. The arrays are on the device; see
    `gsseg_core.learn.em.em_kernels` for their shapes.
    """
    backend = kernels_on(device)
    likelihood, pairs = model.by_label, backend.pairs_of(observation)
    shares = backend.shares(observation, codes, pairs, likelihood)
    stepped: CSRRows = backend.rows_like(codes, pairs.ids)
    backend.m_step_without_view(codes, gradient, prior, pairs, model.used(likelihood), shares.pairs, stepped)
    return stepped
