"""Which segments of different views show the same object, where ids hold only inside their own view.

A segment is one id of one view. Lifted to the Gaussians it is a sparse row w_a, in px, and s_v is the sum of the rows
of view v: all that v saw of each Gaussian. With sqrt(s_u s_v) as the weight of a Gaussian that u and v both see,

    O_ab = sum_i (w_a / sqrt s_u)[i] (w_b / sqrt s_v)[i]       what segment a of u and segment b of v have in common
    V_av = sum_i (w_a / sqrt s_u)[i] sqrt(s_v)[i]              what v sees of a, whatever it calls it

and O_ab / V_av is the share of what v sees of a that it calls b. Hidden parts do not count, so a segment that is half
behind a chair still matches the whole. All three are products of sparse matrices, and sums over the segments of a
cluster are those of the cluster.

1. **Views vote on pairs.** View v says that clusters C and D are one object with the probability that a point of each
   gets the same id there, A_v = sum_b O_Cb O_Db / (V_Cv V_Dv). What counts is the mean over the views that see both,
   so an object that some views split, or two that some views merge, are outvoted by the other views.
2. **Clusters merge**, the most agreed pairs first; what has merged is compared anew, with the evidence of all its
   segments together.
3. **The views tell where to stop.** Segmenters split objects far more often than they merge two, but how often they
   merge differs. It shows in the clusters that most views hold together: of those that touch, the least agreed pairs
   are different objects, so their agreement is how often neighbours are merged. Merging goes on to a level above it; to
   one half where hardly a pair is in doubt, since there objects are whole, and small ones must not go to large ones.
4. **Segments move** to the object that explains them best by what the other views say, until none does. That gives
   leftovers, one half of something, say, to the whole, and clutter to the background; objects left without a segment
   are gone.

Nothing depends on the order of views or ids, nor on how many there are.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import sparse

from gsseg_core.errors import SettingsError
from gsseg_core.objects.lifted_segments import Lifted, Profiles, sums

_PAIRS = 1 << 15  # so many pairs at a time, to keep memory small
_BEST = 0.75  # pairs that agree nearly as well as the best one merge at once, before anything is compared anew
_MOST = 0.6  # agreement above which clusters are one object whatever the segmenter does
_WHOLE = 0.5  # the level where segmenters hardly ever split an object, or too little is known
# Where they do, it is _LEAST + _SLOPE sqrt(how often views merge neighbours), at most _MOST; fitted to made-up masks.
_LEAST, _SLOPE = 0.2, 1.75
_SPLIT, _OFTEN = 0.3, 0.15  # agreement of two parts of one object, at least; share of such pairs that means often
_DIFFERENT = 0.1  # share of the pairs of clusters that touch of which it is sure that they are different objects
_TOUCHING = 5  # views in which clusters touch, for that
_FEWEST = 10  # such pairs, of which fewer tell nothing


@dataclass(frozen=True)
class AssociationSettings:
    """Settings of `associate`."""

    kept: float = 0.8  # share of a segment's weight that is kept, in its heaviest Gaussians, in (0, 1]
    agreement: float | None = None  # clusters merge above it, in (0, 1); by default, what the views tell
    doubt: float = 0.3  # views that disagree, added to every pair: pairs that many views confirm merge first
    evidence: float = 0.3  # views, in full sight of both clusters, that it takes at least to merge two
    full_sight: float = 0.5  # share of a cluster, as far as any view sees it, that a view must see to count in full
    plenty: float = 2000.0  # px of a cluster that a view must see to count in full, however large the cluster is
    full_sight_px: float = 10.0  # what a view sees of a cluster counts by x / (x + this), x in px
    least_share: float = 0.05  # smaller shares O_ab / V_av are soft edges, not overlap
    unseen: float = 0.3  # a segment of which the other views have seen less than this share stays what it is
    rounds: int = 10  # of moves, at most

    def __post_init__(self) -> None:
        """Validate."""
        if not 0 < self.kept <= 1:
            raise SettingsError(f"association: kept is {self.kept}; expected a share in (0, 1]")
        if self.agreement is not None and not 0 < self.agreement < 1:
            raise SettingsError(f"association: agreement is {self.agreement}; expected a share in (0, 1), or None")
        for name in ("doubt", "evidence", "full_sight_px", "least_share", "unseen", "rounds"):
            if getattr(self, name) < 0:
                raise SettingsError(f"association: {name} is {getattr(self, name)}; expected 0 or more")
        if min(self.full_sight, self.plenty) <= 0:
            raise SettingsError(
                f"association: full_sight is {self.full_sight}, plenty {self.plenty}; expected more than 0"
            )


class Association(NamedTuple):
    """Objects that the segments of some views show."""

    objects: dict[str, np.ndarray]  # by view, (L,) int32: of each segment, like `Lifted.ids`; 0 is the background
    agreement: float  # above which clusters merged


def associate(views: Mapping[str, Lifted], settings: AssociationSettings | None = None) -> Association:
    """Find the objects that the segments of all views show.

    Time and memory grow with the number of pairs of segments that share a Gaussian or are neighbours of the same
    segment, not with the square of all: n segments, each seen by o others, take O(n o^2) products.

    Parameters
    ----------
    views : mapping from name to Lifted
        In any order; the names only break ties.
    settings : AssociationSettings, optional

    Returns
    -------
    Association
        Objects have numbers from 1 on, the largest first.
    """
    settings = settings or AssociationSettings()
    names = sorted(views)
    if not names:
        return Association({}, settings.agreement or _WHOLE)
    stack = _Stack([views[name] for name in names])
    clusters, agreement = _merge(stack, settings)
    objects = _by_size(_move(stack, clusters, settings), stack)
    return Association(dict(zip(names, np.split(objects, stack.starts[1:-1]), strict=True)), agreement)


class _Stack:
    """Segments of all views, stacked as the rows of one sparse matrix."""

    def __init__(self, views: list[Lifted]) -> None:
        self.starts = np.concatenate([[0], np.cumsum([len(view) for view in views])])
        self.view = np.repeat(np.arange(len(views)), np.diff(self.starts))
        self.background = np.concatenate([view.ids for view in views]) == 0
        self.size = np.concatenate([sums(view.weights, 1) for view in views])
        # Gaussians that nobody sees take no part; those that are left are numbered anew.
        present, where = np.unique(np.concatenate([view.gaussians for view in views]), return_inverse=True)
        numbers = np.split(where, np.cumsum([len(view.gaussians) for view in views])[:-1])
        self.views = [replace(view, gaussians=ids) for view, ids in zip(views, numbers, strict=True)]
        self.num_gaussians = len(present)

    def overlaps(self) -> tuple[sparse.csr_matrix, np.ndarray]:
        """O (n, n), and V (n, views)."""
        scaled, seen = [], []
        for view in self.views:
            weights, root = view.weights, np.sqrt(sums(view.weights, 0)).astype(np.float32)
            entries = weights.data / root[weights.indices], view.gaussians[weights.indices], weights.indptr
            scaled.append(sparse.csr_matrix(entries, shape=(len(view), self.num_gaussians)))
            seen.append(sparse.csr_matrix((root, view.gaussians, [0, len(root)]), shape=(1, self.num_gaussians)))
        stacked = sparse.vstack(scaled, format="csr")
        return (stacked @ stacked.T).tocsr(), (stacked @ sparse.vstack(seen, format="csr").T).toarray()


def _merge(stack: _Stack, settings: AssociationSettings) -> tuple[np.ndarray, float]:
    """Cluster the segments, and say down to which agreement.

    All of the background are cluster 0, the others are numbered from 1.
    """
    overlap, seen = stack.overlaps()
    nodes = np.flatnonzero(~stack.background)
    touching = _same_view(overlap, stack.view)[nodes][:, nodes]
    cluster = np.arange(len(nodes))
    hidden = np.zeros_like(seen)
    hidden[:, stack.view[stack.background]] = overlap[:, stack.background].toarray()
    overlap.data[stack.background[overlap.indices]] = 0
    overlap.eliminate_zeros()
    overlap, seen, hidden = overlap[nodes], seen[nodes], hidden[nodes]
    agreement = settings.agreement
    while len(seen) > 1:
        votes, counts = _votes(overlap, seen, hidden, stack.view, settings)
        target = _match(_agreements(votes, counts, settings), len(seen), _MOST if agreement is None else agreement)
        if target is None and agreement is not None:
            break
        if target is None:
            groups = _grouping(cluster)
            agreement = _told_level(votes, counts, groups @ touching @ groups.T, settings)
            continue
        merged = np.unique(target, return_inverse=True)[1]
        groups = _grouping(merged)
        overlap, seen, hidden = (groups @ overlap).tocsr(), groups @ seen, groups @ hidden
        cluster = merged[cluster]
    clusters = np.zeros(len(stack.view), np.int64)
    clusters[nodes] = cluster + 1
    return clusters, _WHOLE if agreement is None else agreement


def _grouping(cluster: np.ndarray) -> sparse.csr_matrix:  # (n,)
    """Matrix (C, n) of ones that adds up the rows of each cluster."""
    return sparse.csr_matrix((np.ones(len(cluster), np.float32), (cluster, np.arange(len(cluster)))))


def _votes(
    overlap: sparse.csr_matrix, seen: np.ndarray, hidden: np.ndarray, view: np.ndarray, settings: AssociationSettings
) -> tuple[sparse.csr_matrix, np.ndarray]:
    """Share of each cluster that each segment has, (C, n), and what each view counts for it, (C, views), in the former.

    From what they have in common, (C, n), what each view sees of a cluster, and how much of that is background there,
    (C, views) both. Who calls a cluster background says nothing of which object it is.
    """
    foreground = np.maximum(seen - hidden, 0)
    full = np.minimum(settings.full_sight * seen.max(axis=1, keepdims=True), settings.plenty)
    counts: np.ndarray = np.minimum(foreground / np.maximum(full, 1e-9), 1)
    counts *= foreground / (foreground + settings.full_sight_px)
    entries = overlap.tocoo()
    share = entries.data / np.maximum(foreground[entries.row, view[entries.col]], 1e-9)
    strong = share > settings.least_share
    row, col, share = entries.row[strong], entries.col[strong], share[strong]
    return sparse.csr_matrix((share * counts[row, view[col]], (row, col)), shape=overlap.shape), counts


class _Pairs(NamedTuple):
    """Pairs of clusters that some view calls the same, (P,) each."""

    first: np.ndarray
    second: np.ndarray  # larger than the first
    score: np.ndarray  # mean agreement of the views; 0 where too few see both


def _agreements(votes: sparse.csr_matrix, counts: np.ndarray, settings: AssociationSettings) -> _Pairs:
    """Compare clusters; takes what `_votes` returns."""
    both = sparse.triu(votes @ votes.T, 1).tocoo()
    evidence = np.empty(both.nnz)
    for k in range(0, both.nnz, _PAIRS):
        part = slice(k, k + _PAIRS)
        evidence[part] = np.einsum("pv,pv->p", counts[both.row[part]], counts[both.col[part]])
    score = np.where(evidence >= settings.evidence, both.data / (evidence + settings.doubt), 0)
    return _Pairs(both.row, both.col, score)


def _same_view(overlap: sparse.csr_matrix, view: np.ndarray) -> sparse.csr_matrix:
    """Pairs of segments of one view that share a Gaussian, and so touch, (n, n) of ones."""
    entries = overlap.tocoo()
    same = view[entries.row] == view[entries.col]
    ones = np.ones(int(same.sum()), np.float32)
    return sparse.csr_matrix((ones, (entries.row[same], entries.col[same])), shape=overlap.shape)


def _told_level(
    votes: sparse.csr_matrix, counts: np.ndarray, touching: sparse.csr_matrix, settings: AssociationSettings
) -> float:
    """Agreement above which clusters are one object, by how often the views merge two that are not.

    Takes what `_votes` returns, and in how many views clusters touch, (C, C).
    """
    pairs = sparse.triu(touching, 1).tocoo()
    often = pairs.data >= _TOUCHING
    first, second = pairs.row[often], pairs.col[often]
    evidence = np.einsum("pv,pv->p", counts[first], counts[second])
    agreed = np.asarray(votes[first].multiply(votes[second]).sum(axis=1)).ravel()
    score = (agreed / (evidence + settings.doubt))[evidence > _TOUCHING]
    if len(score) < _FEWEST:
        return _WHOLE
    told = min(_LEAST + _SLOPE * math.sqrt(np.quantile(score, _DIFFERENT)), _MOST)
    return _WHOLE + (told - _WHOLE) * min(float(np.mean(score > _SPLIT)) / _OFTEN, 1)


def _match(pairs: _Pairs, num: int, least: float) -> np.ndarray | None:
    """Pair off clusters, best pairs first, each at most once; return whom each one becomes, None if nobody pairs."""
    good = pairs.score > least
    if not good.any():
        return None
    good &= pairs.score >= _BEST * pairs.score.max()
    first, second, score = pairs.first[good], pairs.second[good], pairs.score[good]
    target, free = np.arange(num), np.ones(num, bool)
    for k in np.lexsort([second, first, -score]):
        a, b = first[k], second[k]
        if free[a] and free[b]:
            free[a] = free[b] = False
            target[b] = a
    return target


def _move(stack: _Stack, objects: np.ndarray, settings: AssociationSettings) -> np.ndarray:
    """Give every segment to the object that explains it best by what the other views say."""
    parts = [slice(*bounds) for bounds in itertools.pairwise(stack.starts.tolist())]
    for _ in range(settings.rounds):
        before, objects = objects, objects.copy()
        profiles = Profiles.empty(stack.num_gaussians)
        for view, rows in zip(stack.views, parts, strict=True):
            profiles.add(view, before[rows])
        for view, rows in zip(stack.views, parts, strict=True):
            best, seen = profiles.explain(view, before[rows])
            moves = ~stack.background[rows] & (seen >= settings.unseen)
            objects[rows] = np.where(moves, best, before[rows])
        if (objects == before).all():
            break
    return objects


def _by_size(objects: np.ndarray, stack: _Stack) -> np.ndarray:
    """Give objects numbers from 1 on, the largest first."""
    size = np.bincount(objects, stack.size)
    present = np.unique(objects[objects > 0])
    number = np.zeros(len(size), np.int32)
    number[present[np.argsort(-size[present], kind="stable")]] = np.arange(1, len(present) + 1)
    return np.asarray(number[objects])
