"""Masks of SAM's automatic generator: what is on top, what lies in what, and what is known of the rest of an image."""

from __future__ import annotations

import json
from pathlib import Path

import mask_writers
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis.extra.numpy import arrays
from mask_writers import PER_VIEW_WRITERS, Writer
from PIL import Image
from test_mask_formats import HEIGHT, STEMS, WIDTH, written

from gsseg_core.data.dataset import Dataset
from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.data.mask_formats.shapes import Bitmap, Runs, Shape, paint, paint_nested
from gsseg_core.data.soft_masks import SeenLabels
from gsseg_core.errors import MaskFormatError


def automatic(root: Path, writer: Writer, *masks: np.ndarray) -> SeenLabels:
    """What a view's automatic masks say."""
    place = root / written(root, writer)
    if (place / "frame_001.json").exists():
        regions = [{"size": [HEIGHT, WIDTH], "counts": mask_writers.runs(mask)} for mask in masks]
        (place / "frame_001.json").write_text(json.dumps([{"segmentation": r, "predicted_iou": 1} for r in regions]))
    else:
        rows = [f"{i},{mask.sum()}{',0' * 12}" for i, mask in enumerate(masks)]
        (place / "frame_001/metadata.csv").write_text("\n".join([mask_writers.AMG_HEADER, *rows]))
        for i, mask in enumerate(masks):
            Image.fromarray(np.uint8(255 * mask)).save(place / f"frame_001/{i}.png")
    return Dataset(root, place).views()[0].read_seen()


def box(top: int, left: int, bottom: int, right: int) -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[top:bottom, left:right] = True
    return mask


@pytest.mark.parametrize("writer", PER_VIEW_WRITERS.values())
def test_of_automatic_masks_the_smaller_one_is_on_top_whatever_their_order(tmp_path: Path, writer: Writer) -> None:
    labels = automatic(tmp_path, writer, box(0, 0, 3, 3), box(0, 0, 6, 6)).labels
    assert (labels == 1).sum() == 9 and (labels == 2).sum() == 27


@pytest.mark.parametrize("writer", PER_VIEW_WRITERS.values())
@pytest.mark.parametrize(("right", "outside"), [(12, 0), (13, UNKNOWN)])
def test_what_automatic_masks_leave_out_is_background_unless_they_cover_most_of_most_images(
    tmp_path: Path, writer: Writer, right: int, outside: int
) -> None:
    place = tmp_path / written(tmp_path, writer, {stem: np.uint8(box(0, 0, HEIGHT, right)) for stem in STEMS})
    *others, last = Dataset(tmp_path, place).views()
    file = place / "frame_003.json"  # What is broken is told to who reads it, and nobody else.
    (file if file.exists() else place / "frame_003/0.png").write_text("[{")
    for view in others:
        assert (view.read_labels()[:, :right] == 1).all() and (view.read_labels()[:, right:] == outside).all()
    with pytest.raises(MaskFormatError):
        last.read_labels()


@pytest.mark.parametrize("writer", PER_VIEW_WRITERS.values())
def test_of_automatic_masks_each_knows_the_outermost_that_it_is_a_part_of(tmp_path: Path, writer: Writer) -> None:
    spot, ear, beside, whole = box(2, 2, 4, 4), box(1, 1, 5, 6), box(0, 8, 4, 12), box(0, 0, 10, 10)
    found = automatic(tmp_path, writer, spot, whole, ear, beside).outermost
    assert found is not None  # Half of the fourth lies beside the whole.
    assert found[1:].tolist() == [2, 2, 2, 4]


@pytest.mark.parametrize("inside", [8, 9])
def test_nine_tenths_of_a_part_lie_in_its_whole(tmp_path: Path, inside: int) -> None:
    part, whole = box(0, 10 - inside, 2, 20 - inside), box(0, 0, 18, 10)
    found = automatic(tmp_path, mask_writers.sam_json, whole, part).outermost
    assert found is not None and found[2] == (1 if inside == 9 else 2)


def test_an_image_in_which_automatic_masks_found_nothing_is_all_background(tmp_path: Path) -> None:
    place = tmp_path / written(tmp_path, mask_writers.sam_json)
    (place / "frame_001.json").write_text("[]")  # the first, by which a format is recognised
    first, second, _ = Dataset(tmp_path, place).views()
    assert not first.read_labels().any() and second.read_labels().any()


def test_automatic_masks_that_found_nothing_in_any_image_are_said_to_have(tmp_path: Path) -> None:
    place = tmp_path / written(tmp_path, mask_writers.sam_json)
    for path in place.iterdir():
        path.write_text("[]")
    with pytest.raises(MaskFormatError, match="but an empty list, and so are those of the other views: nothing was fo"):
        Dataset(tmp_path, place)


def test_a_file_of_more_masks_than_there_are_labels_is_not_painted_for_other_views(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    everything = {stem: np.ones((HEIGHT, WIDTH), np.uint8) for stem in STEMS}
    place = tmp_path / written(tmp_path, mask_writers.sam_json, everything)
    file = place / "frame_003.json"
    file.write_text(json.dumps(json.loads(file.read_text()) * 10))
    painted, parts = [], Runs.parts
    monkeypatch.setattr("gsseg_core.data.mask_formats.shapes.MAX_LABEL", 9)
    monkeypatch.setattr(Runs, "parts", lambda runs, *size: painted.append(runs) or parts(runs, *size))
    first, *_, last = Dataset(tmp_path, place).views()
    assert first.read_labels().all() and len(painted) <= 3  # the two files that can be read, and the first once more
    with pytest.raises(MaskFormatError, match=r"frame_003\.json: has 10 shapes; expected at most 9"):
        last.read_labels()


@given(arrays(bool, (6, HEIGHT, WIDTH)))
@settings(max_examples=50, deadline=None)
def test_nested_shapes_are_painted_as_others_are(inside: np.ndarray) -> None:
    shapes = [Shape(label, Bitmap(0, 0, mask)) for label, mask in enumerate(inside, 1)]
    np.testing.assert_array_equal(paint_nested(shapes, WIDTH, HEIGHT).labels, paint(shapes, WIDTH, HEIGHT))
