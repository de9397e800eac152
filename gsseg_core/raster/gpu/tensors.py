"""What tensors on a GPU are put together to: sparse rows, and the pairs of a view."""

from __future__ import annotations

import threading
import weakref
from typing import NamedTuple

import numpy as np
import torch

from gsseg_core.csr_rows import CSRRows
from gsseg_core.raster.gpu.device import on_device


class RowTensors(NamedTuple):
    """A sparse (N, K) array in compressed rows on a GPU, as `CSRRows` is on the CPU."""

    indptr: torch.Tensor  # (N + 1,) int64: entries of row i are indptr[i] to indptr[i + 1]
    indices: torch.Tensor  # (Z,) int32: column of each entry
    data: torch.Tensor  # (Z,): the entries

    @classmethod
    def of(cls, rows: CSRRows, device: torch.device) -> RowTensors:
        """Copy rows to a GPU."""
        return cls(*(on_device(array, device) for array in (rows.indptr, rows.indices.view(np.int32), rows.data)))

    @classmethod
    def kept(cls, rows: CSRRows, device: torch.device) -> RowTensors:
        """Copy rows, or return the copy of them if they were the last: all views blend the same codes, one by one.

        Rows that are kept must not change; the copy lives as long as they do.
        """
        with _COPYING:
            if device not in _LAST or _LAST[device][0]() is not rows.data:
                _LAST[device] = weakref.ref(rows.data, _forget), cls.of(rows, device)
            return _LAST[device][1]

    def with_data(self, data: torch.Tensor) -> RowTensors:
        """Replace the entries and keep where they stand."""
        return self._replace(data=data)

    def with_rows(self, ids: torch.Tensor, rows: RowTensors) -> RowTensors:  # (M,) distinct; M rows of these patterns
        """Replace the entries of some rows."""
        data = self.data.clone()
        data[self._entries_of(ids, rows.indptr)] = rows.data
        return self.with_data(data)

    def dense(self, ids: torch.Tensor, num_classes: int) -> torch.Tensor:  # (M,)
        """Write some rows out, (M, K) float32."""
        counts = self.indptr.diff()[ids.long()]
        rows = torch.repeat_interleave(torch.arange(len(ids), device=ids.device), counts)
        entries = self._entries_of(ids, starts(counts))
        dense = torch.zeros((len(ids), num_classes), device=ids.device)
        dense[rows, self.indices[entries].long()] = self.data[entries].float()
        return dense

    def _entries_of(self, ids: torch.Tensor, indptr: torch.Tensor) -> torch.Tensor:  # (M,), (M + 1,)
        """List the entries of some rows, which are to begin at `indptr`."""
        shift = torch.repeat_interleave(self.indptr[ids.long()] - indptr[:-1], indptr.diff())
        return shift + torch.arange(len(shift), device=ids.device)


_LAST: dict[torch.device, tuple[weakref.ref[np.ndarray], RowTensors]] = {}
_COPYING = threading.RLock()  # a thread that makes a copy may free what another is of


def _forget(gone: weakref.ref[np.ndarray]) -> None:
    with _COPYING:
        for device in [device for device, (rows, _) in _LAST.items() if rows is gone]:
            del _LAST[device]


class PairTensors(NamedTuple):
    """The (Gaussian, label) pairs of a view on a GPU, as `raster.observation.ViewPairs` has them on the CPU."""

    ids: torch.Tensor  # (M,) int32
    start: torch.Tensor  # (M + 1,) int64
    labels: torch.Tensor  # (P,) int32


def starts(counts: torch.Tensor) -> torch.Tensor:  # (n,)
    """Return the offset at which each of n consecutive parts begins, and the end of the last: (n + 1,) int64."""
    out = counts.new_zeros(len(counts) + 1, dtype=torch.int64)
    torch.cumsum(counts, 0, out=out[1:])
    return out
