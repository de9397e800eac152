"""A view with its mask: the weight matrix of the view, cut down in each pixel to the label that was seen there."""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from gsseg_core.csr_rows import starts
from gsseg_core.data.label_evidence import LabelEvidence
from gsseg_core.errors import SceneValueError
from gsseg_core.raster.view_renderer import ViewRenderer
from gsseg_core.raster.vote_total import PairVotes, VoteTotal
from gsseg_core.scene.camera import Camera

_PARTS = 64  # of the pairs of a view, whose votes are added beside each other


class VoteShares(NamedTuple):
    """One vote per labelled pixel, shared among the (Gaussian, label) pairs that made it; see `Observation.shares`."""

    pairs: np.ndarray  # (P,) float32: for each pair, the sum over the pixels of its label of w[p, i] / p(y_p)
    rest: np.ndarray  # (L,) float64: the same for what the rays had left over, T_end[p] / p(y_p)
    log_likelihood: float  # sum over the labelled pixels of log p(y_p), natural


class LabelWeights(NamedTuple):
    """W^T onehot(mask), label after label: the Gaussians that each label of a mask is on, and their weights."""

    classes: np.ndarray  # (L,) int32: labels that occur in the mask, ascending
    start: np.ndarray  # (L + 1,) int64: those of classes[l] are start[l] to start[l + 1]
    gaussians: np.ndarray  # (P,) int32: indices in the scene, ascending for each label
    weights: np.ndarray  # (P,) float32: in px

    @classmethod
    def of(
        cls, classes: np.ndarray, gaussians: np.ndarray, labels: np.ndarray, weights: np.ndarray  # (L,), (P,) each
    ) -> LabelWeights:  # fmt: skip
        """Sort pairs, whose Gaussians ascend, by label; their labels are positions in `classes`."""
        order = np.argsort(labels.astype(np.uint16), kind="stable")  # A radix sort, as they have sixteen bits.
        start = starts(np.bincount(labels, minlength=len(classes)))
        return cls(classes, start, gaussians[order], weights[order])


class ViewPairs(NamedTuple):
    """The (Gaussian, label) pairs of a view as kernels take them; `Observation` says what the arrays are."""

    ids: np.ndarray  # (M,) int32
    start: np.ndarray  # (M + 1,) int64
    labels: np.ndarray  # (P,) int32


class Observation(ABC):
    """A view with its mask: W cut down, in each pixel, to the label that was seen there.

    A *pair* is a Gaussian with one of the labels under which this view sees it, that is with a weight above zero in
    some pixel of that label. Most Gaussians are seen under one label only, so there are about as many pairs as
    Gaussians that are seen, however many labels the mask has. Votes, the paper's loss and its gradient, and every step
    of EM need one number per pair.
    """

    name: str  # of the view
    ids: np.ndarray  # (M,) int32: Gaussians that some labelled pixel sees, as indices in the scene, ascending
    start: np.ndarray  # (M + 1,) int64: pairs of ids[m] are start[m] to start[m + 1]
    labels: np.ndarray  # (P,) int32: label of each pair, as its position in `classes`
    classes: np.ndarray  # (L,) int32: labels that occur in the mask, ascending
    areas: np.ndarray  # (L,) int64: pixels of each label
    weighted_areas: np.ndarray  # (L,) float64: the same, each pixel by its weight in `shares`
    # The arguments of `shares` when it was last called, and what it returned: nothing is computed twice in succession.
    answered: tuple[np.ndarray, np.ndarray, VoteShares] | None = None

    @property
    @abstractmethod
    def nbytes(self) -> int:
        """Memory that it holds, in bytes."""

    @property
    def num_pairs(self) -> int:
        """P; without any, its pixels with a label see no Gaussian."""
        return len(self.labels)

    @property
    def num_pixels(self) -> int:
        """Pixels with a label."""
        return int(self.areas.sum())

    @cached_property
    def evidence(self) -> LabelEvidence:
        """What the labels say of the classes."""
        return LabelEvidence(self.classes)

    @property
    def rows(self) -> np.ndarray:
        """Which of `ids` each pair is of, (P,) int64."""
        return np.repeat(np.arange(len(self.ids)), np.diff(self.start))

    @property
    def gaussians(self) -> np.ndarray:
        """Gaussian of each pair, as an index in the scene, (P,) int32."""
        return np.repeat(self.ids, np.diff(self.start))

    @property
    def places(self) -> tuple[np.ndarray, np.ndarray]:
        """Gaussian and label of each pair, (P,) each: where it stands in W^T onehot(mask)."""
        return self.gaussians, self.classes[self.labels]

    def dense(self, values: np.ndarray) -> np.ndarray:
        """Write one number per pair, (P,), out by Gaussian and label, (M, L); zero where there is no pair."""
        out = np.zeros((len(self.ids), len(self.classes)), values.dtype)
        out[self.rows, self.labels] = values
        return out

    def votes_by_label(self) -> np.ndarray:
        """Sum of the votes of each label, (L,) float64, in px."""
        return np.bincount(self.labels, weights=self.votes(), minlength=len(self.classes))

    def by_label(self) -> LabelWeights:
        """Sort the pairs and their votes by label."""
        return LabelWeights.of(self.classes, self.gaussians, self.labels, self.votes())

    @abstractmethod
    def operator(self, camera: Camera, num_gaussians: int) -> ViewRenderer:
        """Make the operator of the view again, to blend codes: what pixels without a label show has no meaning.

        Nothing is projected. Camera and number of Gaussians are those of the operator that it was observed with; the
        `ids` may come in another order.
        """

    @abstractmethod
    def votes(self) -> np.ndarray:
        """Sum of weights of each pair, the entries of W^T onehot(y) that are not zero: (P,) float32, in px."""

    def vote(self, total: Any, *, sign: int = 1) -> None:
        """Add the votes to a total of all views, or take them away (sign -1), exactly.

        The total is a `VoteTotal`, or what `gsseg_core.raster.backends.vote_total` has in place of it. Raises
        `SceneValueError` where it has too few Gaussians or classes, or is something else.
        """
        rows, classes = self.ids.max(initial=-1) + 1, self.evidence.votes.indices.max(initial=0) + 1
        check_total(self.name, total, rows, classes)
        borders = self.start[np.arange(_PARTS + 1) * len(self.ids) // _PARTS]
        parts = np.stack([borders[:-1], borders[1:]], axis=1)
        total.add(PairVotes(self.gaussians, self.labels, self.votes(), parts), self.evidence.votes, sign)

    def shares(self, likelihood: np.ndarray, rest: np.ndarray) -> VoteShares:
        """Share one vote per labelled pixel, times its weight, among the Gaussians that made it.

        Given are the likelihood of the label of each pair by its Gaussian, (P,) float32 of at least 0, and that of each
        label by the background, `rest`, (L,) float32; other shapes raise `SceneValueError`.

        With p(y_p) = (W likelihood)[p, y_p] + T_end[p] rest[y_p], the share of a pair is the sum over the pixels of its
        label of w[p, i] / p(y_p). It is the gradient of the log likelihood with respect to that of the pairs.
        """
        likelihood, rest = np.ascontiguousarray(likelihood, np.float32), np.ascontiguousarray(rest, np.float32)
        if likelihood.shape != self.labels.shape or rest.shape != self.classes.shape:
            raise SceneValueError(
                f"view '{self.name}': likelihood and rest have shapes {likelihood.shape} and {rest.shape}; "
                f"expected {self.labels.shape} and {self.classes.shape}"
            )
        known = self.answered  # It may be replaced by another thread.
        if known is None or not all(map(np.array_equal, known[:2], (likelihood, rest))):
            known = self.answered = likelihood.copy(), rest.copy(), self._shares(likelihood, rest)
        return known[2]

    @abstractmethod
    def _shares(self, likelihood: np.ndarray, rest: np.ndarray) -> VoteShares: ...


def check_total(view: str, total: VoteTotal, rows: int, classes: int) -> None:
    """Refuse a total to which a view cannot add its votes: kernels would write beyond it."""
    if not isinstance(total, VoteTotal):
        raise SceneValueError(f"view '{view}': votes are {type(total).__name__}; expected a VoteTotal")
    if total.shape[0] < rows or total.shape[1] < classes:
        raise SceneValueError(f"view '{view}': votes have shape {total.shape}; expected ({rows}, {classes}) or more")
