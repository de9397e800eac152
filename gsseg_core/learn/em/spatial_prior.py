"""Spatial prior of EM: objects are continuous in space, so a Gaussian is likely what its nearest neighbours are.

At first the votes say what the neighbours are. Votes of partial masks say it badly, since each of these votes against
the classes that it looked for and does not show. Where one mask misses an object that few others looked for, the right
class may get more votes against it than for it. It is then dropped, for the Gaussian and its neighbours alike, and
stays at zero in every step. Once EM has all but converged, its probabilities are the better source, and the prior is
taken from them: a class that some of the neighbours have kept then comes back to the others.
"""

from __future__ import annotations

import numpy as np

from gsseg_core.csr_rows import CSRRows
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.spatial.neighbourhood import neighbour_weights, neighbours_of


def spatial_prior(
    shares: CSRRows,  # N rows of each class, in any unit: votes of at least 0, or probabilities
    evidence: np.ndarray,  # (N,): by how many px each was seen, 0 where it was not
    scene: GaussianScene,
    k: int,
    weight: float,
    num_classes: int,
) -> CSRRows:
    """Mean probabilities of the k nearest Gaussians, better seen ones the more, times a weight; empty if none was."""
    neighbours = neighbours_of(scene, k) if weight else None
    if neighbours is None:
        return CSRRows.empty(shares.num_rows, np.float32)
    codes = shares.with_data(shares.data.astype(np.float32)).normalised()
    mean = neighbours.mean_codes(codes, neighbour_weights(evidence > 0, evidence), num_classes).normalised()
    return mean.with_data(np.float32(weight) * mean.data)


def with_prior(codes: CSRRows, gradient: np.ndarray, prior: CSRRows) -> tuple[CSRRows, np.ndarray, CSRRows]:
    """Give codes and their gradient, (Z,), another prior; all three then have the classes that either had.

    Entries that are new are zero. The next M-step adds the prior to them, and from then on they count.
    """
    gradient = codes.with_data(gradient).united(prior)[0].data
    codes, prior = codes.united(prior)
    return codes, gradient, prior
