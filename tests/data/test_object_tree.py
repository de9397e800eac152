"""A tree of parts, objects and wholes: its levels are nested, and what no tree can be is refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.object_tree import OBJECT, PART, WHOLE, ObjectTree
from gsseg_core.errors import SettingsError
from gsseg_core.files.input_files import UnfitError

# A mug (1) of body and handle, on a book (2), which views often take for one; a wall (3); the background.
PARENTS = [-1, 6, 6, -1, 1, 1, -1]
AGREEMENT = [1, 0.6, 1, 1, 1, 1, 0.2]
LEAVES = [0, 4, 4, 5, 2, 3, -1]
NAMES = {0: "background", 1: "mug", 2: "book", 3: "wall"}


def tree(parents: object = PARENTS, agreement: object = AGREEMENT, leaves: object = LEAVES, level: float = 0.5):
    arrays = np.array(parents, np.int32), np.array(agreement, np.float32), np.array(leaves, np.int32)
    return ObjectTree(*arrays, num_classes=4, level=level)


def test_a_cut_says_what_stands_for_each_node() -> None:
    cups = tree()
    assert cups.cut(0.5).tolist() == [0, 1, 2, 3, 1, 1, 6]
    assert cups.cut(0.7).tolist()[4:6] == [4, 5]
    assert cups.cut(0.2).tolist() == [0, 6, 6, 3, 6, 6, 6]
    assert cups.granularities == (pytest.approx(0.2), 0.5, pytest.approx(0.8))


def test_a_node_has_parts_a_whole_a_kind_and_a_name() -> None:
    cups = tree()
    assert [cups.kind(node) for node in range(7)] == [OBJECT] * 4 + [PART] * 2 + [WHOLE]
    assert cups.parts(1) == [4, 5] and cups.parts(6) == [1, 2] and cups.parts(3) == []
    assert cups.whole(4) == 1 and cups.whole(1) == 6 and cups.whole(6) is None
    assert cups._classes[5] == 1 and cups._classes[6] == -1
    assert cups.names(NAMES) == {**NAMES, 4: "mug.1", 5: "mug.2", 6: "whole_001"}
    sizes = cups.sizes(np.array([0, 1, 1, 1, 2, 3, -1], np.int32))
    assert cups.inside(6) == [1, 4, 5, 2] and sizes.tolist() == [1, 3, 1, 1, 2, 1, 4]
    assert [(one["name"], one["part_of"], one["gaussians"]) for one in cups.describe(NAMES, sizes)] == [
        ("mug.1", 1, 2), ("mug.2", 1, 1), ("whole_001", None, 4)
    ]  # fmt: skip


def test_gaussians_follow_their_class_where_it_is_another_than_their_leafs() -> None:
    labels = np.array([0, 1, 2, 1, 1, -2, -1], np.int32)  # The third has left the mug, the book's has come to it.
    assert tree().labels_at(0.9, labels).tolist() == [0, 4, 2, 5, 4, -2, -1]
    assert tree().labels_at(0.5, labels).tolist() == labels.tolist()


def test_shares_go_to_the_own_part_and_of_other_objects_to_the_largest() -> None:
    shares = np.array([[0, 0.75, 0.25, 0], [0, 0.25, 0.75, 0], [0, 1, 0, 0]], np.float32)
    leaves = np.array([5, 2, 4], np.int32)
    fine, nodes = tree().shares_at(0.9, CSRRows.from_dense(shares), leaves)
    assert nodes == [0, 2, 3, 4, 5]
    np.testing.assert_allclose(fine.dense(5), [[0, 0.25, 0, 0, 0.75], [0, 0.75, 0, 0.25, 0], [0, 0, 0, 1, 0]])
    whole, nodes = tree().shares_at(0.1, CSRRows.from_dense(shares), leaves)
    assert nodes == [0, 3, 6]
    np.testing.assert_allclose(whole.dense(3), [[0, 0, 1]] * 3)


@pytest.mark.parametrize(
    "wrong",
    [
        {"parents": [-1, 6, 6, -1, 5, 4, -1]},  # a circle
        {"parents": [-1, 6, 6, -1, 1, 9, -1]},
        {"parents": [-1, 2, 6, -1, 1, 1, -1]},  # a class in a class
        {"agreement": [1, 0.1, 1, 1, 1, 1, 0.2]},  # a part that is less one than its whole
        {"agreement": [1, 0.6, 1, 1, 1, 1, 0.55]},  # a whole at the level of the objects
        {"agreement": [1, np.nan, 1, 1, 1, 1, 0.2]},
        {"leaves": [0, 6]},
        {"leaves": [0, 7]},
        {"level": 1.0},
    ],
)
def test_what_is_no_tree_of_objects_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(UnfitError, match="tree"):
        tree(**wrong)


@pytest.mark.parametrize("granularity", [-0.1, 1.1, float("nan")])
def test_a_granularity_is_a_share(granularity: float) -> None:
    with pytest.raises(SettingsError, match="granularity"):
        tree().cut(granularity)


@st.composite
def trees(draw: st.DrawFn) -> ObjectTree:
    """Any tree of two levels below and two above the objects, with Gaussians in its leaves."""
    k, level = draw(st.integers(2, 5)), 0.5
    parents, agreement = [-1] * k, [1.0] * k
    for parent in list(range(1, k)) + list(range(k, k + 3)):
        low = agreement[parents[parent]] if parent < len(parents) and parents[parent] >= 0 else level - 0.1
        steps = [step / 10 for step in range(5, 10) if step / 10 > low]
        if parent < len(parents) and steps and draw(st.booleans()):
            agreement[parent] = draw(st.sampled_from(steps))
            parents += [parent] * 2
            agreement += [1.0] * 2
    roots = list(range(1, k))
    while len(roots) > 1 and draw(st.booleans()):
        parts = [roots.pop(0), roots.pop(0)]
        steps = range(round(10 * min(0.5, *(agreement[part] for part in parts))))
        if not steps:
            break
        for part in parts:
            parents[part] = len(parents)
        roots.append(len(parents))
        parents.append(-1)
        agreement.append(draw(st.sampled_from(steps)) / 10)
    ends = [node for node in range(len(parents)) if node not in parents]
    leaves = draw(st.lists(st.sampled_from(ends), min_size=1, max_size=20))
    return ObjectTree(
        np.array(parents, np.int32), np.array(agreement, np.float32), np.array(leaves, np.int32), k, level
    )


@given(trees(), st.floats(0, 1), st.floats(0, 1))
def test_every_level_is_a_union_of_what_a_finer_one_has(tree: ObjectTree, one: float, other: float) -> None:
    coarse, fine = (tree.cut(g)[tree.leaves] for g in sorted([one, other]))
    of_fine = {f: c for f, c in zip(fine.tolist(), coarse.tolist(), strict=True)}
    assert [of_fine[f] for f in fine.tolist()] == coarse.tolist()


@given(trees())
def test_the_level_of_the_objects_is_the_objects_and_each_granularity_cuts_otherwise(tree: ObjectTree) -> None:
    classes = tree._classes[tree.leaves]
    np.testing.assert_array_equal(tree.cut(tree.level)[tree.leaves], classes)
    cuts = [tuple(tree.cut(g).tolist()) for g in tree.granularities]
    assert len(set(cuts)) == len(cuts) and list(tree.granularities) == sorted(tree.granularities)
    every = {tuple(tree.cut(g).tolist()) for g in [0.0, 1.0, *tree.agreement.tolist()]}
    assert every <= set(cuts)


@given(trees(), st.floats(0, 1))
def test_shares_keep_their_sum_and_labels_are_their_nodes(tree: ObjectTree, granularity: float) -> None:
    classes = tree._classes[tree.leaves]
    shares = np.eye(tree.num_classes, dtype=np.float32)[classes]
    rows, nodes = tree.shares_at(granularity, CSRRows.from_dense(shares), tree.leaves)
    at = rows.dense(len(nodes))
    np.testing.assert_allclose(at.sum(axis=1), 1)
    np.testing.assert_array_equal(np.array(nodes)[at.argmax(axis=1)], tree.labels_at(granularity, classes))


@given(trees())
def test_every_node_is_there_where_it_is_closed_and_in_parts_where_it_is_opened(tree: ObjectTree) -> None:
    for node in range(len(tree)):
        assert tree.cut(tree.closed(node))[node] == node
        if tree.parts(node) and tree.agreement[node] < 1:
            there = tree.cut(tree.opened(node))
            assert [there[part] for part in tree.parts(node)] == tree.parts(node)
