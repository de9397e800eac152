"""A view with its mask: the weight matrix of the view, cut down in each pixel to the label that was seen there."""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import cached_property
from typing import NamedTuple

import numpy as np

from gsseg_core.data.label_evidence import LabelEvidence
from gsseg_core.raster.votes import add_votes


class VoteShares(NamedTuple):
    """One vote per labelled pixel, shared among the (Gaussian, label) pairs that made it.

    Attributes
    ----------
    pairs : (P,) float32
        For each pair, the sum over the pixels of its label of w[p, i] / likelihood[p].
    rest : (L,) float64
        The same for what the rays had left over, T_end[p] / likelihood[p].
    log_likelihood : float
        Sum over the labelled pixels of log likelihood[p], natural.
    """

    pairs: np.ndarray
    rest: np.ndarray
    log_likelihood: float


class Observation(ABC):
    """A view with its mask: W cut down, in each pixel, to the label that was seen there.

    A *pair* is a Gaussian with one of the labels under which this view sees it, that is with a weight above zero in
    some pixel of that label. Most Gaussians are seen under one label only, so there are about as many pairs as
    Gaussians that are seen, however many labels the mask has. Votes, the paper's loss and its gradient, and every step
    of EM need one number per pair.

    Attributes
    ----------
    ids : (M,) int32
        Gaussians that some labelled pixel sees, as indices in the scene.
    start : (M + 1,) int64
        Pairs of ids[m] are start[m] to start[m + 1].
    labels : (P,) int32
        Label of each pair, as its position in `classes`.
    classes : (L,) int32
        Labels that occur in the mask, ascending.
    areas : (L,) int64
        Pixels of each label.
    evidence : LabelEvidence
        What the labels say of the classes; of a plain mask, that they are classes.
    """

    ids: np.ndarray
    start: np.ndarray
    labels: np.ndarray
    classes: np.ndarray
    areas: np.ndarray

    @property
    @abstractmethod
    def nbytes(self) -> int:
        """Memory that it holds, in bytes."""

    @property
    def num_pixels(self) -> int:
        """Pixels with a label."""
        return int(self.areas.sum())

    @cached_property
    def evidence(self) -> LabelEvidence:
        """What the labels say of the classes."""
        return LabelEvidence(self.classes)

    @cached_property
    def order(self) -> np.ndarray:
        """Places in `ids` in the order of the scene, (M,) int32: whoever goes by it goes through memory once."""
        place = np.full(int(self.ids.max(initial=-1)) + 1, -1, np.int32)
        place[self.ids] = np.arange(len(self.ids), dtype=np.int32)
        return place[place >= 0]

    @property
    def rows(self) -> np.ndarray:
        """Which of `ids` each pair is of, (P,) int64."""
        return np.repeat(np.arange(len(self.ids)), np.diff(self.start))

    def dense(
        self,
        values: np.ndarray,  # (P,)
    ) -> np.ndarray:
        """Write one number per pair out by Gaussian and label, (M, L); zero where there is no pair."""
        out = np.zeros((len(self.ids), len(self.classes)), values.dtype)
        out[self.rows, self.labels] = values
        return out

    @abstractmethod
    def votes(self) -> np.ndarray:
        """Sum of weights of each pair, the entries of W^T onehot(y) that are not zero: (P,) float32, in px."""

    def vote(
        self,
        total: np.ndarray,  # (N, K) int64, added to
        units: float,
        sign: int = 1,
    ) -> None:
        """Add the votes to those of other views, or take them away, in whole units."""
        add_votes(total, self.ids, self.start, self.labels, *self.evidence.votes, self.votes(), units, sign)

    @abstractmethod
    def shares(
        self,
        said: np.ndarray,  # (P,)
        rest: np.ndarray,  # (L,)
    ) -> VoteShares:
        """Share one vote per labelled pixel among the Gaussians that made it.

        With likelihood[p] = (W said)[p, y_p] + T_end[p] rest[y_p], the share of a pair is the sum over the pixels of
        its label of w[p, i] / likelihood[p]. It is the gradient of the log likelihood with respect to what was said.

        Parameters
        ----------
        said : (P,) float32
            What each Gaussian says of the label under which it is seen, at least 0.
        rest : (L,) float32
            What the background says of each label.

        Raises
        ------
        SceneValueError
            They are not of these shapes.
        """
