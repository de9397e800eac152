"""Refinement of learnt probabilities: KNN clustering of unsure Gaussians, and a statistical filter per object.

Both steps are pure functions of positions and probabilities (or labels), take all classes at once, and say what they
changed. Results are bit-identical whatever the order of the Gaussians and the number of threads.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsseg_core.neighbours import Tree, average, nearest, scaled
from gsseg_core.refine_settings import RefineSettings


@dataclass(frozen=True, eq=False)
class Clustered:
    """What `cluster` returns.

    Attributes
    ----------
    probabilities : (N, K) float32
        A new array; rows that did not change are those that went in.
    changed : (N,) bool
        Which Gaussians took the mean code of their neighbours.
    """

    probabilities: np.ndarray
    changed: np.ndarray


def cluster(
    means: np.ndarray,  # (N, 3)
    probabilities: np.ndarray,  # (N, K)
    observed: np.ndarray,  # (N,)
    k: int = RefineSettings.k,
    beta: float = RefineSettings.beta,
) -> Clustered:
    """Give every unsure and every unobserved Gaussian the mean code of its k nearest observed ones.

    Unsure are those whose largest probability is below `beta`. All neighbours' codes are those from before the step.
    Where the paper is silent: codes are averaged as probabilities, not as logits; an unsure Gaussian is its own nearest
    neighbour, as in a plain k-nearest query; neighbours may be unsure themselves, but never unobserved; Gaussians tied
    for the last place share its weight equally. If fewer than k are observed, all of them are the neighbours of each.

    Parameters
    ----------
    means : array (N, 3) of float32
        Finite positions, scene units.
    probabilities : array (N, K) of float32
        Rows on the simplex; those of unobserved Gaussians are not read.
    observed : array (N,) of bool
        Whether any view saw the Gaussian. Where none was seen at all, nothing changes.
    k : int
        Number of neighbours, at least 1.
    beta : float
        Threshold of the largest probability.

    Returns
    -------
    Clustered

    Examples
    --------
    >>> import numpy as np
    >>> means = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0]], np.float32)
    >>> codes = np.array([[0, 1], [0.5, 0.5], [0.25, 0.75]], np.float32)
    >>> cluster(means, codes, np.array([True, False, True]), k=2).probabilities.tolist()
    [[0.0, 1.0], [0.125, 0.875], [0.25, 0.75]]
    """
    codes = np.ascontiguousarray(probabilities, np.float32)
    neighbours = np.flatnonzero(observed)
    changed = ~observed | (codes.max(axis=1, initial=0) < beta)
    if not neighbours.size or not changed.any():
        return Clustered(codes.copy(), np.zeros(len(codes), bool))

    points, queries = scaled(means), np.flatnonzero(changed)
    tree, asking = Tree.build(points[neighbours]), Tree.build(points[queries])  # the latter for its order alone
    k = min(k, neighbours.size)
    radii, _ = nearest(tree.points, tree.boxes, asking.points, k)
    refined = codes.copy()
    into = queries[asking.order]
    average(tree.points, tree.boxes, neighbours[tree.order], codes, asking.points, radii, k, into, refined)
    return Clustered(refined, changed)


def statistical_filter(
    means: np.ndarray,  # (N, 3)
    labels: np.ndarray,  # (N,)
    k: int = RefineSettings.k,
    sigmas: float = RefineSettings.filter_sigmas,
    num_classes: int | None = None,
) -> np.ndarray:
    """Find the Gaussians that lie too far from the rest of their own object.

    D is the mean distance from a Gaussian to its k nearest others of its class, and one is removed where
    D > mu + sigmas * sigma over the class. What the paper calls the variance sigma is taken as the standard deviation,
    since it is added to a distance. A class of k members or fewer uses all others; one of fewer than three is left
    alone. The limit has a slack of one millionth, the precision of D, so that objects of equal spacing stay whole.

    Parameters
    ----------
    means : array (N, 3) of float32
        Finite positions, scene units.
    labels : array (N,) of int
        Class of each Gaussian. The background, 0, is no object and is not filtered, nor are negative labels.
    k : int
        Number of neighbours, at least 1.
    sigmas : float
        Standard deviations above the mean at which to cut.
    num_classes : int, optional
        K; labels from there on are ignored. By default there are none.

    Returns
    -------
    ndarray (N,) bool
        Which Gaussians to remove.

    Examples
    --------
    >>> import numpy as np
    >>> means = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [99, 0, 0]], np.float32)
    >>> statistical_filter(means, np.array([1, 1, 1, 1, 1])).tolist()
    [False, False, False, False, True]
    """
    removed = np.zeros(len(labels), bool)
    limit = int(labels.max(initial=0)) + 1 if num_classes is None else num_classes
    points, by_class = scaled(means), np.argsort(labels, kind="stable")
    bounds = np.searchsorted(labels, np.arange(1, limit + 1), sorter=by_class)
    for first, last in zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True):
        members = by_class[first:last]
        if members.size < 3:
            continue
        tree, others = Tree.build(points[members]), min(k, members.size - 1)
        _, distances = nearest(tree.points, tree.boxes, tree.points, others + 1)  # each finds itself, at distance 0
        distances /= others
        in_order = np.sort(distances)  # rounding in the mean must not depend on the order of the Gaussians
        cut = in_order.mean() + sigmas * in_order.std()
        removed[members[tree.order]] = distances > cut * (1 + 1e-6)
    return removed
