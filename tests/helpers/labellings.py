"""What a viewer knows, written with its zeros."""

from __future__ import annotations

import numpy as np

from gsseg_core.csr_rows import CSRRows
from gsseg_core.viewer.model import Labelling


def labelled(labels: np.ndarray, probabilities: np.ndarray, names: dict[int, str]) -> Labelling:
    """Labels (N,) with class probabilities (N, K)."""
    return Labelling(labels, CSRRows.from_dense(probabilities), names)


def probabilities_of(labelling: Labelling) -> np.ndarray:
    """Class probabilities with their zeros, (N, K)."""
    return labelling.shares.dense(len(labelling.class_names))
