"""What labels are called and which classes they become: label_info, label map and class_names, alone and together."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from ros_message_cases import refusal
from small_scenes import balls_on_a_table

from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.data.soft_masks import SeenLabels, quantise
from gsseg_core.errors import LabelMapError, UnknownLabelError
from gsseg_core.live.session import LiveSession
from gsseg_ros.errors import LabelInfoError
from gsseg_ros.node.masks.label_info import names_of
from gsseg_ros.node.masks.label_space import LabelSpace, NewNames

TOPIC = "/some/topic"
ADE = {0: "wall", 1: "floor", 2: "person", 3: "chair", 4: "armchair", 255: "UNLABELED"}


class Node:
    """A label space and the session that it makes classes for."""

    def __init__(self, class_names: tuple[str, ...] = (), label_map: dict[str, str | None] | None = None) -> None:
        new_names = None if label_map is None else NewNames(label_map, "/some/topic.json")
        self.space = LabelSpace(class_names, new_names, 256)
        self.session = LiveSession(balls_on_a_table()[0], self.space.classes)
        self.said: list[str] = []

    def classes(self, labels: list[int], names: dict[int, str] | None = None) -> list[int]:
        seen = SeenLabels(np.array([labels], np.int32))
        return self.space.classes_of(seen, names, self.session, TOPIC, self.said.append).labels[0].tolist()


def info(entries: Any) -> SimpleNamespace:
    return SimpleNamespace(class_map=[SimpleNamespace(class_id=k, class_name=name) for k, name in entries])


def test_label_info_names_labels_but_65535() -> None:
    assert names_of(info([*ADE.items(), (65535, "UNLABELED")]), TOPIC) == ADE


@pytest.mark.parametrize(
    ("entries", "says"),
    [
        ([], "names no labels; expected a class_map"),
        ([(65535, "UNLABELED")], "names no labels"),
        ([(1, "a"), (1, "b")], "label 1 has two names, 'a' and 'b'; expected one"),
        ([(1, "")], "label 1 has the name ''; expected text"),
        ([(1, "a\x1b[31m")], "label 1 has the name"),
        ([(1, "x" * 1000)], "of 1,000 characters; expected at most 200"),
    ],
)
def test_a_broken_label_info_is_refused(entries: Any, says: str) -> None:
    assert says in refusal(LabelInfoError, names_of, info(entries), TOPIC)


def test_without_names_and_label_map_labels_are_what_they_are() -> None:
    assert Node().classes([0, 7, -1, 3]) == [0, 7, -1, 3]
    assert Node(("background", "chair")).classes([0, 1, -1]) == [0, 1, -1]


def test_label_info_names_the_classes_and_what_has_0_gets_the_next_id() -> None:
    node = Node()
    assert node.space.hear(ADE) and not node.space.hear(dict(ADE))
    assert node.classes([0, 1, 2, 3, 255, -1]) == [5, 1, 2, 3, -1, -1]
    node.session._live.resize(6)
    assert node.session.class_names == {0: "background", 1: "floor", 2: "person", 3: "chair", 4: "armchair", 5: "wall"}


def test_another_segmenter_goes_on_with_the_classes_of_the_last_one() -> None:
    node = Node()
    node.space.hear(ADE)
    node.classes([0])
    node.space.hear({0: "background", 1: "chair", 2: "cup", 3: "Background"})
    assert node.classes([0, 1, 2, 3]) == [0, 3, 6, 0]


def test_a_label_without_a_name_has_the_mask_rejected() -> None:
    node = Node()
    node.space.hear(ADE)
    with pytest.raises(
        UnknownLabelError, match=r"/some/topic: mask holds the labels \[9\]; expected ids of its classes"
    ):
        node.classes([1, 9])


def test_classes_by_name_where_class_names_declares_them_and_all_others_are_background() -> None:
    node = Node(("background", "chair", "floor", "sofa"))
    node.space.hear(ADE)
    assert node.classes([0, 1, 2, 3, -1]) == [0, 2, 0, 1, -1]
    (said,) = node.said
    assert "its classes armchair, person, wall are not among class_names, and become background" in said


def test_a_name_that_is_no_class_is_said_once_though_each_image_has_others_beside_it() -> None:
    node = Node(("background", "chair"))
    detected = ({1: "cup"}, {1: "cup", 2: "chair"}, {1: "chair", 2: "cup", 3: "dog"}, {1: "dog"}, {1: "dog", 2: "cup"})
    for names in detected:
        node.classes(list(names), names)
    assert [said.split("classes ")[1].split(" are not")[0] for said in node.said] == ["cup", "dog"]


def test_a_label_map_renames_merges_and_ignores_what_label_info_names() -> None:
    node = Node(label_map={"armchair": "chair", "person": None, "0": "wall paper"})
    node.space.hear(ADE)
    assert node.classes([0, 1, 2, 3, 4]) == [4, 1, -1, 3, 3]
    declared = Node(("background", "chair"), {"armchair": "chair", "person": None, "*": "background", "chair": "chair"})
    declared.space.hear(ADE)
    assert declared.classes([0, 1, 2, 3, 4]) == [0, 0, -1, 1, 1] and not declared.said


def test_a_label_map_alone_goes_by_numbers_and_with_class_names_by_these() -> None:
    node = Node(label_map={"2": None, "3": "cup", "4": "class_01", "5": "cup"})
    assert node.classes([0, 1, 2, 3, 4, 5]) == [0, 1, -1, 3, 1, 3]
    assert node.session._classes.names == {0: "background", 3: "cup"}, "label_info may name others"
    node = Node(("background", "wall", "armchair", "person"), {"armchair": "chair", "person": None})
    assert node.space.classes == {0: "background", 1: "wall", 2: "armchair", 3: "person", 4: "chair"}
    assert node.classes([0, 1, 2, 3]) == [0, 1, 4, -1]


def test_a_label_that_keeps_its_number_is_no_class_that_a_label_map_has_named() -> None:
    node = Node(label_map={"0": "wall", "1": "floor"})
    assert node.classes([0, 1, 2, 3]) == [4, 1, 2, 3]
    assert node.classes([4, 0, 5, 2]) == [6, 4, 5, 2] and node.classes([5, 4]) == [5, 6]
    assert node.session._classes.names == {0: "background", 1: "floor", 4: "wall", 6: "class_04"}


def test_a_label_map_that_names_what_there_is_not_is_an_error_once_labels_are_known() -> None:
    node = Node(label_map={"sofa": None})
    node.space.hear(ADE)
    with pytest.raises(LabelMapError, match="names 'sofa', which the masks do not have; expected some of 0"):
        node.classes([1])


def test_names_that_come_with_a_mask_go_before_all_others() -> None:
    node = Node(label_map={"person": None, "armchair": "chair"})
    node.space.hear(ADE)
    names = {0: "background", 1: "person", 2: "cup", 3: "chair", 4: "armchair"}
    assert node.classes([0, 1, 2, 3, 4, -1], names) == [0, -1, 1, 2, 2, -1]
    assert node.classes([1, 2], {1: "chair", 2: "cup"}) == [2, 1]
    assert node.space.ignored(names) == {1}


def test_a_label_stays_that_of_its_name_where_a_dataset_or_a_saved_state_numbers_classes_otherwise() -> None:
    node = Node()
    node.space.hear({1: "chair"})
    assert node.classes([1]) == [1]
    node.session._classes.names = {0: "background", 1: "cup", 2: "chair"}
    assert node.classes([1]) == [2]


def test_soft_masks_are_merged_and_ignored_like_plain_ones() -> None:
    p = np.array([[[0.0, 0.0]], [[0.25, 0.0]], [[0.0, 1.0]], [[0.25, 0.0]], [[0.5, 0.0]]])
    node = Node(label_map={"armchair": "chair", "person": None})
    node.space.hear(ADE)
    seen = node.space.classes_of(quantise(p), None, node.session, TOPIC, node.said.append)
    assert seen.named().tolist() == [[3, UNKNOWN]]
    assert seen.evidence is not None and seen.evidence.classes.tolist() == [1, 3]
