"""Classes and selections in every format that scenes are written in, and meshes to collide with."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from other_readers import by_usd
from pxr import Usd, UsdGeom, UsdPhysics, UsdSemantics
from small_scenes import NAMES, NUM_CLASSES, balls_on_a_table

from gsseg_core.data.class_names import MAX_CLASS_NAME
from gsseg_core.errors import EmptySceneError, PathTakenError, SettingsError
from gsseg_core.export import class_files
from gsseg_core.export.class_files import class_file_name, export_classes, write_selection
from gsseg_core.export.collision import HULL, KINDS, POISSON, SURFACE, collision_meshes
from gsseg_core.export.poisson_surface import Voxels
from gsseg_core.files.run_folder import RUN_FILE
from gsseg_core.refine.settings import RefineSettings
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.scene_writers import SCENE_WRITERS
from gsseg_core.scene.triangle_mesh import TriangleMesh
from gsseg_core.segmentation import Segmentation

SCENE, TRUTH = balls_on_a_table()
SURE = np.ones(len(SCENE), np.float32)
HOSTILE = {
    0: "background", 1: "<script>alert(1)</script>", 2: "../../etc/passwd", 3: "x" * MAX_CLASS_NAME,
}  # fmt: skip


def segmented(names: Mapping[int, str] = NAMES, scene: GaussianScene = SCENE) -> Segmentation:
    codes = np.eye(NUM_CLASSES, dtype=np.float32)[TRUTH[: len(scene)]]
    return Segmentation.from_codes(scene, codes, names, RefineSettings(cluster=False, filter=False))


def meshes_in(scene: GaussianScene, result: Segmentation, kind: str) -> dict[int, TriangleMesh]:
    return collision_meshes(scene, result.labels, result.confidence, kind)


@functools.cache
def meshes_of(kind: str | None) -> dict[int, TriangleMesh]:
    return {} if kind is None else meshes_in(SCENE, segmented(), kind)


@pytest.fixture
def meshes_made_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have the meshes of SCENE made once, which takes most of the time; for tests of what is written of them."""
    monkeypatch.setattr(class_files, "collision_meshes", lambda scene, labels, confidence, kind, *_: meshes_of(kind))


def visible(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if path.name != RUN_FILE)


@pytest.mark.parametrize("scene_format", [name for name, writer in SCENE_WRITERS.items() if not writer.together])
def test_every_class_has_a_file_of_the_format_asked_for(tmp_path: Path, scene_format: str) -> None:
    suffix = SCENE_WRITERS[scene_format].suffixes[0]
    paths = export_classes(SCENE, segmented(), tmp_path, scene_format)
    names = ["0_background", "1_red_ball", "2_cup_mug", "3_box"]
    assert [path.name for path in paths.values()] == visible(tmp_path) == [f"{name}{suffix}" for name in names]


def test_usd_has_a_labelled_prim_for_every_class_under_one_scene(tmp_path: Path) -> None:
    paths = export_classes(SCENE, segmented(), tmp_path, "usd")
    assert set(paths.values()) == {tmp_path / "objects.usdc"} and list(paths) == [0, 1, 2, 3]
    stage = Usd.Stage.Open(str(tmp_path / "objects.usdc"))
    root = stage.GetDefaultPrim()
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and root.GetPath() == "/Scene"
    names = ["class_0_background", "class_1_red_ball", "class_2_cup_mug", "class_3_box"]
    assert [prim.GetName() for prim in root.GetChildren()] == names
    for k, prim in enumerate(root.GetChildren()):
        splats = prim.GetChild("splats")
        assert splats.GetTypeName() == "ParticleField3DGaussianSplat"
        assert list(UsdSemantics.LabelsAPI(splats, "class").GetLabelsAttr().Get()) == [NAMES[k]]
        found = by_usd(tmp_path / "objects.usdc", str(splats.GetPath()))
        np.testing.assert_array_equal(found.means, SCENE.means[k == TRUTH])
    # Up, which is -y in a scene, is y in the world of the stage.
    world = UsdGeom.XformCache().GetLocalToWorldTransform(splats).TransformDir((0, -1, 0))
    np.testing.assert_allclose(world, (0, 1, 0), atol=1e-6)


@pytest.mark.parametrize("scene_format", SCENE_WRITERS)
def test_hostile_names_of_classes_are_harmless(tmp_path: Path, scene_format: str) -> None:
    out = tmp_path / "out"
    paths = export_classes(SCENE, segmented(HOSTILE), out, scene_format, HULL)
    assert all(path.parent == out and path.is_file() for path in paths.values())
    assert [path for path in tmp_path.iterdir()] == [out]
    assert all(path.is_file() and len(path.name) < 120 and "<" not in path.name for path in out.iterdir())
    if scene_format == "usd":
        stage = Usd.Stage.Open(str(out / "objects.usdc"))
        labels = [UsdSemantics.LabelsAPI(prim, "class").GetLabelsAttr().Get()[0]
                  for prim in stage.Traverse() if prim.GetName() == "splats"]  # fmt: skip
        assert labels == list(HOSTILE.values())


def test_names_that_become_the_same_are_kept_apart_by_their_ids(tmp_path: Path) -> None:
    names = {0: "background", 1: "a/b", 2: "a b", 3: "a?b"}
    assert len(set(export_classes(SCENE, segmented(names), tmp_path, "glb").values())) == 4
    export_classes(SCENE, segmented(names), tmp_path, "usd")
    stage = Usd.Stage.Open(str(tmp_path / "objects.usdc"))
    assert len(stage.GetDefaultPrim().GetChildren()) == 4
    assert visible(tmp_path) == ["objects.usdc"]  # The files of the export before it are gone.


@pytest.mark.usefixtures("meshes_made_once")
@pytest.mark.parametrize("kind", KINDS)
def test_every_object_but_the_background_has_a_closed_mesh(tmp_path: Path, kind: str) -> None:
    export_classes(SCENE, segmented(), tmp_path, "ply", kind)
    meshes = sorted(tmp_path.glob("*.obj"))
    assert [path.name for path in meshes] == ["1_red_ball.obj", "2_cup_mug.obj", "3_box.obj"]
    for k, path in enumerate(meshes, start=1):
        mesh = trimesh.load(path, force="mesh")
        assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0
        assert mesh.is_convex or kind != HULL
        own = SCENE.means[k == TRUTH]
        np.testing.assert_allclose(mesh.bounds, [own.min(axis=0) - 0.09, own.max(axis=0) + 0.09], atol=0.04)
        assert path.read_text().startswith("# gsseg_run ")


def test_meshes_tell_how_many_are_made_and_no_meshes_tell_nothing() -> None:
    told: list[tuple[str, int, int]] = []
    result = segmented()
    for kind in (None, HULL):
        made = collision_meshes(SCENE, result.labels, result.confidence, kind, lambda *step: told.append(step))
        assert told == ([] if kind is None else [("mesh", done, 3) for done in range(4)])
    assert list(made) == [1, 2, 3]


def test_a_surface_follows_a_hollow_that_a_hull_closes() -> None:
    turns = 2 * np.pi * np.arange(200) / 200
    rings = [np.stack([np.cos(turns) * r, np.sin(turns) * r, np.full(200, z)], axis=1)
             for z in (-0.1, 0, 0.1) for r in (0.8, 0.9, 1.0)]  # fmt: skip
    means = np.concatenate(rings)
    scene = GaussianScene.from_arrays(
        means, np.tile([1.0, 0, 0, 0], (len(means), 1)), np.full((len(means), 3), 0.05), np.full(len(means), 0.9),
        np.zeros((len(means), 1, 3)),
    )  # fmt: skip
    codes = np.tile(np.float32([0, 1]), (len(means), 1))
    ring = Segmentation.from_codes(scene, codes, {0: "background", 1: "ring"}, RefineSettings(cluster=False))
    volumes = {}
    for kind in KINDS:
        mesh = meshes_in(scene, ring, kind)[1]
        closed = trimesh.Trimesh(mesh.points, mesh.triangles)
        assert closed.is_watertight and closed.euler_number == (2 if kind == HULL else 0)
        volumes[kind] = closed.volume
    ring_volume = np.pi * (1.05**2 - 0.75**2) * 0.3
    assert abs(volumes[SURFACE] / ring_volume - 1) < 0.15 and volumes[HULL] > 1.8 * volumes[SURFACE]
    assert abs(volumes[POISSON] / ring_volume - 1) < 0.1


def shells(points: np.ndarray, scale: float | tuple[float, float, float]) -> tuple[GaussianScene, Segmentation]:
    """A scene of nothing but one object, Gaussians of one size at these places (M, 3)."""
    count = len(points)
    scales = np.broadcast_to(scale, (count, 3))
    scene = GaussianScene.from_arrays(
        points, np.tile([1.0, 0, 0, 0], (count, 1)), scales, np.full(count, 0.9), np.zeros((count, 1, 3))
    )
    codes = np.tile(np.float32([0, 1]), (count, 1))
    names = {0: "background", 1: "thing"}
    return scene, Segmentation.from_codes(scene, codes, names, RefineSettings(cluster=False))


@pytest.mark.parametrize(("seed", "count", "sides", "scale"), [(7, 1400, (1, 0.35, 0.35), 0.04), (16, 1500, 1, 0.05)])
def test_a_surface_of_whatever_shape_is_watertight_and_has_no_cavity(
    seed: int, count: int, sides: float | tuple[float, float, float], scale: float
) -> None:
    points = np.random.default_rng(seed).uniform(-1, 1, (count, 3)) * sides
    mesh = meshes_in(*shells(points, scale), SURFACE)[1]
    closed = trimesh.Trimesh(mesh.points, mesh.triangles)  # Corners in one place become one.
    assert closed.is_watertight and all(piece.volume > 0 for piece in closed.split())


def test_a_surface_around_few_and_wide_gaussians_has_neither_gaps_nor_pieces() -> None:
    mesh = meshes_in(*shells(np.array([[-0.5, 0, 0], [0.5, 0, 0]]), (0.5, 0.4, 0.3)), SURFACE)[1]
    closed = trimesh.Trimesh(mesh.points, mesh.triangles)
    assert closed.body_count == 1 and closed.volume == pytest.approx(2 * 4 / 3 * np.pi * 0.5 * 0.4 * 0.3, rel=0.1)


def test_a_poisson_surface_closes_a_box_without_a_bottom_and_leaves_a_bowl_hollow() -> None:
    rng = np.random.default_rng(0)
    walls = []
    for axis, side in ((0, -1), (0, 1), (1, -1), (1, 1), (2, 1)):
        wall = rng.uniform(-1, 1, (800, 3))
        wall[:, axis] = side
        walls.append(wall)
    half = rng.normal(size=(1500, 3))
    half = np.abs(half / np.linalg.norm(half, axis=1, keepdims=True)) * [1, 1, -1]
    half[:, :2] *= rng.choice([-1, 1], (1500, 2))
    bowl = np.concatenate([half, 0.85 * half])
    for points, scale, volume in (
        (np.concatenate(walls), 0.04, 8 * 1.04**3), (bowl, 0.03, 2 / 3 * np.pi * (1.03**3 - 0.82**3))
    ):  # fmt: skip
        mesh = meshes_in(*shells(points, scale), POISSON)[1]
        closed = trimesh.Trimesh(mesh.points, mesh.triangles)
        assert closed.is_watertight and closed.body_count == 1 and closed.volume == pytest.approx(volume, rel=0.1)


def test_a_poisson_surface_of_a_table_stays_within_its_hull() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (3200, 3)) * (1, 1, 0.02)
    legs = points[:800] * (0.04, 0.04, 25)
    corners = np.array([[-0.9, -0.9], [-0.9, 0.9], [0.9, -0.9], [0.9, 0.9]])
    legs[:, :2] += corners[np.arange(800) % 4]
    table = shells(np.concatenate([points, legs - (0, 0, 0.5)]), 0.03)
    hull, mesh = (meshes_in(*table, kind)[1].points for kind in (HULL, POISSON))
    voxel = np.ptp(hull, axis=0).max() / 64
    assert (mesh.min(axis=0) > hull.min(axis=0) - voxel).all() and (mesh.max(axis=0) < hull.max(axis=0) + voxel).all()


def test_a_point_is_in_the_voxel_around_it_below_the_lowest_ellipsoid_too() -> None:
    voxels = Voxels(np.zeros((9, 9, 9), bool), np.float32([1, 2, 3]), 0.5, margin=4)
    places = np.argwhere(~voxels.filled)
    middles = voxels.low + (places - voxels.margin + 0.5) * voxels.size
    for shift in (-0.2, 0.2):
        np.testing.assert_array_equal(np.stack(voxels.cells(middles + shift), axis=1), places)


def test_a_sheet_that_is_seen_from_both_sides_gets_the_surface_around_it() -> None:
    x, y = (side.ravel() for side in np.meshgrid(np.linspace(-1, 1, 30), np.linspace(-1, 1, 30)))
    sheet = shells(np.stack([x, y, 0 * x], axis=1), (0.05, 0.05, 0.002))
    around, found = (meshes_in(*sheet, kind)[1] for kind in (SURFACE, POISSON))
    np.testing.assert_array_equal(around.points, found.points)


@pytest.mark.usefixtures("meshes_made_once")
@pytest.mark.parametrize("kind", KINDS)
def test_meshes_are_in_the_usd_with_the_collision_schemas(tmp_path: Path, kind: str) -> None:
    export_classes(SCENE, segmented(), tmp_path, "usd", kind)
    stage = Usd.Stage.Open(str(tmp_path / "objects.usdc"))
    parents = stage.GetDefaultPrim().GetChildren()
    assert [prim.GetChild("collision").IsValid() for prim in parents] == [False, True, True, True]
    meshes = meshes_of(kind)
    for k, parent in enumerate(parents[1:], start=1):
        prim = parent.GetChild("collision")
        assert prim.HasAPI(UsdPhysics.CollisionAPI) and UsdGeom.Imageable(prim).GetPurposeAttr().Get() == "guide"
        approximation = UsdPhysics.MeshCollisionAPI(prim).GetApproximationAttr().Get()
        assert approximation == ("convexHull" if kind == HULL else "none")
        np.testing.assert_array_equal(np.array(UsdGeom.Mesh(prim).GetPointsAttr().Get()), meshes[k].points)


def test_floaters_and_haze_do_not_blow_a_mesh_up() -> None:
    far = SCENE.means.copy()
    ball = np.flatnonzero(TRUTH == 1)
    far[ball[0]] = 50
    opacities = SCENE.opacities.copy()
    opacities[ball[1]], far[ball[1]] = 0.01, far[ball[2]] + 1
    scene = GaussianScene.from_arrays(far, SCENE.quats, SCENE.scales, opacities, SCENE.sh)
    for kind in KINDS:
        points = meshes_in(scene, segmented(), kind)[1].points
        assert np.ptp(points, axis=0).max() < 1.1


@pytest.mark.parametrize("kind", KINDS)
def test_a_mesh_of_a_plate_reaches_no_farther_up_for_a_few_gaussians_above_it(kind: str) -> None:
    points = np.random.default_rng(3).uniform(-1, 1, (1500, 3)) * (1, 1, 0.1)
    points[:3] = (0, 0, 0.5), (0.3, 0.2, 0.8), (-0.2, 0.4, 1.2)
    heights = meshes_in(*shells(points, 0.02), kind)[1].points[:, 2]
    assert -0.2 < heights.min() < -0.05 and 0.05 < heights.max() < 0.2


def test_an_object_without_a_volume_has_no_hull_and_a_surface_of_its_voxels() -> None:
    labels = np.zeros(len(SCENE), np.int32)
    labels[0] = 1
    scales = SCENE.scales.copy()
    scales[0] = (0.1, 0.1, np.exp(-40))
    scene = GaussianScene.from_arrays(SCENE.means, SCENE.quats, scales, SCENE.opacities, SCENE.sh)
    flat = replace(segmented(), labels=labels)
    assert meshes_in(scene, flat, HULL) == {} and list(meshes_in(scene, flat, SURFACE)) == [1]


@pytest.mark.parametrize("kind", KINDS)
def test_an_object_of_one_gaussian_has_a_mesh_and_one_that_is_not_opaque_has_none(kind: str) -> None:
    labels = np.zeros(len(SCENE), np.int32)
    labels[-1] = 1
    opacities = SCENE.opacities.copy()
    opacities[0], labels[0] = 0.01, 2
    scene = GaussianScene.from_arrays(SCENE.means, SCENE.quats, SCENE.scales, opacities, SCENE.sh)
    assert list(meshes_in(scene, replace(segmented(), labels=labels), kind)) == [1]


def test_a_selection_in_usd_keeps_its_classes_apart(tmp_path: Path) -> None:
    labels = np.where(TRUTH == 3, -2, TRUTH)
    write_selection(SCENE, TRUTH != 0, labels, SURE, NAMES, tmp_path / "selection.usda", "usd")
    stage = Usd.Stage.Open(str(tmp_path / "selection.usda"))
    assert [prim.GetName() for prim in stage.GetDefaultPrim().GetChildren()] == [
        "class_1_red_ball", "class_2_cup_mug", "scene",
    ]  # fmt: skip
    with pytest.raises(EmptySceneError):
        write_selection(SCENE, TRUTH > 9, labels, SURE, NAMES, tmp_path / "none.usda", "usd")
    assert not (tmp_path / "none.usda").exists()


def test_a_selection_replaces_no_mesh_of_others(tmp_path: Path) -> None:
    edited = tmp_path / "rest_2_cup_mug.obj"
    edited.write_text("# Blender\n")
    with pytest.raises(PathTakenError, match=r"rest_2_cup_mug\.obj: is there and is no mesh of an earlier call"):
        write_selection(SCENE, TRUTH < 9, TRUTH, SURE, NAMES, tmp_path / "rest.ply", "ply", HULL)
    assert visible(tmp_path) == [edited.name] and edited.read_text() == "# Blender\n"


def test_a_format_or_mesh_that_is_not_there_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="format is 'obj'"):
        export_classes(SCENE, segmented(), tmp_path / "out", "obj")
    with pytest.raises(SettingsError, match="collision is 'box'; expected one of hull, surface, poisson"):
        export_classes(SCENE, segmented(), tmp_path / "out", "ply", "box")
    assert not (tmp_path / "out").exists()


def test_file_names_have_the_suffix_of_the_format() -> None:
    assert class_file_name(7, "a chair", "compressed-ply") == "7_a_chair.compressed.ply"
    assert class_file_name(7, "a chair", "usd") == "objects.usdc"
