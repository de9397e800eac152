"""Label maps with the errors that real segmenters make most, drawn from a seed: outlines, misses, wrong labels.

An object is a label above 0 that occurs in the view. `benchmarks/wrong_masks.py` has more kinds of errors.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

MISSED, SWAPPED = 0.15, 0.10  # probabilities that an object is missed, and that it gets the label of another one
EDGE_PX = 3  # the outline of each object moves in or out by a whole number of px up to this, all as likely
STREAMS = 4  # of random numbers for each view, so that one kind of error leaves the draws of the others alone


def corrupt(labels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw one wrong version of a view's label map (H, W), int32; unknown (negative) pixels stay so.

    Streams are spawned from `rng`, so the n-th call on a generator depends on its seed and on n alone.
    """
    edges, _, mistakes, _ = rng.spawn(STREAMS)
    wrong = move_edges(np.array(labels, np.int32), edges, EDGE_PX)
    wrong = mistake_objects(wrong, mistakes, MISSED, SWAPPED, 0)
    wrong[labels < 0] = labels[labels < 0]
    return wrong


def move_edges(labels: np.ndarray, rng: np.random.Generator, most: int) -> np.ndarray:
    """Grow or shrink every object by `most` px or less, in random order; what one gives up goes to its neighbours.

    The map (H, W) is changed in place, and returned.
    """
    objects = objects_in(labels)
    shifts = rng.integers(-most, most, len(objects), endpoint=True)
    for k in rng.permutation(len(objects)):
        resize(labels, int(objects[k]), int(shifts[k]))
    return labels


def resize(labels: np.ndarray, label: int, shift: int) -> None:
    """Grow an object of a map (H, W) in place by `shift` px all around, or shrink it if that is negative."""
    mask = labels == label
    if not shift or not mask.any():  # another object may have grown over it
        return
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    margin = max(shift, 1)
    window = tuple(slice(max(found[0] - margin, 0), found[-1] + margin + 1) for found in (rows, columns))
    own = mask[window]
    if shift > 0:
        labels[window][ndimage.distance_transform_edt(~own) <= shift] = label
    elif not own.all():
        depth, (rows, columns) = ndimage.distance_transform_edt(own, return_indices=True)
        lost = own & (depth <= -shift)
        labels[window][lost] = labels[window][rows[lost], columns[lost]]


def mistake_objects(
    labels: np.ndarray, rng: np.random.Generator, missed: float, swapped: float, missed_label: int
) -> np.ndarray:
    """Miss objects of a map (H, W), whose pixels become `missed_label`, and give others the label of another one.

    `missed` and `swapped` are probabilities of an object, which meets one of the two.
    """
    objects = objects_in(labels)
    fate = rng.random(len(objects))
    others = (np.arange(len(objects)) + rng.integers(1, max(len(objects), 2), len(objects))) % max(len(objects), 1)
    is_swapped = (missed <= fate) & (fate < missed + swapped)
    new_labels = np.where(is_swapped, objects[others], objects)
    new_labels[fate < missed] = missed_label
    return relabel(labels, objects, new_labels)


def objects_in(labels: np.ndarray) -> np.ndarray:
    """Labels of the objects in a view, ascending."""
    present = np.flatnonzero(np.bincount(np.maximum(labels, 0).ravel()))
    return present[present > 0]


def relabel(labels: np.ndarray, objects: np.ndarray, new_labels: np.ndarray) -> np.ndarray:
    """Give objects (M,) of a map (H, W) int32 other labels (M,); all other pixels stay as they are."""
    table = np.arange(labels.max(initial=0) + 1, dtype=np.int32)
    table[objects] = new_labels
    return np.where(labels < 0, labels, table[np.maximum(labels, 0)])
