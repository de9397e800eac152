"""How well found objects agree with true ones when neither knows the other's ids: ARI, and matchings for the IoU."""

from __future__ import annotations

from collections import Counter

import numpy as np
from scipy.optimize import linear_sum_assignment

from gsseg_core.data.label_images import UNKNOWN


class Contingency:
    """Pixels by true id and found id, accumulated over views. Pixels whose truth is `UNKNOWN` do not count."""

    def __init__(self) -> None:
        self._pairs: Counter[tuple[int, int]] = Counter()

    def add(
        self,
        truth: np.ndarray,  # (H, W)
        found: np.ndarray,  # (H, W)
    ) -> None:
        """Add one view."""
        known = truth != UNKNOWN
        pairs, counts = np.unique(np.stack([truth[known], found[known]]), axis=1, return_counts=True)
        for (a, b), count in zip(pairs.T.tolist(), counts.tolist(), strict=True):
            self._pairs[a, b] += count

    @property
    def ari(self) -> float:
        """Adjusted Rand index (Hubert & Arabie 1985): 1 for the same partition of the pixels, 0 for chance."""
        table, _, _ = self._table()
        total, rows, columns = (_pairs_of(part) for part in (table.sum(), table.sum(axis=1), table.sum(axis=0)))
        expected = rows.sum() * columns.sum() / total if total else 0.0
        largest = (rows.sum() + columns.sum()) / 2
        return float((_pairs_of(table).sum() - expected) / (largest - expected)) if largest > expected else 1.0

    def one_to_one(self) -> dict[int, int]:
        """Give each found id its true one so that the mean IoU is largest; some have none."""
        iou, true, found = self._iou()
        rows, columns = linear_sum_assignment(iou, maximize=True)
        return {found[b]: true[a] for a, b in zip(rows, columns, strict=True) if iou[a, b] > 0}

    def many_to_one(self) -> dict[int, int]:
        """Give each found id the true one that it shares most pixels with."""
        table, true, found = self._table()
        return {found[b]: true[a] for b, a in enumerate(table.argmax(axis=0).tolist())} if true else {}

    def _table(self) -> tuple[np.ndarray, list[int], list[int]]:
        true, found = (sorted({pair[i] for pair in self._pairs}) for i in (0, 1))
        table = np.zeros((len(true), len(found)))
        for (a, b), count in self._pairs.items():
            table[true.index(a), found.index(b)] = count
        # What was not found is no object.
        return (table[:, 1:], true, found[1:]) if UNKNOWN in found else (table, true, found)

    def _iou(self) -> tuple[np.ndarray, list[int], list[int]]:
        table, true, found = self._table()
        size = np.array([[sum(count for (a, _), count in self._pairs.items() if a == k)] for k in true])
        return table / (table.sum(axis=0) + size - table), true, found


def renamed(
    found: np.ndarray,  # (H, W)
    names: dict[int, int],
) -> np.ndarray:
    """Give found ids their true ones; `UNKNOWN` where there is none."""
    table = np.full(max([int(found.max(initial=0)), *names]) + 2, UNKNOWN, np.int32)  # The last one is for UNKNOWN.
    for one, other in names.items():
        table[one] = other
    labels: np.ndarray = table[found]
    return labels


def _pairs_of(count: np.ndarray) -> np.ndarray:
    pairs: np.ndarray = count * (count - 1) / 2
    return pairs
