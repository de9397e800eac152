"""Label maps with the errors that real segmenters make most, drawn from a seed: outlines, misses, wrong labels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, TypeVar

import numpy as np
from scipy import ndimage

from gsseg_core.errors import SettingsError

STREAMS = 4
"""Streams of random numbers that a view's map gets, so that one kind of error leaves the draws of the others alone."""
EDGES, MISTAKES = 0, 2
"""Which of them the kinds here have; `benchmarks/wrong_masks.py` has more kinds."""


Settings = TypeVar("Settings", bound="MaskErrors")


@dataclass(frozen=True)
class MaskErrors:
    """How wrong masks are. An object is a label above 0 that occurs in the view; the defaults are realistic.

    Attributes
    ----------
    missed : float
        Probability that an object of a view is missed: its pixels become `missed_label`.
    swapped : float
        Probability that an object of a view carries the label of another object of that view instead of its own.
    edge_px : int
        The outline of each object of a view moves in or out by a whole number of px, all from 0 to this one as likely.
    missed_label : int or None
        What a segmenter writes where it found nothing: the background, or the label of what surrounds the objects.
        None: the label that most pixels of the view carry, for scenes without a background.

    Raises
    ------
    SettingsError
        A probability outside [0, 1], `missed` and `swapped` together above 1, or a negative amount.
    """

    missed: float = 0.15
    swapped: float = 0.10
    edge_px: int = 3
    missed_label: int | None = 0

    PROBABILITIES: ClassVar[tuple[str, ...]] = ("missed", "swapped")
    AMOUNTS: ClassVar[tuple[str, ...]] = ("edge_px", "missed_label")

    def __post_init__(self) -> None:
        """Validate."""
        for name in self.PROBABILITIES:
            if not 0 <= getattr(self, name) <= 1:
                raise SettingsError(f"mask errors: found {name} = {getattr(self, name)}; expected a probability")
        if self.missed + self.swapped > 1:
            raise SettingsError(
                f"mask errors: found missed + swapped = {self.missed + self.swapped}; expected at most 1, "
                "since an object meets one of the two"
            )
        for name in self.AMOUNTS:
            if not (getattr(self, name) is None or getattr(self, name) >= 0):
                raise SettingsError(f"mask errors: found {name} = {getattr(self, name)}; expected 0 or more")


def corrupt(
    labels: np.ndarray,  # (H, W)
    rng: np.random.Generator,
    settings: MaskErrors | None = None,
) -> np.ndarray:
    """Draw one wrong version of a view's label map.

    Parameters
    ----------
    labels : array (H, W) of int
        True labels; pixels that are unknown (negative) stay so.
    rng : numpy.random.Generator
        Source of all randomness. Streams are spawned from it, so the n-th call on a generator depends on its seed and
        on n alone.
    settings : MaskErrors, optional
        How wrong; `MaskErrors()` by default.

    Returns
    -------
    ndarray (H, W) int32
        A new array.
    """
    settings, streams = with_label(settings or MaskErrors(), labels), rng.spawn(STREAMS)
    wrong = move_edges(np.array(labels, np.int32), streams[EDGES], settings)
    wrong = mistake_objects(wrong, streams[MISTAKES], settings)
    wrong[labels < 0] = labels[labels < 0]
    return wrong


def with_label(settings: Settings, labels: np.ndarray) -> Settings:
    """Fill in what is written where an object of a map was missed."""
    if settings.missed_label is not None:
        return settings
    return replace(settings, missed_label=int(np.bincount(labels[labels >= 0], minlength=1).argmax()))


def move_edges(labels: np.ndarray, rng: np.random.Generator, settings: MaskErrors) -> np.ndarray:
    """Grow or shrink every object on its own, in random order; what a shrunk one gives up goes to its neighbours."""
    objects = objects_in(labels)
    shifts = rng.integers(-settings.edge_px, settings.edge_px, len(objects), endpoint=True)
    for k in rng.permutation(len(objects)):
        resize(labels, int(objects[k]), int(shifts[k]))
    return labels


def resize(
    labels: np.ndarray,  # (H, W) changed in place
    label: int,
    shift: int,
) -> None:
    """Grow an object by so many px all around, or shrink it if `shift` is negative, down to nothing."""
    mask = labels == label
    if not shift or not mask.any():  # another object may have grown over it
        return
    window = _window(mask, max(shift, 1))
    own = mask[window]
    if shift > 0:
        labels[window][ndimage.distance_transform_edt(~own) <= shift] = label
    elif not own.all():
        depth, (rows, columns) = ndimage.distance_transform_edt(own, return_indices=True)
        lost = own & (depth <= -shift)
        labels[window][lost] = labels[window][rows[lost], columns[lost]]


def mistake_objects(labels: np.ndarray, rng: np.random.Generator, settings: MaskErrors) -> np.ndarray:
    """Miss some objects and give others the label of another one; no object meets both."""
    objects = objects_in(labels)
    fate = rng.random(len(objects))
    others = (np.arange(len(objects)) + rng.integers(1, max(len(objects), 2), len(objects))) % max(len(objects), 1)
    swapped = (settings.missed <= fate) & (fate < settings.missed + settings.swapped)
    new_labels = np.where(swapped, objects[others], objects)
    new_labels[fate < settings.missed] = settings.missed_label
    table = identity(labels)
    table[objects] = new_labels
    return relabel(labels, table)


def objects_in(labels: np.ndarray) -> np.ndarray:
    """Labels of the objects in a view, ascending."""
    present = np.flatnonzero(np.bincount(np.maximum(labels, 0).ravel()))
    return present[present > 0]


def identity(labels: np.ndarray) -> np.ndarray:
    """Table that gives each label itself."""
    return np.arange(labels.max(initial=0) + 1, dtype=np.int32)


def relabel(labels: np.ndarray, table: np.ndarray) -> np.ndarray:
    """Look labels up in a table; the unknown stay as they are."""
    relabelled: np.ndarray = np.where(labels < 0, labels, table[np.maximum(labels, 0)])
    return relabelled


def _window(mask: np.ndarray, margin: int) -> tuple[slice, slice]:
    """Bounding box of a mask, widened by a margin in px as far as the image goes."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return (
        slice(max(rows[0] - margin, 0), rows[-1] + margin + 1),
        slice(max(columns[0] - margin, 0), columns[-1] + margin + 1),
    )
