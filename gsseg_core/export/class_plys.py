"""A segmentation as files for others: one PLY per object, a report, pictures."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gsseg_core.data.dataset import View
from gsseg_core.export.pictures import contact_sheet, legend, overlay, palette, save_png
from gsseg_core.files.atomic import write_atomically
from gsseg_core.files.earlier_outputs import earlier_classes
from gsseg_core.files.run_folder import staged_run
from gsseg_core.raster.view_operator import ViewOperator, make_operator
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.ply import write_vertices
from gsseg_core.segmentation import Segmentation

_LONGEST_NAME = 255
"""Bytes that file systems take as the name of a file."""


def export_classes(
    scene: GaussianScene,
    segmentation: Segmentation,
    folder: str | os.PathLike[str],
) -> dict[int, Path]:
    """Write `<id>_<name>.ply` for every class that has Gaussians; valid 3DGS PLYs with all properties kept.

    Two properties are added: `label` (int), the class, and `confidence` (float), that of the segmentation.

    All PLYs of an earlier export are replaced in one step, as `gsseg_core.files.run_folder` says; other files stay.

    Raises
    ------
    PathTakenError
        The folder, or the name of a PLY, is taken by what is no earlier export; nothing was written.
    WriteError
        Something cannot be written; an earlier export is unchanged.
    """
    folder = Path(folder)
    with staged_run(folder, "classes", earlier=earlier_classes) as run:
        written = write_classes(scene, segmentation, run.folder, run.id)
    return {k: folder / path.name for k, path in written.items()}


def write_classes(scene: GaussianScene, segmentation: Segmentation, folder: Path, run: str) -> dict[int, Path]:
    """Write the PLYs of `export_classes` into a folder of a run with this id."""
    confidence, paths = segmentation.confidence, {}
    for k in np.flatnonzero(segmentation.counts()).tolist():
        members = segmentation.labels == k
        vertices = scene.vertices[members]
        paths[k] = folder / class_file_name(k, segmentation.class_names[k])
        write_vertices(paths[k], with_confidence(vertices, k, confidence[members]), run)
    return paths


def with_confidence(
    vertices: npt.NDArray[np.void],  # (M,)
    label: int,
    confidence: np.ndarray,  # (M,)
) -> npt.NDArray[np.void]:
    """Add the properties `label` (int32) and `confidence` (float32) to vertices; earlier ones are replaced."""
    kept = [name for name in vertices.dtype.names or () if name not in ("label", "confidence")]
    types = [(name, vertices.dtype[name]) for name in kept]
    out = np.empty(len(vertices), [*types, ("label", np.int32), ("confidence", np.float32)])
    for name in kept:
        out[name] = vertices[name]
    out["label"], out["confidence"] = label, confidence
    return out


def class_file_name(label: int, name: str) -> str:
    """File name of a class, safe on any file system."""
    return f"{label}_{re.sub(r'[^0-9A-Za-z._-]+', '_', name)[:100].strip('._') or 'class'}.ply"


def view_file_name(name: str, prefix: str = "") -> str:
    """File name of a picture of a view: `<prefix><name>.png`, or one near to it where no file can be named so."""
    safe = re.sub(r"[\x00-\x1f\x7f/\ud800-\udfff]", "_", name)
    room = _LONGEST_NAME - len(f"{prefix}.png")
    if safe != name or len(safe.encode()) > room:
        # What tells it from others that would be cut to the same.
        digest = hashlib.sha256(name.encode("utf-8", "surrogatepass")).hexdigest()[:8]
        safe = safe.encode()[: room - 9].decode(errors="ignore") + f"-{digest}"
    return f"{prefix}{safe}.png"


def segment_places(class_names: Mapping[int, str], views: Iterable[View]) -> list[str]:
    """Files that `gsseg segment` writes, as far as they are known before it learns; relative to its folder."""
    pictures = ["contact_sheet.png", "legend.png", "worst_views.png"]
    pictures += [view_file_name(view.name, "overlay_") for view in views]
    plys = [class_file_name(k, name) for k, name in class_names.items()]
    return [
        "segmentation.npz", "report.json", "report.html",
        *(f"classes/{name}" for name in plys), *(f"pictures/{name}" for name in pictures),
    ]  # fmt: skip


def write_json(path: str | os.PathLike[str], content: Mapping[str, Any]) -> None:
    """Write JSON atomically."""
    with write_atomically(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def background_image(scene: GaussianScene, operator: ViewOperator) -> np.ndarray:
    """Render the scene's colours from a view, (H, W, 3) uint8, on black."""
    image = operator.render(scene.colors(operator.camera.center))
    pixels: np.ndarray = np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)
    return pixels


class Drawn(NamedTuple):
    """A view of a segmentation, for people.

    Attributes
    ----------
    view : View
        Where from.
    labels : (H, W) int32
        Class of each pixel.
    overlay : (H, W, 3) uint8
        The scene, tinted by class.
    image : (H, W, 3) uint8
        The scene in its own colours.
    """

    view: View
    labels: np.ndarray
    overlay: np.ndarray
    image: np.ndarray


def draw_views(
    scene: GaussianScene, segmentation: Segmentation, views: Iterable[View], *, device: str = "cpu"
) -> Iterator[Drawn]:
    """Draw the labels of some views, and the scene under them."""
    colors = palette(segmentation.num_classes)
    for view in views:
        operator = make_operator(scene, view.camera, device)
        labels = segmentation.render(operator).labels
        image = background_image(scene, operator)
        yield Drawn(view, labels, overlay(image, labels, colors), image)


def write_pictures(
    segmentation: Segmentation, drawn: Iterable[Drawn], folder: str | os.PathLike[str], run: str | None = None
) -> list[Path]:
    """Write overlays of some views, as `draw_views` gives them, a contact sheet of them, and the legend.

    Parameters
    ----------
    run : str, optional
        Id of the run that they belong to.

    Returns
    -------
    list of pathlib.Path
        `overlay_<stem>.png` ..., `contact_sheet.png`, `legend.png`.
    """
    folder = Path(folder)
    images, captions, paths = [], [], []
    for one in drawn:
        images.append(one.overlay)
        captions.append(one.view.name)
        paths.append(folder / view_file_name(one.view.name, "overlay_"))
        save_png(paths[-1], one.overlay, run)
    return paths + write_overview(segmentation, images, captions, folder, run)


def write_overview(
    segmentation: Segmentation,
    images: Sequence[np.ndarray],
    captions: Sequence[str],
    folder: Path,
    run: str | None = None,
) -> list[Path]:
    """Write `contact_sheet.png` of some pictures, if there are any, and `legend.png`."""
    paths = []
    if images:
        paths.append(folder / "contact_sheet.png")
        save_png(paths[-1], contact_sheet(images, captions, min(4, len(images))), run)
    paths.append(folder / "legend.png")
    colors = palette(segmentation.num_classes)
    save_png(paths[-1], legend(segmentation.class_names, colors, segmentation.counts()), run)
    return paths
