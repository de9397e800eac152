"""Refinement of learnt probabilities: KNN clustering of unsure Gaussians, and a statistical filter per object.

Both steps take all classes at once, and say what they changed. Results are bit-identical whatever the order of the
Gaussians and the number of threads.
"""

from __future__ import annotations

import numpy as np

from gsseg_core.csr_rows import CSRRows, largest, starts
from gsseg_core.refine.settings import RefineSettings
from gsseg_core.spatial.class_distances import class_distances
from gsseg_core.spatial.neighbourhood import Neighbours, neighbour_weights
from gsseg_core.spatial.row_order import rows_by_label

_ROWS = 1 << 12  # of codes that are copied at a time


def cluster_in_place(
    means: np.ndarray,  # (N, 3) float32, finite, scene units
    codes: np.ndarray,  # (N, K) float32, contiguous, rows on the simplex, written to; not read where unobserved
    observed: np.ndarray,  # (N,) bool: whether any view saw the Gaussian
    k: int = RefineSettings.k,  # at least 1
    beta: float = RefineSettings.beta,
    neighbours: Neighbours | None = None,  # of `means` for this k, if they are known already
    evidence: np.ndarray | None = None,  # (N,) px that each code stands on, for `neighbour_weights`
) -> tuple[np.ndarray, np.ndarray]:
    """Give every unsure and every unobserved Gaussian the mean code of the observed ones among its k nearest.

    Returns which rows changed, (N,) bool, and what these were before, (M, K) float32.

    Unsure are those whose largest probability is below `beta`. All neighbours' codes are those from before the step.
    Where the paper is silent: codes are averaged as probabilities, not as logits; a Gaussian is not its own neighbour;
    neighbours may be unsure themselves; Gaussians tied for the last place share its weight equally. One with no
    observed neighbour keeps its code: a part of the scene that no view has come near stays unobserved. Without
    evidence, all observed ones weigh the same, as in the paper.

    Examples
    --------
    >>> import numpy as np
    >>> means = np.array([[0, 0, 0], [1, 0, 0], [3, 0, 0]], np.float32)
    >>> codes = np.array([[0, 1], [0.5, 0.5], [0.25, 0.75]], np.float32)
    >>> changed, before = cluster_in_place(means, codes, np.array([True, True, True]), k=1)
    >>> codes.tolist()
    [[0.0, 1.0], [0.0, 1.0], [0.25, 0.75]]
    """
    wanted = ~observed | (largest(codes)[0] < beta)
    if len(means) < 2 or not wanted.any() or not observed.any():
        return np.zeros(len(codes), bool), np.empty((0, codes.shape[1]), np.float32)
    known, before = neighbours or Neighbours.among(means, k), CSRRows.from_dense(codes)
    weights = observed if evidence is None else neighbour_weights(observed, evidence)
    changed = known.average_into(codes, before, weights, wanted)
    return changed, before.take(np.flatnonzero(changed)).dense(codes.shape[1])


def before_clustering(
    codes: np.ndarray,  # (N, K) float32
    clustered: np.ndarray,  # (N,) bool: which of them `cluster_in_place` changed
    learnt: np.ndarray,  # (C, K) float32: what these were before
) -> CSRRows:
    """Give the codes that Gaussians have learnt themselves, and of those that learnt nothing what they are."""
    rows, parts = starts(clustered), list[CSRRows]()
    for first in range(0, max(len(codes), 1), _ROWS):  # A copy of all would take as much memory as they.
        part = codes[first : first + _ROWS].copy()
        before = learnt[rows[first] : rows[first + len(part)]]
        known = before.any(axis=1)
        part[np.flatnonzero(clustered[first : first + _ROWS])[known]] = before[known]
        parts.append(CSRRows.from_dense(part))
    return CSRRows.vstack(parts)


def statistical_filter(
    means: np.ndarray,  # (N, 3) float32, finite, scene units
    labels: np.ndarray,  # (N,) class of each; the background, 0, is no object and not filtered, nor are negative ones
    k: int = RefineSettings.k,  # at least 1
    sigmas: float = RefineSettings.filter_sigmas,
    num_classes: int | None = None,  # K; labels from there on are ignored: by default there are none
    neighbours: Neighbours | None = None,  # of `means` for this k, if they are known already
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
    >>> statistical_filter(means, np.array([1, 1, 1, 1, 1])).tolist()
    [False, False, False, False, True]
    """
    removed = np.zeros(len(labels), bool)
    limit = int(labels.max(initial=0)) + 1 if num_classes is None else num_classes
    if len(means) < 3:
        return removed
    known = class_distances(neighbours or Neighbours.among(means, k), labels, limit)
    for label, members in rows_by_label(labels).items():
        if not 0 < label < limit or members.size < 3:
            continue
        distances = known[members]
        in_order = np.sort(distances)  # rounding in the mean must not depend on the order of the Gaussians
        cut = in_order.mean() + sigmas * in_order.std()
        removed[members] = distances > cut * (1 + 1e-6)
    return removed
