"""Spatial prior of EM: objects are continuous in space, so a Gaussian likely has the class of its nearest neighbours.

At first, the classes of the neighbours come from the votes. Partial masks make these less reliable, since a partial
mask votes against each class that its segmenter looked for and did not find. If one mask misses an object that few
others looked for, the right class may get more votes against it than for it. It is then dropped for the Gaussian and
its neighbours alike, and stays at zero in every step. Once EM has almost converged, its probabilities are more
reliable. The prior is then computed from them, and a class that some neighbours have kept returns to the others.
"""

from __future__ import annotations

import numpy as np

from gsseg_core.csr_rows import CSRRows
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.spatial.neighbourhood import neighbour_weights, neighbours_of


def spatial_prior(
    shares: CSRRows,  # N rows: votes of at least 0, in any unit, or probabilities, by class
    evidence: np.ndarray,  # (N,): px that saw each Gaussian, 0 if it was not seen
    scene: GaussianScene,
    k: int,
    weight: float,
    num_classes: int,
) -> CSRRows:
    """Return `weight` times the evidence-weighted mean of the k nearest Gaussians; rows are empty if none was seen."""
    neighbours = neighbours_of(scene, k) if weight else None
    if neighbours is None:
        return CSRRows.empty(shares.num_rows, np.float32)
    codes = shares.with_data(shares.data.astype(np.float32)).normalised()
    mean = neighbours.mean_codes(codes, neighbour_weights(evidence > 0, evidence), num_classes).normalised()
    return mean.with_data(np.float32(weight) * mean.data)


def with_prior(codes: CSRRows, gradient: np.ndarray, prior: CSRRows) -> tuple[CSRRows, np.ndarray, CSRRows]:
    """Combine codes and their gradient, (Z,), with a new prior; all three then have the classes of both.

    New entries of codes and gradient are zero. They become positive in the next M-step, which adds the prior.
    """
    gradient = codes.with_data(gradient).united(prior)[0].data
    codes, prior = codes.united(prior)
    return codes, gradient, prior
