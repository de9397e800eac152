"""Object benchmarks of the field in their published layouts: NVOS, SPIn-NeRF and LERF-Mask.

Each gives `Task`s: one object, how it is shown, and its true masks in some views. What is certain of the layouts and
what is not, and how scores are made of the tasks, stands in docs/evaluation.md.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.data.view import View
from gsseg_core.errors import CameraFileError, MaskFormatError, MaskSizeError
from gsseg_core.files.input_files import open_image
from gsseg_core.metrics import Evaluation
from gsseg_core.scene.camera import Camera, resized_camera

ASPECT_TOLERANCE = 0.01
"""How far the aspect ratio of a mask may be from its camera's, as a share: sizes are rounded when images are halved."""


@dataclass(frozen=True, eq=False)
class Task:
    """One object to be found.

    Attributes
    ----------
    name : str
        Of the scene, or the text prompt.
    reference : View or None
        What is given: labels 1 (object), 0 (not it), -1 (nothing said). None where the prompt is a text.
    targets : list of View
        Where it is scored: labels 1 and 0.
    """

    name: str
    reference: View | None
    targets: list[View]


class Scores(NamedTuple):
    """How well an object was found; each the mean over the target views of what one view gives.

    Attributes
    ----------
    iou : float
        Intersection over union of predicted and true pixels.
    accuracy : float
        Share of all pixels, of the object or not, that are right.
    boundary_iou : float
        IoU of the boundary bands, 2 % of the image diagonal wide.
    pooled_iou : float
        Intersection and union summed over the views, and then divided.
    views : int
        How many target views there are.
    """

    iou: float
    accuracy: float
    boundary_iou: float
    pooled_iou: float
    views: int


def nvos(root: str | os.PathLike[str], scene: str, cameras: Sequence[Camera]) -> Task:
    """Read a scene of NVOS (Ren et al. 2022): scribbles in one view, the true mask of another.

    Parameters
    ----------
    root : path
        Holds `reference_image/<scene>/<stem>.*`, `scribbles/<scene>/*pos*.png` and `*neg*.png`, and
        `masks/<scene>/<stem>_mask.png`.
    scene : str
        Such as "fern" or "horns_center".
    cameras : sequence of Camera
        Of the LLFF scene, named by their images.

    Raises
    ------
    MaskFormatError
        A file is missing, or there are several in its place.
    MaskSizeError
        A mask has another shape than its camera.
    CameraFileError
        No camera has the name of the image.
    """
    root = Path(root)
    image = _only(root / "reference_image" / scene, "*.*", "the reference image")
    positive, negative = (
        _only(root / "scribbles" / scene, f"*{tag}*.png", f"scribbles ({tag})") for tag in ("pos", "neg")
    )
    mine, not_mine = _read_binary(positive), _read_binary(negative)
    if mine.shape != not_mine.shape:
        raise MaskSizeError(f"{negative}: has shape {not_mine.shape}; expected {mine.shape}, that of {positive}")
    # A pixel in both is no evidence for either.
    labels = np.where(mine == not_mine, UNKNOWN, mine).astype(np.int32)
    mask = _only(root / "masks" / scene, "*_mask.png", "the true mask")
    target = _view(mask, _read_binary(mask), mask.stem.removesuffix("_mask"), cameras)
    return Task(scene, _view(positive, labels, image.stem, cameras), [target])


def spin_nerf(folder: str | os.PathLike[str], cameras: Sequence[Camera]) -> Task:
    """Read a scene of SPIn-NeRF's multiview segmentation (Mirzaei et al. 2023): the object's mask in many views.

    The first mask, by name, is given, and all are scored, that one too.

    Parameters
    ----------
    folder : path
        Masks `<name>.png`; `<name>_cutout.png`, `<name>_pseudo.png` and JSON files are passed over. A mask belongs to
        the camera with its stem, or with the stem that `pairs.json` ({mask stem: image stem}) names. If no stem is a
        camera's and there are as many of each, both are paired in the order of their names.
    cameras : sequence of Camera
        Of the scene.

    Raises
    ------
    MaskFormatError, MaskSizeError, CameraFileError
        There is no mask, a mask has another shape than its camera, or masks and cameras cannot be paired.
    """
    folder = Path(folder)
    aside = ("_cutout", "_pseudo")
    masks = [path for path in sorted(folder.glob("*.png")) if not path.stem.endswith(aside)]
    if not masks:
        raise MaskFormatError(f"{folder}: found no masks; expected <name>.png")
    named = dict(zip((mask.stem for mask in masks), _image_stems(folder, masks, cameras), strict=True))
    targets = [_view(mask, _read_binary(mask), named[mask.stem], cameras) for mask in masks]
    return Task(folder.name, targets[0], targets)


def lerf_mask(folder: str | os.PathLike[str], cameras: Sequence[Camera]) -> list[Task]:
    """Read a scene of LERF-Mask (Ye et al. 2024, Gaussian Grouping): true masks of text prompts in test views.

    Parameters
    ----------
    folder : path
        Holds `test_mask/<view>/<prompt>.png`, and `images/` and `images_train/`, the former with the test views
        besides. A view is called by the stem of its image or by its number, from 0, among the test views in the order
        of their names.
    cameras : sequence of Camera
        Of all images.

    Returns
    -------
    list of Task
        One for each prompt, without a reference.

    Raises
    ------
    MaskFormatError, MaskSizeError, CameraFileError
        There is no mask, a mask has another shape than its camera, or there is no such view.
    """
    folder = Path(folder)
    train = {path.stem for path in (folder / "images_train").glob("*")}
    tests = sorted(camera.name for camera in cameras if camera.name not in train)
    targets: dict[str, list[View]] = {}
    for mask in sorted((folder / "test_mask").glob("*/*.png")):
        stem = mask.parent.name
        if stem not in {camera.name for camera in cameras} and stem.isdecimal() and int(stem) < len(tests):
            stem = tests[int(stem)]
        targets.setdefault(mask.stem, []).append(_view(mask, _read_binary(mask), stem, cameras))
    if not targets:
        raise MaskFormatError(f"{folder / 'test_mask'}: found no masks; expected <view>/<prompt>.png")
    return [Task(prompt, None, views) for prompt, views in targets.items()]


def score_task(task: Task, predict: Callable[[Camera], np.ndarray]) -> Scores:
    """Score the masks (H, W) bool that are predicted for the cameras of the target views."""
    ious, accuracies, boundaries, pooled = [], [], [], Evaluation()
    for view in task.targets:
        truth, prediction = view.read_labels(), predict(view.camera).astype(np.int32)
        single = Evaluation()
        single.add(truth, prediction, view.name)
        pooled.add(truth, prediction, view.name)
        confusion = single.confusion
        accuracies.append(np.trace(confusion) / confusion.sum())
        # Where the object is in neither, all is right.
        absent = len(single.iou) < 2 or np.isnan(single.iou[1])
        ious.append(1.0 if absent else single.iou[1])
        boundaries.append(1.0 if absent else single.boundary_iou[1])
    total = pooled.iou[1] if len(pooled.iou) > 1 else 1.0
    iou, accuracy, boundary = (float(np.mean(values)) for values in (ious, accuracies, boundaries))
    return Scores(iou, accuracy, boundary, float(total), len(task.targets))


def resized(camera: Camera, width: int, height: int) -> Camera:
    """Give a camera another image size, so that it sees the same in more or fewer pixels.

    Raises
    ------
    MaskSizeError
        The shape differs by more than `ASPECT_TOLERANCE`.
    """
    across, down = width / camera.width, height / camera.height
    if abs(across / down - 1) > ASPECT_TOLERANCE:
        raise MaskSizeError(
            f"camera '{camera.name}': mask is {width} x {height} pixels; expected the shape of its image, "
            f"{camera.width} x {camera.height}"
        )
    return resized_camera(camera, width, height)


def _image_stems(folder: Path, masks: Sequence[Path], cameras: Sequence[Camera]) -> list[str]:
    pairs = folder / "pairs.json"
    given = json.loads(pairs.read_text(encoding="utf-8")) if pairs.is_file() else {}
    stems, names = [given.get(mask.stem, mask.stem) for mask in masks], sorted(camera.name for camera in cameras)
    if not set(stems) & set(names) and len(stems) == len(names):
        return names
    strangers = sorted(set(stems) - set(names))
    if strangers:
        raise CameraFileError(
            f"{folder}: {len(strangers)} of {len(stems)} masks have no camera of their name, the first "
            f"{strangers[0]!r}, and there are {len(names)} cameras; expected a pairs.json with "
            f'{{"{strangers[0]}": "{names[0] if names else "image stem"}", ...}}'
        )
    return stems


def _view(path: Path, labels: np.ndarray, stem: str, cameras: Sequence[Camera]) -> View:
    found = [camera for camera in cameras if camera.name == stem]
    if not found:
        some = min((camera.name for camera in cameras), default="none")
        raise CameraFileError(f"{path}: there is no camera {stem!r}; expected an image stem such as {some!r}")
    return View.from_arrays(resized(found[0], labels.shape[1], labels.shape[0]), labels)


def _only(folder: Path, pattern: str, what: str) -> Path:
    paths = sorted(folder.glob(pattern))
    if len(paths) != 1:
        raise MaskFormatError(f"{folder}: found {len(paths)} files {pattern}; expected one, {what}")
    return paths[0]


def _read_binary(path: Path) -> np.ndarray:
    """Read an image of two values, of any kind: 1 where it is brighter than half of the largest, (H, W) int32."""
    with open_image(path, MaskFormatError, "image", "a black and white image") as image:
        values = np.asarray(image.convert("L"), np.int32)
    mine: np.ndarray = 2 * values > max(int(values.max(initial=0)), 1)
    return mine.astype(np.int32)
