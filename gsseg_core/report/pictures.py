"""Pictures in the report page: views with masks laid over them, and a thumbnail of every class, as data URIs."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from io import BytesIO

import numpy as np
from PIL import Image

from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.data.view import View
from gsseg_core.export.pictures import FAINT_INK, outline, overlay, shown_at, shrunk
from gsseg_core.export.view_pictures import Drawn, background_image
from gsseg_core.learn.mask_reliability import ViewCheck
from gsseg_core.raster.backends import make_operator
from gsseg_core.report.findings import MaskChecks
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.several_at_once import several_at_once

PICTURE_PX = 480  # longest side of the views that are shown
THUMBNAIL_PX = 128
MARGIN = 0.25  # around the object in a thumbnail, as a share of its size
SMALLEST_CROP_PX = 32
ENOUGH = THUMBNAIL_PX**2  # pixels of a class that fill its thumbnail: more of them show no more
CUT = 0.3  # what a view in which the margin cuts an object counts, beside one that shows it whole
MOST_KEPT = 32  # images that are kept once they were rendered: thumbnails may need hundreds, each once
UNSEEN = 0.5  # what a view counts whose image would have to be rendered, beside one whose image is at hand
_AGREE, _DIFFER, _UNKNOWN = (40, 44, 52), (236, 72, 60), FAINT_INK


class ViewImages:
    """What was seen from a view: its photo, else the colours of the scene, rendered on a device unless drawn before."""

    def __init__(self, scene: GaussianScene, device: str = "cpu", drawn: Iterable[Drawn] = ()) -> None:
        self.scene, self.device = scene, device
        self._images: dict[tuple[str, int], np.ndarray] = {}
        for one in drawn:
            self.keep(one.view, one.image)

    def keep(self, view: View, rendered: np.ndarray) -> None:
        """Keep a rendering (H, W, 3) uint8 that has been made anyway."""
        self._images[view.name, view.camera.width] = rendered

    def at_hand(self, view: View) -> bool:
        """Whether nothing needs to be rendered."""
        return (view.name, view.camera.width) in self._images or view.image_path is not None

    def of(self, view: View) -> np.ndarray:
        """Give the image, (H, W, 3) uint8 of the camera's size."""
        photo = view.read_photo()
        return self.rendered(view) if photo is None else photo

    def rendered(self, view: View) -> np.ndarray:
        """Give the colours of the scene, (H, W, 3) uint8, also where there is a photo."""
        image = self._images.get((view.name, view.camera.width))
        if image is None:
            image = background_image(self.scene, make_operator(self.scene, view.camera, self.device))
            if len(self._images) < MOST_KEPT:
                self.keep(view, image)
        return image


def draw_triple(check: ViewCheck, view: View, images: ViewImages, colors: np.ndarray) -> tuple[np.ndarray, ...]:
    """Lay a view's mask over its image, and what is predicted, in colours (K, 3) of classes; show where they differ.

    Returns these three, (H, W, 3) uint8. Large ones are thinned out, to be shown with at most `PICTURE_PX` px a side.
    """
    image, mask, predicted = shown_at(PICTURE_PX, images.of(view), view.read_labels(), check.prediction())
    # There are three tints, and 766 greys to lay them over.
    strength, tints = np.array([0.6, 0.75, 0.75])[:, None, None], np.array([_AGREE, _DIFFER, _UNKNOWN])[:, None]
    table = ((1 - strength) * (np.arange(3 * 255 + 1) / 3)[:, None] + strength * tints).round().astype(np.uint8)
    which = np.where((mask == UNKNOWN) | (predicted == UNKNOWN), 2, mask != predicted)
    difference = table[which, image[..., 0].astype(np.int16) + image[..., 1] + image[..., 2]]
    return overlay(image, mask, colors), overlay(image, predicted, colors), difference


def thumbnails(
    classes: Iterable[int], checked: MaskChecks, images: ViewImages, colors: np.ndarray
) -> dict[int, tuple[str, np.ndarray]]:
    """Cut classes out of the views that show them best, outlined in their colours (K, 3), several views at once.

    Returns, for each of the classes that some view shows, the view's name and the picture, (px, px, 3) uint8 with px
    being `THUMBNAIL_PX`.
    """
    chosen: dict[int, list[int]] = {}
    best = _best_views(checked, images, len(colors))
    for k in classes:
        if k in best:
            chosen.setdefault(best[k], []).append(k)

    def cut_from(place: int) -> dict[int, tuple[str, np.ndarray]]:
        check = checked.checks[place]
        view = checked.views[check.name]
        image, mask = images.of(view), view.read_labels()
        predicted = check.completed(mask)
        return {k: (view.name, _crop(image, (mask == k) & (predicted == k), colors[k])) for k in chosen[place]}

    return {k: found for some in several_at_once(cut_from, chosen, images.device) for k, found in some.items()}


def jpeg_uri(image: np.ndarray, largest: int) -> str:
    """Encode a picture (H, W, 3) uint8 as a data URI, shrunk so that neither side is longer than `largest` px."""
    buffer = BytesIO()
    # Thin lines in strong colours are what these pictures have to show; JPEG's usual subsampling smears them.
    Image.fromarray(shrunk(image, largest)).save(buffer, "JPEG", quality=85, subsampling=0)
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def _best_views(checked: MaskChecks, images: ViewImages, num_classes: int) -> dict[int, int]:
    """Find the check of the view that shows each class best, by class; of those that some view shows.

    That is the one with most pixels on which mask and prediction agree, but `ENOUGH` are as good as more. It counts
    less if the margin cuts the object, or if the view's image would have to be rendered. A small rest of an object that
    is large elsewhere is not looked at, though nothing cuts it.
    """
    checks = checked.checks
    pixels, cut = (np.zeros((len(checks), num_classes), kind) for kind in (np.int64, np.bool_))
    for place, check in enumerate(checks):
        predicted, labels, count = check.cells()
        right = predicted == labels
        pixels[place, labels[right]] = count[right]
        cut[place, check.cut] = True
    at_hand = np.array([images.at_hand(checked.views[check.name]) for check in checks], bool)
    worth = np.minimum(pixels, ENOUGH) * np.where(cut, CUT, 1) * np.where(at_hand, 1, UNSEEN)[:, None]
    worth[pixels < np.minimum(ENOUGH, CUT * pixels.max(axis=0, initial=0))] = 0
    best = np.where(worth == worth.max(axis=0, initial=0), pixels, -1)
    return {k: int(best[:, k].argmax()) for k in np.flatnonzero(pixels.any(axis=0)).tolist()}


def _crop(image: np.ndarray, own: np.ndarray, color: np.ndarray) -> np.ndarray:
    """Cut a square out of an image (H, W, 3), around an object (H, W) bool, outlined in its colour; the rest dimmed."""
    rows, columns = np.flatnonzero(own.any(axis=1)), np.flatnonzero(own.any(axis=0))
    # What makes up the object; a few pixels elsewhere should not shrink it to a dot.
    top, bottom = _extent(own[rows].sum(axis=1), rows)
    left, right = _extent(own[:, columns].sum(axis=0), columns)
    side = max(round((1 + 2 * MARGIN) * max(bottom - top, right - left)), SMALLEST_CROP_PX)
    side = min(side, *own.shape)
    top = int(np.clip((top + bottom - side) // 2, 0, own.shape[0] - side))
    left = int(np.clip((left + right - side) // 2, 0, own.shape[1] - side))
    window = np.s_[top : top + side, left : left + side]
    size = (THUMBNAIL_PX, THUMBNAIL_PX)
    shown = np.asarray(Image.fromarray(image[window]).resize(size, Image.Resampling.BICUBIC))
    inside = np.asarray(Image.fromarray(own[window]).resize(size, Image.Resampling.NEAREST))
    dimmed = (0.45 * shown + 0.15 * shown.mean(axis=2, keepdims=True)).astype(np.uint8)
    picture = np.where(inside[..., None], shown, dimmed)
    # Two pixels wide: the page shows two of them as one.
    picture[outline(inside)] = color
    return picture


def _extent(weights: np.ndarray, places: np.ndarray) -> tuple[int, int]:
    """First and last of some places (R,), but for the hundredth of their weights (R,) at either end."""
    share = np.cumsum(weights) / weights.sum()
    first, last = np.searchsorted(share, [0.01, 0.99])
    return int(places[first]), int(places[last]) + 1
