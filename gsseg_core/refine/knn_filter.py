"""Refinement of learnt probabilities: KNN clustering of uncertain Gaussians, and a statistical filter per object.

Both steps process all classes at once and return what they changed. Results are bit-identical for any order of the
Gaussians and any number of threads.
"""

from __future__ import annotations

import numpy as np

from gsseg_core.csr_rows import CSRRows, largest
from gsseg_core.refine.settings import RefineSettings
from gsseg_core.spatial.class_distances import class_distances
from gsseg_core.spatial.neighbourhood import Neighbours, neighbour_weights
from gsseg_core.spatial.row_order import rows_by_label


def cluster(
    neighbours: Neighbours | None,  # of N Gaussians; None if there is only one
    codes: CSRRows,  # N rows of float32 that sum to 1; empty if no view saw the Gaussian
    num_classes: int,
    beta: float = RefineSettings.beta,
    evidence: np.ndarray | None = None,  # (N,) px from which each code was learnt, for `neighbour_weights`
) -> tuple[CSRRows, np.ndarray]:
    """Give every uncertain or unobserved Gaussian the mean code of the observed ones among its k nearest.

    Returns the codes, and which rows changed, (N,) bool.

    A Gaussian is uncertain if its largest probability is below `beta`. All means use the codes from before the step.
    Without evidence, all observed neighbours have equal weight, as in the paper. A Gaussian without observed neighbours
    keeps its code, so parts of the scene far from all views stay unobserved. Choices that the paper leaves open:

    - Codes are averaged as probabilities, not as logits.
    - A Gaussian is not its own neighbour, and neighbours may be uncertain themselves.
    - Gaussians tied for the last place share its weight equally.

    Examples
    --------
    >>> import numpy as np
    >>> means = np.array([[0, 0, 0], [1, 0, 0], [3, 0, 0]], np.float32)
    >>> codes = CSRRows.from_dense(np.array([[0, 1], [0.5, 0.5], [0.25, 0.75]], np.float32))
    >>> clustered, changed = cluster(Neighbours.among(means, k=1), codes, 2)
    >>> clustered.dense(2).tolist()
    [[0.0, 1.0], [0.0, 1.0], [0.25, 0.75]]
    """
    most = largest(codes)[0]
    observed = most > 0
    wanted = ~observed | (most < beta)
    if neighbours is None or not wanted.any() or not observed.any():
        return codes, np.zeros(len(wanted), bool)
    weights = observed if evidence is None else neighbour_weights(observed, evidence)
    mean = neighbours.mean_codes(codes, weights, num_classes, wanted)
    changed = np.diff(mean.indptr) > 0
    return codes.replaced(np.where(changed, np.arange(len(changed)), -1), mean), changed


def before_clustering(
    codes: CSRRows,  # N rows
    clustered: np.ndarray,  # (N,) bool: rows that `cluster` changed
    learnt: CSRRows,  # C rows: the codes of these before
) -> CSRRows:
    """Restore the codes from before `cluster`; rows that were empty before keep their clustered codes."""
    rows = np.full(len(clustered), -1)
    rows[clustered] = np.where(learnt.known(), np.arange(learnt.num_rows), -1)
    return codes.replaced(rows, learnt)


def statistical_filter(
    neighbours: Neighbours | None,  # of N Gaussians; None if there is only one
    labels: np.ndarray,  # (N,) class of each; background (0) and negative labels are not filtered
    sigmas: float = RefineSettings.filter_sigmas,
) -> np.ndarray:
    """Mark the Gaussians to remove because they lie too far from the rest of their own object: (N,) bool.

    D is the mean distance of a Gaussian to its k nearest others of its class. Gaussians with D > mu + sigmas * sigma
    are marked, where mu and sigma are the mean and standard deviation of D over the class. (The paper calls sigma the
    variance, but adds it to a distance.) A class of k members or fewer uses all others; one of fewer than three is not
    filtered. The limit has a slack of 1e-6, the precision of D, so that objects of equal spacing stay whole.

    Examples
    --------
    >>> import numpy as np
    >>> means = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [99, 0, 0]], np.float32)
    >>> statistical_filter(Neighbours.among(means, k=50), np.array([1, 1, 1, 1, 1])).tolist()
    [False, False, False, False, True]
    """
    removed = np.zeros(len(labels), bool)
    if neighbours is None:
        return removed
    known = class_distances(neighbours, labels)
    for label, members in rows_by_label(labels).items():
        if label <= 0 or members.size < 3:
            continue
        distances = known[members]
        in_order = np.sort(distances)  # so that rounding of the mean does not depend on the order of the Gaussians
        cut = in_order.mean() + sigmas * in_order.std()
        removed[members] = distances > cut * (1 + 1e-6)
    return removed
