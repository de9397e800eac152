"""Parts and wholes grow from what views say together: which ones, at which level, and in any order."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from parts_of_balls import SCENE, TOP, TRUTH, halved, seen_as, views_in_halves
from per_view_ids import shuffled
from scipy import sparse
from small_scenes import NAMES, NUM_CLASSES, balls_on_a_table, clean_views, ring, write_dataset

from gsseg_core.cli.main import main
from gsseg_core.data.dataset import Dataset
from gsseg_core.data.label_images import write_mask
from gsseg_core.data.object_tree import ObjectTree
from gsseg_core.data.view import View
from gsseg_core.errors import StateMismatchError
from gsseg_core.learn.vote_learner import VoteLearner
from gsseg_core.objects.association import AssociationSettings
from gsseg_core.objects.lifted_segments import Lifted
from gsseg_core.objects.object_table import ObjectTable, find_objects, object_name
from gsseg_core.objects.sight import EVIDENCE, FULL_SIGHT_PX, sight
from gsseg_core.objects.tree_growing import SEVERAL, _kept, _Region, _Segments, grow_tree
from gsseg_core.objects.tree_kernels import DOUBT, Merged, cells
from gsseg_core.raster.backends import make_operator
from gsseg_core.refine.settings import UNREFINED
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import Segmentation

VIEWS = clean_views(12)


def grown(views: Sequence[View], level: float = 0.4) -> ObjectTree:
    lifted = {v.name: Lifted.of(make_operator(SCENE, v.camera).lift(v.read_labels())) for v in views}
    return grow_tree(SCENE.means, TRUTH, NUM_CLASSES, lifted, level)


def votes_of(regions: np.ndarray, segments: _Segments) -> tuple[np.ndarray, np.ndarray]:
    """Shares of regions (R, S) that each view's ids have, as far as the view counts, and how far, (R, views)."""
    seen = segments.seen(regions)
    counts = sight(seen, seen.max(axis=1, keepdims=True, initial=0))
    return regions * (counts / np.maximum(seen, 1e-9))[:, segments.view], counts


def merged_slowly(shares: np.ndarray, segments: _Segments) -> tuple[list[tuple[int, int, float]], np.ndarray]:
    """Regions that merge, and how much they agree, and the shares of all: every round measures every pair anew."""
    left, every, merges = list(range(len(shares))), [*shares], list[tuple[int, int, float]]()
    while True:
        votes, counts = votes_of(np.array([every[region] for region in left]), segments)
        both = sparse.csr_matrix(counts) @ counts.T
        agreed = sparse.csr_matrix(votes) @ votes.T / (both + DOUBT)
        agreed[both < EVIDENCE] = 0
        np.fill_diagonal(agreed, 0)
        best = agreed.argmax(axis=1).tolist()
        pairs = [(a, b) for a, b in enumerate(best) if b > a and best[b] == a and agreed[a, b] > 0]
        if not pairs:
            return merges, np.array(every)
        for a, b in pairs:
            merges.append((left[a], left[b], float(agreed[a, b])))
            every.append(every[left[a]] + every[left[b]])
            left[a] = len(every) - 1
        gone = {b for _, b in pairs}
        left = [region for place, region in enumerate(left) if place not in gone]


@given(st.integers(1, 40), st.integers(1, 6), st.integers(1, 12), st.integers(0, 2**32 - 1))
def test_regions_merge_bit_for_bit_as_when_all_pairs_are_measured_in_every_round(
    count: int, views: int, ids: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    view = np.repeat(np.arange(views), ids)
    shares = rng.integers(0, 60, (count, len(view))) * (rng.random((count, len(view))) < 2 / ids) * 1.0
    segments = _Segments(view, shares.sum(axis=0))
    merged = segments.merged(sparse.csr_matrix(shares), np.arange(count))
    merges, expected = merged_slowly(shares, segments)
    assert [(*two, by) for two, by in zip(merged.parts.tolist(), merged.agreement.tolist(), strict=True)][
        count:
    ] == merges
    assert (merged.parts[:count] == -1).all()
    np.testing.assert_array_equal(merged.shares, expected)


def shown_slowly(merged: Merged, segments: _Segments) -> np.ndarray:
    """Which views show each region, (R, views), one region after another: the twin of `_Segments.showing`."""
    seen = segments.seen(merged.shares)
    iou = merged.shares / np.maximum(seen[:, segments.view] + segments.size - merged.shares, 1e-9)
    fits = iou > 0.5
    for region, two in enumerate(merged.parts.tolist()):
        for part in two if two[0] >= 0 else []:
            fits[part] &= iou[part] > iou[region]
            fits[region] &= iou[region] >= iou[part]
    of_view = segments.view == np.arange(seen.shape[1])[:, None]
    return (fits[:, None] & of_view).any(axis=2) & (seen >= FULL_SIGHT_PX)


def kept_slowly(merged: Merged, shown: np.ndarray, objects: Sequence[_Region]) -> list[_Region]:
    """What is kept of all regions, with the views that show them as sets: the twin of `_kept`."""
    kept, waiting = dict[int, list[_Region]](), dict[int, set[int]]()
    for row, two in enumerate(merged.parts.tolist()):
        found = [(kept.pop(part), waiting.pop(part)) for part in two if part >= 0]
        parts, views = [one for each, _ in found for one in each], set(np.flatnonzero(shown[row]).tolist())
        alive = [few for each, few in found if each or few]
        if len(alive) == 1:
            views |= alive[0]
        if row < len(objects):
            kept[row], waiting[row] = [objects[row]], set()
        elif len(views) < SEVERAL:
            kept[row], waiting[row] = parts, views
        else:
            same = parts[0] if len(parts) == 1 else _Region(float(merged.agreement[row]) if parts else 1.0, parts)
            kept[row], waiting[row] = [_Region(same.agreement, same.parts, row)], set()
    return [region for each in kept.values() for region in each]


def described(region: _Region) -> list[object]:
    return [region.row, region.agreement, *map(described, region.parts)]


@given(st.integers(1, 30), st.integers(1, 9), st.integers(1, 5), st.integers(0, 2**32 - 1), st.booleans())
def test_regions_that_are_shown_and_kept_are_those_of_the_slow_twins(
    count: int, views: int, ids: int, seed: int, certain: bool
) -> None:
    rng = np.random.default_rng(seed)
    view = np.repeat(np.arange(views), ids)
    owner = rng.integers(0, ids, (count, views))
    shares = (owner[:, :, None] == np.arange(ids)).reshape(count, -1) * rng.integers(1, 60, (count, len(view))) * 1.0
    segments = _Segments(view, shares.sum(axis=0))
    merged = segments.merged(sparse.csr_matrix(shares), np.arange(count))
    shown = segments.showing(merged)
    np.testing.assert_array_equal(shown, shown_slowly(merged, segments))
    objects = [_Region(row=k) for k in range(count)] if certain else []
    expected = kept_slowly(merged, shown, objects)
    assert [described(region) for region in _kept(merged, shown.copy(), objects)] == [*map(described, expected)]


@given(st.integers(0, 60), st.integers(0, 2**32 - 1), st.sampled_from([1.0, 2.5, 8.0]))
def test_cells_are_halves_of_halves(count: int, seed: int, size: float) -> None:
    points = np.random.default_rng(seed).integers(0, 5, (count, 3)).astype(np.float32)
    cell, parts, number = np.zeros(count, np.int64), [np.arange(count)], 0
    while parts:
        part = parts.pop()
        if len(part) <= size:
            cell[part], number = number, number + 1
            continue
        own = points[part]
        order = part[np.argsort(own[:, np.ptp(own, axis=0).argmax()], kind="stable")]
        parts += [order[: len(order) // 2], order[len(order) // 2 :]]
    np.testing.assert_array_equal(cells(points, size), cell)


def test_an_object_that_some_views_cut_up_has_parts() -> None:
    views = views_in_halves()
    tree = grown(views)
    assert [len(tree.parts(k)) for k in range(NUM_CLASSES)] == [0, 2, 0, 0] and len(tree) == NUM_CLASSES + 2
    assert tree.agreement[1] == pytest.approx(0.5, abs=0.1)
    ball = TRUTH == 1
    upper = tree.leaves[ball] == np.bincount(tree.leaves[ball & (halved(1) == TOP)]).argmax()
    assert (upper == (halved(1)[ball] == TOP)).mean() > 0.9


def test_parts_of_parts_are_nested() -> None:
    quarters = np.where(
        (halved(1) == TOP) & (SCENE.means[:, 0] > np.median(SCENE.means[TRUTH == 1, 0])), TOP + 1, halved(1)
    )
    views = [seen_as(view, [TRUTH, halved(1), quarters][i % 3]) for i, view in enumerate(VIEWS)]
    tree = grown(views, level=0.2)
    assert len(tree.parts(1)) == 2
    assert sorted(len(tree.parts(part)) for part in tree.parts(1)) == [0, 2]


def test_what_a_view_or_two_cut_up_has_no_parts() -> None:
    views = [seen_as(view, halved(1) if i < 2 else TRUTH) for i, view in enumerate(VIEWS)]
    assert len(grown(views)) == NUM_CLASSES


def test_objects_that_some_views_have_under_one_id_make_a_whole() -> None:
    views = [seen_as(view, np.where(TRUTH == 2, 1, TRUTH) if i % 3 == 0 else TRUTH) for i, view in enumerate(VIEWS)]
    tree = grown(views)
    assert tree.parents.tolist() == [-1, NUM_CLASSES, NUM_CLASSES, -1, -1]
    assert tree.agreement[NUM_CLASSES] == pytest.approx(0.3, abs=0.1)


def test_views_that_agree_on_objects_make_neither_parts_nor_wholes() -> None:
    tree = grown([shuffled(view) for view in VIEWS])
    assert len(tree) == NUM_CLASSES and tree.granularities == (tree.level,)
    np.testing.assert_array_equal(tree.leaves, TRUTH)


def test_without_views_objects_are_all_there_is() -> None:
    np.testing.assert_array_equal(grown([]).leaves, TRUTH)


def test_the_tree_has_the_same_bits_in_any_order_of_views_and_ids() -> None:
    truths = [TRUTH, halved(1), halved(2), np.where(TRUTH == 3, 2, TRUTH)]
    views = [seen_as(view, truths[i % 4]) for i, view in enumerate(VIEWS)]
    expected = grown(views)
    assert len(expected) > NUM_CLASSES
    for seed in (1, 2):
        order = np.random.default_rng(seed).permutation(len(views))
        found = grown([shuffled(views[i], seed) for i in order])
        for name in ("parents", "agreement", "leaves"):
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_every_node_is_shown_by_several_views() -> None:
    """The slow reading of what a segment has to be: it fits the node better than either of what merged to it."""
    views = views_in_halves()
    tree = grown(views)
    lifted = {v.name: Lifted.of(make_operator(SCENE, v.camera).lift(v.read_labels())) for v in views}
    for part in tree.parts(1):
        inside = np.isin(tree.leaves, [part])
        shown = 0
        for one in lifted.values():
            dense = one.weights.toarray()[one.ids > 0]
            there = inside[one.gaussians]
            mine = dense[:, there].sum(axis=1)
            shown += bool((mine / (dense.sum(axis=1) + mine.sum() - mine)).max() > 0.5)
        assert shown >= 3


def test_an_object_table_adds_the_tree_to_a_segmentation() -> None:
    views = views_in_halves()
    table = find_objects(SCENE, views, AssociationSettings(agreement=0.4))
    learner = VoteLearner(SCENE, len(table.class_names))
    learner.observe_all([table.relabelled(view) for view in views])
    learner.fit()
    objects = Segmentation.from_codes(SCENE, learner.codes_, table.class_names)
    result = table.with_tree(objects)
    assert result.tree is not None and result.tree.level == 0.4 and len(result.tree) == NUM_CLASSES + 2
    np.testing.assert_array_equal(result.at(0.4).labels, objects.labels)
    fine = result.at(0.9)
    (cut,) = (k for k in range(NUM_CLASSES) if result.tree.parts(k))
    assert sorted(set(fine.class_names) - set(objects.class_names)) == [NUM_CLASSES, NUM_CLASSES + 1]
    assert fine.class_names[NUM_CLASSES] == f"object_{cut:03d}.1" and cut not in fine.class_names
    np.testing.assert_array_equal(np.isin(fine.labels, [NUM_CLASSES, NUM_CLASSES + 1]), objects.labels == cut)
    np.testing.assert_allclose(fine.probabilities.sum(axis=1), objects.probabilities.sum(axis=1), atol=1e-6)


def test_a_tree_is_for_no_segmentation_of_another_scene() -> None:
    scene = balls_on_a_table(seed=1)[0]
    other = Segmentation.from_codes(scene, np.ones((len(scene), 1), np.float32), {})
    with pytest.raises(StateMismatchError, match="belongs to the scene"):
        ObjectTable(SCENE).with_tree(other)


def test_views_that_came_one_by_one_make_the_same_tree() -> None:
    views = views_in_halves()
    codes = np.eye(NUM_CLASSES, dtype=np.float32)[TRUTH]
    found = []
    for order in (views, views[::-1]):
        table = ObjectTable(SCENE)
        for view in order:
            table.match(view)
        names = {k: object_name(k) for k in range(NUM_CLASSES)}
        found.append(table.with_tree(Segmentation.from_codes(SCENE, codes, names, UNREFINED)).tree)
    np.testing.assert_array_equal(found[0].leaves, found[1].leaves)
    np.testing.assert_array_equal(found[0].agreement, found[1].agreement)
    assert len(found[0]) == NUM_CLASSES + 2


def test_the_command_writes_the_level_that_is_asked_for_and_keeps_the_objects(tmp_path: Path) -> None:
    data = write_dataset(tmp_path / "data", SCENE, TRUTH, ring(24), NAMES)
    for i, view in enumerate(Dataset(data).views("train")):
        labels = seen_as(view, TRUTH if i % 3 else halved(1)).read_labels()
        write_mask(data / "labels" / f"{view.name}.png", labels, 8)
    inputs = [f"{data}/scene.ply", "--data", str(data), "--ids", "per-view", "--learner", "votes", "--quiet"]
    assert main(["segment", *inputs, "--out", f"{tmp_path}/out", "--granularity", "0.9"]) == 0
    report = json.loads((tmp_path / "out/report.json").read_text())
    names = {entry["name"]: entry for entry in report["classes"]}
    parts = sorted(name for name in names if "." in name)
    assert len(parts) == 2 and len(report["ids"]["tree"]) == 2
    assert [names[part]["gaussians"] for part in parts] == [one["gaussians"] for one in report["ids"]["tree"]]
    whole = parts[0].removesuffix(".1")
    assert whole not in names and (tmp_path / "out" / names[parts[1]]["ply"]).is_file()
    scene = GaussianScene.load(data / "scene.ply")
    result = Segmentation.load(tmp_path / "out/segmentation.npz", scene)
    assert list(result.class_names.values()) == ["background", "object_001", "object_002", "object_003"]
    assert (
        result.tree is not None
        and sum(names[part]["gaussians"] for part in parts)
        == (result.counts()[result.tree._classes[names[parts[0]]["id"]]])
    )
    left = tmp_path / "left.ply"
    assert main(["remove", f"{data}/scene.ply", "--segmentation", f"{tmp_path}/out/segmentation.npz",
                 "--class", parts[0], "--out", str(left)]) == 0  # fmt: skip
    assert len(GaussianScene.load(left)) == len(scene) - names[parts[0]]["gaussians"]


def test_a_granularity_is_for_ids_of_each_views_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = write_dataset(tmp_path / "data", SCENE, TRUTH, ring(6), NAMES)
    inputs = ["segment", f"{data}/scene.ply", "--data", str(data), "--out", f"{tmp_path}/out", "--quiet"]
    assert main([*inputs, "--granularity", "0.5"]) == 2
    assert "expected ids per-view" in capsys.readouterr().err
    assert main([*inputs, "--ids", "per-view", "--granularity", "1.5"]) == 2
    assert "granularity is 1.5; expected a share in [0, 1]" in capsys.readouterr().err
