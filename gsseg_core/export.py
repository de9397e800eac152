"""A segmentation as files for others: one PLY per object, a report, pictures."""

from __future__ import annotations

import json
import os
import re
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gsseg_core.atomic import write_atomically
from gsseg_core.dataset import View
from gsseg_core.errors import WriteError
from gsseg_core.operator import ViewOperator, make_operator
from gsseg_core.pictures import contact_sheet, legend, overlay, palette, save_png
from gsseg_core.ply import write_vertices
from gsseg_core.scene import GaussianScene
from gsseg_core.segmentation import Segmentation


def export_classes(
    scene: GaussianScene,
    segmentation: Segmentation,
    folder: str | os.PathLike[str],
) -> dict[int, Path]:
    """Write `<id>_<name>.ply` for every class that has Gaussians; valid 3DGS PLYs with all properties kept.

    Two properties are added: `label` (int), the class, and `confidence` (float), that of the segmentation.

    The folder is replaced as a whole, at the end: it never mixes two segmentations.

    Raises
    ------
    WriteError
        Something cannot be written, or the folder holds files that are no export; an earlier folder is unchanged.
    """
    folder = Path(folder)
    _check_replaceable(folder)
    names = {k: class_file_name(k, segmentation.class_names[k]) for k in np.flatnonzero(segmentation.counts()).tolist()}
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=".gsseg-", dir=folder.parent))
    except OSError as error:
        raise WriteError(f"{folder}: cannot be written ({error.strerror or error})") from error
    confidence = segmentation.confidence
    try:
        (work / "new").mkdir()
        for k, name in names.items():
            members = segmentation.labels == k
            vertices = scene.vertices[members]
            write_vertices(work / "new" / name, with_confidence(vertices, k, confidence[members]))
        if folder.exists():
            folder.rename(work / "old")
        (work / "new").rename(folder)
    except OSError as error:
        raise WriteError(f"{folder}: cannot be written ({error.strerror or error})") from error
    finally:
        if (work / "old").exists() and not folder.exists():
            (work / "old").rename(folder)
        shutil.rmtree(work, ignore_errors=True)
    return {k: folder / name for k, name in names.items()}


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


def _check_replaceable(folder: Path) -> None:
    if not folder.exists():
        return
    if not folder.is_dir():
        raise WriteError(f"{folder}: is a file; expected a folder, or nothing")
    names = sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))
    strangers = [name for name in names if not re.fullmatch(r"[0-9]+_.+\.ply", name)]
    if strangers:
        raise WriteError(
            f"{folder}: holds {strangers[0]!r}, which is no earlier export; expected a folder that can be replaced"
        )


def class_file_name(label: int, name: str) -> str:
    """File name of a class, safe on any file system."""
    return f"{label}_{re.sub(r'[^0-9A-Za-z._-]+', '_', name)[:100].strip('._') or 'class'}.ply"


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


def write_pictures(segmentation: Segmentation, drawn: Iterable[Drawn], folder: str | os.PathLike[str]) -> list[Path]:
    """Write overlays of some views, as `draw_views` gives them, a contact sheet of them, and the legend.

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
        paths.append(folder / f"overlay_{one.view.name}.png")
        save_png(paths[-1], one.overlay)
    paths += write_overview(segmentation, images, captions, folder)
    # Overlays of views that an earlier run drew would show another segmentation.
    for stale in set(folder.glob("overlay_*.png")) - set(paths):
        stale.unlink(missing_ok=True)
    return paths


def write_overview(
    segmentation: Segmentation, images: Sequence[np.ndarray], captions: Sequence[str], folder: Path
) -> list[Path]:
    """Write `contact_sheet.png` of some pictures, if there are any, and `legend.png`."""
    paths = []
    if images:
        paths.append(folder / "contact_sheet.png")
        save_png(paths[-1], contact_sheet(images, captions, min(4, len(images))))
    paths.append(folder / "legend.png")
    colors = palette(segmentation.num_classes)
    save_png(paths[-1], legend(segmentation.class_names, colors, segmentation.counts()))
    return paths
