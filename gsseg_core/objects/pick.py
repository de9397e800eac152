"""One object from one view or a few: from masks, from scribbles, or from clicks.

A mask says of one view what is the object (1), what is not (0), and where nothing is said (-1). The view's operator
carries that to the Gaussians, W^T onehot(y) px of each; votes of several views add up. Where learners end rays at
surfaces, here they go on: of so few views, also what shines through tells of what lies just under a surface. What no
view shows takes its neighbours' answer along the graph of the scene (`gsseg_core.refine.label_propagation`): the back
of a chair hangs together with its front, and the wall behind it with the wall beside it.

Two things would let a mask spread to rooms that no view shows. A thousandth of the light of a pixel comes from
Gaussians behind what it shows; no other pixel contradicts, so all votes for these are votes for the object. And where
no vote is near, neighbours agree on whatever reaches them. So each Gaussian has a little evidence against the object
besides what was seen, the more, the farther away it lies for the object's own size:

    FAR |x_i - c|^2 / R^2 px

with c and R^2 the mean and the mean squared distance of what the mask shows, each Gaussian weighed by its votes. Within
the object that is next to nothing; it knows no unit of length.

Clicks become a mask first (`gsseg_core.objects.clicks`).
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsseg_core.data.class_names import class_ids, listed
from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.data.mask_files import CLASS_ID, masks_below
from gsseg_core.data.mask_formats.images import read_label_image
from gsseg_core.data.mask_formats.place import Place
from gsseg_core.data.mask_formats.table import open_masks
from gsseg_core.data.view import View
from gsseg_core.errors import MaskFormatError, NoUsableViewsError, SettingsError
from gsseg_core.files.npz_files import write_npz
from gsseg_core.objects.clicks import Pixel, click_labels
from gsseg_core.raster.backends import make_operator
from gsseg_core.refine.label_propagation import GraphSettings, propagate
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.spatial.neighbour_graph import graph_of
from gsseg_core.text import quoted

FORMAT = "gsseg-pick-1"

FAR = 0.04  # px of evidence against the object for what lies as far from its middle as its Gaussians do on average
_SHADES = (64, 191)  # of grey: edges that are soft have some as dark, and some as light
GRAPH = GraphSettings(strength=4.0)  # one view says little of each Gaussian, so its neighbours say more than usual


@dataclass(frozen=True, eq=False)
class Pick:
    """An object of a scene."""

    membership: np.ndarray  # (N,) float32: how sure each is of the object, in [0, 1]; 0 where nothing is known
    evidence: np.ndarray  # (N,) float32: labelled pixels that the membership stands on, in px
    scene_digest: str  # which scene it belongs to

    @property
    def ids(self) -> np.ndarray:
        """Gaussians of the object, those with a membership of at least one half, (M,) int64."""
        return np.flatnonzero(self.membership >= 0.5)

    def silhouette(self, scene: GaussianScene, camera: Camera, *, device: str = "cpu") -> np.ndarray:
        """Where a camera sees the object, not what hides it: its blended membership is at least one half, (H, W) bool.

        What a ray has left over is not the object.
        """
        return make_operator(scene, camera, device).render(self.membership[:, None])[..., 0] >= 0.5

    def next_view(self, scene: GaussianScene, cameras: Sequence[Camera], *, device: str = "cpu") -> int:
        """Find the camera whose mask would help most: where the most of what is in doubt is seen, in px.

        In doubt is how far a membership m may be off, its standard deviation sqrt(m (1 - m)), as far as it was guessed
        from neighbours and not seen: s / (s + e), with e the evidence and s the strength of the neighbours. Raises
        `SettingsError` where there are no cameras.
        """
        if not cameras:
            raise SettingsError("found no camera to choose from; expected a view that has no mask yet")
        guessed = GRAPH.strength / (GRAPH.strength + self.evidence)
        doubt = (np.sqrt(self.membership * (1 - self.membership)) * guessed)[:, None]
        return int(np.argmax([make_operator(scene, camera, device).render(doubt).sum() for camera in cameras]))

    def save(self, path: str | os.PathLike[str], run: str | None = None) -> None:
        """Write ids and membership, with the scene's digest and the run, as one npz, atomically (`WriteError`)."""
        header = {"format": FORMAT, "scene": self.scene_digest, **({} if run is None else {"run": run})}
        write_npz(path, header, ids=self.ids, membership=self.membership)


def pick_mask(scene: GaussianScene, view: View, settings: GraphSettings = GRAPH, *, device: str = "cpu") -> Pick:
    """Pick the object that a mask of one view shows; parameters and errors are those of `pick_masks`."""
    return pick_masks(scene, [view], settings, device=device)


def pick_masks(
    scene: GaussianScene, views: Sequence[View], settings: GraphSettings = GRAPH, *, device: str = "cpu"
) -> Pick:
    """Pick the object that masks of some views show; `settings` say how what was seen spreads to what was not.

    Labels of views are 1 for the object, 0 for what is not it, -1 where nothing is said; so scribbles will do, of both
    kinds. Make one by `View.from_arrays(camera, labels)`. A view that shows nothing of the object has 0 alone.

    Raises `NoUsableViewsError` where no Gaussian is seen in a pixel of the object, or none in one that is not it, so
    that nothing says where it ends; `SettingsError` where there are other labels, or no views.
    """
    if not views:
        raise SettingsError("found no masks to pick an object by; expected at least one view")
    votes = np.zeros((len(scene), 2), np.float32)
    for view in views:
        labels = view.read_labels()
        if labels.max() > 1:
            raise SettingsError(f"view '{view.name}': labels up to {labels.max()}; expected 1 (object), 0 (not it), -1")
        votes += make_operator(scene, view.camera, device).adjoint(np.stack([labels == 0, labels == 1], axis=2))
    for k, what in enumerate(("not the object", "the object")):
        if not votes[:, k].any():
            names = ", ".join(f"'{view.name}'" for view in views[:9])
            raise NoUsableViewsError(
                f"{'view' if len(views) == 1 else 'views'} {names}: no Gaussian is seen in a pixel with the label {k} "
                f"({what}); expected pixels of both kinds"
            )
    seen = votes.sum(axis=1)
    votes[:, 0] += FAR * _distance(scene.means, votes[:, 1])
    evidence = votes.sum(axis=1)
    shares = np.divide(votes, evidence[:, None], out=np.zeros_like(votes), where=evidence[:, None] > 0)
    membership = propagate(graph_of(scene, settings.k), shares, evidence, settings)[:, 1].copy()
    return Pick(membership, seen, scene.digest)


def pick_clicks(
    scene: GaussianScene, camera: Camera, inside: Sequence[Pixel], outside: Sequence[Pixel] = (), *, device: str = "cpu"
) -> Pick:
    """Pick the object around one click or several in a view, leaving out what clicks say is not of it.

    Parameters are those of `gsseg_core.objects.clicks.click_labels`, errors those of it and of `pick_mask`.
    """
    labels = click_labels(scene, camera, inside, outside, device=device)
    return pick_mask(scene, View.from_arrays(camera, labels), device=device)


def read_object_mask(
    path: str | os.PathLike[str],
    camera: Camera,  # whose image the mask is drawn on as it was taken, of its size or the same larger or smaller
    label: str | int | None = None,  # the object's: an id, or the name of a class; by default all but 0
    class_names: Mapping[int, str] | None = None,  # of what label images hold; masks of other programs bring their own
) -> np.ndarray:
    """Read a drawn mask of a view, or one label of it, as labels (H, W) int32 of the pinhole view for `pick_mask`.

    It is a label image, a PNG of ids; in one of black and white only, soft edges or not, 255 is the object and not
    unknown, and so is what is nearer to it. Or it is of another program, see docs/formats.md; a file with the mask of
    one image may have any name.

    Raises `MaskFormatError` or `MaskSizeError` where the file holds no masks, has none of this view or of another
    shape, or nothing in it is the object; `SettingsError` where there is no such class.
    """
    path, names = Path(path), class_names
    place = Place(path, frozenset([camera.image]))
    masks = None if path.suffix.lower() == ".png" else open_masks(place)
    if masks is None:
        path = masks_below(place).get(camera.image, path) if path.is_dir() else path
        labels = read_label_image(path, camera)
    else:
        names, labels = masks.class_names, masks.views[camera.image].labels(camera)
    named_by = "classes.json" if masks is None and names is not None else path
    mask = object_mask(labels, None if label is None else _label_id(str(label), names, named_by), str(path))
    return mask if camera.undistortion is None else camera.undistortion.sample(mask, UNKNOWN)


def _label_id(label: str, class_names: Mapping[int, str] | None, path: str | Path) -> int:
    if class_names is not None:
        return class_ids([label], dict(sorted(class_names.items())), path)[0]
    if not re.fullmatch(CLASS_ID, label):
        raise SettingsError(f"{path}: label is {quoted(label)}; expected a number, as the mask has no names of classes")
    return int(label)


def object_mask(labels: np.ndarray, label: int | None, source: str) -> np.ndarray:  # (H, W) int
    """Make labels for `pick_mask` of the labels of an image, as `read_object_mask` does of a file's.

    `source` is what messages call the image.
    """
    if label is None and _is_black_and_white(labels):
        labels = ((labels == UNKNOWN) | (labels > 127)).astype(np.int32)
    chosen = labels > 0 if label is None else labels == label
    if not chosen.any():
        there = listed(map(str, np.unique(labels[labels != UNKNOWN]).tolist()))
        wanted = "a label above 0" if label is None else f"the label {label}"
        raise MaskFormatError(f"{source}: holds the labels {there}; expected pixels with {wanted}")
    return np.where(chosen, 1, np.where(labels == UNKNOWN, UNKNOWN, 0)).astype(np.int32)


def _is_black_and_white(labels: np.ndarray) -> bool:  # (H, W) int
    """Whether an image has no ids, but white, which was read as unknown, and at most as much grey of all shades."""
    grey = labels[labels > 0]
    dark, light = _SHADES
    has_shades = grey.size == 0 or (grey.min() <= dark and light <= grey.max() < 255)
    return bool(has_shades and grey.size <= np.count_nonzero(labels == UNKNOWN))


def _distance(means: np.ndarray, votes: np.ndarray) -> np.ndarray:
    """Squared distance of means (N, 3) to the middle of votes (N,), as a multiple of the mean of the voted, (N,)."""
    weights = votes / votes.sum(dtype=np.float64)
    squared: np.ndarray = ((means - weights @ means) ** 2).sum(axis=1)
    typical = float(weights @ squared)
    return squared / typical if typical > 0 else np.zeros_like(squared)
