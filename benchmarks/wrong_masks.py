"""Label maps with every error that segmenters, trackers and poses make, drawn from a seed, to measure learners against.

Each kind of error is one function of (labels, generator, settings), and `corrupt` applies them in the order in which
they arise: where the outline of an object lies, what is missing inside it, which label it gets, clutter on top, which
objects have exchanged their ids, whether all of them have, and where the map lies on its image.
Every kind has a stream of random numbers of its own, so switching one off leaves the draws of the others as they were.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gsseg_core.demo.mask_errors import (
    EDGE_PX,
    MISSED,
    STREAMS,
    SWAPPED,
    mistake_objects,
    move_edges,
    objects_in,
    relabel,
)
from gsseg_core.errors import SettingsError


@dataclass(frozen=True)
class WrongMasks:
    """How wrong masks are. An object is a label above 0 that occurs in the view; the defaults are the demo's.

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
    holes : float
        Probability that an object of a view has a hole, which becomes `missed_label`.
    hole_px : float
        Largest mean radius of a hole in px; the smallest is a third of it.
    blobs : float
        Mean number of clutter blobs in a view; each carries the label of some object of the view.
    blob_px : float
        Largest mean radius of a blob in px; the smallest is a third of it.
    exchanged : float
        Probability that an object of a view has exchanged its label with another one. Objects pair up at random.
    bad_frame : float
        Probability that a view is bad as a whole: none of its objects carries its own label.
    shift_px : float
        The whole map lies beside its image by a length from 0 to this, in px, in any direction, all as likely: mask and
        pose are not of the same time. What comes in at the side goes on as the margin is.

    Raises
    ------
    SettingsError
        A probability outside [0, 1], `missed` and `swapped` together above 1, or a negative amount.
    """

    missed: float = MISSED
    swapped: float = SWAPPED
    edge_px: int = EDGE_PX
    missed_label: int | None = 0
    holes: float = 0.0
    hole_px: float = 8.0
    blobs: float = 0.0
    blob_px: float = 12.0
    exchanged: float = 0.0
    bad_frame: float = 0.0
    shift_px: float = 0.0

    def __post_init__(self) -> None:
        """Validate."""
        for name in ("missed", "swapped", "holes", "exchanged", "bad_frame"):
            if not 0 <= getattr(self, name) <= 1:
                raise SettingsError(f"mask errors: found {name} = {getattr(self, name)}; expected a probability")
        if self.missed + self.swapped > 1:
            raise SettingsError(
                f"mask errors: found missed + swapped = {self.missed + self.swapped}; expected at most 1, "
                "since an object meets one of the two"
            )
        for name in ("edge_px", "missed_label", "hole_px", "blobs", "blob_px", "shift_px"):
            if not (getattr(self, name) is None or getattr(self, name) >= 0):
                raise SettingsError(f"mask errors: found {name} = {getattr(self, name)}; expected 0 or more")


def corrupt(
    labels: np.ndarray,  # (H, W)
    rng: np.random.Generator,
    settings: WrongMasks | None = None,
) -> np.ndarray:
    """Draw one wrong version of a view's label map, (H, W) int32; unknown pixels stay so, and a shift takes them along.

    By default it makes what `gsseg_core.demo.mask_errors.corrupt` makes.
    """
    settings = settings or WrongMasks()
    if settings.missed_label is None:
        settings = replace(settings, missed_label=int(np.bincount(labels[labels >= 0], minlength=1).argmax()))
    wrong = np.array(labels, np.int32)
    streams = rng.spawn(STREAMS)
    # Not from `rng`: what its later calls draw depends on how many streams were spawned from it.
    streams += streams[0].spawn(len(_LATER_KINDS))
    for make_error, stream in zip(_FIRST_KINDS + _LATER_KINDS, streams, strict=True):
        wrong = make_error(wrong, stream, settings)
    wrong[labels < 0] = labels[labels < 0]
    return wrong


def _move_edges(labels: np.ndarray, rng: np.random.Generator, settings: WrongMasks) -> np.ndarray:
    return move_edges(labels, rng, settings.edge_px)


def _mistake_objects(labels: np.ndarray, rng: np.random.Generator, settings: WrongMasks) -> np.ndarray:
    assert settings.missed_label is not None
    return mistake_objects(labels, rng, settings.missed, settings.swapped, settings.missed_label)


def _punch_holes(labels: np.ndarray, rng: np.random.Generator, settings: WrongMasks) -> np.ndarray:
    """Leave a hole somewhere in some objects."""
    objects = objects_in(labels)
    for label in objects[rng.random(len(objects)) < settings.holes]:
        own = labels == label
        labels[own & _blob(own, settings.hole_px, rng)] = settings.missed_label
    return labels


def _add_blobs(labels: np.ndarray, rng: np.random.Generator, settings: WrongMasks) -> np.ndarray:
    """Drop clutter anywhere in the view."""
    objects = objects_in(labels)
    anywhere = np.ones(labels.shape, bool)
    for _ in range(rng.poisson(settings.blobs) if objects.size and anywhere.size else 0):
        labels[_blob(anywhere, settings.blob_px, rng)] = rng.choice(objects)
    return labels


def _exchange_labels(labels: np.ndarray, rng: np.random.Generator, settings: WrongMasks) -> np.ndarray:
    """Have the two objects of some pairs exchange their labels; where their number is odd, one has no partner."""
    objects = rng.permutation(objects_in(labels))
    first, second = objects[: len(objects) // 2 * 2].reshape(-1, 2).T
    chosen = rng.random(len(first)) < settings.exchanged
    first, second = first[chosen], second[chosen]
    return relabel(labels, np.concatenate([first, second]), np.concatenate([second, first]))


def _spoil_frame(labels: np.ndarray, rng: np.random.Generator, settings: WrongMasks) -> np.ndarray:
    """Now and then, pass the labels of all objects on in a circle, so that none keeps its own."""
    objects = rng.permutation(objects_in(labels))
    if rng.random() >= settings.bad_frame:
        return labels
    return relabel(labels, objects, np.roll(objects, 1))


def _shift_map(labels: np.ndarray, rng: np.random.Generator, settings: WrongMasks) -> np.ndarray:
    """Move the whole map by whole px, its margins going on outwards."""
    length, angle = settings.shift_px * rng.random(), rng.uniform(0, 2 * np.pi)
    rows, columns = (
        np.clip(np.arange(size) - round(length * part), 0, max(size - 1, 0))
        for size, part in zip(labels.shape, (np.sin(angle), np.cos(angle)), strict=True)
    )
    return labels[np.ix_(rows, columns)]


# The streams of the first kinds are those that they have always had, so a seed still gives the masks that it gave.
_FIRST_KINDS = (_move_edges, _punch_holes, _mistake_objects, _add_blobs)
_LATER_KINDS = (_exchange_labels, _spoil_frame, _shift_map)


def _blob(inside: np.ndarray, largest: float, rng: np.random.Generator) -> np.ndarray:
    """(H, W) bool, a roundish patch with a wavy outline around a random pixel of a mask."""
    row, column = rng.choice(np.argwhere(inside))
    radius = rng.uniform(largest / 3, largest)
    y, x = np.ogrid[: inside.shape[0], : inside.shape[1]]
    angle = np.arctan2(y - row, x - column)
    waves = sum(rng.uniform(0, 0.2) * np.cos(k * angle + rng.uniform(0, 2 * np.pi)) for k in (2, 3, 5))
    patch: np.ndarray = np.hypot(y - row, x - column) <= radius * (1 + waves)
    return patch
