"""Ids with gaps: what is learnt, written and shown is the same as without, and a large id costs no memory."""

from __future__ import annotations

import json
import resource
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import plyfile
import pytest
from PIL import Image
from small_scenes import NAMES, NUM_CLASSES, balls_on_a_table, ring, write_dataset

from gsseg_core import pipeline
from gsseg_core.cli.main import main
from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.dataset import Dataset
from gsseg_core.data.label_images import UNKNOWN, read_mask, write_mask
from gsseg_core.errors import UnknownLabelError
from gsseg_core.export.pictures import legend, palette
from gsseg_core.learn.registry import make_learner
from gsseg_core.raster.backends import make_operator
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import REMOVED, Segmentation
from gsseg_core.viewer.model import Labelling, ViewModel, completed

IDS = np.array([0, 1, 700, 65534], np.int32)
SCENE, TRUTH = balls_on_a_table()


def with_gaps(folder: Path, names: bool = True) -> Path:
    """The usual dataset, the ids of its classes far apart."""
    write_dataset(folder)
    for path in (folder / "labels").glob("*.png"):
        write_mask(path, IDS[read_mask(path).labels], 16)
    if names:
        (folder / "classes.json").write_text(json.dumps({str(IDS[k]): NAMES[k] for k in (1, 2, 3)}))
    else:
        (folder / "classes.json").unlink()
    return folder


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same dataset segmented with ids from 0 to 3, with ids that have gaps, and with those without names."""
    root = tmp_path_factory.mktemp("runs")
    write_dataset(root / "dense")
    with_gaps(root / "gaps")
    with_gaps(root / "nameless", names=False)
    for name in ("dense", "gaps", "nameless"):
        pipeline.segment(root / name / "scene.ply", root / name, root / name / "out", learner="em")
    return root


def test_a_run_with_gaps_gives_the_users_ids_and_is_otherwise_that_without(runs: Path) -> None:
    with np.load(runs / "dense/out/segmentation.npz") as dense:
        expected = dict(dense)
    assert expected["class_ids"].tolist() == [0, 1, 2, 3]
    for name in ("gaps", "nameless"):
        with np.load(runs / name / "out/segmentation.npz") as file:
            assert file["class_ids"].tolist() == IDS.tolist()
            labels = expected["labels"]
            np.testing.assert_array_equal(file["labels"], np.where(labels >= 0, IDS[labels], labels))
            for array in ("probabilities", "confidence", "clustered", "learnt"):
                np.testing.assert_array_equal(file[array], expected[array])
    plys = {path.name: path for path in (runs / "gaps/out/classes").iterdir()}
    assert set(plys) == {"0_background.ply", "1_red_ball.ply", "700_cup_mug.ply", "65534_box.ply"}
    assert set(plyfile.PlyData.read(str(plys["65534_box.ply"]))["vertex"]["label"]) == {65534}


def test_the_report_has_the_users_ids_and_the_same_figures(runs: Path) -> None:
    dense, gaps = (json.loads((runs / name / "out/report.json").read_text()) for name in ("dense", "gaps"))
    assert [entry["id"] for entry in gaps["classes"]] == IDS.tolist()
    for one, other in zip(dense["classes"], gaps["classes"], strict=True):
        assert {**one, "id": 0, "ply": ""} == {**other, "id": 0, "ply": ""}
    assert gaps["views"]["reliability"] == dense["views"]["reliability"]
    assert "<small>65534</small>" in (runs / "gaps/out/report.html").read_text()


def test_rendered_masks_hold_the_users_ids(runs: Path) -> None:
    for name in ("dense", "gaps"):
        folder = runs / name
        pipeline.render(folder / "scene.ply", folder, folder / "out/segmentation.npz", folder / "rendered", split="all")
    for path in (runs / "gaps/rendered").glob("*.png"):
        dense, gaps = read_mask(runs / "dense/rendered" / path.name), read_mask(path)
        np.testing.assert_array_equal(gaps.labels, IDS[dense.labels])
        assert (dense.bits, gaps.bits) == (8, 16)
        overlays = [Image.open(runs / name / "rendered/overlays" / path.name) for name in ("dense", "gaps")]
        np.testing.assert_array_equal(*overlays)


def test_legends_show_the_users_ids_beside_the_same_colours(runs: Path) -> None:
    result = Segmentation.load(runs / "dense/out/segmentation.npz", SCENE)
    folder = runs / "gaps"
    pipeline.render(folder / "scene.ply", folder, folder / "out/segmentation.npz", folder / "drawn", split="all")
    expected = legend(result.class_names, palette(NUM_CLASSES), result.counts(), IDS.tolist())
    for path in (folder / "out/pictures/legend.png", folder / "drawn/overlays/legend.png"):
        with Image.open(path) as image:
            np.testing.assert_array_equal(np.asarray(image), expected)


def test_a_loaded_segmentation_speaks_of_the_users_ids(runs: Path) -> None:
    dense, gaps = (Segmentation.load(runs / name / "out/segmentation.npz", SCENE) for name in ("dense", "gaps"))
    assert gaps.class_ids.tolist() == IDS.tolist() and gaps.class_names[65534] == "box"
    assert gaps.num_classes == 65535 and gaps.probabilities.shape[1] == 4
    operator = make_operator(SCENE, ring(1)[0])
    np.testing.assert_array_equal(gaps.render(operator).labels, IDS[dense.render(operator).labels])
    assert gaps.counts()[IDS].tolist() == dense.counts().tolist()
    numbered = gaps.numbered()
    np.testing.assert_array_equal(numbered.labels, dense.labels)
    assert numbered.class_names == dense.class_names and dense.numbered() is dense
    back = numbered.with_ids(IDS.tolist())
    np.testing.assert_array_equal(back.labels, gaps.labels)
    assert back.labels.dtype == np.int32 and (back.labels == REMOVED).sum() == (dense.labels == REMOVED).sum()


def test_columns_go_with_their_ids_when_ids_come_in_another_order() -> None:
    codes = np.eye(NUM_CLASSES, dtype=np.float32)[TRUTH]
    result = Segmentation.from_codes(SCENE, codes, NAMES).with_ids([0, 9, 700, 5])
    assert result.class_ids.tolist() == [0, 5, 9, 700] and result.class_names[5] == NAMES[3]
    labelled = result.labels >= 0
    columns = np.searchsorted(result.class_ids, result.labels[labelled])
    np.testing.assert_array_equal(result.probabilities[labelled].argmax(axis=1), columns)


def test_an_object_is_removed_by_its_own_id(runs: Path, tmp_path: Path) -> None:
    folder = runs / "gaps"
    done = main([
        "remove", str(folder / "scene.ply"), "--segmentation", str(folder / "out/segmentation.npz"),
        "--class", "65534", "--out", str(tmp_path / "rest.ply"),
    ])  # fmt: skip
    removed = int((Segmentation.load(folder / "out/segmentation.npz", SCENE).labels == 65534).sum())
    assert done == 0 and removed > 0
    assert len(GaussianScene.load(tmp_path / "rest.ply")) == len(SCENE) - removed


def test_one_stray_pixel_of_the_largest_id_takes_no_memory(tmp_path: Path) -> None:
    folder = with_gaps(tmp_path / "data", names=False)
    for path in (folder / "labels").glob("*.png"):
        write_mask(path, np.searchsorted(IDS, read_mask(path).labels), 16)
    labels = read_mask(folder / "labels/view0.png").labels
    labels[0, 0] = 65534
    write_mask(folder / "labels/view0.png", labels, 16)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    pipeline.segment(folder / "scene.ply", folder, tmp_path / "out", learner="votes")
    # Votes alone were 626 x 65535 x 8 bytes.
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 150_000
    with np.load(tmp_path / "out/segmentation.npz") as file:
        assert file["class_ids"].tolist() == [0, 1, 2, 3, 65534] and file["probabilities"].shape == (len(SCENE), 5)


def test_a_dataset_is_numbered_only_where_ids_have_gaps(tmp_path: Path) -> None:
    dense = Dataset(write_dataset(tmp_path / "dense"))
    assert dense.numbered() is dense
    gaps = Dataset(with_gaps(tmp_path / "gaps"))
    numbered = gaps.numbered()
    assert gaps.num_classes == 65535 and numbered.num_classes == 4 and numbered.class_names == dense.class_names
    for one, other in zip(dense.views(), numbered.views(), strict=True):
        np.testing.assert_array_equal(one.read_labels(), other.read_labels())
        assert one.class_ids() == other.class_ids() and one.largest_label == other.largest_label
    with pytest.raises(
        UnknownLabelError, match=r"view0\.png: mask holds the labels \[.*65534\]; expected ids of the 3"
    ):
        Dataset(with_gaps(tmp_path / "nameless", names=False)).numbered([0, 1, 700]).views()[0].read_labels()


def test_soft_and_partial_masks_are_numbered_too(tmp_path: Path) -> None:
    folder = with_gaps(tmp_path / "data")
    shutil.rmtree(folder / "labels")
    (folder / "labels/view0").mkdir(parents=True)
    write_mask(folder / "labels/view0/65534.png", np.full((48, 64), 127), 8)
    write_mask(folder / "labels/view1.png", np.full((48, 64), 700), 16)
    (folder / "labels/supervises.json").write_text('{"*": [700, 65534]}')
    views = {view.name: view for view in Dataset(folder).numbered().views()}
    assert views["view0"].class_ids() == {3} and views["view1"].class_ids() == {2, 3}
    assert set(np.unique(views["view1"].read_labels())) == {2}


def test_workers_get_numbered_masks_as_they_are_read(tmp_path: Path) -> None:
    view = Dataset(with_gaps(tmp_path / "data")).numbered().views()[0]
    sent = view.held()
    np.testing.assert_array_equal(sent.read_labels(), view.read_labels())
    assert sent.is_in_memory and make_learner("votes", SCENE, 4).observe(sent)


def test_the_viewer_numbers_classes_and_saves_the_users_ids() -> None:
    codes = np.eye(NUM_CLASSES, dtype=np.float32)[TRUTH]
    gaps = Segmentation.from_codes(SCENE, codes, NAMES).with_ids(IDS.tolist())
    model = ViewModel(SCENE, Labelling.of(gaps.numbered()), class_ids=tuple(gaps.class_ids.tolist()))
    assert model.ids() == IDS.tolist() and model.colors().shape == (len(SCENE), 3)
    model.labelling = replace(model.labelling, class_names={**model.labelling.class_names, 4: "added"})
    assert model.ids() == [*IDS.tolist(), 2]


def test_probabilities_of_a_source_that_tells_the_largest_only_are_completed() -> None:
    told = np.array([[0.6, 0, 0], [0, 0, 0], [0.2, 0.3, 0.5]], np.float32)
    whole = completed(CSRRows.from_dense(told), 3).dense(3)
    np.testing.assert_allclose(whole, [[0.6, 0.2, 0.2], [0, 0, 0], [0.2, 0.3, 0.5]], rtol=1e-6)


@pytest.mark.parametrize(("name", "label"), [("_background_", 0), ("Background", 0), ("__ignore__", UNKNOWN)])
def test_a_category_of_coco_that_is_no_object_by_its_name_is_none_whatever_its_id(
    tmp_path: Path, name: str, label: int
) -> None:
    data = write_dataset(tmp_path / "data")
    view = Dataset(data).views()[0]
    image = {"id": 1, "file_name": f"{view.name}.png", "width": view.camera.width, "height": view.camera.height}
    of_all = [[0, 0, image["width"], 0, image["width"], image["height"], 0, image["height"]]]
    categories = [{"id": 7, "name": name}, {"id": 9, "name": "mug"}]
    annotation = {"image_id": 1, "category_id": 7, "segmentation": of_all}
    whole = {"images": [image], "annotations": [annotation], "categories": categories}
    (data / "coco.json").write_text(json.dumps(whole))
    dataset = Dataset(data, "coco.json")
    assert dataset.class_names == {0: "background", 9: "mug"} and (dataset.views()[0].read_labels() == label).all()
