"""Which segments of different views show the same object, where ids hold only inside their own view.

A segment is one id of one view. Lifted to the Gaussians it is a sparse row w_a, in px, and s_v is the sum of the rows
of view v: all that v saw of each Gaussian. With sqrt(s_u s_v) as the weight of a Gaussian that u and v both see,

    O_ab = sum_i (w_a / sqrt s_u)[i] (w_b / sqrt s_v)[i]       what segment a of u and segment b of v have in common
    V_av = sum_i (w_a / sqrt s_u)[i] sqrt(s_v)[i]              what v sees of a, whatever it calls it

and O_ab / V_av is the share of what v sees of a that it calls b. Hidden parts do not count, so a segment that is half
behind a chair still matches the whole. Both are products of sparse matrices, and sums over the segments of a
cluster are those of the cluster. An O_ab of less than a hundredth of V_av is taken for nothing: a half to two thirds of
all are, and they hardly ever make a vote together.

1. **Views that show things whole vote.** A view shows cluster C whole by f_C, which grows from 0 to 1 while the largest
   share O_Cb / V_Cv of an id grows from one half to nine tenths. Of the views that see both C and D, two averages are
   taken: the share in which one id shows both whole, and the share of that among those in which each is shown whole.
   Their geometric mean is the agreement of C and D. Parts of one object are shown whole together as often as the object
   is; two objects only where both happen to be whole and have been merged as well. A view in which half of C is merged
   with D, as where many neighbours are, does not count. What has merged by mistake is hardly shown whole by any view,
   and what the last few say must not join more to it: so a view that disagrees is added to each pair, or less where
   there are few in all. A view whose masks lie in each other has two thirds of a vote by its finest ones, and
   a third by its outermost ones.
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

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import sparse

from gsseg_core.errors import SettingsError
from gsseg_core.objects.association_kernels import dots_of_pairs
from gsseg_core.objects.depth_edges import Borders
from gsseg_core.objects.lifted_segments import Lifted
from gsseg_core.objects.move_kernels import add_objects, by_view, explain_segments
from gsseg_core.objects.sight import EVIDENCE, sight
from gsseg_core.objects.sparse_products import grouping, product_above
from gsseg_core.objects.stacked_segments import Stack, Voters

_BEST = 0.75  # pairs that agree nearly as well as the best one merge at once, before anything is compared anew
_MOST = 0.6  # agreement above which clusters are one object whatever the segmenter does
_WHOLE = 0.5  # the level where segmenters hardly ever split an object, or too little is known
_DOUBTED, _SPLIT = 0.3, 0.1  # agreement of parts of one object, at least; share of such pairs that means often split
_MANY = 0.2  # such share beyond which any two are the likelier one object, the more there are
_USUAL, _BORDER = 0.75, 100.0  # strength of depth edges between any two, taken for so many px more of their border
_SURFACE, _FACTORS = 4.0, (0.75, 1.8)  # by how much agreement grows as edges get weaker, and between what
_OFTEN = 5  # views in which clusters touch, or that see one, from which on they tell how the segmenter works
_MANY_VIEWS, _LEAST_DOUBT = 60, 0.3  # views from which on one that disagrees is added; the share of one at least
_LEAST_SHARE = 0.5  # of what a view sees of a cluster: an id that has no more does not show it
_WHOLE_SHARE = 0.9  # an id that has as much shows it whole
UNSEEN = 0.3  # a segment of which the other views have seen less than this share stays what it is
_ROUNDS = 10  # of moves, at most


@dataclass(frozen=True)
class AssociationSettings:
    """Settings of `associate`."""

    agreement: float | None = None  # clusters merge above it, in (0, 1); by default, what the views tell

    def __post_init__(self) -> None:
        """Validate."""
        if self.agreement is not None and not 0 < self.agreement < 1:
            raise SettingsError(f"association: agreement is {self.agreement}; expected a share in (0, 1), or None")


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
    stack = Stack([views[name] for name in names])
    clusters, agreement = _merge(stack, settings.agreement)
    objects = _by_size(_move(stack, clusters), stack)
    return Association(dict(zip(names, np.split(objects, stack.starts[1:-1]), strict=True)), agreement)


def _merge(stack: Stack, agreement: float | None) -> tuple[np.ndarray, float]:
    """Cluster the segments, and say down to which agreement, if none is given.

    All of the background are cluster 0, the others are numbered from 1.
    """
    start, doubt = _Clusters.single(stack), np.clip(len(stack.views) / _MANY_VIEWS, _LEAST_DOUBT, 1)
    single = start, _Votes.of(start, np.arange(len(start.seen)), stack.voters, doubt)
    sure = max(agreement or 0, _MOST)
    clusters, votes = _merged(*single, stack.voters, sure, surface=0.0)
    doubted = votes.doubted(_touching(stack, clusters))
    split = _in_parts(doubted)
    if split > 0:  # Begun again, so that depth edges count from the first pair on.
        clusters, votes = _merged(*single, stack.voters, sure, surface=split)
    agreement = agreement or votes.merging_level(doubted)
    clusters, _ = _merged(clusters, votes, stack.voters, agreement, surface=split)
    merged = np.zeros(len(stack.view), np.int64)
    merged[~stack.background] = clusters.of + 1
    return merged, agreement


class _Clusters(NamedTuple):
    """C clusters that A segments of objects make up, and what they have in common with all n segments."""

    of: np.ndarray  # (A,): the cluster of each
    overlap: sparse.csr_matrix  # (A, n + W): O, that with the background left out, and with wholes
    seen: np.ndarray  # (C, views): V
    hidden: np.ndarray  # (C, views): what of it the view calls background
    borders: Borders  # of C clusters

    @classmethod
    def single(cls, stack: Stack) -> _Clusters:
        """Start with each segment by itself."""
        nodes = np.flatnonzero(~stack.background)
        borders = Borders(*(part[nodes][:, nodes] for part in stack.borders()))
        return cls(np.arange(len(nodes)), *stack.overlaps(), borders)

    def merged(self, number: np.ndarray) -> _Clusters:  # (C,): which cluster each one becomes
        groups = grouping(number)
        borders = Borders(*((groups @ part @ groups.T).tocsr() for part in self.borders))
        return self._replace(of=number[self.of], seen=groups @ self.seen, hidden=groups @ self.hidden, borders=borders)


def _merged(
    clusters: _Clusters, votes: _Votes, voters: Voters, level: float, surface: float
) -> tuple[_Clusters, _Votes]:
    """Merge clusters down to a level, depth edges counting by `surface`, 0 to 1.

    After a step, only those that have merged are compared anew.
    """
    pairs = votes.pairs(np.arange(len(clusters.seen)), clusters.borders, surface, level)
    while len(pairs.first):
        alive, number = np.unique(_match(pairs, len(clusters.seen)), return_inverse=True)
        unchanged = np.bincount(number) == 1
        changed = np.flatnonzero(~unchanged)
        clusters = clusters.merged(number)
        votes = votes.replaced(alive[unchanged], changed, _Votes.of(clusters, changed, voters, votes.doubt))
        pairs = pairs.among(number, unchanged).plus(votes.pairs(changed, clusters.borders, surface, level))
    return clusters, votes


class _Pairs(NamedTuple):
    """Pairs of clusters that agree, (P,) each."""

    first: np.ndarray
    second: np.ndarray  # larger than the first
    score: np.ndarray  # agreement

    def among(self, number: np.ndarray, unchanged: np.ndarray) -> _Pairs:
        """Take the pairs of clusters that have not changed, (C',) bool, under their new numbers, of (C,)."""
        first, second = number[self.first], number[self.second]
        kept = unchanged[first] & unchanged[second]
        return _Pairs(first[kept], second[kept], self.score[kept])

    def plus(self, others: _Pairs) -> _Pairs:
        """Add others."""
        return _Pairs(*(np.concatenate(both) for both in zip(self, others, strict=True)))


class _Votes(NamedTuple):
    """How the views show C clusters."""

    whole: sparse.csr_matrix  # (C, n + W) float32: how whole each voter shows each, times what its view counts, shared
    counts: np.ndarray  # (C, views): 0 to 1, by how much of a cluster the view sees
    shown: np.ndarray  # (C, views): how whole the view shows it under any id, times counts
    doubt: float  # views that disagree, added to every pair

    @classmethod
    def of(cls, clusters: _Clusters, which: np.ndarray, voters: Voters, doubt: float) -> _Votes:
        """Let the views vote on some clusters. Who calls a cluster background says nothing of which object it is."""
        seen = clusters.seen[which]
        foreground = np.maximum(seen - clusters.hidden[which], 0)
        counts = sight(foreground, seen.max(axis=1, keepdims=True, initial=0))
        groups, view = grouping(clusters.of)[which], voters.view
        strong = product_above(groups, clusters.overlap, _LEAST_SHARE * foreground, view).tocoo()
        row, col = strong.row, strong.col
        share = strong.data / np.maximum(foreground[row, view[col]], 1e-9)
        grown = (share - _LEAST_SHARE) / (_WHOLE_SHARE - _LEAST_SHARE)
        whole = np.minimum(grown, 1) * counts[row, view[col]]
        shown = np.zeros_like(counts)
        np.maximum.at(shown, (row, view[col]), whole)
        shared = whole.astype(np.float32) * voters.share[col]
        rows = sparse.csr_matrix((shared, (row, col)), shape=strong.shape)
        return cls(rows, counts, shown, doubt)

    def replaced(self, kept: np.ndarray, changed: np.ndarray, by: _Votes) -> _Votes:
        """Keep the rows of some clusters, and put those of others between them: at the places `changed`, ascending."""
        order = np.insert(np.arange(len(kept)), changed - np.arange(len(changed)), len(kept) + np.arange(len(changed)))
        counts, shown = (np.concatenate([old[kept], new])[order] for old, new in zip(self[1:3], by[1:3], strict=True))
        whole = sparse.vstack([self.whole[kept], by.whole], format="csr")[order]
        return _Votes(whole, counts, shown, self.doubt)

    def pairs(self, of: np.ndarray, borders: Borders, surface: float, level: float) -> _Pairs:
        """Compare clusters, ascending, with all that any id shows whole together with them; return who agree enough.

        Depth edges count by `surface`, 0 to 1.
        """
        # No fewer views see both, or show each whole, than show both whole together.
        least = level * self.doubt / ((_FACTORS[1] if surface > 0 else 1) - level)
        bar, group = np.full((len(of), 1), least), np.zeros(self.whole.shape[0])
        together = product_above(self.whole[of], self.whole.T.tocsr(), bar, group).tocoo()
        first, second = of[together.row], together.col
        # Each pair once, and none with itself.
        asked = np.zeros(len(group), bool)
        asked[of] = True
        once = (first < second) | ((first > second) & ~asked[second])
        first, second, together = first[once], second[once], together.data[once].astype(np.float64)
        first, second = np.minimum(first, second), np.maximum(first, second)
        see, show = self._views_of_both(first, second)
        score = np.where(see >= EVIDENCE, self._agreement(together, see, show), 0)
        if surface > 0:
            score *= _surface_factor(borders, first, second) ** surface
        agree = score > level
        return _Pairs(first[agree], second[agree], score[agree])

    def _agreement(self, together: np.ndarray, see: np.ndarray, show: np.ndarray) -> np.ndarray:
        return together / np.sqrt((see + self.doubt) * (show + self.doubt))

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
        first, second = first.astype(np.int64), second.astype(np.int64)
        return np.stack([dots_of_pairs(first, second, votes) for votes in (self.counts, self.shown)])


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


def _touching(stack: Stack, clusters: _Clusters) -> sparse.csr_matrix:
    """Count for pairs of clusters, (C, C), those of their segments that touch in a view."""
    groups, nodes = grouping(clusters.of), np.flatnonzero(~stack.background)
    return (groups @ stack.touching()[nodes][:, nodes] @ groups.T).tocsr()


def _match(pairs: _Pairs, num: int) -> np.ndarray:
    """Pair off clusters, best pairs first, each at most once; return whom each one becomes, (C,)."""
    good = pairs.score >= _BEST * pairs.score.max()
    first, second, score = pairs.first[good], pairs.second[good], pairs.score[good]
    target, free = np.arange(num), np.ones(num, bool)
    for k in np.lexsort([second, first, -score]):
        a, b = first[k], second[k]
        if free[a] and free[b]:
            free[a] = free[b] = False
            target[b] = a
    return target


def _move(stack: Stack, objects: np.ndarray) -> np.ndarray:
    """Give every segment to the object that explains it best by what the other views say.

    That ends when none moves any more. Two of which either is explained best by the other would change places for ever:
    where one would go back to where it came from, both come together in the larger of the two objects.
    """
    before, weights = objects, stack.weights().T.tocsr()
    by_gaussian = weights.indptr, weights.indices, weights.data
    views = by_view(*by_gaussian, stack.starts, *stack.gaussians())
    for _ in range(_ROUNDS):
        earlier, before, num = before, objects, int(objects.max(initial=0)) + 1
        best, known = explain_segments(views, *add_objects(*by_gaussian, before, num), before, num)
        seen = np.divide(known, stack.size, out=np.zeros_like(known), where=stack.size > 0)
        moves = ~stack.background & (seen >= UNSEEN)
        size = np.bincount(before, stack.size, num)
        stays = (best == earlier) & (size[best] < size[before])
        objects = np.where(moves & ~stays, best, before)
        if (objects == before).all():
            break
    return objects


def _by_size(objects: np.ndarray, stack: Stack) -> np.ndarray:
    """Give objects numbers from 1 on, the largest first."""
    size = np.bincount(objects, stack.size)
    present = np.unique(objects[objects > 0])
    number = np.zeros(len(size), np.int32)
    number[present[np.argsort(-size[present], kind="stable")]] = np.arange(1, len(present) + 1)
    return np.asarray(number[objects])
