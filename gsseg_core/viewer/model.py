"""Decides which Gaussians of a segmentation are shown, and in which colours. Pure numpy; it knows no viewer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from gsseg_core.csr_rows import CSRRows, largest, slices
from gsseg_core.data.class_names import BACKGROUND_NAME, class_name
from gsseg_core.data.object_tree import ObjectTree
from gsseg_core.errors import UnknownLabelError
from gsseg_core.export.pictures import FILL, palette
from gsseg_core.files.npz_files import SHARES_TOLERANCE
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import REMOVED, UNOBSERVED, Segmentation

TRUE_COLOURS, BY_CLASS, BY_CONFIDENCE, BY_RELIABILITY = "true colours", "class", "confidence", "view reliability"
MODES = (TRUE_COLOURS, BY_CLASS, BY_CONFIDENCE, BY_RELIABILITY)

NO_CLASS = {UNOBSERVED: "(unobserved)", REMOVED: "(taken out by refinement)"}  # names of labels that are no class
NOTHING_KNOWN = (120, 120, 120)  # colour of Gaussians without a value in the present mode
# From bad to good: dark red, orange, pale yellow, green, dark green; it can be told apart without seeing red and green,
# since brightness rises to the middle and the ends differ in blue.
_RAMP = np.array([(122, 1, 30), (230, 120, 40), (250, 230, 140), (90, 180, 140), (0, 90, 130)], np.float32)


@dataclass(frozen=True, eq=False)
class Labelling:
    """Label and class probabilities of each Gaussian, from a segmentation, a live source or corrections."""

    labels: np.ndarray  # (N,) int32: class, or `UNOBSERVED` (-1), or `REMOVED` (-2)
    shares: CSRRows  # (N, K) float32: probabilities; none where nothing is known, and rows may sum to less than 1
    class_names: dict[int, str]  # names by id, for all K
    nodes: tuple[int, ...] | None = None  # ids of the classes that are nodes of a tree, and coloured by it

    @classmethod
    def of(cls, segmentation: Segmentation) -> Labelling:
        """Take labels, probabilities and names of a segmentation."""
        return cls(segmentation.labels, segmentation.shares, dict(segmentation.class_names))

    @classmethod
    def unknown(cls, num_gaussians: int, class_names: Mapping[int, str] | None = None) -> Labelling:
        """Label all Gaussians as unobserved."""
        names = {0: BACKGROUND_NAME, **(class_names or {})}
        names = {k: class_name(names, k) for k in range(max(names) + 1)}
        return cls(np.full(num_gaussians, UNOBSERVED, np.int32), CSRRows.empty(num_gaussians), names)

    @cached_property
    def confidence(self) -> np.ndarray:
        """Largest probability of each Gaussian, (N,) float32; 0 where nothing is known."""
        return np.asarray(largest(self.shares)[0])

    @cached_property
    def palette(self) -> np.ndarray:
        """Colours by label, (K + 2, 3) uint8: labels -1 and -2, which are no class, are its last two."""
        nodes = self.nodes or range(max(self.class_names, default=0) + 1)
        colors = palette(max(nodes) + 1)[list(nodes)]
        return np.concatenate([colors, np.array([NOTHING_KNOWN] * len(NO_CLASS), np.uint8)])


def at_level(objects: Labelling, tree: ObjectTree, granularity: float) -> Labelling:
    """Label the nodes of a tree at a level without gaps; at its own level, the objects come back as they are.

    Their first classes are those of the tree; others, which were added in the viewer, are on every level.
    """
    k, added = tree.num_classes, len(objects.class_names) - tree.num_classes
    of_added = range(len(tree), len(tree) + added)
    if granularity == tree.level:
        return replace(objects, nodes=(*range(k), *of_added)) if added else objects
    in_tree = objects.shares.indices < k
    shares, nodes = tree.shares_at(granularity, objects.shares.entries(in_tree), tree.leaves)
    of_tree, first = objects.labels < k, len(nodes)
    others = objects.shares.entries(~in_tree)
    node = tree.labels_at(granularity, np.where(of_tree, objects.labels, 0))
    place = np.where(node >= 0, np.searchsorted(nodes, node), node)
    names = tree.names(objects.class_names)
    return Labelling(
        np.where(of_tree, place, objects.labels - k + first).astype(np.int32),
        shares.plus(others._replace(indices=others.indices - np.uint32(k) + np.uint32(first))),
        dict(enumerate([*(names[one] for one in nodes), *(objects.class_names[k + i] for i in range(added))])),
        (*nodes, *of_added),
    )


class ClassRow(NamedTuple):
    """A class in the list of classes."""

    label: int
    name: str
    color: tuple[int, int, int]
    size: int
    shown: bool


@dataclass(eq=False)
class ViewModel:
    """The state of a viewer. Change it with its methods; `shown` and `colors` say what follows from it."""

    scene: GaussianScene  # N Gaussians
    labelling: Labelling  # what is known of them; replaced as a whole, and what was switched off stays so
    reliability: np.ndarray | None = None  # (N,) float32: mean over the views that saw each, or NaN; None if unknown
    mode: str = BY_CLASS  # one of `MODES`
    min_confidence: float = 0.0  # Gaussians that are less sure of their own class are not shown
    min_probability: float = 0.0  # if above 0, what is shown has at least this probability of a shown class
    hidden: set[int] = field(default_factory=set)  # labels that are switched off
    removed: set[int] = field(default_factory=set)  # labels that are off the list, too
    class_ids: tuple[int, ...] = ()  # ids by label, as many as were given: labels are numbers without gaps
    tree: ObjectTree | None = None  # parts and wholes of the classes
    read: Segmentation | None = None  # what the labelling is of, if it is of one, its classes without gaps

    def ids(self) -> list[int]:
        """Ids of all classes, by label; those that were added in the viewer have the smallest free ones."""
        if self.labelling.nodes is not None:
            return list(self.labelling.nodes)
        given, count = {*self.class_ids}, len(self.labelling.class_names)
        free = (i for i in range(len(given) + count) if i not in given)
        return [*self.class_ids, *free][:count]

    @property
    def labels_in_use(self) -> list[int]:
        """Labels of the list of classes."""
        return [row.label for row in self.rows()]

    def rows(self) -> list[ClassRow]:
        """List the classes that have Gaussians, then what is of no class, without those that were removed."""
        counts = np.bincount(self.labelling.labels + len(NO_CLASS), minlength=len(NO_CLASS)).tolist()
        sizes = {label: count for label, count in enumerate(counts, start=-len(NO_CLASS)) if count}
        listed = [k for k in (*self.labelling.class_names, *NO_CLASS) if k in sizes and k not in self.removed]
        return [ClassRow(k, self.name(k), self.color(k), sizes[k], k not in self.hidden) for k in listed]

    def name(self, label: int) -> str:
        """Name of a label, also of those that are no class."""
        return NO_CLASS.get(label) or class_name(self.labelling.class_names, label)

    def color(self, label: int) -> tuple[int, int, int]:
        """Colour of a label."""
        red, green, blue = self.labelling.palette[label].tolist()
        return red, green, blue

    def toggle(self, label: int) -> None:
        """Switch a class off, or on again; `UnknownLabelError` where it is not in the list, here and below."""
        self.hidden ^= {self._listed(label)}

    def isolate(self, label: int) -> None:
        """Show this class alone; asked for a second time, show all again."""
        others = set(self.labels_in_use) - {self._listed(label)}
        self.hidden = set() if others <= self.hidden and label not in self.hidden else others

    def remove(self, label: int) -> None:
        """Take a class off the list, and its Gaussians out of the picture and of exports."""
        self.removed |= {self._listed(label)}
        self.hidden -= {label}

    def show_all(self) -> None:
        """Switch all on, also what was removed, and lower both thresholds to 0."""
        self.hidden, self.removed = set(), set()
        self.min_confidence = self.min_probability = 0.0

    def shown(self) -> np.ndarray:
        """Which Gaussians are shown, (N,) bool."""
        known, num_classes = self.labelling, len(self.labelling.class_names)
        on = np.ones(num_classes + len(NO_CLASS), bool)  # labels -1 and -2 are its last two
        on[[k for k in self.hidden | self.removed if k < num_classes]] = False
        kept: np.ndarray = on[known.labels]
        if self.min_probability > 0:
            on_alone = known.shares.with_data(known.shares.data * on[known.shares.indices])
            kept = largest(on_alone)[0] >= np.float32(self.min_probability)
        if self.min_confidence > 0:
            kept &= known.confidence >= np.float32(self.min_confidence)
        return kept

    def colors(self) -> np.ndarray:
        """Colour of every Gaussian in the present mode, (N, 3) uint8."""
        if self.mode == TRUE_COLOURS:
            return self._true_colors
        known = self.labelling
        if self.mode == BY_CONFIDENCE:
            return ramp(np.where(known.confidence > 0, known.confidence, np.nan))
        if self.mode == BY_RELIABILITY:
            nothing = np.full(len(self.scene), np.nan, np.float32)
            return ramp(nothing if self.reliability is None else self.reliability)
        by_class: np.ndarray = known.palette[known.labels]
        # What refinement took out lies across an edge: in one colour it would be a stain on what it covers.
        out, num_classes = np.flatnonzero(known.labels == REMOVED), len(known.class_names)
        by_class[out] = np.rint(known.shares.take(out).dense(num_classes) @ known.palette[:num_classes])
        # Light and shade stay, as in the overlays.
        grey = self._true_colors.mean(axis=1, keepdims=True, dtype=np.float32)
        return np.rint(grey + FILL * (by_class - grey)).astype(np.uint8)

    @cached_property
    def _true_colors(self) -> np.ndarray:
        return np.rint(self.scene.colors() * 255).astype(np.uint8)

    def _listed(self, label: int) -> int:
        if label not in (listed := self.labels_in_use):
            raise UnknownLabelError(f"class {label} is not in the list; expected one of {listed}")
        return label


def completed(shares: CSRRows, num_classes: int) -> CSRRows:
    """Fill rows (N, K) up to a sum of 1: what is missing is divided among the classes that have none."""
    every = np.arange(shares.num_rows)
    rest = 1 - np.bincount(np.repeat(every, np.diff(shares.indptr)), shares.data, len(every))
    short = np.flatnonzero(shares.known() & (rest > SHARES_TOLERANCE))
    parts, taken = [CSRRows.empty(0)], shares.take(short).nonzero()
    share = rest[short] / np.maximum(num_classes - np.diff(taken.indptr), 1)
    for some, block in zip(slices(len(short), num_classes), taken.blocks(num_classes), strict=True):
        parts.append(CSRRows.from_dense(np.where(block == 0, share[some, None], block).astype(np.float32)))
    return shares.replaced_at(short, CSRRows.vstack(parts))


def ramp(values: np.ndarray) -> np.ndarray:
    """Colours (N, 3) uint8 of values (N,), from bad (0, dark red) to good (1, dark blue); grey where one is NaN."""
    position = np.clip(np.nan_to_num(values), 0, 1) * (len(_RAMP) - 1)
    first = np.minimum(position.astype(np.int64), len(_RAMP) - 2)
    part = (position - first)[:, None]
    colors: np.ndarray = np.rint(_RAMP[first] * (1 - part) + _RAMP[first + 1] * part).astype(np.uint8)
    colors[np.isnan(values)] = NOTHING_KNOWN
    return colors
