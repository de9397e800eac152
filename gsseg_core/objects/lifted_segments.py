"""The segments of views, ids lifted to the Gaussians as sparse rows, and what they add up to."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from gsseg_core.csr_rows import CSRRows, starts
from gsseg_core.metrics import iou
from gsseg_core.objects.association_kernels import add_common
from gsseg_core.objects.depth_edges import Borders, borders, depth_edges
from gsseg_core.objects.heaviest import heaviest
from gsseg_core.objects.sparse_products import grouping, sums
from gsseg_core.raster.observation import LabelWeights
from gsseg_core.raster.view_operator import ViewOperator
from gsseg_core.scene.gaussian_scene import GaussianScene

KEPT = 0.8  # share of a segment's weight that is kept, in its heaviest Gaussians


@dataclass(frozen=True, eq=False)
class Lifted:
    """The segments of one view, lifted to the Gaussians, heaviest segment first."""

    ids: np.ndarray  # (L,) int32: of each segment in the mask; 0 is the background; those on no Gaussian are left out
    gaussians: np.ndarray  # (M,) int32: those that the segments are on, ascending
    weights: sparse.csr_matrix  # (L, M) float32: w_a, in px
    borders: Borders | None = None  # between them; None where nothing is known of the surface
    wholes: np.ndarray | None = None  # (L,) int32: by segment, the id of the whole that it is a part of in its mask

    @classmethod
    def of(cls, seen: LabelWeights, kept: float = KEPT) -> Lifted:
        """Lift the ids of a mask; of each, only the heaviest Gaussians that make up a share of its weight."""
        size, heavy = heaviest(seen.start, seen.weights, kept)
        ids, weights = seen.gaussians[heavy], seen.weights[heavy]
        start = starts(heavy)[seen.start]
        # An order that the ids have no part in: by weight, then by the first Gaussian.
        first = np.full(len(size), np.iinfo(np.int64).max)
        shown = np.diff(start) > 0
        first[shown] = ids[start[:-1][shown]]
        order = np.lexsort([first, -size])[: np.count_nonzero(size)]
        gaussians, column = without_gaps(ids)
        by_label = sparse.csr_matrix((weights, column, start), shape=(len(size), len(gaussians)))
        return cls(seen.classes[order], gaussians, by_label[order])

    def bordered(self, scene: GaussianScene, operator: ViewOperator, labels: np.ndarray) -> Lifted:
        """Measure the borders between the segments of a mask, (H, W) integers, on the surface of the scene, too."""
        return replace(self, borders=borders(labels, self.ids, depth_edges(scene, operator)))

    def of_all(self, num_gaussians: int, data: np.ndarray) -> sparse.csr_matrix:
        """Write out what stands where the weights do, for all Gaussians, (L, N), and not only those that are seen."""
        entries = data, self.gaussians[self.weights.indices], self.weights.indptr
        return sparse.csr_matrix(entries, shape=(len(self), num_gaussians))

    def wholes_of_several(self) -> sparse.csr_matrix:
        """Tell which segments make up each whole of several, (W, L) float32 of ones."""
        _, number = np.unique(self.ids if self.wholes is None else self.wholes, return_inverse=True)
        wholes = grouping(number)
        return wholes[np.diff(wholes.indptr) > 1]

    def __len__(self) -> int:
        """Count the segments."""
        return len(self.ids)


class Profiles:
    """Weights of the objects on the Gaussians: the segments of each object added up, a sparse (N, K) matrix, in px."""

    def __init__(self, weights: sparse.csr_matrix) -> None:
        self._sum, self._more = weights, list[sparse.coo_matrix]()

    @classmethod
    def empty(cls, num_gaussians: int) -> Profiles:
        """Start without any segment."""
        return cls(sparse.csr_matrix((num_gaussians, 1)))

    @classmethod
    def of(cls, votes: CSRRows) -> Profiles:
        """Make those of votes for objects, in px; of each, only the heaviest Gaussians, as `Lifted.of` does."""
        shape = votes.num_rows, int(votes.indices.max(initial=0)) + 1
        px = np.maximum(votes.data, 0).astype(np.float32)
        weights = sparse.csr_matrix((px, votes.indices.astype(np.int64), votes.indptr), shape=shape).tocsc()
        weights.data *= heaviest(weights.indptr.astype(np.int64), weights.data, KEPT)[1]
        weights.eliminate_zeros()
        return cls(weights.tocsr())

    def add(self, segments: Lifted, objects: np.ndarray) -> None:  # (L,)
        """Add the segments of a view to their objects."""
        part = (grouping(objects) @ segments.weights.astype(np.float64)).tocoo()
        at = segments.gaussians[part.col], part.row
        if sum(more.nnz for more in self._more) > self._sum.nnz:  # Nobody may ask for the sum, view after view.
            self._add_up()
        # Another list: copies have their own, in no more memory.
        self._more = [*self._more, sparse.coo_matrix((part.data, at), shape=(len(self), part.shape[0]))]

    def renumbered(self, objects: np.ndarray) -> Profiles:  # (K,)
        """Give the objects other numbers; those that get the same one become one."""
        old = self.weights.tocoo()
        shape = (len(self), int(objects.max(initial=0)) + 1)
        return Profiles(sparse.coo_matrix((old.data, (old.row, objects[old.col])), shape=shape).tocsr())

    def __len__(self) -> int:
        """Count the Gaussians, N."""
        return int(self._sum.shape[0])

    @property
    def weights(self) -> sparse.csr_matrix:
        """The sum, (N, K) csr_matrix of float64."""
        if self._more:
            self._add_up()
        return self._sum

    def _add_up(self) -> None:
        parts = [self._sum.tocoo(), *self._more]
        row, col, data = (np.concatenate([getattr(p, name) for p in parts]) for name in ("row", "col", "data"))
        shape = (len(self), int(max(part.shape[1] for part in parts)))
        self._sum, self._more = sparse.coo_matrix((data, (row, col)), shape=shape).tocsr(), []

    def common(self, segments: Lifted) -> tuple[np.ndarray, np.ndarray]:
        """How much of L segments of a view lies on each object, (L, K), and on known Gaussians, (L,), in px."""
        present, common, known = self._common(segments)
        every = np.zeros((len(segments), self.weights.shape[1]))
        every[:, present] = common
        return every, known

    def explain(self, segments: Lifted) -> tuple[np.ndarray, np.ndarray]:
        """Find the object of the largest IoU with each segment of a view, (L,), 0 where there is none.

        Also returns the share of each segment that lies on Gaussians of which anything is known, (L,).
        """
        present, common, known = self._common(segments)
        overlap = np.nan_to_num(iou(common, known[:, None], common.sum(axis=0)))
        whole = sums(segments.weights, 1)
        best = np.where(overlap.any(axis=1), present[overlap.argmax(axis=1)], 0)
        return best, np.divide(known, whole, out=np.zeros_like(known), where=whole > 0)

    def _common(self, segments: Lifted) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Find which objects are on the Gaussians of the segments, (U,) with 0, and `common` of these, (L, U)."""
        profile = self.weights[segments.gaussians].astype(np.float64, copy=False)
        present, column = without_gaps(np.append(profile.indices, 0))
        common, known, weights = np.zeros((len(segments), len(present))), np.zeros(len(segments)), segments.weights
        add_common(
            weights.indptr, weights.indices, weights.data, profile.indptr, column[:-1], profile.data, sums(profile, 1),
            common, known,
        )  # fmt: skip
        return present, common, known


def without_gaps(numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:  # (P,), at least 0
    """Find which numbers occur, (U,) int32 ascending, and give each its place among these, (P,) int32.

    It is `np.unique` with the inverse, without sorting: for numbers that are not much larger than there are many.
    """
    place = np.zeros(int(numbers.max(initial=-1)) + 1, np.int32)
    place[numbers] = 1
    present = np.flatnonzero(place).astype(np.int32)
    place[present] = np.arange(len(present), dtype=np.int32)
    return present, place[numbers]
