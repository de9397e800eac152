"""Label maps: classes renamed, merged and ignored, in plain and soft masks."""

from __future__ import annotations

import json
from pathlib import Path

import mask_writers
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_mask_formats import NAMES, label_images, make_cameras, written

from gsseg_core.data.dataset import Dataset
from gsseg_core.data.label_images import UNKNOWN, write_mask
from gsseg_core.data.label_map import map_labels
from gsseg_core.data.soft_masks import SeenLabels, quantise, restrict
from gsseg_core.errors import LabelMapError, UnknownLabelError

CLASSES = {0: "background", 1: "chair", 2: "stool", 5: "person", 9: "chair"}


@pytest.mark.parametrize(
    ("given", "new_ids", "names"),
    [
        ({}, {0: 0, 1: 1, 2: 2, 5: 5, 9: 9}, CLASSES),
        ({"stool": "seat"}, {0: 0, 1: 1, 2: 2, 5: 5, 9: 9}, {**CLASSES, 2: "seat"}),
        ({"chair": "seat", "stool": "seat"}, {0: 0, 1: 1, 2: 1, 5: 5, 9: 1}, {0: "background", 1: "seat", 5: "person"}),
        ({"5": "stool"}, {0: 0, 1: 1, 2: 2, 5: 2, 9: 9}, {0: "background", 1: "chair", 2: "stool", 9: "chair"}),
        ({"1": "person", "2": "person"}, {0: 0, 1: 5, 2: 5, 5: 5, 9: 9}, {0: "background", 5: "person", 9: "chair"}),
        ({"person": None}, {0: 0, 1: 1, 2: 2, 5: -1, 9: 9}, {0: "background", 1: "chair", 2: "stool", 9: "chair"}),
        (
            {"9": None, "chair": "a"},
            {0: 0, 1: 1, 2: 2, 5: 5, 9: -1},
            {0: "background", 1: "a", 2: "stool", 5: "person"},
        ),
        ({"1": "background", "*": None}, {0: -1, 1: 0, 2: -1, 5: -1, 9: -1}, {0: "background"}),
        ({"0": "floor"}, {0: 10, 1: 1, 2: 2, 5: 5, 9: 9}, {**CLASSES, 10: "floor"}),
        ({"background": "stool"}, {0: 2, 1: 1, 2: 2, 5: 5, 9: 9}, CLASSES),
        ({"background": None}, {0: -1, 1: 1, 2: 2, 5: 5, 9: 9}, CLASSES),
    ],
)
def test_classes_are_renamed_merged_and_ignored(
    given: dict[str, str | None], new_ids: dict[int, int], names: dict[int, str]
) -> None:
    found = map_labels(given, CLASSES, "map")
    assert found.new_ids == new_ids and found.class_names == names and list(found.class_names) == sorted(names)


@given(
    st.dictionaries(st.sampled_from([*map(str, CLASSES), *CLASSES.values(), "*"]), st.sampled_from([None, "a", "b"]))
)
def test_ids_of_one_new_name_become_one_and_no_others_do(given: dict[str, str | None]) -> None:
    found = map_labels(given, CLASSES, "map")
    assert set(found.new_ids) == set(CLASSES)
    kept = {k for k in found.new_ids.values() if k != UNKNOWN}
    assert kept <= set(found.class_names) and found.class_names[0] == "background"
    for name in ("a", "b"):
        assert sum(known == name for known in found.class_names.values()) <= 1


@pytest.mark.parametrize(
    ("content", "what"),
    [
        ('{"sofa": "seat"}', "names 'sofa', which the masks do not have; expected some of 0 (background), 1 (chair)"),
        ('{"7": "seat"}', "names '7', which the masks do not have"),
        ("[1]", "holds no object; expected an object such as"),
        ('{"chair": 7}', "gives 'chair' the name 7; expected text"),
        ('{"chair": "a\\nb"}', "expected one line of text"),
        ('{"chair": {}}', "gives 'chair' the name {}; expected text"),
        ("{", "not valid JSON"),
        ("", "not valid JSON"),
        ("[" * 100_000, "not valid JSON"),
    ],
)
def test_a_broken_label_map_is_refused_with_one_line(tmp_path: Path, content: str, what: str) -> None:
    make_cameras(tmp_path)
    (tmp_path / "classes.json").write_text(json.dumps(CLASSES))
    (tmp_path / "map.json").write_text(content)
    with pytest.raises(LabelMapError) as caught:
        Dataset(tmp_path, label_map=tmp_path / "map.json")
    assert str(caught.value).startswith(f"{tmp_path}/map.json: ") and what in str(caught.value)


def test_a_missing_label_map_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LabelMapError, match=r"no\.json: cannot be read"):
        Dataset(make_cameras(tmp_path), label_map=tmp_path / "no.json")


def test_a_label_map_may_be_yaml(tmp_path: Path) -> None:
    pytest.importorskip("yaml")
    make_cameras(tmp_path)
    (tmp_path / "classes.json").write_text(json.dumps(CLASSES))
    (tmp_path / "map.yaml").write_text("chair: seat\n5: ~\nstool: ignore\n")
    dataset = Dataset(tmp_path, label_map=tmp_path / "map.yaml")
    assert dataset.class_names == {0: "background", 1: "seat"}
    for bomb in ("a: &a [1]\nb: [*a, *a]", "? [1]\n: b", "{" * 1500, "1.5: a", "a: 2026-01-01"):
        (tmp_path / "map.yaml").write_text(bomb)
        with pytest.raises(LabelMapError):
            Dataset(tmp_path, label_map=tmp_path / "map.yaml")


@pytest.mark.parametrize("name", [*mask_writers.WRITERS])
def test_a_label_map_goes_with_every_format(tmp_path: Path, name: str) -> None:
    place = written(tmp_path, mask_writers.WRITERS[name])
    (tmp_path / "map.json").write_text(json.dumps({"1": "seat", "3": "seat", "2": None}))
    dataset = Dataset(tmp_path, place, label_map=tmp_path / "map.json")
    assert dataset.class_names == {0: "background", 1: "seat"}
    labels = label_images()["frame_001"]
    expected = np.array([0, 1, UNKNOWN, 1])[labels]
    np.testing.assert_array_equal(dataset.views()[0].read_labels(), expected)
    np.testing.assert_array_equal(dataset.numbered().views()[0].read_labels(), expected)


def test_a_label_map_lets_0_be_an_object_of_label_images(tmp_path: Path) -> None:
    place = written(tmp_path, mask_writers.object_masks)
    (tmp_path / "classes.json").write_text(json.dumps(NAMES))
    (tmp_path / "map.json").write_text(json.dumps({"0": "floor"}))
    dataset = Dataset(tmp_path, place, label_map=tmp_path / "map.json")
    assert dataset.class_names == {**NAMES, 4: "floor"}
    labels = label_images()["frame_001"]
    np.testing.assert_array_equal(dataset.views()[0].read_labels(), np.where(labels == 0, 4, labels))


def test_labels_without_a_class_stay_an_error(tmp_path: Path) -> None:
    make_cameras(tmp_path)
    write_mask(tmp_path / "labels/frame_001.png", np.full((18, 24), 7), 8)
    (tmp_path / "classes.json").write_text(json.dumps(CLASSES))
    (tmp_path / "map.json").write_text(json.dumps({"chair": None}))
    with pytest.raises(UnknownLabelError, match=r"frame_001\.png: mask holds the labels \[7\]"):
        Dataset(tmp_path, label_map=tmp_path / "map.json").views()[0].read_labels()


# Soft and partial masks


def soft(*pixels: list[float], classes: list[int] | None = None) -> SeenLabels:
    return quantise(np.array([pixels], np.float32).transpose(2, 0, 1), classes)


def plausibility(seen: SeenLabels, classes: int) -> np.ndarray:
    """Of each class in each pixel of the first row, NaN where the pixel is unknown."""
    if seen.evidence is None:
        return np.array([np.eye(classes)[k] if k >= 0 else np.full(classes, np.nan) for k in seen.labels[0]])
    table = seen.evidence.plausibility(classes)
    return np.array([table[k] if k >= 0 else np.full(classes, np.nan) for k in seen.labels[0]])


def test_probabilities_of_merged_classes_are_added() -> None:
    seen = soft([0, 0.5, 0.25, 0.25], [0.5, 0.5, 0, 0]).relabelled({0: 0, 1: 1, 2: 1, 3: 3}, "m")
    np.testing.assert_allclose(plausibility(seen, 4), [[0, 0.75, 0, 0.25], [0.5, 0.5, 0, 0]])


def test_pixels_that_name_an_ignored_class_are_unknown_and_elsewhere_its_share_is_left_out() -> None:
    seen = soft([0, 0.75, 0.25], [0.25, 0.25, 0.5], [0.5, 0.25, 0.25]).relabelled({0: 0, 1: 1, 2: UNKNOWN}, "m")
    found = plausibility(seen, 2)
    np.testing.assert_allclose(found[0], [0, 1])
    assert np.isnan(found[1]).all()
    np.testing.assert_allclose(found[2], [2 / 3, 1 / 3], rtol=1e-6)


def test_a_merged_class_counts_as_looked_for_only_where_all_of_its_parts_were() -> None:
    labels = np.array([[0, 1, 2]], np.int32)
    whole = restrict(labels, [1, 2]).relabelled({0: 0, 1: 1, 2: 1, 3: 3}, "m")
    assert whole.evidence is not None and whole.evidence.supervised is not None
    assert whole.evidence.supervised.tolist() == [1] and whole.named().tolist() == [[UNKNOWN, 1, 1]]
    part = restrict(labels, [1, 2]).relabelled({0: 0, 1: 1, 2: 2, 3: 2}, "m")
    assert part.evidence is None or part.evidence.supervised is None
    assert part.named().tolist() == [[UNKNOWN, 1, 2]]


@given(st.lists(st.lists(st.integers(0, 8), min_size=4, max_size=4), min_size=1, max_size=5))
def test_a_label_map_that_changes_nothing_changes_no_soft_mask(counts: list[list[int]]) -> None:
    shares = [[c / max(sum(pixel), 8) for c in pixel] for pixel in counts]
    for classes in (None, [0, 1, 2, 3]):
        seen = soft(*shares, classes=classes)
        again = seen.relabelled({k: k for k in range(5)}, "m")
        np.testing.assert_allclose(plausibility(again, 5), plausibility(seen, 5), atol=1e-6)
