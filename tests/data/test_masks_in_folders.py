"""Masks in folders as their images are, `left/1.json` of `left/1.jpg`, of every format with a file per image."""

from __future__ import annotations

import json
from pathlib import Path

import mask_writers
import numpy as np
import pytest
from mask_writers import PER_VIEW_WRITERS, WRITERS
from PIL import Image

from gsseg_core.data.dataset import Dataset
from gsseg_core.data.hints import mask_hint
from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.errors import MaskFormatError

NAMES = {0: "background", 1: "chair", 2: "tür", 3: "wall"}
SIZE = (18, 24)
LABELS = {f"{side}_1": np.repeat(np.arange(4) % (3 + i), 108).reshape(SIZE) for i, side in enumerate(("left", "right"))}


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    """Cameras of `left/1.jpg` and `right/1.jpg`, and an empty folder for masks."""
    camera = {
        "width": SIZE[1],
        "height": SIZE[0],
        "position": [0, 0, 0],
        "rotation": np.eye(3).tolist(),
        "fx": 20,
        "fy": 20,
    }
    cameras = [camera | {"img_name": f"{side}/1.jpg"} for side in ("left", "right")]
    (tmp_path / "cameras.json").write_text(json.dumps(cameras))
    (tmp_path / "masks").mkdir()
    return tmp_path


def in_folders(masks: Path) -> None:
    """Move `left_1.json` to `left/1.json`, and so on."""
    for path in list(masks.glob("*_1.*")):
        side, _, name = path.name.partition("_")
        (masks / side).mkdir(exist_ok=True)
        path.rename(masks / side / name)


@pytest.mark.parametrize(
    "name", ["LabelMe polygons", "ISAT", "YOLO", "Grounded SAM 2", "SAM JSON", "EISeg images", "EISeg polygons"]
)
def test_masks_in_folders_as_their_images_are_found(rig: Path, name: str) -> None:
    masks = (WRITERS | PER_VIEW_WRITERS)[name](rig / "masks", LABELS, NAMES)
    in_folders(masks)
    dataset = Dataset(rig, masks)
    for view in dataset.views():
        outside = UNKNOWN if dataset.masks and dataset.masks.per_view else 0
        expected = np.where(LABELS[view.name] == 0, outside, LABELS[view.name])
        np.testing.assert_array_equal(view.read_labels(), expected)


def test_label_images_in_folders_stay_what_they_are_beside_other_json_files(rig: Path) -> None:
    mask_writers.object_masks(rig / "masks", LABELS, NAMES)
    in_folders(rig / "masks")
    (rig / "masks/left/1.json").write_text('{"exposure": 3}')
    for view in Dataset(rig, "masks").views():
        np.testing.assert_array_equal(view.read_labels(), LABELS[view.name])


def test_masks_of_two_formats_in_folders_are_refused(rig: Path) -> None:
    for writer in (mask_writers.object_masks, mask_writers.labelme):
        writer(rig / "masks", LABELS, NAMES)
    in_folders(rig / "masks")
    with pytest.raises(MaskFormatError, match="may be masks of LabelMe or label images"):
        Dataset(rig, "masks")


def test_masks_in_folders_of_another_name_are_told_of(rig: Path) -> None:
    mask_writers.labelme(rig / "masks", LABELS, NAMES)
    in_folders(rig / "masks")
    assert "found 2 masks of these names in masks/: type --labels masks" in mask_hint(rig, "labels", [*LABELS])


def test_a_file_for_all_views_goes_before_files_in_folders(rig: Path) -> None:
    mask_writers.labelme(rig / "masks", LABELS, NAMES)
    in_folders(rig / "masks")
    mask_writers.cvat(rig / "masks", LABELS, NAMES)
    dataset = Dataset(rig, "masks")
    assert dataset.masks is not None and dataset.masks.format == "CVAT"


def test_photos_in_folders_beside_their_annotations_are_no_masks(rig: Path) -> None:
    mask_writers.labelme(rig / "masks", LABELS, NAMES)
    in_folders(rig / "masks")
    for side in ("left", "right"):
        Image.fromarray(np.zeros((*SIZE, 3), np.uint8)).save(rig / f"masks/{side}/1.png")
    dataset = Dataset(rig, "masks")
    assert dataset.masks is not None and dataset.masks.format == "LabelMe"
