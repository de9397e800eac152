"""The segments of all views together: what any two of them have in common on the Gaussians."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy import sparse

from gsseg_core.csr_rows import starts
from gsseg_core.objects.depth_edges import Borders
from gsseg_core.objects.lifted_segments import Lifted, without_gaps
from gsseg_core.objects.sparse_products import product_above, sums

_BY_WHOLES = 1 / 3  # of a view's vote; with a half, wholes that all views agree on would join objects by themselves
_LEAST = 0.01  # of what a view sees of a segment: what has no larger a share in common with it is taken for nothing


class Voters(NamedTuple):
    """Ids by which views vote: segments, and in views whose masks lie in others the wholes that these make up."""

    view: np.ndarray  # (n + W,) int64
    share: np.ndarray  # (n + W,) float32: root of what a vote is worth, `_BY_WHOLES` of a whole, the rest of its parts


class Stack:
    """The n segments of all views, stacked; Gaussians that no view sees take no part."""

    def __init__(self, views: list[Lifted]) -> None:
        self.starts = starts(np.array([len(view) for view in views]))
        self.view = np.repeat(np.arange(len(views)), np.diff(self.starts))
        self.background = np.concatenate([view.ids for view in views]) == 0
        self.size = np.concatenate([sums(view.weights, 1) for view in views])
        present, where = without_gaps(np.concatenate([view.gaussians for view in views]))
        numbers = np.split(where, np.cumsum([len(view.gaussians) for view in views])[:-1])
        self.views = [replace(view, gaussians=ids) for view, ids in zip(views, numbers, strict=True)]
        self.num_gaussians = len(present)
        self.wholes, self.voters = self._voters()

    def _voters(self) -> tuple[sparse.csr_matrix, Voters]:
        """Tell which segments make up each of the W wholes, (n, W) of ones, and who votes."""
        wholes = [view.wholes_of_several() for view in self.views]
        members = sparse.block_diag(wholes, format="csr").T.tocsr()
        of_wholes = np.repeat(np.arange(len(wholes)), [part.shape[0] for part in wholes])
        worth = np.where(np.diff(members.indptr) > 0, 1 - _BY_WHOLES, 1), np.full(len(of_wholes), _BY_WHOLES)
        return members, Voters(np.append(self.view, of_wholes), np.sqrt(np.concatenate(worth), dtype=np.float32))

    def weights(self) -> sparse.csr_matrix:
        """Weights of the segments on the Gaussians, (n, I) float32, in px."""
        return self._stacked([view.weights.data for view in self.views])

    def gaussians(self) -> tuple[np.ndarray, np.ndarray]:
        """Where the Gaussians of each view begin, (views + 1,), and which they are, view after view, (M,)."""
        parts = [view.gaussians for view in self.views]
        return starts(np.array([len(part) for part in parts])), np.concatenate(parts)

    def borders(self) -> Borders:
        """Borders between the segments of each view."""
        parts = zip(*(view.borders or Borders.empty(len(view)) for view in self.views), strict=True)
        return Borders(*(sparse.block_diag(part, format="csr") for part in parts))

    def touching(self) -> sparse.csr_matrix:
        """Pairs of segments of one view that share a Gaussian, (n, n) of ones."""
        touching = sparse.block_diag([view.weights @ view.weights.T for view in self.views], format="csr")
        touching.data[:] = 1
        return touching

    def overlaps(self) -> tuple[sparse.csr_matrix, np.ndarray, np.ndarray]:
        """Overlaps of the A segments that are no background, by the formulas at the top of `association`.

        These are O, and its sums by whole, (A, n + W) float32, zero with background, and where it is next to nothing of
        what the view sees; V; and how much of that the view calls background, (A, views) float32 each.
        """
        roots = [np.sqrt(sums(view.weights, 0)).astype(np.float32) for view in self.views]
        scaled = [view.weights.data / root[view.weights.indices] for view, root in zip(self.views, roots, strict=True)]
        stacked, behind = self._stacked(scaled), np.flatnonzero(self.background)
        where = np.concatenate([view.gaussians for view in self.views])
        ends = np.cumsum([0, *(len(root) for root in roots)])
        each = sparse.csr_matrix((np.concatenate(roots), where, ends), shape=(len(roots), self.num_gaussians))
        objects = stacked[~self.background]
        seen = (objects @ each.T).toarray()
        hidden = np.zeros_like(seen)
        hidden[:, self.view[behind]] = (objects @ stacked[behind].T).toarray()
        stacked.data[np.repeat(self.background, np.diff(stacked.indptr))] = 0
        overlap = product_above(objects, stacked.T.tocsr(), _LEAST * seen, self.view)
        return sparse.hstack([overlap, overlap @ self.wholes], format="csr"), seen, hidden

    def _stacked(self, data: list[np.ndarray]) -> sparse.csr_matrix:
        """Stack what stands where the weights of each view do, (n, I)."""
        rows = [view.of_all(self.num_gaussians, entries) for view, entries in zip(self.views, data, strict=True)]
        return sparse.vstack(rows, format="csr")
