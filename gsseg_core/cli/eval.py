"""The command `gsseg eval`."""

from __future__ import annotations

import argparse
import os
from contextlib import suppress
from pathlib import Path

from gsseg_core.cli.terminal import note, tell

DESCRIPTION = """
Scores predicted label maps against true ones with the same names: IoU, accuracy and boundary IoU of each class, and
their means over the classes that occur. Pixels whose truth is unknown do not count. If the cameras beside the truth
have lens distortion, the truth is undistorted first, because rendered label maps are pinhole views.
"""
EXAMPLES = """
  gsseg eval --pred rendered --truth DATASET/labels
  gsseg eval --pred rendered --truth DATASET/annotations.json --json scores.json
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what the command takes."""
    parser.add_argument("--pred", required=True, metavar="DIR", help="folder of predicted label maps <stem>.png")
    truth = "folder of true label maps <stem>.png, or true masks of another program, such as COCO"
    parser.add_argument("--truth", required=True, metavar="PATH", help=truth)
    parser.add_argument("--json", metavar="FILE", help="also write the scores to this file")


def run(options: argparse.Namespace) -> int:
    """Score, and print a table."""
    from gsseg_core.data.camera_files import find_cameras, read_cameras
    from gsseg_core.data.class_names import read_classes
    from gsseg_core.data.mask_formats.place import Place
    from gsseg_core.data.mask_formats.table import open_masks
    from gsseg_core.errors import ClassesFileError, SettingsError
    from gsseg_core.files.atomic import check_replaceable, check_writable
    from gsseg_core.files.input_files import is_there
    from gsseg_core.files.json_files import write_json
    from gsseg_core.metrics import evaluate_folders, evaluate_masks, predicted_maps
    from gsseg_core.text import evaluation_summary

    if options.json:
        check_writable(options.json)
        check_replaceable(Path(options.json), "file of scores", _holds_scores(Path(options.json)))
    root = Path(os.path.abspath(options.truth)).parent  # The folder may be called "." or end in "..".
    classes = root / "classes.json"
    names = read_classes(classes) if is_there(classes, ClassesFileError) else None
    cameras = read_cameras(root) if find_cameras(root) else []
    images = [camera.image for camera in cameras] or [path.stem for path in predicted_maps(options.pred)]
    masks = open_masks(Place(Path(options.truth), frozenset(images)))
    if masks is None:
        evaluation = evaluate_folders(options.pred, options.truth, cameras)
    elif masks.per_view:
        raise SettingsError(
            f"{options.truth}: is of {masks.format}, whose ids hold in their own view only; expected true masks with "
            "ids that mean the same in every view"
        )
    else:
        evaluation = evaluate_masks(options.pred, masks, cameras)
    scores = evaluation.as_dict((masks and masks.class_names) or names)
    if options.json:
        write_json(options.json, scores)
    if others := evaluation.other_ids:
        listed = ", ".join(f"{k} is {found}" for k, found in list(others.items())[:3])
        note(
            f"most true objects have another id in {options.pred} (true {listed}): ids are compared as they are; "
            "objects that were found, as by --ids per-view, have numbers of their own, and no score here"
        )
    tell(evaluation_summary(scores))
    return 0


def _holds_scores(path: Path) -> bool:
    """Whether a file holds scores, is empty, or does not exist, as behind a link that leads nowhere."""
    from gsseg_core.errors import GssegError
    from gsseg_core.files.json_files import read_object

    with suppress(GssegError):
        return not (path.exists() and path.stat().st_size) or "mean_iou" in read_object(path, GssegError, "scores")
    return False
