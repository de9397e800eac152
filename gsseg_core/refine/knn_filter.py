"""Refinement of learnt probabilities: KNN clustering of unsure Gaussians, and a statistical filter per object.

Both steps take all classes at once, and say what they changed. Results are bit-identical whatever the order of the
Gaussians and the number of threads.
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
    codes: CSRRows,  # N rows of float32 on the simplex; without entries where no view saw the Gaussian
    num_classes: int,
    beta: float = RefineSettings.beta,
    evidence: np.ndarray | None = None,  # (N,) px that each code stands on, for `neighbour_weights`
) -> tuple[CSRRows, np.ndarray]:
    """Give every unsure and every unobserved Gaussian the mean code of the observed ones among its k nearest.

    Returns the codes, and which rows changed, (N,) bool.

    Unsure are those whose largest probability is below `beta`. All neighbours' codes are those from before the step.
    Where the paper is silent: codes are averaged as probabilities, not as logits; a Gaussian is not its own neighbour;
    neighbours may be unsure themselves; Gaussians tied for the last place share its weight equally. One with no
    observed neighbour keeps its code: a part of the scene that no view has come near stays unobserved. Without
    evidence, all observed ones weigh the same, as in the paper.

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
    clustered: np.ndarray,  # (N,) bool: which of them `cluster` changed
    learnt: CSRRows,  # C rows: what these were before
) -> CSRRows:
    """Give the codes that Gaussians have learnt themselves, and of those that learnt nothing what they are."""
    rows = np.full(len(clustered), -1)
    rows[clustered] = np.where(learnt.known(), np.arange(learnt.num_rows), -1)
    return codes.replaced(rows, learnt)


def statistical_filter(
    neighbours: Neighbours | None,  # of N Gaussians; None if there is only one
    labels: np.ndarray,  # (N,) class of each; the background, 0, is no object and not filtered, nor are negative ones
    sigmas: float = RefineSettings.filter_sigmas,
) -> np.ndarray:
    """Find the Gaussians that lie too far from the rest of their own object, and are to be removed: (N,) bool.

    D is the mean distance from a Gaussian to its k nearest others of its class, and one is removed where
    D > mu + sigmas * sigma over the class. What the paper calls the variance sigma is taken as the standard deviation,
    since it is added to a distance. A class of k members or fewer uses all others; one of fewer than three is left
    alone. The limit has a slack of one millionth, the precision of D, so that objects of equal spacing stay whole.

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
        in_order = np.sort(distances)  # rounding in the mean must not depend on the order of the Gaussians
        cut = in_order.mean() + sigmas * in_order.std()
        removed[members] = distances > cut * (1 + 1e-6)
    return removed
