"""Label maps with the errors that real segmenters make, drawn from a seed, to learn from and to be measured against.

Each kind of error is one function of (labels, generator, settings), and `corrupt` applies them in the order in which
they arise: where the outline of an object lies, what is missing inside it, which label it gets, clutter on top, which
objects have exchanged their ids, whether all of them have, and where the map lies on its image.
Every kind has a stream of random numbers of its own, so switching one off leaves the draws of the others as they were.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from gsseg_core.errors import SettingsError


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
    holes : float
        Probability that an object of a view has a hole, which becomes `missed_label`.
    hole_px : float
        Largest mean radius of a hole in px; the smallest is a third of it.
    blobs : float
        Mean number of clutter blobs in a view; each carries the label of some object of the view.
    blob_px : float
        Largest mean radius of a blob in px; the smallest is a third of it.
    missed_label : int or None
        What a segmenter writes where it found nothing: the background, or the label of what surrounds the objects.
        None: the label that most pixels of the view carry, for scenes without a background.
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

    missed: float = 0.15
    swapped: float = 0.10
    edge_px: int = 3
    holes: float = 0.0
    hole_px: float = 8.0
    blobs: float = 0.0
    blob_px: float = 12.0
    missed_label: int | None = 0
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
        for name in ("edge_px", "hole_px", "blobs", "blob_px", "missed_label", "shift_px"):
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
        True labels; pixels that are unknown (negative) stay so, and a shift takes them along.
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
    settings = settings or MaskErrors()
    wrong = np.array(labels, np.int32)
    if settings.missed_label is None:
        settings = replace(settings, missed_label=int(np.bincount(wrong[wrong >= 0], minlength=1).argmax()))
    streams = rng.spawn(len(_FIRST_KINDS))
    # Not from `rng`: what its later calls draw depends on how many streams were spawned from it.
    streams += streams[0].spawn(len(_LATER_KINDS))
    for make_error, stream in zip(_FIRST_KINDS + _LATER_KINDS, streams, strict=True):
        wrong = make_error(wrong, stream, settings)
    wrong[labels < 0] = labels[labels < 0]
    return wrong


def _move_edges(labels: np.ndarray, rng: np.random.Generator, settings: MaskErrors) -> np.ndarray:
    """Grow or shrink every object on its own, in random order; what a shrunk one gives up goes to its neighbours."""
    objects = _objects(labels)
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


def _punch_holes(labels: np.ndarray, rng: np.random.Generator, settings: MaskErrors) -> np.ndarray:
    """Leave a hole somewhere in some objects."""
    objects = _objects(labels)
    for label in objects[rng.random(len(objects)) < settings.holes]:
        own = labels == label
        labels[own & _blob(own, settings.hole_px, rng)] = settings.missed_label
    return labels


def _mistake_objects(labels: np.ndarray, rng: np.random.Generator, settings: MaskErrors) -> np.ndarray:
    """Miss some objects and give others the label of another one; no object meets both."""
    objects = _objects(labels)
    fate = rng.random(len(objects))
    others = (np.arange(len(objects)) + rng.integers(1, max(len(objects), 2), len(objects))) % max(len(objects), 1)
    swapped = (settings.missed <= fate) & (fate < settings.missed + settings.swapped)
    new_labels = np.where(swapped, objects[others], objects)
    new_labels[fate < settings.missed] = settings.missed_label
    table = _identity(labels)
    table[objects] = new_labels
    return _relabel(labels, table)


def _add_blobs(labels: np.ndarray, rng: np.random.Generator, settings: MaskErrors) -> np.ndarray:
    """Drop clutter anywhere in the view."""
    objects = _objects(labels)
    anywhere = np.ones(labels.shape, bool)
    for _ in range(rng.poisson(settings.blobs) if objects.size and anywhere.size else 0):
        labels[_blob(anywhere, settings.blob_px, rng)] = rng.choice(objects)
    return labels


def _exchange_labels(labels: np.ndarray, rng: np.random.Generator, settings: MaskErrors) -> np.ndarray:
    """Have the two objects of some pairs exchange their labels; where their number is odd, one has no partner."""
    objects = rng.permutation(_objects(labels))
    first, second = objects[: len(objects) // 2 * 2].reshape(-1, 2).T
    chosen = rng.random(len(first)) < settings.exchanged
    table = _identity(labels)
    table[first[chosen]], table[second[chosen]] = second[chosen], first[chosen]
    return _relabel(labels, table)


def _spoil_frame(labels: np.ndarray, rng: np.random.Generator, settings: MaskErrors) -> np.ndarray:
    """Now and then, pass the labels of all objects on in a circle, so that none keeps its own."""
    objects = rng.permutation(_objects(labels))
    if rng.random() >= settings.bad_frame:
        return labels
    table = _identity(labels)
    table[objects] = np.roll(objects, 1)
    return _relabel(labels, table)


def _shift_map(labels: np.ndarray, rng: np.random.Generator, settings: MaskErrors) -> np.ndarray:
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


def _objects(labels: np.ndarray) -> np.ndarray:
    """Labels of the objects in a view, ascending."""
    present = np.flatnonzero(np.bincount(np.maximum(labels, 0).ravel()))
    return present[present > 0]


def _identity(labels: np.ndarray) -> np.ndarray:
    """Table that gives each label itself."""
    return np.arange(labels.max(initial=0) + 1, dtype=np.int32)


def _relabel(labels: np.ndarray, table: np.ndarray) -> np.ndarray:
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


def _blob(inside: np.ndarray, largest: float, rng: np.random.Generator) -> np.ndarray:
    """(H, W) bool, a roundish patch with a wavy outline around a random pixel of a mask."""
    row, column = rng.choice(np.argwhere(inside))
    radius = rng.uniform(largest / 3, largest)
    y, x = np.ogrid[: inside.shape[0], : inside.shape[1]]
    angle = np.arctan2(y - row, x - column)
    waves = sum(rng.uniform(0, 0.2) * np.cos(k * angle + rng.uniform(0, 2 * np.pi)) for k in (2, 3, 5))
    patch: np.ndarray = np.hypot(y - row, x - column) <= radius * (1 + waves)
    return patch
