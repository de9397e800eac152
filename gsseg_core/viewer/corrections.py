"""Corrections by a person: turns what is drawn in a picture into a posed mask, and fuses it at once."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from gsseg_core.csr_rows import CSRRows, slices
from gsseg_core.data.class_names import class_name
from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.data.view import View
from gsseg_core.errors import NoUsableViewsError, SettingsError
from gsseg_core.files.limits import MAX_LABEL
from gsseg_core.objects.clicks import click_labels
from gsseg_core.raster.backends import make_operator
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import REMOVED
from gsseg_core.viewer.model import Labelling

TRUST = 4.0  # a correction that sees a whole Gaussian weighs so many times as much as all that was learnt before


def disc(camera: Camera, column: float, row: float, radius: float, label: int) -> View:
    """Draw a disc in a camera's picture, in pixels: a view that says `label` there, and nothing anywhere else.

    At least the pixel of the middle is drawn. Raises `SettingsError` where that is not in the picture, or the label is
    no class.
    """
    middle = _pixel(camera, column, row)
    x, y = np.arange(camera.width) + 0.5, np.arange(camera.height)[:, None] + 0.5
    drawn = (x - column) ** 2 + (y - row) ** 2 <= radius**2
    drawn[middle] = True
    return _view(camera, drawn, label)


def box(camera: Camera, corner: Sequence[float], opposite: Sequence[float], label: int) -> View:
    """Draw a rectangle between two corners, column and row in pixels; see `disc`."""
    (left, right), (top, bottom) = (sorted(pair) for pair in zip(corner, opposite, strict=True))
    x, y = np.arange(camera.width) + 0.5, np.arange(camera.height)[:, None] + 0.5
    return _view(camera, (x >= left) & (x <= right) & (y >= top) & (y <= bottom), label)


def region(camera: Camera, label_map: np.ndarray, column: float, row: float, label: int) -> View:
    """Draw the connected region of one label of a map (H, W) around a pixel, as it is shown now; see `disc`."""
    clicked = _pixel(camera, column, row)
    parts, _ = ndimage.label(label_map == label_map[clicked])
    return _view(camera, parts == parts[clicked], label)


def looks_alike(
    scene: GaussianScene, camera: Camera, column: float, row: float, label: int, *, device: str = "cpu"
) -> View:
    """Draw the region of one colour and direction around a pixel, whatever its label; see `disc`.

    Also raises `NoUsableViewsError` where the pixel shows no Gaussian.
    """
    return _view(camera, click_labels(scene, camera, [_pixel(camera, column, row)], device=device) == 1, label)


class Correction(NamedTuple):
    """What a correction says of the M Gaussians that it sees, in P pairs of a Gaussian and a label."""

    ids: np.ndarray  # (P,) int32: Gaussian of each pair
    labels: np.ndarray  # (P,) int32
    votes: np.ndarray  # (P,) float32, px: sum of the Gaussian's weights over the pixels of the label
    seen: np.ndarray  # (P,) float32 in [0, 1]: how much the labelled pixels see of the Gaussian, in its first pair


class Corrections:
    """Corrections of one scene, in the order in which they came.

    They vote as all masks do. How much a correction weighs against what was learnt before goes by how much of a
    Gaussian it sees: the sum of its weights over what was drawn, divided by that of its opacities over the whole image,
    which is 1 for one that lies open and inside the drawing, and near 0 for what lies behind; 0 without a vote. With e
    its sum over the corrections, c their normalised votes and q the class probabilities learnt before,

        q' = normalise( q + TRUST e c )
    """

    def __init__(self, scene: GaussianScene, *, device: str = "cpu") -> None:
        self._scene, self._device = scene, device
        self.drawn: tuple[Correction, ...] = ()  # what each says

    def __len__(self) -> int:
        """Count the corrections."""
        return len(self.drawn)

    def add(self, view: View, shown: np.ndarray | None = None) -> None:
        """Learn a correction that was drawn on the Gaussians that are shown, (N,) bool; by default, on all.

        Raises `NoUsableViewsError` where nothing was drawn on any Gaussian.
        """
        drawn = drawn_on(self._scene, view, shown, self._device)
        if not len(drawn.ids):
            raise NoUsableViewsError(
                "correction: what was drawn sees no Gaussian; expected something drawn on the scene"
            )
        self.drawn += (drawn,)

    def undo(self) -> bool:
        """Take the last correction back, exactly; return whether there was one."""
        before, self.drawn = self.drawn, self.drawn[:-1]
        return bool(before)

    def labels(self) -> set[int]:
        """Return the classes that were drawn."""
        return {label for drawn in self.drawn for label in np.unique(drawn.labels).tolist()}

    def renumber(self, ids: Mapping[int, int]) -> None:
        """Give some classes other numbers."""
        table = np.arange(MAX_LABEL + 1, dtype=np.int32)
        table[list(ids)] = list(ids.values())
        self.drawn = tuple(drawn._replace(labels=table[drawn.labels]) for drawn in self.drawn)

    def apply(self, before: Labelling, names: Mapping[int, str] | None = None) -> Labelling:
        """Combine a labelling of the same scene with the corrections; it stays where none has seen a Gaussian.

        `names` are those of classes that only the corrections have.
        """
        if not self.drawn:
            return before
        ids, drawn_labels, votes, seen = map(np.concatenate, zip(*self.drawn, strict=True))
        num_classes = max(int(drawn_labels.max()) + 1, len(before.class_names))
        touched, rows = np.unique(ids.astype(np.int64), return_inverse=True)
        weight, order, labels = TRUST * np.bincount(rows, seen), np.argsort(rows, kind="stable"), before.labels.copy()
        mixed = [CSRRows.empty(0)]
        for some in slices(len(touched), num_classes):  # With the zeros of all classes, memory is for a few alone.
            pairs = order[slice(*np.searchsorted(rows[order], [some.start, some.stop]))]
            drawn = np.zeros((some.stop - some.start, num_classes), np.float32)
            np.add.at(drawn, (rows[pairs] - some.start, drawn_labels[pairs]), votes[pairs])
            drawn *= weight[some, None] / drawn.sum(axis=1, keepdims=True)
            learnt = before.shares.take(touched[some]).dense(num_classes)
            drawn += learnt
            drawn /= drawn.sum(axis=1, keepdims=True)
            mixed.append(CSRRows.from_dense(drawn))
            # A Gaussian that refinement took out of its object stays out, unless it goes to another one.
            best = drawn.argmax(axis=1).astype(np.int32)
            filtered = (labels[touched[some]] == REMOVED) & (best == learnt.argmax(axis=1))
            labels[touched[some]] = np.where(filtered, REMOVED, best)
        shares = before.shares.replaced_at(touched, CSRRows.vstack(mixed))
        known = {**(names or {}), **before.class_names}
        return Labelling(labels, shares, {k: class_name(known, k) for k in range(num_classes)})


def drawn_on(scene: GaussianScene, view: View, shown: np.ndarray | None = None, device: str = "cpu") -> Correction:
    """Lift the labels of a view onto the Gaussians that are shown, (N,) bool, as if there were no others."""
    operator, labels = make_operator(scene, view.camera, device), view.read_labels()
    if shown is not None:
        operator = operator.without(~shown)
    observed = operator.observe(labels)  # What lies behind these shines through, but nobody drew on it.
    full, seen = np.zeros(len(scene), np.float32), np.zeros(len(observed.labels), np.float32)
    full[operator.ids] = operator.footprints()
    weights = operator.adjoint((labels != UNKNOWN)[..., None].astype(np.float32))[observed.ids, 0]
    seen[observed.start[:-1]] = np.minimum(weights / full[observed.ids], 1)
    return Correction(*observed.places, observed.votes(), seen)


def _view(camera: Camera, drawn: np.ndarray, label: int) -> View:
    if not 0 <= label <= MAX_LABEL:
        raise SettingsError(f"correction: label is {label}; expected a class")
    return View.from_arrays(camera, np.where(drawn, np.int32(label), np.int32(UNKNOWN)))


def _pixel(camera: Camera, column: float, row: float) -> tuple[int, int]:
    """Row and column of the pixel that a place lies in; `SettingsError` where the picture has none there."""
    return camera.checked_pixel(math.floor(row), math.floor(column))
