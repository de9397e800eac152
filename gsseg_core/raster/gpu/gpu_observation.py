"""A view with its mask on a GPU."""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch

from gsseg_core.data.label_evidence import UNITS
from gsseg_core.raster.constants import BLOCK
from gsseg_core.raster.gpu import label_sharing as kernels
from gsseg_core.raster.gpu.blending import THREADS, launch_on_tiles
from gsseg_core.raster.gpu.device import launch, launch_each, on_device, to_cpu
from gsseg_core.raster.gpu.projection import TileTensors
from gsseg_core.raster.gpu.tensors import PairTensors, RowTensors, starts
from gsseg_core.raster.observation import Observation, VoteShares
from gsseg_core.raster.view_renderer import ViewRenderer
from gsseg_core.scene.camera import Camera


class ShareTensors(NamedTuple):
    """What `raster.observation.VoteShares` has on the CPU."""

    pairs: torch.Tensor  # (P,) float32, on the GPU
    rest: np.ndarray  # (L,) float64
    log_likelihood: float


class GPUObservation(Observation):
    """W of one view, cut down to what its labelled pixels see; remade from it in every product.

    Sums are of whole units of 2^-24 px, so they are the same in every run, whatever order threads come in.
    """

    def __init__(
        self, operator: ViewRenderer, tiles: TileTensors, labels: np.ndarray, weights: np.ndarray | None
    ) -> None:  # labels (H, W)
        self.name, self._operator, device = operator.camera.name, operator, tiles.table.device
        self._shared: tuple[torch.Tensor, np.ndarray, ShareTensors] | None = None  # what was asked last
        if weights is None:
            weights = np.ones((-(-tiles.height // BLOCK), -(-tiles.width // BLOCK)), np.float32)
        self._weights = on_device(weights.astype(np.float32, copy=False), device)
        mask = self._count_labels(on_device(labels.astype(np.int32, copy=False), device))
        self._slots, self._label_start, self._present = _cut(mask, tiles)
        self._operator_bytes = tiles.nbytes
        self._pair_up(tiles)

    def _count_labels(self, labels: torch.Tensor) -> torch.Tensor:
        """Set the classes of the mask and their areas; returns the mask by positions of classes, -1 where unknown."""
        classes, positions, areas = torch.unique(labels, return_inverse=True, return_counts=True)
        unknown = int((classes < 0).sum())
        of_pixels = self._weights.repeat_interleave(BLOCK, dim=0).repeat_interleave(BLOCK, dim=1)
        of_pixels = of_pixels[: labels.shape[0], : labels.shape[1]].double()
        weighted = torch.bincount(positions.ravel(), of_pixels.ravel(), len(classes))
        self.classes = to_cpu(classes[unknown:].int())
        self.areas, self.weighted_areas = to_cpu(areas[unknown:]), to_cpu(weighted[unknown:])
        return (positions - unknown).clamp_min(-1).int()

    def _pair_up(self, tiles: TileTensors) -> None:
        """Lift the mask, list the pairs, and keep the entries that pixels with a weight see."""
        device, label_counts = tiles.table.device, self._label_start.diff()
        slot_start = starts(tiles.start.diff() * label_counts)
        sums = torch.zeros(int(slot_start[-1]), dtype=torch.int64, device=device)
        reached = torch.zeros(len(tiles.entries), dtype=torch.uint8, device=device)
        launch_on_tiles(kernels.lift, tiles, self._slots, self._label_start, slot_start, self._weights, reached, sums)
        used = sums.nonzero()[:, 0]  # Of these slots, their tile, entry, and number among the slots of the entry:
        tile = torch.searchsorted(slot_start, used, right=True) - 1
        within = used - slot_start[tile]
        entry, slot = tiles.start[tile] + within // label_counts[tile], within % label_counts[tile]
        number = self._list_pairs(tiles, sums[used], entry, self._present[self._label_start[tile] + slot])

        kept = starts(reached)
        counts, still = kept[tiles.start].diff(), reached[entry] > 0
        self._slot_start, start = starts(counts * label_counts), starts(counts)
        tile, slot, place = tile[still], slot[still], kept[entry[still]]
        self._pair = torch.full((int(self._slot_start[-1]),), -1, dtype=torch.int32, device=device)
        self._pair[self._slot_start[tile] + (place - start[tile]) * label_counts[tile] + slot] = number[still]
        self._tiles = tiles._replace(start=start, entries=tiles.entries[reached > 0])

    def _list_pairs(
        self, tiles: TileTensors, units: torch.Tensor, entry: torch.Tensor, label: torch.Tensor  # (S,) of slots
    ) -> torch.Tensor:  # fmt: skip
        """List the pairs that slots with a sum are of, and add up their votes; returns the number of each, (S,)."""
        labels = max(len(self.classes), 1)
        key, order = torch.sort(tiles.ids[tiles.entries[entry].long()].long() * labels + label)
        pairs, number, counts = torch.unique_consecutive(key, return_inverse=True, return_counts=True)
        ends = starts(units[order])[starts(counts)]
        owner = torch.div(pairs, labels, rounding_mode="floor")
        ids, counts = torch.unique_consecutive(owner, return_counts=True)
        self.pairs = PairTensors(ids.int(), starts(counts), (pairs % labels).int())
        self.own_votes = (ends.diff().double() / UNITS).float()
        return torch.empty_like(number, dtype=torch.int32).scatter_(0, order, number.int())

    @cached_property
    def ids(self) -> np.ndarray:  # type: ignore[override] # these three are copied from the GPU when somebody asks
        """Gaussians that some labelled pixel sees, (M,) int32."""
        return to_cpu(self.pairs.ids)

    @cached_property
    def start(self) -> np.ndarray:  # type: ignore[override]
        """Where the pairs of each begin, (M + 1,) int64."""
        return to_cpu(self.pairs.start)

    @cached_property
    def labels(self) -> np.ndarray:  # type: ignore[override]
        """Label of each pair, (P,) int32."""
        return to_cpu(self.pairs.labels)

    @property
    def nbytes(self) -> int:
        """Memory that it holds, in bytes, the operator's included; most of it on the GPU."""
        held = (*self.pairs, self.own_votes, self._weights, self._slots, self._label_start,
                self._present, self._slot_start, self._pair, self._tiles.entries, self._tiles.start)  # fmt: skip
        # And what `shares` was asked last, and answered.
        return self._operator_bytes + sum(array.nbytes for array in held) + 2 * self.own_votes.nbytes

    def operator(self, camera: Camera, num_gaussians: int) -> ViewRenderer:
        """Give the operator that it was observed with."""
        return self._operator

    def votes(self) -> np.ndarray:
        """Weights summed by pair, (P,) float32."""
        return to_cpu(self.own_votes)

    @property
    def num_pairs(self) -> int:
        """P, of which nothing is copied."""
        return len(self.own_votes)

    def vote(self, total: Any, *, sign: int = 1) -> None:
        """Add the votes to those of other views, or take them away, where these are."""
        if not isinstance(total, torch.Tensor):
            super().vote(total, sign=sign)
            return
        label_votes = RowTensors.of(self.evidence.votes, total.device)
        launch_each(kernels.add_votes, len(self.pairs.ids), total, *self.pairs, self.own_votes, *label_votes, sign)

    def votes_by_label(self) -> np.ndarray:
        """Sum of the votes of each label, (L,) float64."""
        units = (self.own_votes.double() * UNITS).long()
        return _px_by_label(units, self.pairs.labels.long(), len(self.classes))

    def _shares(self, likelihood: np.ndarray, rest: np.ndarray) -> VoteShares:
        shares = self.shared(on_device(likelihood, self._pair.device), rest)
        return VoteShares(to_cpu(shares.pairs), shares.rest, shares.log_likelihood)

    def shared(self, likelihood: torch.Tensor, rest: np.ndarray) -> ShareTensors:
        """Do what `shares` does with a tensor, and return one; nothing is computed twice in succession either."""
        known = self._shared
        if known is None or not (torch.equal(known[0], likelihood) and np.array_equal(known[1], rest)):
            self._shared = known = likelihood, rest.copy(), self._share(likelihood, rest)
        return known[2]

    def _share(self, likelihood: torch.Tensor, rest: np.ndarray) -> ShareTensors:
        device, tiles = self._pair.device, self._tiles
        of_labels, present = on_device(rest.astype(np.float32, copy=False), device), self._present.long()
        logs = torch.zeros(self._slots.shape, device=device)
        left_over = torch.zeros(len(present), dtype=torch.int64, device=device)
        sums = torch.zeros(len(likelihood), dtype=torch.int64, device=device)
        launch_on_tiles(
            kernels.share, tiles, self._slots, self._label_start, self._slot_start, self._weights, self._pair,
            likelihood, of_labels[present], logs, left_over, sums,
        )  # fmt: skip
        pairs = (sums.double() / UNITS).float()
        of_rest = _px_by_label(left_over, present, len(rest))
        return ShareTensors(pairs, of_rest, float(logs.sum(dtype=torch.float64)))


def _px_by_label(units: torch.Tensor, labels: torch.Tensor, count: int) -> np.ndarray:  # (S,) int64, (S,)
    """Add up units by label, in px, (L,) float64."""
    return kernels.joined(units.new_zeros((count, 2)).index_add_(0, labels, kernels.halves(units))) / UNITS


def _cut(mask: torch.Tensor, tiles: TileTensors) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Give numbers to the labels of each tile of a mask, (H, W) int32.

    Returns the number of each pixel's label, (T, THREADS) int16 by threads, -1 where unknown; where the labels of each
    tile begin, (T + 1,) int64; and which these are, (label_start[-1],) int32.
    """
    count, device = tiles.columns * tiles.rows, mask.device
    slots = torch.empty((count, THREADS), dtype=torch.int16, device=device)
    counts = torch.empty(count, dtype=torch.int32, device=device)
    launch(kernels.number_labels, count, THREADS, mask, tiles.columns, slots, counts)
    label_start = starts(counts)
    present = torch.empty(int(label_start[-1]), dtype=torch.int32, device=device)
    launch(kernels.list_labels, count, THREADS, mask, tiles.columns, slots, label_start, present)
    return slots, label_start, present
