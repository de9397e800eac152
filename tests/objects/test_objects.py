"""Extracted objects: their silhouettes, what is carved away, and the scene without them."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path

import numba as nb
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from object_ceiling import best_selection
from object_scores import ObjectScores, objects_of
from scipy.spatial.transform import Rotation
from small_scenes import (
    HEIGHT,
    NAMES,
    NUM_CLASSES,
    WIDTH,
    balls_on_a_table,
    clean_views,
    look_at,
    many_classes,
    ring,
    true_labels,
    write_dataset,
)

from gsseg_core.cli.main import main
from gsseg_core.data.class_names import class_ids
from gsseg_core.data.view import View
from gsseg_core.errors import EmptySceneError, MaskSizeError, SettingsError
from gsseg_core.export.class_files import export_classes
from gsseg_core.objects.removal import without_objects
from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.cpu.objects_alone import TileObjects
from gsseg_core.raster.depth import BEHIND, depths, surface
from gsseg_core.refine import silhouette_carving
from gsseg_core.refine.settings import UNREFINED, RefineSettings
from gsseg_core.refine.silhouette_carving import ENOUGH, Silhouette, kept_shares, looked_from, sticking_out
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import REMOVED, Segmentation

SCENE, TRUTH = balls_on_a_table()
LABELS = TRUTH.astype(np.int32)


def silhouettes(scene: GaussianScene = SCENE, cameras: list[Camera] | None = None) -> list[Silhouette]:
    out = []
    for camera in cameras or ring(3):
        out.append(Silhouette.of(scene, make_operator(scene, camera), true_labels(SCENE, TRUTH, camera)))
    return out


def shares_of(scene: GaussianScene, labels: np.ndarray, views: list[Silhouette], steps: int) -> np.ndarray:
    return kept_shares(scene, labels, views, lambda shown: shown, steps=steps)


def carve(scene: GaussianScene, labels: np.ndarray, views: list[Silhouette]) -> np.ndarray:
    return sticking_out(kept_shares(scene, labels, views, lambda shown: shown), labels)


def scores(labels: np.ndarray, scene: GaussianScene = SCENE, turn: float = 0.3) -> ObjectScores:
    result, objects = ObjectScores(NUM_CLASSES), objects_of(scene, labels)
    for camera in ring(3, turn=turn):
        depth = surface(SCENE, make_operator(SCENE, camera)).depth
        result.add(objects, camera, true_labels(SCENE, TRUTH, camera), depth)
    return result


def with_fringe() -> tuple[GaussianScene, np.ndarray, np.ndarray]:
    """The scene with flat discs of the table, around the balls, taken for parts of these; and which they are."""
    distance = np.linalg.norm(
        SCENE.means[:, None, :2] - [SCENE.means[k == LABELS, :2].mean(axis=0) for k in (1, 2, 3)], axis=2
    )
    labels = LABELS.copy()
    fringe = (LABELS == 0) & (distance.min(axis=1) > 0.5) & (distance.min(axis=1) < 0.7) & (SCENE.means[:, 2] < 1)
    labels[fringe] = distance.argmin(axis=1)[fringe] + 1
    return SCENE, labels, fringe


def slow_shares(scene: GaussianScene, labels: np.ndarray, views: list[Silhouette], steps: int) -> np.ndarray:
    """Readable twin of `kept_shares`: each Gaussian's alpha is the weight that it has when it is alone."""
    kept = np.ones(len(scene))
    each, cameras = [scene.subset([i]) for i in range(len(scene))], [view.operator.camera for view in views]
    alphas = [np.stack([1 - make_operator(one, camera).transmittance() for one in each]) for camera in cameras]
    for _ in range(steps):
        stay, go = np.zeros(len(scene)), np.zeros(len(scene))
        for view, camera, alpha in zip(views, cameras, alphas, strict=True):
            for k in range(1, labels.max() + 1):
                members = np.flatnonzero(labels == k)
                through = np.prod(1 - kept[members, None, None] * alpha[members], axis=0)
                need = through / (1 - through + 1e-3) * (view.labels == k)
                excess = (view.labels != k) & (view.labels >= 0)
                for i in members:
                    shows = excess & (depths(scene, camera, np.array([i]))[0] <= BEHIND * view.depth)
                    stay[i] += (alpha[i] * need).sum()
                    go[i] += (alpha[i] * shows).sum()
        kept = np.where(go > 0, np.clip(kept * stay / np.maximum(go, 1e-30), 0.01, 1), kept)
    return kept


def test_shares_agree_with_their_slow_twin() -> None:
    chosen = np.concatenate([np.flatnonzero(k == LABELS)[:20] for k in range(NUM_CLASSES)])
    scene, labels = SCENE.subset(chosen), LABELS[chosen]
    labels[:4] = 1
    views = []
    for camera in ring(2):
        shown = true_labels(SCENE, TRUTH, camera)
        shown[:10] = -1
        views.append(Silhouette.of(scene, make_operator(scene, camera), shown))
    result = shares_of(scene, labels, views, steps=3)
    np.testing.assert_allclose(result, slow_shares(scene, labels, views, 3), atol=2e-3)
    assert (result < 0.5).any() and (result == 1).any()


def test_carving_takes_the_fringe_away_and_leaves_the_objects() -> None:
    scene, labels, fringe = with_fringe()
    out = carve(scene, labels, silhouettes())
    assert fringe.sum() > 20 and out[fringe].mean() > 0.9 and out[~fringe].mean() < 0.03
    before, after = scores(labels), scores(np.where(out, 0, labels))
    assert np.nanmean(after.visible.iou) > np.nanmean(before.visible.iou) + 0.1
    assert np.nanmean(after.visible.boundary_iou) > np.nanmean(before.visible.boundary_iou)


def test_who_knows_the_truth_chooses_at_least_as_well_as_who_carves() -> None:
    """To a point of IoU: both find local optima."""
    scene, labels, fringe = with_fringe()
    views = [View.from_arrays(camera, true_labels(SCENE, TRUTH, camera)) for camera in ring(3, turn=0.3)]
    best = best_selection(scene, labels, views, scene)
    gone = best != labels
    assert (best[gone] == REMOVED).all() and not gone[labels <= 0].any() and gone[fringe].mean() > 0.8
    without = scores(labels).visible.iou
    carved_away = scores(np.where(carve(scene, labels, silhouettes()), REMOVED, labels)).visible.iou
    assert (scores(best).visible.iou[1:] > without[1:] + 0.05).all()
    assert np.nanmean(scores(best).visible.iou) > np.nanmean(carved_away) - 0.01


def test_views_that_do_not_fit_into_memory_are_projected_anew_and_change_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene, labels, _ = with_fringe()
    out = carve(scene, labels, silhouettes())
    monkeypatch.setattr(silhouette_carving, "_MEMORY", 0)
    np.testing.assert_array_equal(carve(scene, labels, silhouettes()), out)


def test_who_looks_at_a_view_weighs_it_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """One thread after the other would wait for the caller's, where what renders the views is no CPU."""
    scene, labels, _ = with_fringe()
    expected = carve(scene, labels, silhouettes())
    monkeypatch.setattr("gsseg_core.several_at_once.numba.get_num_threads", lambda: 2)
    looked: list[int] = []
    weighed: list[int] = []
    weigh = TileObjects.reasons_to_go

    def weigh_here(alone: TileObjects, *asked: np.ndarray) -> np.ndarray:
        weighed.append(threading.get_ident())
        return weigh(alone, *asked)

    def look(shown: Silhouette) -> Silhouette:
        looked.append(threading.get_ident())
        return shown

    monkeypatch.setattr(TileObjects, "reasons_to_go", weigh_here)
    np.testing.assert_array_equal(sticking_out(kept_shares(scene, labels, silhouettes(), look), labels), expected)
    assert sorted(looked) == sorted(weighed) and threading.get_ident() not in weighed


def test_large_views_are_looked_at_with_fewer_pixels_that_count_for_as_many() -> None:
    camera = look_at("above", np.array([0.1, 0.1, 3.5]), 120, 90, 125.0)
    assert looked_from(camera) is camera
    large = replace(camera, width=1200, height=900, K=np.diag([10.0, 10, 1]) @ camera.K)
    small = looked_from(large)
    assert ENOUGH <= small.width * small.height < 1.01 * ENOUGH
    expected = large.project(SCENE.means)[0] * [small.width / large.width, small.height / large.height]
    np.testing.assert_allclose(small.project(SCENE.means)[0], expected)
    shown = Silhouette.of(SCENE, make_operator(SCENE, small), true_labels(SCENE, TRUTH, small), view=large)
    assert shown.stands_for == large.width * large.height / (small.width * small.height)


def test_a_view_with_a_quarter_of_the_pixels_weighs_as_much() -> None:
    scene, labels, _ = with_fringe()
    views = silhouettes()
    alone = shares_of(scene, labels, views[:1], steps=1)
    heavier = [views[0]._replace(stands_for=3.0), *views[1:]]
    repeated = [views[0], views[0], *views]
    np.testing.assert_allclose(shares_of(scene, labels, heavier, 1), shares_of(scene, labels, repeated, 1), rtol=1e-5)
    np.testing.assert_allclose(shares_of(scene, labels, heavier[:1], steps=1), alone, rtol=1e-5)


def test_an_object_of_one_gaussian_that_sticks_out_stays() -> None:
    scene, truth = many_classes(9)
    camera = look_at("above", np.array([0.1, 0.1, 3.5]), 120, 90, 125.0)
    shown = true_labels(scene, truth, camera)
    shares = shares_of(scene, truth, [Silhouette.of(scene, make_operator(scene, camera), shown)], steps=5)
    assert (shares[1:] < 0.5).any() and not sticking_out(shares, truth).any()


def test_background_and_what_no_view_sees_is_never_carved() -> None:
    _, labels, _ = with_fringe()
    labels[-3:] = 1  # out of sight
    labels[:5] = REMOVED
    out = carve(SCENE, labels, silhouettes())
    assert not out[labels <= 0].any() and not out[-3:].any()
    assert not carve(SCENE, labels, []).any()


@settings(max_examples=5)
@given(seed=st.integers(0, 10**6))
def test_order_of_gaussians_and_number_of_threads_change_nothing_in_what_is_carved(seed: int) -> None:
    scene, labels, _ = with_fringe()
    out = carve(scene, labels, silhouettes())
    order = np.random.default_rng(seed).permutation(len(scene))
    threads = nb.get_num_threads()
    nb.set_num_threads(1)
    try:
        again = carve(scene.subset(order), labels[order], silhouettes(scene.subset(order)))
    finally:
        nb.set_num_threads(threads)
    np.testing.assert_array_equal(again, out[order])


def test_a_rigid_motion_carves_the_same() -> None:
    scene, labels, _ = with_fringe()
    turn = Rotation.from_euler("xyz", [0.4, -1.1, 2.0])
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = turn.as_matrix(), [0.3, -2, 1]
    turned = turn * Rotation.from_quat(np.roll(scene.quats, -1, axis=1))  # SciPy has the scalar last.
    quats = np.roll(turned.as_quat(), 1, axis=1)
    moved = GaussianScene.from_arrays(
        scene.means @ motion[:3, :3].T + motion[:3, 3], quats, scene.scales, scene.opacities, scene.sh
    )
    there = []
    for view in silhouettes():
        c = view.operator.camera
        camera = Camera(c.name, c.width, c.height, c.K, c.world_to_camera @ np.linalg.inv(motion))
        there.append(Silhouette.of(moved, make_operator(moved, camera), view.labels))
    assert (carve(moved, labels, there) != carve(scene, labels, silhouettes())).sum() <= 2


def test_a_segmentation_carves_itself_by_what_it_renders() -> None:
    result = Segmentation.from_codes(SCENE, np.eye(NUM_CLASSES, dtype=np.float32)[TRUTH], NAMES, UNREFINED)
    after = result.carved(SCENE, ring(3))
    changed = after.labels != result.labels
    assert (after.labels[changed] == REMOVED).all() and changed.mean() < 0.05
    np.testing.assert_array_equal(after.probabilities, result.probabilities)


def test_a_label_map_of_another_size_is_refused() -> None:
    camera = ring(1)[0]
    with pytest.raises(MaskSizeError, match=rf"view0.*shape \(3, 4\); expected \({HEIGHT}, {WIDTH}\)"):
        Silhouette.of(SCENE, make_operator(SCENE, camera), np.zeros((3, 4), np.int32))


def segmentation() -> Segmentation:
    return Segmentation.from_codes(SCENE, np.eye(NUM_CLASSES, dtype=np.float32)[TRUTH], NAMES, UNREFINED)


@pytest.mark.parametrize("classes", [[1], [2, 3], [0]])
def test_objects_and_the_scene_without_them_make_up_the_scene(tmp_path: Path, classes: list[int]) -> None:
    result = segmentation()
    rest = without_objects(SCENE, result, classes)
    rest.save(tmp_path / "rest.ply")
    read = GaussianScene.load(tmp_path / "rest.ply")
    plys = export_classes(SCENE, result, tmp_path / "classes")
    assert read.vertices.dtype == SCENE.vertices.dtype
    parts = [read.vertices, *(GaussianScene.load(plys[k]).vertices[list(SCENE.vertices.dtype.names)] for k in classes)]
    together = np.sort(np.concatenate([part.astype(SCENE.vertices.dtype) for part in parts]))
    np.testing.assert_array_equal(together, np.sort(SCENE.vertices))
    np.testing.assert_array_equal(read.vertices, SCENE.vertices[~np.isin(TRUTH, classes)])


def test_what_cannot_be_removed_is_refused_by_name() -> None:
    result = segmentation()
    with pytest.raises(SettingsError, match=r"remove class 7, which has no Gaussians; expected some of: 0 \(backgr"):
        without_objects(SCENE, result, [1, 7])
    with pytest.raises(SettingsError, match="remove no class"):
        without_objects(SCENE, result, [])
    with pytest.raises(EmptySceneError, match="nothing is left without 4 classes"):
        without_objects(SCENE, result, range(NUM_CLASSES))
    with pytest.raises(SettingsError, match=r"class 'chair' does not exist; expected one of 0 \(background\), 1"):
        class_ids(["box", "chair"], result.class_names)
    assert class_ids(["box", "1"], result.class_names) == [3, 1]
    with pytest.raises(SettingsError, match=r"2 classes have the name 'chair'; expected one of their ids, 4, 6$"):
        class_ids(["chair"], {4: "chair", 5: "cup", 6: "chair"})


def test_a_number_is_the_id_of_a_class_whatever_others_are_called() -> None:
    names = {1: "7", 2: "007", 7: "chair", 9: "8"}
    assert class_ids(["7", "1", "7"], names) == [7, 1]
    assert class_ids(["8", "chair"], names) == [9, 7]
    with pytest.raises(SettingsError, match="class '²' does not exist"):
        class_ids(["²"], names)


def test_gsseg_remove_writes_the_rest_and_refuses_what_is_not_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = write_dataset(tmp_path / "data")
    segmentation().save(tmp_path / "segmentation.npz")
    command = ["remove", f"{data}/scene.ply", "--segmentation", f"{tmp_path}/segmentation.npz"]
    assert main([*command, "--class", "box", "--class", "1", "--out", f"{tmp_path}/rest.ply"]) == 0
    kept = int((~np.isin(TRUTH, [1, 3])).sum())
    assert f"without 3 (box), 1 (red ball): {kept:,} of {len(SCENE):,} Gaussians" in capsys.readouterr().out
    assert len(GaussianScene.load(tmp_path / "rest.ply")) == kept
    assert main([*command, "--class", "chair", "--out", f"{tmp_path}/none.ply"]) == 2
    assert f"{tmp_path}/segmentation.npz: class 'chair' does not exist" in capsys.readouterr().err
    assert not (tmp_path / "none.ply").exists()


def test_gsseg_remove_writes_the_format_that_the_suffix_says(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = write_dataset(tmp_path / "data")
    segmentation().save(tmp_path / "segmentation.npz")
    command = ["remove", f"{data}/scene.ply", "--segmentation", f"{tmp_path}/segmentation.npz", "--class", "box"]
    assert main([*command, "--out", f"{tmp_path}/rest.splat"]) == 0
    kept = int((TRUTH != 3).sum())
    assert (tmp_path / "rest.splat").stat().st_size == 32 * kept and f"{kept:,} of" in capsys.readouterr().out
    assert main([*command, "--out", f"{tmp_path}/rest.bin", "--format", "glb"]) == 0
    assert (tmp_path / "rest.bin").read_bytes().startswith(b"glTF")
    assert main([*command, "--out", f"{tmp_path}/rest.spz", "--format", "glb"]) == 2
    assert "rest.spz: has the suffix of the format spz, but glb is asked for" in capsys.readouterr().err


def test_gsseg_remove_writes_meshes_of_the_objects_that_are_left(tmp_path: Path) -> None:
    from pxr import Usd

    data = write_dataset(tmp_path / "data")
    segmentation().save(tmp_path / "segmentation.npz")
    command = ["remove", f"{data}/scene.ply", "--segmentation", f"{tmp_path}/segmentation.npz", "--class", "box"]
    out = tmp_path / "rest"
    out.mkdir()
    assert main([*command, "--out", f"{out}/rest.compressed.ply", "--collision"]) == 0
    assert sorted(path.name for path in out.iterdir()) == [
        "rest.compressed.ply", "rest_1_red_ball.obj", "rest_2_cup_mug.obj"
    ]  # fmt: skip
    assert main([*command, "--out", f"{out}/rest.usdc", "--collision"]) == 0
    stage = Usd.Stage.Open(f"{out}/rest.usdc")
    meshes = [prim.GetParent().GetName() for prim in stage.Traverse() if prim.GetName() == "collision"]
    assert len(meshes) == 2 and len(list(out.iterdir())) == 4


def test_meshes_beside_what_is_left_are_of_that_and_of_nothing_before(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = write_dataset(tmp_path / "data")
    segmentation().save(tmp_path / "segmentation.npz")
    out = tmp_path / "out"

    def remove(name: str, *options: str) -> int:
        given = [f"{data}/scene.ply", "--segmentation", f"{tmp_path}/segmentation.npz", "--class", name]
        return main(["remove", *given, "--out", f"{out}/rest.ply", *options])

    assert remove("box", "--collision") == 0
    (out / "rest_0_background.obj").write_text("v 0 0 0\n")  # somebody's
    (out / "other_1_red_ball.obj").write_bytes((out / "rest_1_red_ball.obj").read_bytes())
    assert remove("red ball", "--collision") == 0
    written = ["rest.ply", "rest_2_cup_mug.obj", "rest_3_box.obj"]
    others = ["other_1_red_ball.obj", "rest_0_background.obj"]
    assert sorted(path.name for path in out.iterdir()) == sorted(written + others)
    assert remove("red ball") == 0 and (out / "rest_3_box.obj").is_file()  # They were not asked for again.
    before = {path.name: path.read_bytes() for path in out.iterdir() if path.is_file()}
    (out / "rest_2_cup_mug.obj").unlink()
    (out / "rest_2_cup_mug.obj").mkdir()
    del before["rest_2_cup_mug.obj"]
    assert remove("box", "--collision") == 2 and "rest_2_cup_mug.obj" in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in out.iterdir() if path.is_file()} == before
    (out / "rest_2_cup_mug.obj").rmdir()
    every = ["--class", "red ball", "--class", "cup/mug", "--collision"]
    assert remove("box", *every) == 0  # Of what is left, there is no mesh.
    assert sorted(path.name for path in out.iterdir()) == sorted(["rest.ply", *others])


def test_gsseg_segment_carves_when_asked_to(tmp_path: Path) -> None:
    data = write_dataset(tmp_path / "data")
    out = tmp_path / "out"
    assert main(["segment", f"{data}/scene.ply", "--data", str(data), "--out", str(out), "--carve", "--quiet"]) == 0
    report = (out / "report.json").read_text()
    assert '"carve": true' in report and '"filter": false' in report


@pytest.mark.parametrize("wrong", [{"carve_views": 0}, {"carve_views": 1.5}, {"carve": True, "filter": True}])
def test_settings_of_carving_out_of_range_are_refused_by_name(wrong: dict[str, float]) -> None:
    with pytest.raises(SettingsError, match=r"refinement: found .*carve.*; expected"):
        RefineSettings(**wrong)


def test_clean_views_carve_hardly_anything() -> None:
    """The truth itself has nothing to carve but what lies across an edge."""
    views = [Silhouette.of(SCENE, make_operator(SCENE, v.camera), v.read_labels()) for v in clean_views(4)]
    assert carve(SCENE, LABELS, views).mean() < 0.05
