"""Pictures of views: the scene tinted by class, and the masks that are trusted least."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.data.view import View
from gsseg_core.export.pictures import CELL_PX, contact_sheet, legend, overlay, palette, save_png, shown_at
from gsseg_core.learn.mask_reliability import WORST, ViewCheck, worst_views
from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.depth import surface_of, with_depths
from gsseg_core.raster.view_operator import ViewOperator
from gsseg_core.refine.silhouette_carving import Silhouette, looked_from
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import Segmentation
from gsseg_core.several_at_once import several_at_once

LEGEND_CLASSES = 100  # more than this are a vocabulary or found objects, some of which no Gaussian belongs to
_DIFFERENT = np.array([[0, 0, 0], [230, 40, 40]], np.uint8)
SavePicture = Callable[[Path, np.ndarray], object]  # writes a picture as `save_png` does, now or later
_LONGEST_NAME = 255  # bytes of the name of a file, at most, on all file systems


def view_file_name(name: str, prefix: str = "") -> str:
    """File name of a picture of a view: `<prefix><name>.png`, or one near to it where no file can be named so."""
    safe = re.sub(r"[\x00-\x1f\x7f/\ud800-\udfff]", "_", name)
    room = _LONGEST_NAME - len(f"{prefix}.png")
    if safe != name or len(safe.encode()) > room:
        # Two names may be cut to the same; the digest tells them apart.
        digest = hashlib.sha256(name.encode("utf-8", "surrogatepass")).hexdigest()[:8]
        safe = safe.encode()[: room - 9].decode(errors="ignore") + f"-{digest}"
    return f"{prefix}{safe}.png"


def background_image(scene: GaussianScene, operator: ViewOperator) -> np.ndarray:
    """Render the scene's colours from a view, (H, W, 3) uint8, on black."""
    return as_pixels(operator.blend_seen(scene.colors(operator.camera.center, operator.ids)).image)


def as_pixels(image: np.ndarray) -> np.ndarray:  # (H, W, 3) in [0, 1]
    """Round blended colours to pixels, (H, W, 3) uint8."""
    return np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)


class Drawn(NamedTuple):
    """A view of a segmentation, for people."""

    view: View  # where from
    labels: np.ndarray  # (H, W) int32: class of each pixel
    overlay: np.ndarray  # (H, W, 3) uint8: the scene tinted by class
    image: np.ndarray  # (H, W, 3) uint8: the scene in its own colours

    @classmethod
    def of(cls, view: View, labels: np.ndarray, image: np.ndarray, num_classes: int) -> Drawn:
        """Tint an image by its labels."""
        return cls(view, labels, overlay(image, labels, palette(num_classes)), image)


def draw_views(
    scene: GaussianScene, segmentation: Segmentation, views: Iterable[View], *, device: str = "cpu"
) -> Iterator[Drawn]:
    """Draw the labels of some views, and the scene under them."""

    def draw(view: View) -> Drawn:
        operator = make_operator(scene, view.camera, device)
        labels, seen = segmentation.label_map_beside(operator, scene.colors(view.camera.center, operator.ids))
        return Drawn.of(view, labels, as_pixels(seen.image), segmentation.num_classes)

    yield from several_at_once(draw, views, device)


def look_and_draw(
    scene: GaussianScene,
    segmentation: Segmentation,
    asked: Collection[str],
    drawn: dict[str, Drawn],
    device: str,
    view: View,
) -> Silhouette:
    """Render the silhouettes of a view, to carve objects by; if its name is in `asked`, also put a picture in `drawn`.

    A view that is drawn is rendered at its full size.
    """
    pictured = view.name in asked
    operator = make_operator(scene, view.camera if pictured else looked_from(view.camera), device)
    nothing = np.empty((len(operator.ids), 0), np.float32)
    colors = scene.colors(view.camera.center, operator.ids) if pictured else nothing
    labels, (image, left_over) = segmentation.label_map_beside(operator, with_depths(scene, operator, colors))
    if pictured:
        drawn[view.name] = Drawn.of(view, labels, as_pixels(image[..., :3]), segmentation.num_classes)
    return Silhouette.of(scene, operator, labels, surface_of(image[..., -1], left_over).depth, view.camera)


def write_pictures(
    segmentation: Segmentation,
    drawn: Iterable[Drawn],
    folder: Path,
    save: SavePicture = save_png,
    ids: Sequence[int] | None = None,
) -> list[Path]:
    """Write overlays of some views, as `draw_views` gives them, a contact sheet of them, and the legend.

    Their files are `overlay_<stem>.png` ..., `contact_sheet.png` and `legend.png`; `ids` are those of `write_overview`.
    """
    images, captions, paths = [], [], []
    for one in drawn:
        images.append(one.overlay)
        captions.append(one.view.name)
        paths.append(folder / view_file_name(one.view.name, "overlay_"))
        save(paths[-1], one.overlay)
    return paths + write_overview(segmentation, images, captions, folder, save, ids)


def write_overview(
    result: Segmentation,
    images: Sequence[np.ndarray],
    captions: Sequence[str],
    folder: Path,
    save: SavePicture,
    ids: Sequence[int] | None = None,  # of its classes, (K,), where these are numbered without the gaps of their ids
) -> list[Path]:
    """Write `contact_sheet.png` of some pictures, if there are any, and `legend.png`.

    Of more than `LEGEND_CLASSES` classes the legend shows those that Gaussians belong to.
    """
    paths = []
    if images:
        paths.append(folder / "contact_sheet.png")
        # A tower of hundreds of views would be a thin line on a screen.
        save(paths[-1], contact_sheet(images, captions, max(4, math.ceil(len(images) ** 0.5))))
    paths.append(folder / "legend.png")
    names, counts = result.class_names, result.counts()
    if len(names) > LEGEND_CLASSES:
        names = {k: name for k, name in names.items() if counts[k]}
    save(paths[-1], legend(names, palette(result.num_classes), counts, ids))
    return paths


def draw_worst_views(
    images_of: Callable[[View], np.ndarray],  # gives the colours of the scene from a view, (H, W, 3) uint8
    views: Mapping[str, View],  # at least those that were checked
    checks: Sequence[ViewCheck],  # of all views, or of some, with what was predicted; at least one
    count: int = WORST,  # views at most, one a row
    device: str = "cpu",  # where images are made: on the CPU, two at once
) -> np.ndarray:
    """Draw the worst views: the mask, what other views predict, and in red where the two differ; (H, W, 3) uint8."""
    colors = palette(checks[0].counts.num_rows)

    def draw(check: ViewCheck) -> list[np.ndarray]:
        view = views[check.name]
        image, mask, predicted = shown_at(CELL_PX, images_of(view), view.read_labels(), check.prediction())
        different = ((mask != predicted) & (mask != UNKNOWN) & (predicted != UNKNOWN)).astype(np.int32)
        return [overlay(image, mask, colors), overlay(image, predicted, colors), overlay(image, different, _DIFFERENT)]

    captions, worst = [], worst_views(checks, count)
    for check in worst:
        trusted = f"{100 * check.reliability:.0f} % reliable" if check.checked else "unchecked"
        captions += [f"{check.name}: {trusted}", "what the other views say", "where they differ"]
    images = [image for row in several_at_once(draw, worst, device) for image in row]
    return contact_sheet(images, captions, 3)
