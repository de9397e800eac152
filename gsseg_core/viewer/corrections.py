"""Corrections by a person: turns what is drawn in a picture into a posed mask, and fuses it at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy import ndimage

from gsseg_core.data.class_names import class_name
from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.data.view import View
from gsseg_core.errors import NoUsableViewsError, SettingsError
from gsseg_core.files.limits import MAX_LABEL
from gsseg_core.live.session import LiveSession
from gsseg_core.objects.clicks import click_labels
from gsseg_core.raster.backends import make_operator
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import REMOVED, UNOBSERVED
from gsseg_core.viewer.model import Labelling

TRUST = 4.0  # a correction that sees a whole Gaussian weighs so many times as much as all that was learnt before


def disc(camera: Camera, column: float, row: float, radius: float, label: int) -> View:
    """Draw a disc in a camera's picture, in pixels: a view that says `label` there, and nothing anywhere else.

    At least the pixel of the middle is drawn. Raises `SettingsError` where that is not in the picture, or the label is
    no class.
    """
    _check_inside(camera, column, row)
    x, y = np.arange(camera.width) + 0.5, np.arange(camera.height)[:, None] + 0.5
    drawn = (x - column) ** 2 + (y - row) ** 2 <= radius**2
    drawn[int(row), int(column)] = True
    return _view(camera, drawn, label)


def box(camera: Camera, corner: Sequence[float], opposite: Sequence[float], label: int) -> View:
    """Draw a rectangle between two corners, column and row in pixels; see `disc`."""
    (left, right), (top, bottom) = (sorted(pair) for pair in zip(corner, opposite, strict=True))
    x, y = np.arange(camera.width) + 0.5, np.arange(camera.height)[:, None] + 0.5
    return _view(camera, (x >= left) & (x <= right) & (y >= top) & (y <= bottom), label)


def region(camera: Camera, label_map: np.ndarray, column: float, row: float, label: int) -> View:
    """Draw the connected region of one label of a map (H, W) around a pixel, as it is shown now; see `disc`."""
    _check_inside(camera, column, row)
    parts, _ = ndimage.label(label_map == label_map[int(row), int(column)])
    return _view(camera, parts == parts[int(row), int(column)], label)


def looks_alike(
    scene: GaussianScene, camera: Camera, column: float, row: float, label: int, *, device: str = "cpu"
) -> View:
    """Draw the region of one colour and direction around a pixel, whatever its label; see `disc`.

    Also raises `NoUsableViewsError` where the pixel shows no Gaussian.
    """
    _check_inside(camera, column, row)
    return _view(camera, click_labels(scene, camera, [(int(row), int(column))], device=device) == 1, label)


class Corrections:
    """Corrections of one scene, in the order in which they came.

    They are views like any other, fused by a `LiveSession` that has no others. How much a correction weighs against
    what was learnt before goes by how much of a Gaussian it sees: the sum of its weights over what was drawn, divided
    by that of its opacities over the whole image, which is 1 for one that lies open and inside the drawing, and near 0
    for what lies behind; 0 without a vote. With e its sum over the corrections, c their class probabilities and q those
    learnt before,

        q' = normalise( q + TRUST e c )

    Attributes
    ----------
    views : list of View
        The corrections.
    """

    def __init__(self, scene: GaussianScene, *, device: str = "cpu") -> None:
        self._scene, self._device = scene, device
        self.views: list[View] = []
        self._session = LiveSession(scene, device=device, max_classes=MAX_LABEL + 1)
        self._seen: list[np.ndarray] = []

    def __len__(self) -> int:
        """Count the corrections."""
        return len(self.views)

    def add(self, view: View) -> None:
        """Learn a correction. A view of a name that is there already is another correction all the same.

        Raises `NoUsableViewsError` where nothing was drawn on any Gaussian.
        """
        camera = replace(view.camera, name=f"correction_{len(self.views):04d}")
        own = View.from_arrays(camera, view.read_labels())
        rejection = self._session.fuse(own)
        if rejection is not None:
            raise NoUsableViewsError(f"correction: {rejection.message}; expected something drawn on the scene")
        self.views.append(own)
        self._seen.append(share_seen(self._scene, own, self._device))

    def undo(self) -> bool:
        """Take the last correction back, exactly; return whether there was one."""
        if not self.views:
            return False
        self.views.pop()
        self._seen.pop()
        self._fuse_anew()
        return True

    def renumber(self, ids: Mapping[int, int]) -> None:
        """Give some classes other numbers."""
        table = np.arange(MAX_LABEL + 2)
        table[-1] = UNKNOWN
        table[list(ids)] = list(ids.values())
        self.views = [View.from_arrays(view.camera, table[view.read_labels()]) for view in self.views]
        self._fuse_anew()

    def _fuse_anew(self) -> None:
        self._session.reset()
        for view in self.views:
            self._session.fuse(view)

    def apply(self, before: Labelling, names: Mapping[int, str] | None = None) -> Labelling:
        """Combine a labelling of the same scene with the corrections; it stays where none has seen a Gaussian.

        `names` are those of classes that only the corrections have.
        """
        if not self.views:
            return before
        drawn = self._session.codes()
        num_classes = max(drawn.shape[1], before.probabilities.shape[1])
        probabilities, drawn = _widened(before.probabilities, num_classes), _widened(drawn, num_classes)
        weight: np.ndarray = TRUST * np.stack(self._seen).sum(axis=0)
        touched = np.flatnonzero(weight)
        mixed = probabilities[touched] + weight[touched, None] * drawn[touched]
        mixed /= mixed.sum(axis=1, keepdims=True)
        probabilities[touched] = mixed
        labels = before.labels.copy()
        # A Gaussian that refinement took out of its object stays out, unless it goes to another one.
        best = mixed.argmax(axis=1).astype(np.int32)
        filtered = (labels[touched] == REMOVED) & (best == before.probabilities[touched].argmax(axis=1))
        labels[touched] = np.where(filtered, REMOVED, best)
        known = {**(names or {}), **before.class_names}
        return Labelling(labels, probabilities, {k: class_name(known, k) for k in range(num_classes)})


def share_seen(scene: GaussianScene, view: View, device: str = "cpu") -> np.ndarray:
    """How much of each Gaussian the labelled pixels of a view see, (N,) float32 in [0, 1]; 0 of one without a vote."""
    operator, labels = make_operator(scene, view.camera, device), view.read_labels()
    drawn_on = operator.observe(labels).ids  # What lies behind these shines through, but nobody drew on it.
    full, share = np.zeros(len(scene), np.float32), np.zeros(len(scene), np.float32)
    full[operator.ids] = operator.footprints()
    seen = operator.adjoint((labels != UNKNOWN)[..., None].astype(np.float32))[drawn_on, 0]
    share[drawn_on] = np.minimum(seen / full[drawn_on], 1)
    return share


def _view(camera: Camera, drawn: np.ndarray, label: int) -> View:
    if label <= UNOBSERVED:
        raise SettingsError(f"correction: label is {label}; expected a class")
    return View.from_arrays(camera, np.where(drawn, np.int32(label), np.int32(UNKNOWN)))


def _check_inside(camera: Camera, column: float, row: float) -> None:
    if not (0 <= column < camera.width and 0 <= row < camera.height):
        raise SettingsError(
            f"correction: pixel is (column {column:g}, row {row:g}); expected one of the "
            f"{camera.width} x {camera.height} of the picture"
        )


def _widened(probabilities: np.ndarray, num_classes: int) -> np.ndarray:
    return np.pad(probabilities, ((0, 0), (0, num_classes - probabilities.shape[1])))
