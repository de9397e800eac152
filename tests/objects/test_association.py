"""Masks whose ids hold only inside their own view: the objects that they show are found, and stay what they are."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import bench_ids
import numpy as np
import pytest
from matching import Contingency, renamed
from per_view_ids import agreement, in_halves, row_of_objects, shuffled, with_labels
from scipy import sparse
from small_scenes import (
    NAMES,
    NUM_CLASSES,
    balls_on_a_table,
    clean_views,
    look_at,
    many_classes,
    ring,
    true_labels,
    write_dataset,
)

from gsseg_core.cli.main import main
from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.dataset import Dataset
from gsseg_core.data.label_images import UNKNOWN, read_mask, write_mask
from gsseg_core.data.view import View
from gsseg_core.errors import SceneValueError, SettingsError
from gsseg_core.learn.em.em_learner import EMLearner
from gsseg_core.objects.association import AssociationSettings, associate
from gsseg_core.objects.lifted_segments import Lifted, Profiles
from gsseg_core.objects.object_table import ObjectTable, find_objects, object_name
from gsseg_core.raster.backends import make_operator
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import Segmentation

SCENE, TRUTH = balls_on_a_table()
VIEWS = clean_views(8)


def test_shuffled_ids_give_the_objects_that_true_ids_give() -> None:
    table = find_objects(SCENE, [shuffled(view) for view in VIEWS])
    assert table.num_objects == 3 and agreement(table, VIEWS) == 1.0
    true = find_objects(SCENE, VIEWS)
    for view in VIEWS:
        found = (part.relabelled(part.views[view.name]).read_labels() for part in (table, true))
        np.testing.assert_array_equal(*found)
    assert table.class_names == {0: "background", 1: "object_001", 2: "object_002", 3: "object_003"}


@pytest.mark.parametrize("votes", [np.full((len(SCENE), 2), np.nan), np.full((len(SCENE), 2), np.inf), np.ones((3, 2))])
def test_views_that_are_not_there_and_votes_that_are_none_are_refused_and_nothing_changes(votes: np.ndarray) -> None:
    table = ObjectTable(SCENE)
    before = table.match(VIEWS[0]).read_labels()
    for use in (table.remove, table.forget):
        with pytest.raises(SettingsError, match="view 'nowhere' was not added; there are 1 others"):
            use("nowhere")
    with pytest.raises(SceneValueError, match=r"objects: votes have shape .*; expected \(626, K\), finite"):
        table.recall(CSRRows.from_dense(votes))
    np.testing.assert_array_equal(table.relabelled(VIEWS[0]).read_labels(), before)


def test_a_view_of_which_no_objects_are_known_has_none_or_is_refused() -> None:
    table = ObjectTable(SCENE)
    table.set_aside(VIEWS[0])
    assert table.objects_in(VIEWS[0].name).objects == {}
    with pytest.raises(SettingsError, match="view 'nowhere' was not added; there are 1 others"):
        table.objects_in("nowhere")
    table.add(VIEWS[1])
    name = VIEWS[1].name
    for use in (lambda: table.objects_in(name), lambda: table.relabelled(VIEWS[1]), lambda: table.forget(name)):
        with pytest.raises(SettingsError, match=r"its objects are not known yet; expected solve\(\) first"):
            use()


def test_what_is_found_does_not_depend_on_the_order_of_the_views() -> None:
    views = [shuffled(in_halves(view, 1 + i % 3)) for i, view in enumerate(VIEWS)]
    lifted = {v.name: Lifted.of(make_operator(SCENE, v.camera).lift(v.read_labels())) for v in views}
    expected = associate(lifted).objects
    for order in (list(lifted)[::-1], list(np.random.default_rng(0).permutation(list(lifted)))):
        found = associate({str(name): lifted[str(name)] for name in order}).objects
        for name, objects in expected.items():
            np.testing.assert_array_equal(found[name], objects)


def test_background_is_an_object_like_others_only_where_masks_do_not_call_it_0() -> None:
    table = find_objects(SCENE, [shuffled(with_labels(view, view.read_labels() + 1)) for view in VIEWS])
    assert table.num_objects == 4 and agreement(table, VIEWS) == 1.0


def test_an_object_that_some_views_split_is_one() -> None:
    views = [shuffled(in_halves(view, 1) if i % 3 == 0 else view) for i, view in enumerate(VIEWS)]
    table = find_objects(SCENE, views)
    assert table.num_objects == 3 and agreement(table, VIEWS) == 1.0
    assert [table.objects_in(view.name).split for view in VIEWS] == [1, 0, 0, 1, 0, 0, 1, 0]
    nothing = Segmentation.from_codes(SCENE, np.zeros((len(SCENE), 4), np.float32), table.class_names)
    summary = table.summary(nothing)
    assert summary["split"] == 3 and summary["merged"] == 0 and summary["objects"] == 3


def test_objects_that_some_views_merge_stay_two() -> None:
    merged = [
        with_labels(view, np.where(view.read_labels() == 2, 1, view.read_labels())) if i % 4 == 0 else view
        for i, view in enumerate(VIEWS)
    ]
    table = find_objects(SCENE, [shuffled(view) for view in merged])
    assert table.num_objects == 3
    right = [view for i, view in enumerate(VIEWS) if i % 4]
    assert agreement(table, right) == 1.0
    assert [table.objects_in(view.name).merged for view in VIEWS] == [1, 0, 0, 0, 1, 0, 0, 0]


def test_undoing_a_solve_brings_back_all_that_the_table_said_before() -> None:
    table = ObjectTable(SCENE)
    for view in VIEWS[:3]:
        table.match(shuffled(view))
    nothing = Segmentation.from_codes(SCENE, np.zeros((len(SCENE), 4), np.float32), table.class_names)
    before, undo = table.summary(nothing), table.checkpoint()
    table.solve()
    assert table.summary(nothing)["granularity"] is not None
    undo()
    assert table.summary(nothing) == before


@pytest.mark.parametrize("change", [lambda table: table.remove(VIEWS[0].name), ObjectTable.solve])
def test_a_change_that_is_interrupted_leaves_the_table_as_it_was(
    change: Callable[[ObjectTable], object], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    table, untouched = ObjectTable(SCENE), ObjectTable(SCENE)
    for view in VIEWS[:3]:
        table.match(shuffled(view))
        untouched.match(shuffled(view))
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Profiles, "add", interrupted)
        change(table)
    nothing = Segmentation.from_codes(SCENE, np.zeros((len(SCENE), 4), np.float32), table.class_names)
    assert table.summary(nothing) == untouched.summary(nothing)
    np.testing.assert_array_equal(*(each.match(shuffled(VIEWS[3])).read_labels() for each in (table, untouched)))


def test_clutter_that_one_view_shows_goes_to_the_background() -> None:
    labels = VIEWS[0].read_labels().copy()
    labels[:6, :10] = np.where(labels[:6, :10] == 0, 9, labels[:6, :10])
    labels[40:, 20:40] = np.where(labels[40:, 20:40] == 0, 9, labels[40:, 20:40])
    table = find_objects(SCENE, [with_labels(VIEWS[0], labels), *VIEWS[1:]])
    assert table.num_objects == 3 and table.objects_in(VIEWS[0].name).objects[9] == 0


def test_views_that_share_nothing_have_objects_of_their_own() -> None:
    far = SCENE.means + np.array([500.0, 0, 0], np.float32)
    two = GaussianScene.from_arrays(
        np.concatenate([SCENE.means, far]), *(np.tile(a, (2,) + (1,) * (a.ndim - 1)) for a in attributes(SCENE))
    )
    there = []
    for view in VIEWS[:3]:
        pose = view.camera.world_to_camera.copy()
        pose[:3, 3] -= pose[:3, :3] @ [500.0, 0, 0]
        camera = type(view.camera)(f"far {view.name}", view.camera.width, view.camera.height, view.camera.K, pose)
        there.append(View.from_arrays(camera, view.read_labels()))
    assert find_objects(two, [*VIEWS[:3], *there]).num_objects == 6


def attributes(scene: GaussianScene) -> tuple[np.ndarray, ...]:
    return scene.quats, scene.scales, scene.opacities, scene.sh


def test_there_can_be_more_than_255_objects() -> None:
    scene, truth = many_classes(300)
    cameras = [look_at(f"v{i}", np.array([0.2 * i, 0.1, 3.5]), 320, 240, 330.0) for i in range(3)]
    rng = np.random.default_rng(0)
    views = []
    for camera in cameras:
        labels = true_labels(scene, truth, camera)
        views.append(View.from_arrays(camera, np.where(labels, 1 + rng.permutation(300)[labels], 0)))
    table = find_objects(scene, views)
    assert table.num_objects == 299
    assert agreement(table, [View.from_arrays(c, true_labels(scene, truth, c)) for c in cameras]) > 0.99


@pytest.mark.parametrize(("split", "merged"), [(0.0, 0.0), (0.8, 0.0), (0.0, 0.25), (0.5, 0.1)])
def test_views_tell_how_often_they_merge_neighbours_and_so_the_objects_are_whole(split: float, merged: float) -> None:
    rng = np.random.default_rng(0)
    views = {f"v{i:02}": row_of_objects(rng, split, merged) for i in range(40)}
    objects = associate(views).objects
    votes = sum(
        sparse.csr_matrix((np.ones(len(ids)), (ids, np.arange(len(ids)))), shape=(400, len(ids))) @ views[name].weights
        for name, ids in objects.items()
    )
    score = Contingency()
    score.add(np.repeat(np.arange(16), 20), np.asarray(votes.argmax(axis=0)).ravel())
    assert score.ari > 0.97


def test_no_view_one_view_and_views_without_evidence_are_no_special_case() -> None:
    assert associate({}).objects == {} and find_objects(SCENE, []).class_names == {0: "background"}
    one = find_objects(SCENE, [shuffled(VIEWS[0])])
    assert one.num_objects == 3 and agreement(one, VIEWS[:1]) == 1.0
    table = ObjectTable(SCENE)
    unknown = with_labels(VIEWS[1], np.full((48, 64), UNKNOWN))
    empty = with_labels(VIEWS[2], np.zeros((48, 64), np.int32))
    there = VIEWS[0].camera
    away = type(there)("away", there.width, there.height, there.K, np.diag([1, -1, -1, 1.0]) @ there.world_to_camera)
    assert not table.add(unknown) and not table.add(View(VIEWS[1].camera))
    assert not table.add(View.from_arrays(away, np.ones((48, 64), np.int32)))
    assert table.add(empty) and table.solve().changed == [empty.name] and table.num_objects == 0
    assert (table.relabelled(unknown).read_labels() == UNKNOWN).all()


def test_views_that_are_added_all_at_once_show_what_they_show_one_by_one() -> None:
    views = [*map(shuffled, VIEWS), View(replace(VIEWS[0].camera, name="without a mask"))]
    at_once, one_by_one = ObjectTable(SCENE), ObjectTable(SCENE)
    at_once.add_all(views)
    assert [one_by_one.add(view) for view in views] == [True] * len(VIEWS) + [False]
    assert at_once.solve().changed == one_by_one.solve().changed
    for view in views[:-1]:
        first, second = (table.relabelled(view).read_labels() for table in (at_once, one_by_one))
        np.testing.assert_array_equal(first, second)


def test_a_view_of_which_labelled_pixels_see_no_gaussian_is_not_taken() -> None:
    operator = make_operator(SCENE, VIEWS[0].camera)
    empty = operator.blend_seen(np.ones((len(operator.ids), 1), np.float32)).transmittance == 1
    view = with_labels(VIEWS[0], np.where(empty, 1, UNKNOWN))
    table = ObjectTable(SCENE)
    assert empty.any() and len(operator.ids) and not table.sees_any(view) and not table.add(view)


def test_pixels_that_are_unknown_stay_unknown() -> None:
    views = []
    for view in VIEWS:
        labels = view.read_labels().copy()
        labels[:, :20] = UNKNOWN
        views.append(with_labels(view, labels))
    table = find_objects(SCENE, [shuffled(view) for view in views])
    assert table.num_objects == 3
    for view in views:
        found = table.relabelled(view).read_labels()
        np.testing.assert_array_equal(found == UNKNOWN, view.read_labels() == UNKNOWN)


def test_a_new_view_is_matched_to_the_objects_so_far() -> None:
    table = ObjectTable(SCENE)
    first = table.match(shuffled(VIEWS[0])).read_labels()
    assert len(np.unique(first[first > 0])) == 3
    for view in VIEWS[1:]:
        table.match(shuffled(view))
    assert table.num_objects == 3 and agreement(table, VIEWS) == 1.0
    assert table.solve().changed == []


def test_solving_repairs_what_matching_could_not_know_and_objects_keep_their_numbers() -> None:
    table = ObjectTable(SCENE)
    views = [in_halves(VIEWS[0], 1), *VIEWS[1:]]
    for view in views:
        table.match(shuffled(view))
    before = {view.name: table.relabelled(view).read_labels() for view in views}
    assert table.num_objects == 4
    repair = table.solve()
    assert table.num_objects == 3 and agreement(table, VIEWS) == 1.0
    assert VIEWS[0].name in repair.changed and len(np.unique(repair.successors)) < len(repair.successors)
    for k in (2, 3):
        place = VIEWS[4].read_labels() == k
        np.testing.assert_array_equal(table.relabelled(VIEWS[4]).read_labels()[place], before[VIEWS[4].name][place])


def test_a_view_can_be_replaced_and_what_was_forgotten_still_matches() -> None:
    table = ObjectTable(SCENE)
    for view in VIEWS[:4]:
        table.match(shuffled(view))
    table.match(shuffled(VIEWS[0], seed=1))
    assert len(table.views) == 4 and table.num_objects == 3
    for view in VIEWS[:4]:
        table.forget(view.name)
    assert table.num_objects == 0
    table.match(shuffled(VIEWS[4]))
    assert set(table.objects_in(VIEWS[4].name).objects.values()) <= {0, 1, 2, 3}


def test_objects_found_are_learnt_as_well_as_with_true_ids() -> None:
    table = find_objects(SCENE, [shuffled(view) for view in VIEWS])
    found, true = EMLearner(SCENE, NUM_CLASSES), EMLearner(SCENE, NUM_CLASSES)
    for view in VIEWS:
        found.observe(table.relabelled(view))
        true.observe(view)
    labels = found.fit().codes_.argmax(axis=1)
    score = Contingency()
    score.add(true.fit().codes_.argmax(axis=1)[:, None], labels[:, None])
    assert score.ari == pytest.approx(1.0)


def test_who_takes_ids_of_each_views_own_for_classes_is_told_of_per_view(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = write_dataset(tmp_path / "data", SCENE, TRUTH, ring(9), NAMES)
    for i, view in enumerate(Dataset(data).views()):
        write_mask(data / "own" / f"{view.name}.png", (view.read_labels() + i) % 7 + 1, 8)
    inputs = [f"{data}/scene.ply", "--data", str(data), "--quiet", "--labels", "own", "--out", f"{tmp_path}/out"]
    assert main(["segment", *inputs]) == 2 and "takes --ids per-view" in capsys.readouterr().err
    (data / "classes.json").unlink()
    assert main(["segment", *inputs]) == 0 and "takes --ids per-view" in capsys.readouterr().err
    assert main(["segment", *inputs, "--ids", "per-view"]) == 0 and "per-view" not in capsys.readouterr().err


def test_objects_that_end_without_a_gaussian_are_listed_apart_and_ids_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = write_dataset(tmp_path / "data", SCENE, TRUTH, ring(9), NAMES)
    monkeypatch.setattr(ObjectTable, "class_names", {k: object_name(k) for k in range(6)})  # Two more than views show.
    for level in ([], ["--granularity", "0.5"]):
        inputs = [f"{data}/scene.ply", "--data", str(data), "--quiet", "--ids", "per-view", *level]
        assert main(["segment", *inputs, "--out", f"{tmp_path}/out"]) == 0
        report = json.loads((tmp_path / "out/report.json").read_text())
        assert [one["id"] for one in report["classes"]] == [0, 1, 2, 3]
        assert report["ids"]["objects"] == 3 and report["ids"]["without_gaussians"] == [4, 5]
        warnings, _, sections = (tmp_path / "out/report.html").read_text().partition("<main>")
        assert "<bdi>object_003</bdi>" in sections and "<bdi>object_004</bdi>" not in sections
        assert "got no Gaussian" in warnings and "<bdi>object_004</bdi>, <bdi>object_005</bdi>." in warnings
        with np.load(tmp_path / "out/segmentation.npz") as file:
            assert file["class_ids"].tolist() == [0, 1, 2, 3, 4, 5]


def test_the_command_finds_the_objects_and_reports_what_the_ids_meant(tmp_path: Path) -> None:
    data = write_dataset(tmp_path / "data", SCENE, TRUTH, ring(9), NAMES)
    for view in Dataset(data).views("train"):
        write_mask(data / "labels" / f"{view.name}.png", shuffled(view).read_labels(), 8)
    inputs = [f"{data}/scene.ply", "--data", str(data), "--quiet"]
    assert main(["segment", *inputs, "--out", f"{tmp_path}/out", "--ids", "per-view"]) == 0
    report = json.loads((tmp_path / "out/report.json").read_text())
    assert report["ids"]["objects"] == 3 and report["ids"]["split"] == report["ids"]["merged"] == 0
    assert len(report["ids"]["views"]) == 6 and report["settings"]["ids"] == "per-view"
    assert report["ids"]["granularity"] == 0.5 and report["settings"]["granularity"] is None
    names = sorted(path.name for path in (tmp_path / "out/classes").iterdir())
    assert names == ["0_background.ply", "1_object_001.ply", "2_object_002.ply", "3_object_003.ply"]
    npz = f"{tmp_path}/out/segmentation.npz"
    assert main(["render", *inputs, "--segmentation", npz, "--out", f"{tmp_path}/maps"]) == 0
    pairs = [
        (read_mask(data / "labels" / p.name).labels, read_mask(p).labels) for p in (tmp_path / "maps").glob("*.png")
    ]
    score = Contingency()
    for pair in pairs:
        score.add(*pair)
    names_of = score.one_to_one()
    assert len(pairs) == 3 and sorted(names_of.values()) == [0, 1, 2, 3] and score.ari > 0.9
    assert np.mean([(truth == renamed(found, names_of)).mean() for truth, found in pairs]) > 0.95


def test_ari_and_matchings_are_those_of_the_definition() -> None:
    score = Contingency()
    truth, found = np.array([[0, 0, 0, 1, 1, 1, UNKNOWN]]), np.array([[5, 5, 7, 7, 8, 8, 9]])
    score.add(truth, found)
    assert score.ari == pytest.approx(0.2424, abs=1e-4)
    assert score.one_to_one() == {5: 0, 8: 1} and score.many_to_one() == {5: 0, 7: 0, 8: 1}
    assert renamed(np.array([5, 7, UNKNOWN]), {5: 0}).tolist() == [0, UNKNOWN, UNKNOWN]


def test_views_of_a_corner_of_something_large_say_that_what_is_beside_it_is_another_thing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A view from afar calls both one; five from close by, which see little of the large one, tell them apart."""

    def lifted(rows: list[list[float]]) -> Lifted:
        weights = sparse.csr_matrix(np.array(rows, np.float32))
        seen = np.flatnonzero(weights.toarray().any(axis=0)).astype(np.int32)
        return Lifted(np.arange(1, len(rows) + 1, dtype=np.int32), seen, weights[:, seen])

    views = {"afar": lifted([[9e4] * 9 + [150.0]])}
    views |= {f"close {i}": lifted([[0.0] * 8 + [3e3, 0.0], [0.0] * 9 + [300.0]]) for i in range(5)}
    objects = associate(views).objects
    large, small = objects["close 0"]
    assert large != small and objects["afar"].tolist() == [large]
    assert all(objects[name].tolist() == [large, small] for name in views if name != "afar")
    monkeypatch.setattr("gsseg_core.objects.sight.PLENTY", np.inf)
    one = associate(views).objects
    assert len(set(np.concatenate(list(one.values())).tolist())) == 1


@pytest.mark.parametrize("agreement", [0.0, 1.0, -0.1, np.nan])
def test_settings_that_make_no_sense_are_refused(agreement: float) -> None:
    with pytest.raises(SettingsError, match="association"):
        AssociationSettings(agreement)


def test_the_benchmark_splits_and_merges_objects_as_often_as_it_says() -> None:
    labels = np.kron(np.arange(400).reshape(20, 20), np.ones((4, 4), int))
    random = np.random.default_rng(0)
    split, merged = bench_ids.cut(labels, random), bench_ids.merged(labels, random)
    assert 0.15 * 399 < len(np.unique(split)) - 400 < 0.25 * 399
    assert 0.15 * 399 < 2 * (400 - len(np.unique(merged))) < 0.25 * 399
    assert (split[labels == 0] == 0).all() and (merged[labels == 0] == 0).all()
    assert len(np.unique(np.stack([split.ravel(), labels.ravel()]), axis=1).T) == len(np.unique(split))
