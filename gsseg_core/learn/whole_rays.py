"""Recomputes votes of an older version, whose rays went on behind surfaces, for all views whose masks are kept."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gsseg_core.csr_rows import CSRRows, starts
from gsseg_core.data.label_evidence import UNITS, LabelEvidence
from gsseg_core.data.soft_masks import SeenLabels
from gsseg_core.data.view import View
from gsseg_core.learn.learner_state import State
from gsseg_core.raster.constants import CHANNELS
from gsseg_core.raster.view_operator import ViewOperator
from gsseg_core.raster.vote_total import VoteTotal
from gsseg_core.spatial.row_order import RowOrder

_ROUNDING = 1e-3  # largest relative difference between a subtracted and an added vote; rounding makes about 1e-5


def votes_cast_anew(
    state: State, operator_of: Callable[[View], ViewOperator], used: Callable[[SeenLabels, ViewOperator], SeenLabels],
    order: RowOrder,
) -> VoteTotal:  # fmt: skip
    """Return the votes of a state, in pages of an order, with rays of all kept views that end at surfaces.

    Votes of views that are not kept stay unchanged. The old votes of kept views are computed again and subtracted from
    the sum. Their rounding may differ from the original one, so small remainders of a sum are set to 0.
    """
    shape, all_kept = (state.votes.num_rows, state.num_classes), state.num_fused == len(state.views)
    left = VoteTotal(*shape, order) if all_kept else VoteTotal.from_rows(state.votes, state.num_classes, order)
    anew, taken = VoteTotal(*shape, order), VoteTotal(*shape, order)
    for view in state.views:
        operator = operator_of(view)
        seen = used(view.read_seen(), operator)
        operator.vote(seen.labels, seen.evidence, anew)
        if not all_kept:
            _take(left, taken, operator, seen)
    cast = taken.rows()
    rest, rounded = left.rows().united(cast.with_data(_ROUNDING * cast.data.astype(np.float32)))
    anew.add_rows(rest.with_data(np.where(np.abs(rest.data) <= rounded.data, 0, rest.data)).nonzero())
    return anew


def _take(left: VoteTotal, taken: VoteTotal, operator: ViewOperator, seen: SeenLabels) -> None:
    """Subtract the votes of a view by whole rays from `left`; add their absolute values to `taken`."""
    present = np.unique(seen.labels[seen.labels >= 0])  # These are 0 to L - 1 if the mask has `evidence`.
    rows = (seen.evidence or LabelEvidence(present)).votes
    for first in range(0, len(present), CHANNELS):
        some = present[first : first + CHANNELS]
        weights = operator.adjoint((seen.labels[..., None] == some).astype(np.float32))
        for c in range(len(some)):
            of_label = slice(*rows.indptr[first + c : first + c + 2])
            for k, vote in zip(rows.indices[of_label], rows.data[of_label], strict=True):
                cast = _column(np.rint(weights[:, c] * vote * UNITS).astype(np.int64), k)
                left.add_rows(cast.with_data(-cast.data))
                taken.add_rows(cast.with_data(np.abs(cast.data)))


def _column(votes: np.ndarray, k: int) -> CSRRows:  # (N,)
    """Return votes for one class as CSR rows."""
    cast = votes != 0
    return CSRRows(starts(cast), np.full(np.count_nonzero(cast), k, np.uint32), votes[cast])
