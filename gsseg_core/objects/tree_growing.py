"""Which parts objects have and which wholes they make, by what the views say that the objects were found from.

A segment is one id of one view, lifted to the Gaussians. For a region R, any set of Gaussians, view v has the shares
p_Rb of what it sees of R that it calls b; two regions are one there with the probability sum_b p_Rb p_Sb, and their
agreement is the mean of that over the views, each counting by how much it sees of both. That holds for pieces of one
object and for whole objects alike, so that one tree has all of them:

1. Each object is cut into cells of a few Gaussians that lie together, and these merge, the most agreed first. "Beside
   each other" in one view and "both inside" in the next are votes on the same pair: what some views cut up and others
   show whole becomes parts that agree by the share of the views that show it whole.
2. Objects merge in the same way, by how often views have them under one id.
   A view whose masks lie in each other votes twice, by its segments and by the wholes that these make up.
3. A region stays if three views or more show it as a segment: under one id that is it more than anything else, by an
   IoU above one half. What no view shows, as a rim of mixed Gaussians, goes to what it agrees with most.
4. Every Gaussian goes to the part of its object that the ids on it speak for; one that no view has seen, to that of the
   nearest that was seen.

Gaussians merge, not segments: so levels are nested whatever an id covers, and the objects are those that were learnt.
Nothing depends on the order of views or ids.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import sparse

from gsseg_core.data.object_tree import ObjectTree
from gsseg_core.objects.lifted_segments import Lifted
from gsseg_core.objects.sight import FULL_SIGHT_PX
from gsseg_core.objects.sparse_products import grouping, sums
from gsseg_core.objects.tree_kernels import Merged, cells, merge_regions, showing, staying
from gsseg_core.spatial.row_order import rows_by_label

SEVERAL = 3  # views that have to show a part or a whole
_CELL, _MOST_CELLS = 8, 256  # Gaussians of a cell; cells of an object, of which a larger one has larger cells
_ITSELF = 0.5  # IoU above which a segment is a region: it can be so of no other one beside it
_STEPS = 10  # agreements are told apart by a tenth


@dataclass(eq=False)
class _Region:
    """A node of the tree while it grows."""

    agreement: float = 1.0  # by which its parts are one
    parts: list[_Region] = field(default_factory=list)
    row: int = -1  # of its shares, among those of all regions
    size: int = 0  # Gaussians, of a leaf
    number: int = -1

    def leaves(self) -> list[_Region]:
        return [leaf for part in self.parts for leaf in part.leaves()] or [self]

    @property
    def total(self) -> int:
        return sum(leaf.size for leaf in self.leaves())


def grow_tree(
    means: np.ndarray,  # (N, 3) float32: where the Gaussians are
    classes: np.ndarray,  # (N,) int: object of each; 0 is the background, which has no parts, and below 0 is none
    num_classes: int,  # largest object that there may be, and one more for the background
    views: Mapping[str, Lifted],  # in any order; the names only break ties
    level: float,  # agreement down to which segments were put together, the granularity of the objects
) -> ObjectTree:
    """Find the parts of objects, and the wholes that they make."""
    weights, segments = _stacked(views, len(means))
    objects = [_Region(row=k) for k in range(num_classes)]
    places = np.where(classes >= 0, 0, -1)  # among the leaves of its object
    of_class, nobody = rows_by_label(classes), np.zeros(0, np.int64)
    members = [of_class.get(k, nobody) for k in range(num_classes)]
    for k in range(1, num_classes):
        rows = weights[members[k]]
        used = np.unique(rows.indices)
        rows, own, seen = rows[:, used], segments.among(used), np.diff(rows.indptr) > 0
        cell = cells(means[members[k]][seen], max(float(_CELL), np.count_nonzero(seen) / _MOST_CELLS))
        merged = own.merged(rows[seen], cell)
        tops = _kept(merged, own.showing(merged))
        found = _stepped(tops[0] if len(tops) == 1 else _Region(0.0, tops), level, 1.0)
        if found.parts:
            places[members[k]] = _nearest_part(
                means[members[k]], rows, own, merged.shares[[r.row for r in found.leaves()]]
            )
            objects[k] = found
    for k, object_ in enumerate(objects):
        leaves = object_.leaves()
        for leaf, size in zip(leaves, np.bincount(places[members[k]], minlength=len(leaves)).tolist(), strict=True):
            leaf.size = size
    return _numbered(objects, _wholes(objects, members, weights, segments, level), members, places, level)


@dataclass(frozen=True, eq=False)
class _Segments:
    """Segments of several views, and how these compare regions by them."""

    view: np.ndarray  # (S,): ascending
    size: np.ndarray  # (S,), px

    def among(self, used: np.ndarray) -> _Segments:  # (S',)
        """Take some of them, of views without gaps."""
        return _Segments(np.unique(self.view[used], return_inverse=True)[1], self.size[used])

    def seen(self, regions: np.ndarray) -> np.ndarray:
        """Sum up what each view sees of regions (R, S), in px, (R, views)."""
        firsts = np.flatnonzero(np.diff(self.view, prepend=-1))
        return np.add.reduceat(regions, firsts, axis=1) if len(firsts) else regions

    def merged(self, rows: sparse.csr_matrix, groups: np.ndarray) -> Merged:
        """Merge the regions that groups (n,) of Gaussians are, by rows (n, S): all on the way, parts before wholes."""
        shares = (grouping(groups) @ rows.astype(np.float64)).toarray()
        return merge_regions(shares, self.view)

    def showing(self, merged: Merged) -> np.ndarray:
        """Which views show each region as a segment, (R, views) bool."""
        return showing(merged.parts, merged.shares, self.view, self.size, _ITSELF, FULL_SIGHT_PX)


def _stacked(views: Mapping[str, Lifted], num_gaussians: int) -> tuple[sparse.csr_matrix, _Segments]:  # (N, S), px
    """Stack the segments of all views but their backgrounds, and the wholes of several."""
    blocks = [sparse.csr_matrix((0, num_gaussians), dtype=np.float32)]
    for name in sorted(views):
        one = views[name]
        every = one.of_all(num_gaussians, one.weights.data)
        blocks += [every[one.ids != 0], one.wholes_of_several() @ every]
    stacked = sparse.vstack(blocks, format="csr")
    view = np.repeat(np.arange(len(blocks)), [block.shape[0] for block in blocks])
    every = _Segments(view, sums(stacked, 1))
    return stacked.T.tocsr(), every.among(np.arange(len(view)))


def _kept(merged: Merged, shown: np.ndarray, objects: Sequence[_Region] = ()) -> list[_Region]:
    """Keep of all regions what several views show; `objects`, for the first regions, are kept in any case."""
    stays, kept = staying(merged.parts, shown, len(objects), SEVERAL), dict[int, list[_Region]]()
    pairs = zip(merged.parts.tolist(), merged.agreement.tolist(), stays.tolist(), strict=True)
    for row, (two, agreement, itself) in enumerate(pairs):
        parts = [one for part in two if part >= 0 for one in kept.pop(part)]
        if row < len(objects):
            parts = [objects[row]]
        elif itself:
            same = parts[0] if len(parts) == 1 else _Region(agreement if parts else 1.0, parts)
            parts = [_Region(same.agreement, same.parts, row)]
        kept[row] = parts
    return [region for each in kept.values() for region in each]


def _stepped(region: _Region, least: float, most: float) -> _Region:
    """Round agreements down to steps within bounds, none above those of its parts; parts of the same one are one."""
    if not region.parts:
        return region
    inner = [_stepped(part, least, most) for part in region.parts]
    own = float(np.clip(np.floor(region.agreement * _STEPS) / _STEPS, least, most))
    own = min([own, *(part.agreement for part in inner)])
    parts = [p for part in inner for p in (part.parts if part.parts and part.agreement == own else [part])]
    return _Region(own, parts, region.row)


def _nearest_part(
    means: np.ndarray, rows: sparse.csr_matrix, segments: _Segments, parts: np.ndarray
) -> np.ndarray:  # (n,) index of a part
    """Give each Gaussian of an object to one of its parts (P, S), by the ids on it or else by its neighbour's."""
    shares = parts / np.maximum(segments.seen(parts), 1e-9)[:, segments.view]
    place = np.asarray((rows @ shares.T).argmax(axis=1))
    seen = np.diff(rows.indptr) > 0
    if not seen.all():
        from scipy.spatial import cKDTree  # It takes a while to load.

        place[~seen] = place[seen][cKDTree(means[seen]).query(means[~seen])[1]]
    return place


def _wholes(
    objects: Sequence[_Region],
    members: Sequence[np.ndarray],
    weights: sparse.csr_matrix,  # (N, S)
    segments: _Segments,
    level: float,
) -> list[_Region]:
    """Put objects together that several views show as one; leaves have the numbers of objects for rows."""
    present = [k for k in range(1, len(objects)) if len(members[k])]
    groups = np.repeat(np.arange(len(present)), np.array([len(members[k]) for k in present], np.int64))
    merged = segments.merged(weights[np.concatenate([np.zeros(0, np.int64), *members[1:]])], groups)
    tops = _kept(merged, segments.showing(merged), [_Region(row=k) for k in present])
    below = float(np.nextafter(np.float32(level), np.float32(0)))
    todo, found = [_stepped(region, 0.0, below) for region in tops], list[_Region]()
    while todo:  # What hardly a view has under one id is no whole.
        region = todo.pop()
        if region.parts and region.agreement > 0:
            found.append(region)
        else:
            todo += region.parts
    return sorted(found, key=lambda region: -sum(len(members[leaf.row]) for leaf in region.leaves()))


def _numbered(
    objects: Sequence[_Region],
    wholes: Sequence[_Region],
    members: Sequence[np.ndarray],
    places: np.ndarray,
    level: float,
) -> ObjectTree:
    """Give the nodes numbers, those with the most Gaussians first, and every Gaussian that of its leaf."""
    parents, agreement = [-1] * len(objects), [1.0] * len(objects)

    def add(region: _Region, number: int) -> None:
        region.number, agreement[number] = number, region.agreement
        first = len(parents)
        parents.extend([number] * len(region.parts))
        agreement.extend([1.0] * len(region.parts))
        for place, part in enumerate(region.parts):
            add(part, first + place)

    leaves = np.full(len(places), -1, np.int32)
    for k, region in enumerate(objects):
        before = region.leaves()
        add(_pruned(region), k)
        leaves[members[k]] = np.array([leaf.number for leaf in before])[places[members[k]]] if region.parts else k

    def put_together(region: _Region, whole: int) -> None:
        if region.parts:
            parents.append(whole)
            agreement.append(region.agreement)
            whole = len(parents) - 1
            for part in region.parts:
                put_together(part, whole)
        else:
            parents[region.row] = whole

    for region in wholes:
        put_together(region, -1)
    return ObjectTree(np.array(parents, np.int32), np.array(agreement, np.float32), leaves, len(objects), level)


def _pruned(region: _Region) -> _Region:
    """Leave out, in place, parts without Gaussians; a part that is the only one left is the whole."""
    parts = sorted((_pruned(part) for part in region.parts if part.total), key=lambda part: -part.total)
    if len(parts) == 1:
        parts, region.agreement = parts[0].parts, parts[0].agreement
    region.parts = parts
    return region
