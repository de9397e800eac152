"""Which segments of different views show the same object, where ids hold only inside their own view.

A segment is one id of one view. Lifted to the Gaussians it is a sparse row w_a, in px, and s_v is the sum of the rows
of view v: all that v saw of each Gaussian. With sqrt(s_u s_v) as the weight of a Gaussian that u and v both see,

    O_ab = sum_i (w_a / sqrt s_u)[i] (w_b / sqrt s_v)[i]       what segment a of u and segment b of v have in common
    V_av = sum_i (w_a / sqrt s_u)[i] sqrt(s_v)[i]              what v sees of a, whatever it calls it

and O_ab / V_av is the share of what v sees of a that it calls b. Hidden parts do not count, so a segment that is half
behind a chair still matches the whole. All three are products of sparse matrices, and sums over the segments of a
cluster are those of the cluster.

1. **Views that show things whole vote.** A view shows cluster C whole by f_C, which grows from 0 to 1 while the largest
   share O_Cb / V_Cv of an id grows from one half to nine tenths. Of the views that see both C and D, two averages are
   taken: the share in which one id shows both whole, and the share of that among those in which each is shown whole.
   Their geometric mean is the agreement of C and D. Parts of one object are shown whole together as often as the object
   is; two objects only where both happen to be whole and have been merged as well. A view in which half of C is merged
   with D, as where many neighbours are, does not count.
2. **Clusters merge**, the most agreed pairs first; what has merged is compared anew, with the evidence of all its
   segments together. Down to an agreement of 0.6 that is so whatever the segmenter does. Where then hardly any clusters
   that touch agree by 0.3 to 0.6, no object comes in parts, and merging goes on to one half only: small ones must not
   go to large ones.
3. **Depth edges count where objects come in parts**, and merging begins again. With e the mean strength of the
   depth edges along the borders of C and D in all views, agreement counts exp(4 (0.75 - e)) times, as parts of one
   object meet on its surface and different objects do not. And the views tell where to stop. Let them show an object
   whole with the probability w, and merge neighbours with the probability m. Two objects are under one id, both whole,
   in w w m of the views, which is an agreement of w m, and parts of one in w of them: so merging goes on down to w, if
   that is less than one half. It is read off the clusters at 0.6, as how often they are shown whole. Where more than a
   fifth of those that touch agree by 0.3 to 0.6, any two are the likelier one object, and w counts less.
4. **Segments move** to the object that explains them best by what the other views say, until none does. That gives
   leftovers, one half of something, say, to the whole, and clutter to the background; objects left without a segment
   are gone.

Nothing depends on the order of views or ids, nor on how many there are.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import sparse

from gsseg_core.errors import SettingsError
from gsseg_core.objects.depth_edges import Borders
from gsseg_core.objects.lifted_segments import Lifted, Profiles, sums

_PAIRS = 1 << 15  # so many pairs at a time, to keep memory small
_BEST = 0.75  # pairs that agree nearly as well as the best one merge at once, before anything is compared anew
_MOST = 0.6  # agreement above which clusters are one object whatever the segmenter does
_WHOLE = 0.5  # the level where segmenters hardly ever split an object, or too little is known
_DOUBTED, _SPLIT = 0.3, 0.1  # agreement of parts of one object, at least; share of such pairs that means often split
_MANY = 0.2  # such share beyond which any two are the likelier one object, the more there are
_USUAL, _BORDER = 0.75, 100.0  # strength of depth edges between any two, taken for so many px more of their border
_SURFACE, _FACTORS = 4.0, (0.75, 1.8)  # by how much agreement grows as edges get weaker, and between what
_OFTEN = 5  # views in which clusters touch, or that see one, from which on they tell how the segmenter works


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
    least_share: float = 0.5  # of what a view sees of a cluster: an id that has no more does not show it
    whole_share: float = 0.9  # an id that has as much shows it whole
    unseen: float = 0.3  # a segment of which the other views have seen less than this share stays what it is
    rounds: int = 10  # of moves, at most

    def __post_init__(self) -> None:
        """Validate."""
        if not 0 < self.kept <= 1:
            raise SettingsError(f"association: kept is {self.kept}; expected a share in (0, 1]")
        if self.agreement is not None and not 0 < self.agreement < 1:
            raise SettingsError(f"association: agreement is {self.agreement}; expected a share in (0, 1), or None")
        if not 0 <= self.least_share < self.whole_share <= 1:
            raise SettingsError(
                f"association: least_share is {self.least_share}, whole_share {self.whole_share}; expected shares "
                "in [0, 1], the second the larger one"
            )
        for name in ("doubt", "evidence", "full_sight_px", "unseen", "rounds"):
            if getattr(self, name) < 0:
                raise SettingsError(f"association: {name} is {getattr(self, name)}; expected 0 or more")
        if min(self.full_sight, self.plenty) <= 0:
            raise SettingsError(
                f"association: full_sight is {self.full_sight}, plenty {self.plenty}; expected more than 0"
            )

    def sight(self, seen: np.ndarray, most: np.ndarray) -> np.ndarray:
        """Say how much views count for what they see of clusters, (C, views) px; the most that any sees is (C, 1)."""
        full = np.minimum(self.full_sight * most, self.plenty)
        return np.minimum(seen / np.maximum(full, 1e-9), 1) * seen / (seen + self.full_sight_px)


class Association(NamedTuple):
    """Objects that the segments of some views show."""

    objects: dict[str, np.ndarray]  # by view, (L,) int32: of each segment, like `Lifted.ids`; 0 is the background
    agreement: float  # above which clusters merged


def associate(views: Mapping[str, Lifted], settings: AssociationSettings | None = None) -> Association:
    """Find the objects that the segments of all views show, numbered from 1 on, the largest first.

    Views may come in any order; their names only break ties. Time and memory grow with the number of pairs of segments
    that share a Gaussian or are neighbours of the same segment, not with the square of all: n segments, each seen by o
    others, take O(n o^2) products.
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

    def borders(self) -> Borders:
        """Between the segments of each view."""
        parts = zip(*(view.borders or Borders.empty(len(view)) for view in self.views), strict=True)
        return Borders(*(sparse.block_diag(part, format="csr") for part in parts))

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
    single, sure = _Clusters.single(stack), max(settings.agreement or 0, _MOST)
    clusters, votes = _merged(single, stack.view, settings, sure, surface=0.0)
    doubted = votes.doubted(clusters.touching)
    split = _in_parts(doubted)
    if split > 0:  # Begun again, so that depth edges count from the first pair on.
        clusters, votes = _merged(single, stack.view, settings, sure, surface=split)
    agreement = settings.agreement or votes.merging_level(doubted)
    clusters, _ = _merged(clusters, stack.view, settings, agreement, surface=split)
    merged = np.zeros(len(stack.view), np.int64)
    merged[~stack.background] = clusters.of + 1
    return merged, agreement


class _Clusters(NamedTuple):
    """C clusters that segments of objects make up, and what they have in common with all n segments."""

    of: np.ndarray  # the cluster of each segment that is not background
    overlap: sparse.csr_matrix  # (C, n): O, that with the background left out
    seen: np.ndarray  # (C, views): V
    hidden: np.ndarray  # (C, views): what of it the view calls background
    touching: sparse.csr_matrix  # (C, C): pairs of segments of one view that touch
    borders: Borders  # of C clusters

    @classmethod
    def single(cls, stack: _Stack) -> _Clusters:
        """Start with each segment by itself."""
        overlap, seen = stack.overlaps()
        nodes = np.flatnonzero(~stack.background)
        touching = _same_view(overlap, stack.view)[nodes][:, nodes]
        hidden = np.zeros_like(seen)
        hidden[:, stack.view[stack.background]] = overlap[:, stack.background].toarray()
        overlap.data[stack.background[overlap.indices]] = 0
        overlap.eliminate_zeros()
        borders = Borders(*(part[nodes][:, nodes] for part in stack.borders()))
        return cls(np.arange(len(nodes)), overlap[nodes], seen[nodes], hidden[nodes], touching, borders)

    def merged(self, target: np.ndarray) -> _Clusters:  # (C,): whom each one becomes
        number = np.unique(target, return_inverse=True)[1]
        # Ones that add up the rows of each cluster, (C', C).
        groups = sparse.csr_matrix((np.ones(len(number), np.float32), (number, np.arange(len(number)))))
        touching, *borders = ((groups @ part @ groups.T).tocsr() for part in (self.touching, *self.borders))
        overlap, seen, hidden = (groups @ self.overlap).tocsr(), groups @ self.seen, groups @ self.hidden
        return _Clusters(number[self.of], overlap, seen, hidden, touching, Borders(*borders))


def _merged(
    clusters: _Clusters, view: np.ndarray, settings: AssociationSettings, level: float, surface: float
) -> tuple[_Clusters, _Votes]:
    """Merge clusters down to a level, depth edges counting by `surface`, 0 to 1; also return the last votes."""
    while True:
        votes = _Votes.of(clusters, view, settings)
        target = _match(votes.pairs(clusters.borders, surface, level), len(clusters.seen), level)
        if target is None:
            return clusters, votes
        clusters = clusters.merged(target)


class _Pairs(NamedTuple):
    """Pairs of clusters that some view shows whole under one id, (P,) each."""

    first: np.ndarray
    second: np.ndarray  # larger than the first
    score: np.ndarray  # agreement; 0 where too few views see both


class _Votes(NamedTuple):
    """How the views show C clusters."""

    whole: sparse.csr_matrix  # (C, n): how whole each segment shows each cluster, times what its view counts for that
    counts: np.ndarray  # (C, views): 0 to 1, by how much of a cluster the view sees
    shown: np.ndarray  # (C, views): how whole the view shows it under any id, times counts
    settings: AssociationSettings

    @classmethod
    def of(cls, clusters: _Clusters, view: np.ndarray, settings: AssociationSettings) -> _Votes:
        """Let the views vote. Who calls a cluster background says nothing of which object it is."""
        foreground = np.maximum(clusters.seen - clusters.hidden, 0)
        counts = settings.sight(foreground, clusters.seen.max(axis=1, keepdims=True, initial=0))
        entries = clusters.overlap.tocoo()
        share = entries.data / np.maximum(foreground[entries.row, view[entries.col]], 1e-9)
        strong = share > settings.least_share
        row, col = entries.row[strong], entries.col[strong]
        grown = (share[strong] - settings.least_share) / (settings.whole_share - settings.least_share)
        whole = np.minimum(grown, 1) * counts[row, view[col]]
        shown = np.zeros_like(counts)
        np.maximum.at(shown, (row, view[col]), whole)
        return cls(sparse.csr_matrix((whole, (row, col)), shape=clusters.overlap.shape), counts, shown, settings)

    def pairs(self, borders: Borders, surface: float, level: float) -> _Pairs:
        """Compare all clusters that any id shows whole together, and that may agree by more than a level.

        Depth edges count by `surface`, 0 to 1.
        """
        together = sparse.triu(self.whole @ self.whole.T, 1).tocoo()
        # No fewer views see both, or show each whole, than show both whole together.
        likely = together.data * (_FACTORS[1] if surface > 0 else 1) > level * (together.data + self.settings.doubt)
        first, second = together.row[likely], together.col[likely]
        see, show = self._views_of_both(first, second)
        score = np.where(see >= self.settings.evidence, self._agreement(together.data[likely], see, show), 0)
        if surface > 0:
            score *= _surface_factor(borders, first, second) ** surface
        return _Pairs(first, second, score)

    def _agreement(self, together: np.ndarray, see: np.ndarray, show: np.ndarray) -> np.ndarray:
        doubt = self.settings.doubt
        return together / np.sqrt((see + doubt) * (show + doubt))

    def doubted(self, touching: sparse.csr_matrix) -> float:
        """Share of the pairs of clusters that touch, (C, C), that may be parts of one object."""
        pairs = sparse.triu(touching, 1).tocoo()
        often = pairs.data >= _OFTEN
        first, second = pairs.row[often], pairs.col[often]
        together = np.asarray(self.whole[first].multiply(self.whole[second]).sum(axis=1)).ravel()
        see, show = self._views_of_both(first, second)
        doubted = self._agreement(together, see, show)[see > _OFTEN] > _DOUBTED
        return float(np.mean(doubted)) if len(doubted) else 0.0

    def merging_level(self, doubted: float) -> float:
        """Agreement above which clusters are one object, by how often views show them whole and the share `doubted`."""
        seen = self.counts.sum(axis=1)
        known = seen >= _OFTEN
        if not known.any():
            return _WHOLE
        whole = float(np.mean(self.shown[known].sum(axis=1) / seen[known]))
        level = whole * np.sqrt(_MANY / max(doubted, _MANY))
        return float(_WHOLE - _in_parts(doubted) * max(_WHOLE - level, 0))

    def _views_of_both(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Count, for pairs of clusters, the views that see both, and those that show each of them whole, (2, P)."""
        count = np.empty((2, len(first)))
        for k in range(0, len(first), _PAIRS):
            part = slice(k, k + _PAIRS)
            for row, votes in zip(count, (self.counts, self.shown), strict=True):
                row[part] = np.einsum("pv,pv->p", votes[first[part]], votes[second[part]])
        return count


def _surface_factor(borders: Borders, first: np.ndarray, second: np.ndarray) -> np.ndarray:  # (P,), (P,)
    """Factors (P,) of the agreement of pairs of clusters: above 1 where few depth edges run along their border."""
    if not len(first):
        return np.ones(0)
    length, edges = (np.asarray(part[first, second], np.float64).ravel() for part in borders)
    share = (edges + _USUAL * _BORDER) / (length + _BORDER)
    return np.clip(np.exp(_SURFACE * (_USUAL - share)), *_FACTORS)


def _in_parts(doubted: float) -> float:
    """How far the masks show objects in parts, 0 to 1, by the share of touching clusters that may be one object."""
    return min(doubted / _SPLIT, 1)


def _same_view(overlap: sparse.csr_matrix, view: np.ndarray) -> sparse.csr_matrix:
    """Pairs of segments of one view that share a Gaussian, and so touch, (n, n) of ones."""
    entries = overlap.tocoo()
    same = view[entries.row] == view[entries.col]
    ones = np.ones(int(same.sum()), np.float32)
    return sparse.csr_matrix((ones, (entries.row[same], entries.col[same])), shape=overlap.shape)


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
    """Give every segment to the object that explains it best by what the other views say.

    That ends when none moves any more, or when some do nothing but change places with each other.
    """
    parts = [slice(*bounds) for bounds in itertools.pairwise(stack.starts.tolist())]
    before = objects
    for _ in range(settings.rounds):
        earlier, before, objects = before, objects, objects.copy()
        profiles = Profiles.empty(stack.num_gaussians)
        for view, rows in zip(stack.views, parts, strict=True):
            profiles.add(view, before[rows])
        for view, rows in zip(stack.views, parts, strict=True):
            best, seen = profiles.explain(view, before[rows])
            moves = ~stack.background[rows] & (seen >= settings.unseen)
            objects[rows] = np.where(moves, best, before[rows])
        if (objects == before).all() or (objects == earlier).all():
            break
    return objects


def _by_size(objects: np.ndarray, stack: _Stack) -> np.ndarray:
    """Give objects numbers from 1 on, the largest first."""
    size = np.bincount(objects, stack.size)
    present = np.unique(objects[objects > 0])
    number = np.zeros(len(size), np.int32)
    number[present[np.argsort(-size[present], kind="stable")]] = np.arange(1, len(present) + 1)
    return np.asarray(number[objects])
