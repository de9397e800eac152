"""Ids of classes by their names: the same name is the same class, whatever number a segmenter gives it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_scenes import NUM_CLASSES, balls_on_a_table, clean_views, fed

from gsseg_core.errors import UnknownLabelError
from gsseg_core.live.session import LiveSession
from gsseg_core.live.session_classes import ids_by_name

names = st.dictionaries(st.integers(0, 9), st.sampled_from(["background", "chair", "table", "wall", "cup"]), max_size=6)
known = st.dictionaries(st.integers(1, 9), st.sampled_from(["chair", "table", "door"]), max_size=3)


@given(names, known, st.booleans(), st.integers(1, 12))
def test_a_name_has_one_id_and_an_id_one_name_and_what_is_known_stays(
    labels: dict[int, str], classes: dict[int, str], keep: bool, limit: int
) -> None:
    classes = {0: "background", **classes}
    ids = ids_by_name(labels, classes, limit, keep_numbers=keep)
    assert ids.keys() == labels.keys()
    name_of = {ids[k]: name for k, name in labels.items()}
    assert len(set(labels.values())) == len(name_of)
    assert {k: classes[k] for k in name_of.keys() & classes.keys()}.items() <= name_of.items()
    assert all((name == "background") == (ids[k] == 0) for k, name in labels.items())
    assert ids_by_name(labels, {**classes, **name_of}, limit, keep_numbers=keep) == ids


def test_new_classes_keep_free_numbers_and_others_come_after_all() -> None:
    ids = ids_by_name({0: "wall", 1: "chair", 2: "cup", 300: "door"}, {0: "background", 2: "table"}, 256)
    assert ids == {0: 3, 1: 1, 2: 4, 300: 5}
    assert ids_by_name({1: "b", 2: "a"}, {0: "background"}, 256, keep_numbers=False) == {1: 1, 2: 2}


def test_of_classes_that_were_declared_there_are_no_others() -> None:
    assert ids_by_name({0: "wall", 5: "chair", 6: "cup"}, {0: "background", 1: "chair"}, 0) == {0: 0, 5: 1, 6: 0}


def test_more_classes_than_labels_are_refused() -> None:
    with pytest.raises(UnknownLabelError, match="ids up to 65535; expected at most 65534"):
        ids_by_name({0: "wall"}, {0: "background", 65534: "last"}, 256)


def test_a_session_learns_names_once() -> None:
    session = LiveSession(balls_on_a_table()[0])
    before = session.version
    assert session.number_classes({0: "wall", 1: "chair"}) == {0: 2, 1: 1}
    assert session.version > before
    version = session.version
    assert session.number_classes({7: "chair"}) == {7: 1} and session.version == version


def test_new_names_come_after_classes_that_have_votes_and_no_name() -> None:
    session = fed(LiveSession(balls_on_a_table()[0]), clean_views(2))
    before = session.codes()
    assert session.number_classes({0: "wall", 1: "chair"}) == {0: NUM_CLASSES, 1: 1}, "masks keep the meaning they had"
    assert session.number_classes({1: "lamp"}, keep_numbers=False) == {1: NUM_CLASSES + 1}
    np.testing.assert_array_equal(session.codes(), before)
    assert session.class_names == {0: "background", 1: "chair", 2: "class_02", 3: "class_03"}


def test_a_session_with_declared_classes_learns_no_names() -> None:
    session = LiveSession(balls_on_a_table()[0], {1: "ball"})
    assert session.number_classes({4: "ball", 5: "cube"}) == {4: 1, 5: 0}
    assert session.class_names == {0: "background", 1: "ball"}


def test_a_class_that_was_only_numbered_gets_its_name_when_it_is_told() -> None:
    session = LiveSession(balls_on_a_table()[0])
    session._classes.names = {0: "background", 1: "class_01", 2: "chair"}  # As of a saved state.
    assert session.number_classes({1: "cup", 2: "table"}) == {1: 1, 2: 3}
    assert session._classes.names == {0: "background", 1: "cup", 2: "chair", 3: "table"}


def test_a_class_that_is_announced_and_not_yet_seen_keeps_its_name_and_number_after_loading(tmp_path: Path) -> None:
    session = fed(LiveSession(balls_on_a_table()[0]), clean_views(2))
    ids = session.number_classes({1: "lamp", 9: "cup"})
    assert ids == {1: 1, 9: 9}
    session.save(tmp_path / "state.npz")
    other = LiveSession(session.scene)
    other.load(tmp_path / "state.npz")
    assert other.class_names == session.class_names
    for each in (session, other):
        assert each.number_classes({2: "sofa", 1: "cup"}, keep_numbers=False) == {2: 10, 1: 9}
