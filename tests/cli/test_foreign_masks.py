"""`gsseg segment --labels` with masks of other programs: what comes out, and what is said of them."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import mask_writers
import numpy as np
import pytest
from segmented_place import assert_one_line, segment
from small_scenes import NAMES

from gsseg_core.cli.main import main
from gsseg_core.data.dataset import Dataset
from gsseg_core.data.label_images import read_mask, write_mask
from gsseg_core.errors import MaskFormatError


def masks_of(place: Path, writer: mask_writers.Writer, factor: int = 1) -> Path:
    """Write the masks of a place once more; what `--labels` is to name."""
    labels = {path.stem: read_mask(path).labels for path in sorted((place / "data/labels").iterdir())}
    large = {stem: np.repeat(np.repeat(image, factor, axis=0), factor, axis=1) for stem, image in labels.items()}
    (place / "masks").mkdir()
    return writer(place / "masks", large, NAMES)


def labels_of(place: Path) -> np.ndarray:
    with np.load(place / "out/segmentation.npz") as file:
        return np.array(file["labels"])


@pytest.mark.parametrize("name", ["COCO text", "CVAT masks", "YOLO"])
def test_masks_of_another_program_give_the_labels_of_the_same_label_images(
    place: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    expected = labels_of(place)
    masks = masks_of(place, mask_writers.WRITERS[name])
    assert main([*segment(place), "--labels", str(masks)]) == 0
    np.testing.assert_array_equal(labels_of(place), expected)
    assert f"masks: {name.split()[0]}, ids global, 6 views\n" in capsys.readouterr().out
    assert json.loads((place / "out/report.json").read_text())["masks"]["format"] == name.split()[0]


@pytest.mark.parametrize("name", ["COCO polygons", "LabelMe polygons", "ISAT", "Grounded SAM 2"])
def test_sizes_of_images_may_be_written_as_floats_but_not_with_a_fraction(place: Path, name: str) -> None:
    masks = masks_of(place, mask_writers.WRITERS[name])
    files = sorted(masks.glob("*.json")) if masks.is_dir() else [masks]
    for end in (".0", ".5"):
        for path in files:
            path.write_text(re.sub(r'(?i)((?:width|height)": \d+)(\.\d)?', rf"\g<1>{end}", path.read_text()))
        assert f": 64{end}" in files[0].read_text()
        if end == ".0":
            found = Dataset(place / "data", masks).views()[0].read_labels()
            np.testing.assert_array_equal(found > 0, read_mask(place / "data/labels/view0.png").labels > 0)
    with pytest.raises(MaskFormatError, match=r"is (64|48)\.5; expected a whole number of pixels"):
        Dataset(place / "data", masks)


def test_automatic_masks_are_taken_with_ids_of_their_own_view_and_that_is_said(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    masks = masks_of(place, mask_writers.sam_json, factor=2)
    assert main([*segment(place), "--labels", str(masks)]) == 0
    said = "masks: SAM JSON, ids per-view, 6 views; scaled by nearest pixel, 128 x 96 to 64 x 48 pixels\n"
    assert said in capsys.readouterr().out
    report = json.loads((place / "out/report.json").read_text())
    assert report["settings"]["ids"] == "per-view" and report["ids"]["objects"] == 3


@pytest.mark.parametrize(
    ("extra", "said"),
    [
        (("--ids", "global"), "ids are to be global; expected per-view, as SAM JSON has them"),
        (("--label-map", "map.json"), "a label map was given for masks of SAM JSON"),
    ],
)
def test_what_automatic_masks_cannot_do_is_refused(
    place: Path, extra: tuple[str, str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    masks = masks_of(place, mask_writers.sam_json)
    assert main([*segment(place), "--labels", str(masks), *extra]) == 2
    assert_one_line(capsys.readouterr().err, said)


def test_a_label_map_names_the_objects_that_are_written(place: Path) -> None:
    (place / "map.json").write_text('{"red ball": "ball", "cup/mug": "ball", "background": "background", "*": null}')
    assert main([*segment(place), "--label-map", f"{place}/map.json"]) == 0
    report = json.loads((place / "out/report.json").read_text())
    assert [(entry["id"], entry["name"]) for entry in report["classes"]] == [(0, "background"), (1, "ball")]
    assert report["settings"]["label_map"] == f"{place}/map.json"


def test_masks_that_lie_where_the_command_is_typed_are_found(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    masks_of(place, mask_writers.coco_runs)
    monkeypatch.chdir(place)
    assert main([*segment(place), "--labels", "masks/annotations.json"]) == 0
    assert "masks" in json.loads((place / "out/report.json").read_text())


@pytest.mark.parametrize(("suffix", "content"), [(".json", "{}"), (".txt", "-1 .1 .1 .9 .1 .9 .9")])
def test_a_folder_of_unknown_files_is_refused_with_what_is_read(
    place: Path, capsys: pytest.CaptureFixture[str], suffix: str, content: str
) -> None:
    (place / "data/strange").mkdir()
    for view in range(6):
        (place / f"data/strange/view{view}{suffix}").write_text(content)
    assert main([*segment(place), "--labels", "strange"]) == 2
    said = f"strange/view0{suffix}: is not a file of masks in a known format; gsseg reads label"
    assert_one_line(capsys.readouterr().err, said)


@pytest.mark.parametrize("name", ["COCO polygons", "LabelMe masks", "SAM 2 video"])
def test_an_object_is_picked_by_the_mask_of_another_program(place: Path, name: str) -> None:
    masks = masks_of(place, mask_writers.WRITERS[name])
    mask = masks / "view0.json" if name.startswith("LabelMe") else masks
    data = place / "data"
    start = ["pick", str(data / "scene.ply"), "--data", str(data), "--view", "view0", "--quiet"]
    label = "1" if name in mask_writers.NAMELESS else NAMES[1]
    for out, given, wanted in (("own", data / "labels/view0.png", NAMES[1]), ("other", mask, label)):
        assert main([*start, "--mask", str(given), "--label", wanted, "--out", str(place / out)]) == 0
    own, other = (np.load(place / out / "pick.npz")["ids"] for out in ("own", "other"))
    assert len(own) and np.array_equal(own, other)


@pytest.mark.parametrize("name", ["COCO text", "YOLO", "EISeg images"])
def test_scores_by_the_truth_of_another_program_are_those_of_the_same_label_images(
    place: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    data, predicted = place / "data", place / "predicted"
    shutil.copytree(data / "labels", predicted)
    write_mask(predicted / "view1.png", np.roll(read_mask(predicted / "view1.png").labels, 3, axis=1), 8)
    truth = masks_of(place, mask_writers.WRITERS[name])
    for json_file, path in (("own.json", data / "labels"), ("other.json", truth)):
        assert main(["eval", "--pred", str(predicted), "--truth", str(path), "--json", str(place / json_file)]) == 0
    own, other = (json.loads((place / file).read_text()) for file in ("own.json", "other.json"))
    assert own["mean_iou"] < 1 and own == other
    write_mask(predicted / "no_view.png", np.zeros((96, 128), np.int32), 8)
    capsys.readouterr()
    assert main(["eval", "--pred", str(predicted), "--truth", str(truth)]) == 2
    assert_one_line(capsys.readouterr().err, "no_view.png: has no true mask among those of")


def test_scores_by_ids_that_hold_in_one_view_only_are_refused(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth = masks_of(place, mask_writers.sam_json)
    assert main(["eval", "--pred", str(place / "data/labels"), "--truth", str(truth)]) == 2
    assert_one_line(capsys.readouterr().err, "is of SAM JSON, whose ids hold in their own view only")
