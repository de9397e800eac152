"""Soft and partial masks: probabilities and detections become a label image of prototypes with their evidence.

A pixel's probabilities are rounded to sixteenths, and pixels that are then alike share one label, a prototype, with its
`LabelEvidence`. A mask that is certain everywhere loses nothing, and comes out as the plain mask it is. How much each
of the others loses is bounded: no probability changes by as much as one step, see `quantise`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gsseg_core.data.class_names import listed
from gsseg_core.data.label_evidence import LabelEvidence
from gsseg_core.data.label_images import UNKNOWN, PackedLabels, digest_of
from gsseg_core.errors import MaskFormatError, MaskSizeError, UnknownLabelError
from gsseg_core.files.limits import MAX_LABEL
from gsseg_core.files.npz_files import Header
from gsseg_core.kernels.compiler import called_by_kernels, kernel
from gsseg_core.scene.undistortion import Undistortion
from gsseg_core.text import clipped

MOST_PROTOTYPES = 512  # of a view, unless there are more even without any step between 0 and 1
STEPS = (16, 8, 4, 2, 1)  # from probability 0 to 1: the first of these that gives no more than so many prototypes

TOLERANCE = 0.01
"""By how much probabilities of a pixel may sum to more than 1; those of half precision and images of 8 bits do."""

_SURE = np.float32(1 - 1e-4)
_TIED = np.float32(0.01)  # of a step, by which equal probabilities may differ


class SeenLabels(NamedTuple):
    """Labels of a mask (H, W) int32, `UNKNOWN` where nothing is known, and their evidence; None if they are classes.

    `outermost` (L,) tells of each label which one is the whole that it is a part of in this mask; None if nothing does.
    """

    labels: npt.NDArray[np.int32]
    evidence: LabelEvidence | None = None
    outermost: npt.NDArray[np.int32] | None = None

    @property
    def largest(self) -> int:
        """Largest class on which the mask has evidence, `UNKNOWN` if there is none."""
        if self.evidence is not None:
            return self.evidence.largest
        return int(self.labels.max()) if self.labels.size else UNKNOWN

    @property
    def concerned(self) -> npt.NDArray[np.int32]:
        """Classes on which the mask has evidence: in any shape, with repetitions, and perhaps with `UNKNOWN`."""
        return self.labels if self.evidence is None else self.evidence.concerned

    def named(self) -> npt.NDArray[np.int32]:
        """Reduce the mask to one class per pixel, (H, W) int32; `UNKNOWN` where it leaves the class open."""
        if self.evidence is None:
            return self.labels
        return np.append(self.evidence.named(), np.int32(UNKNOWN))[self.labels]

    def hardened(self) -> SeenLabels:
        """Reduce a soft mask of all classes to a plain one, if it names any; a partial mask stays as it is."""
        if self.evidence is None or self.evidence.supervised is not None:
            return self
        named = self.named()
        return SeenLabels(named) if (named >= 0).any() else self

    def undistorted(self, undistortion: Undistortion) -> SeenLabels:
        """Make the mask of a pinhole view of the one drawn on its image, by nearest pixels; `UNKNOWN` outside it."""
        return self._with_labels(undistortion.sample(self.labels, UNKNOWN))

    def every(self, step: int) -> SeenLabels:
        """Keep every step-th pixel of each row and column, from pixel step // 2 on."""
        return self._with_labels(self.labels[step // 2 :: step, step // 2 :: step])

    def hidden(self, pixels: npt.NDArray[np.bool_]) -> SeenLabels:
        """Make some pixels (H, W) unknown."""
        return self._with_labels(np.where(pixels, np.int32(UNKNOWN), self.labels))

    def _with_labels(self, labels: npt.NDArray[np.int32]) -> SeenLabels:
        """Replace the label image by another of the same prototypes, and drop those that no longer occur."""
        if self.evidence is None or self.evidence.mass is None:
            return self._replace(labels=labels)
        return _tidied(labels, self.evidence.classes, self.evidence.mass, self.evidence.supervised, None)

    def numbered(self, ids: npt.NDArray[np.int32], source: str) -> SeenLabels:
        """Renumber the classes by their place among some ids, ascending; `UnknownLabelError` if one is not there."""
        expected = f"ids of the {len(ids)} classes in use"
        table, concerned = self._new_ids(ids, np.arange(len(ids)), source, expected)
        if self.evidence is None:
            return SeenLabels(concerned)
        classes, mass, supervised = self.evidence.classes, self.evidence.mass, self.evidence.supervised
        supervised = None if supervised is None else table[supervised]
        return SeenLabels(self.labels, LabelEvidence(table[classes], mass, supervised))

    def relabelled(self, new_ids: Mapping[int, int], source: str) -> SeenLabels:
        """Give the classes new ids, and merge those that get the same; pixels of a class that gets `UNKNOWN` become so.

        In a soft mask, those are the pixels that name such a class; in others its probability is left out, and all else
        is scaled up for it. A merged class counts as looked for where all its parts were; else what its mask
        leaves open is unknown. Raises `UnknownLabelError` where a class has no new id.
        """
        table, concerned = self._new_ids([*new_ids], [*new_ids.values()], source, "ids of its classes")
        if self.evidence is None:
            return SeenLabels(concerned)
        given, supervised = self.evidence, self.evidence.supervised
        mass = np.eye(len(given.classes), dtype=np.float32) if given.mass is None else given.mass
        targets = table[given.classes]
        classes = np.unique(targets[targets != UNKNOWN])
        merged = np.stack([mass[:, targets == k].sum(axis=1) for k in classes] or [np.zeros(len(mass))], axis=1)
        kept = 1 - mass[:, targets == UNKNOWN].sum(axis=1, keepdims=True)
        merged = np.divide(merged, kept, out=np.zeros_like(merged), where=kept > 0).astype(np.float32)
        named = given.named()
        ignored = (named != UNKNOWN) & (table[named] == UNKNOWN)
        if supervised is not None:
            parts = [k for k, new in new_ids.items() if new != UNKNOWN and new in table[supervised]]
            whole = np.isin(parts, supervised).all()
            supervised = np.setdiff1d(table[supervised], [UNKNOWN]) if whole else None
        unknown = np.append(ignored, False)[self.labels]
        return _tidied(self.labels.copy(), classes, merged[:, : len(classes)], supervised, unknown)

    def _new_ids(
        self, ids: npt.ArrayLike, new: npt.ArrayLike, source: str, expected: str  # (K,), (K,)
    ) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:  # fmt: skip
        """Give classes new ids: a table of these by id, `UNKNOWN` included, and what `concerned` becomes by it."""
        table = np.full(MAX_LABEL + 2, UNKNOWN - 1, np.int32)  # The last one is for unknown pixels.
        table[np.asarray(ids, np.int64)], table[UNKNOWN] = new, UNKNOWN
        concerned = table[self.concerned]
        if (concerned < UNKNOWN).any():
            found = np.unique(self.concerned[concerned < UNKNOWN]).tolist()
            raise UnknownLabelError(f"{source}: mask holds the labels {clipped(found)}; expected {expected}")
        return table, concerned


class PackedMask:
    """A soft or partial mask in memory, its prototypes compressed like a plain one's labels."""

    def __init__(self, seen: SeenLabels) -> None:
        self._labels, self._evidence, self.largest = PackedLabels(seen.labels), seen.evidence, seen.largest
        self._outermost = seen.outermost

    def unpack(self) -> SeenLabels:
        """Return what was packed; the labels in memory of their own."""
        return SeenLabels(self._labels.unpack(), self._evidence, self._outermost)

    @property
    def digest(self) -> bytes:
        """16 bytes that are others for other labels, or other evidence."""
        given = self._evidence
        if given is None or given.mass is None:
            return self._labels.digest
        said = (None if part is None else part.tobytes() for part in (given.classes, given.mass, given.supervised))
        return digest_of(self._labels.digest, *said)


def quantise(
    probabilities: npt.NDArray[np.floating],  # (C, H, W) of 16, 32 or 64 bits, in [0, 1]; [c] is of class classes[c]
    classes: Sequence[int] | None = None,  # C ids
    *,
    unknown: npt.NDArray[np.bool_] | None = None,  # (H, W): where the segmenter gives no evidence
    source: str = "probabilities",  # what messages call the mask
) -> SeenLabels:
    """Make prototypes of the probabilities that one segmenter gives.

    With `classes`, the segmenter looked for these and no others: what a pixel's probabilities lack to 1, the rest,
    means "none of these". Without, [c] is class c, no class is left out, and the rest is unknown.

    Each probability is rounded to the nearest step, or down where a pixel's would then sum to more than 1. Where
    another would come up to the likeliest, that is rounded up and all others down. So none changes by as much as 1/16,
    or one of the coarser `STEPS` where there would be more than `MOST_PROTOTYPES`.

    Raises `MaskFormatError` where the array has another type or dimension, is not finite, or has negative values or
    sums above 1; `MaskSizeError` where `unknown` has another size; `UnknownLabelError` where `classes` are not C
    different ids from 0 to `MAX_LABEL`.
    """
    given = None if classes is None else np.asarray(classes)
    check_forms(probabilities, given, unknown, source)
    if given is not None and (given.min() < 0 or given.max() > MAX_LABEL or len(np.unique(given)) < len(given)):
        raise UnknownLabelError(
            f"{source}: classes are {str(given.tolist())[1:-1][:60]}; expected different ids from 0 to {MAX_LABEL}"
        )
    _check_range(probabilities, f"{source}: probabilities")
    total = float(probabilities.sum(axis=0, dtype=np.float32).max(initial=0))
    if total > 1 + TOLERANCE:
        raise MaskFormatError(
            f"{source}: probabilities of a pixel sum to {total:.3f}; expected at most 1 (what detectors say "
            "that do not know of each other goes into one image per class)"
        )
    ids = np.arange(len(probabilities), dtype=np.int32) if given is None else given.astype(np.int32)
    supervised = None if given is None else np.sort(ids)
    occurs = [c for c in np.argsort(ids) if probabilities[c].max(initial=0) > 0]
    size = probabilities.shape[1:]
    by_pixel = np.moveaxis(probabilities[occurs], 0, -1).reshape(size[0] * size[1], len(occurs))
    values = np.ascontiguousarray(by_pixel, np.float32)
    for steps in STEPS:
        parts = _rounded(values, steps)
        labels, firsts = _group(parts)
        if len(firsts) <= MOST_PROTOTYPES:
            break
    mass = parts[firsts] / np.float32(steps)
    return _tidied(labels.reshape(size).astype(np.int32), ids[occurs], mass, supervised, unknown)


_Form = npt.NDArray[Any] | Header


def check_forms(probabilities: _Form, classes: _Form | None, unknown: _Form | None, source: str) -> None:
    """Raise the errors of `quantise` that types and shapes tell, of arrays or of their headers in a file."""
    if len(probabilities.shape) != 3 or probabilities.dtype.kind != "f" or not probabilities.shape[0]:
        raise MaskFormatError(f"{source}: probabilities are {Header.of(probabilities)}; expected floats (K, H, W)")
    count, *size = probabilities.shape
    if classes is not None and (classes.shape != (count,) or classes.dtype.kind not in "iu"):
        raise UnknownLabelError(f"{source}: classes are {Header.of(classes)}; expected {count} ids, one per map")
    if unknown is not None and unknown.dtype.kind != "b":
        raise MaskFormatError(f"{source}: unknown is {unknown.dtype}; expected bool, true where nothing is known")
    if unknown is not None and unknown.shape != tuple(size):
        raise MaskSizeError(f"{source}: unknown has shape {unknown.shape}; expected {tuple(size)}, as the maps")


def combine_detections(
    detections: Mapping[int, npt.NDArray[np.generic]],  # class -> (H, W)
    *,
    unknown: npt.NDArray[np.bool_] | None = None,  # (H, W)
    source: str = "detections",
) -> SeenLabels:
    """Make prototypes of the outputs of several detectors, each of which looked for one class only.

    Where detectors contradict each other, each is taken as evidence of its own: a pixel is of class k, and of no other
    that was looked for, with a probability in proportion to p_k prod_{c != k} (1 - p_c), and none of these with
    prod_c (1 - p_c). For one detector that is p and 1 - p.

    A detector gives bool, or float: the probability of its class in each pixel, in [0, 1]. One that ran and found
    nothing gives zeros. Of a class without a detector nothing is known, nor of any class where it is `unknown`.
    Messages call the mask `source`; raises what `quantise` raises.
    """
    if not detections:
        raise MaskFormatError(f"{source}: holds no detections; expected at least one class, zeros where it is not seen")
    classes = sorted(detections)
    arrays = {k: np.asarray(detections[k]) for k in classes}
    shape = arrays[classes[0]].shape
    for k, array in arrays.items():
        if array.ndim != 2 or array.dtype.kind not in "bf":
            raise MaskFormatError(f"{source}: class {k} is {Header.of(array)}; expected bool or float (H, W)")
        if array.shape != shape:
            raise MaskSizeError(
                f"{source}: class {k} is {array.shape[1]} x {array.shape[0]} pixels; expected {shape[1]} x {shape[0]}, "
                f"as class {classes[0]}"
            )
        _check_range(array, f"{source}: class {k}")
    alone = np.stack([arrays[k].astype(np.float32) for k in classes])
    if len(classes) > 1:
        odds = np.minimum(alone, _SURE)
        odds /= 1 - odds
        alone = odds / (1 + odds.sum(axis=0))
    return quantise(alone, classes, unknown=unknown, source=source)


def restrict(labels: npt.NDArray[np.integer], supervised: Collection[int], source: str = "labels") -> SeenLabels:
    """Give a plain mask the evidence of a segmenter that looked for some classes only.

    Its 0 means "none of these", unless 0 is one of them. Raises `UnknownLabelError` where the mask holds a class that
    was not looked for.
    """
    looked_for = np.array(sorted(set(supervised)), np.int32)
    ids = np.unique(labels)
    unknown_ids = [i for i in ids.tolist() if i not in looked_for and i not in (0, UNKNOWN)]
    if unknown_ids:
        raise UnknownLabelError(
            f"{source}: mask holds the labels {listed(map(str, unknown_ids))}; expected those that it supervises, "
            f"{listed(map(str, looked_for.tolist()))}, and 0 for none of these"
        )
    prototypes = ids[ids != UNKNOWN].astype(np.int32)
    named = prototypes[np.isin(prototypes, looked_for)]
    mass = (prototypes[:, None] == named).astype(np.float32)
    table = np.full(int(ids.max(initial=0)) + 2, UNKNOWN, np.int32)
    table[prototypes] = np.arange(len(prototypes))
    return SeenLabels(table[labels], LabelEvidence(named, mass, looked_for))


@kernel
def _rounded(values: np.ndarray, steps: int) -> np.ndarray:  # (P, C) float32 in [0, 1]
    """Round probabilities to whole steps, (P, C) uint8, at most `steps` in all; the likeliest class stays that."""
    count, classes = values.shape
    parts, scaled = np.zeros((count, classes), np.uint8), np.empty(classes, np.float32)
    for p in range(count if classes else 0):
        first, total = 0, np.float32(0)
        for c in range(classes):
            scaled[c] = values[p, c] * np.float32(steps)
            total += np.rint(scaled[c])
            first = c if scaled[c] > scaled[first] else first
        down = total > steps
        most, tied = np.floor(scaled[first]) if down else np.rint(scaled[first]), False
        for c in range(classes):
            part = np.floor(scaled[c]) if down else np.rint(scaled[c])
            parts[p, c] = np.uint8(part)
            tied |= part == most and most > 0 and scaled[c] < scaled[first] - _TIED
        if tied:  # The likeliest alone is rounded up, and all others down.
            left = np.float32(steps)
            for c in range(classes):
                parts[p, c] = np.uint8(np.floor(scaled[c]))
                left -= np.floor(scaled[c]) if c != first else np.float32(0)
            parts[p, first] = np.uint8(min(np.ceil(scaled[first]), left))
    return parts


def _tidied(
    labels: npt.NDArray[np.int32],  # (H, W)
    classes: npt.NDArray[np.int32],  # (C,)
    mass: npt.NDArray[np.float32],  # (L, C)
    supervised: npt.NDArray[np.int32] | None,
    unknown: npt.NDArray[np.bool_] | None,  # (H, W)
) -> SeenLabels:
    """Drop prototypes that do not occur or hold no evidence; a mask that is then certain becomes a plain one."""
    if unknown is not None:
        labels[unknown] = UNKNOWN
    kept = np.bincount(labels[labels >= 0], minlength=len(mass)) > 0
    if supervised is None:
        kept &= mass.any(axis=1)
    mass = mass[kept]
    number = np.append(np.where(kept, np.cumsum(kept) - 1, UNKNOWN), UNKNOWN).astype(np.int32)
    labels = number[labels]
    occurs = mass.any(axis=0)
    classes, mass = classes[occurs], mass[:, occurs]
    evidence = LabelEvidence(classes, mass, supervised)
    seen = SeenLabels(labels, evidence)
    return SeenLabels(seen.named()) if evidence.is_certain else seen


def _check_range(values: npt.NDArray[np.generic], what: str) -> None:
    if values.dtype.kind == "b" or not values.size:
        return
    low, high = float(values.min()), float(values.max())  # NaN if any is.
    if not (low >= 0 and high <= 1 + TOLERANCE):
        found = "NaN" if np.isnan(low) else f"from {low:.3g} to {high:.3g}"
        raise MaskFormatError(f"{what}: values are {found}; expected probabilities from 0 to 1")


@kernel
def _group(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:  # (P, C) uint8
    """Give different rows numbers in order of first occurrence: that of each row (P,), and the first row of each."""
    count, size = rows.shape[0], 64
    while size < 2 * count:
        size *= 2
    table, numbers, firsts, n = np.full(size, -1, np.int64), np.empty(count, np.int64), np.empty(count, np.int64), 0
    for p in range(count):
        code = np.uint64(14695981039346656037)  # Fowler, Noll and Vo's hash
        for c in range(rows.shape[1]):
            code = (code ^ np.uint64(rows[p, c])) * np.uint64(1099511628211)
        place = np.int64((code ^ (code >> np.uint64(32))) & np.uint64(size - 1))
        while table[place] >= 0 and not _same(rows[firsts[table[place]]], rows[p]):
            place = (place + 1) & (size - 1)
        if table[place] < 0:
            table[place], firsts[n] = n, p
            n += 1
        numbers[p] = table[place]
    return numbers, firsts[:n].copy()


@called_by_kernels
def _same(one: np.ndarray, two: np.ndarray) -> bool:
    for c in range(one.shape[0]):  # noqa: SIM110 - compiled: there is no generator.
        if one[c] != two[c]:
            return False
    return True
