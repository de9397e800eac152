"""Changes of a scene on disk, and ids in files: whole, or refused with one clear error that names the file."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from small_scenes import balls_on_a_table

from gsseg_core.errors import GssegError, SceneDeltaError, SceneValueError
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.living_scene import LivingScene
from gsseg_core.scene.scene_delta import GroupMove, SceneDelta, read_similarity
from gsseg_core.scene.similarity import Similarity

SCENE, _ = balls_on_a_table()
PART = SCENE.subset(np.arange(20))
NONE = np.empty(0, np.int64)


def change() -> SceneDelta:
    motion = Similarity(1.5, Rotation.from_rotvec([1, 2, 3]).as_matrix(), np.array([1.0, 2, 3]))
    moves = (GroupMove(3, motion, ("a", "b")), GroupMove(0, Similarity()))
    return SceneDelta(4, np.array([7, 2**62]), PART, np.arange(20) + 10**15, np.arange(20) % 4, moves)


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    change().save(tmp_path / "delta.npz")
    return tmp_path / "delta.npz"


def rewritten(path: Path, header: dict[str, Any] | None = None, **arrays: np.ndarray) -> Path:
    with np.load(path) as file:
        content = {**dict(file), **arrays}
    if header is not None:
        content["header"] = np.array(json.dumps({**json.loads(str(content["header"])), **header}))
    np.savez_compressed(path, **content)
    return path


def test_a_change_comes_back_as_it_was_saved(saved: Path) -> None:
    again, delta = SceneDelta.load(saved), change()
    for name in ("removed", "added_ids", "added_groups"):
        np.testing.assert_array_equal(getattr(again, name), getattr(delta, name))
    np.testing.assert_allclose(again.added.means, PART.means)  # type: ignore[union-attr]
    np.testing.assert_array_equal(again.moves[0].motion.rotation, delta.moves[0].motion.rotation)
    assert (again.revision, again.moves[0].views, again.moves[0].motion.scale) == (4, ("a", "b"), 1.5)
    SceneDelta().save(saved)
    empty = SceneDelta.load(saved)
    assert empty.revision is None and empty.added is None and not empty.moves


def test_a_change_with_numbers_of_numpy_can_be_saved(tmp_path: Path) -> None:
    move = GroupMove(np.int64(3), Similarity(np.float32(1.5)))  # type: ignore[arg-type]
    SceneDelta(np.int64(4), moves=(move,)).save(tmp_path / "delta.npz")  # type: ignore[arg-type]
    again = SceneDelta.load(tmp_path / "delta.npz")
    assert (again.revision, again.moves[0].group, again.moves[0].motion.scale) == (4, 3, 1.5)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_a_truncated_file_is_refused_with_one_error(saved: Path, share: float) -> None:
    content = saved.read_bytes()
    saved.write_bytes(content[: int(share * len(content))])
    with pytest.raises(SceneDeltaError, match="is not a scene delta, or is damaged"):
        SceneDelta.load(saved)


@pytest.mark.parametrize(
    ("header", "arrays", "message"),
    [
        ({"format": "gsseg-state-1"}, {}, "format is 'gsseg-state-1'; expected 'gsseg-delta-1'"),
        ({"revision": -1}, {}, "revision is -1; expected a whole number"),
        ({"moves": [{}]}, {}, "damaged"),
        ({"moves": [{"group": 0, "scale": 0, "rotation": np.eye(3).tolist(), "translation": [0, 0, 0], "views": []}]},
         {}, "a scale of 0"),
        ({"moves": [{"group": 0, "scale": 1, "rotation": np.ones((3, 3)).tolist(), "translation": [0, 0, 0],
                     "views": []}]}, {}, "is no rotation"),
        ({}, {"removed": np.array([-1])}, "removed hold"),
        ({}, {"removed": np.array([5, 5])}, "removed hold 5 twice"),
        ({}, {"added_ids": np.zeros(20, np.int64)}, "added_ids hold 0 twice"),
        ({}, {"added_groups": np.zeros(19, np.int64)}, "array added_groups is int64"),
        ({}, {"means": np.full((20, 3), np.nan, np.float32)}, "NaN"),
        ({}, {"scales": np.zeros((20, 3), np.float32)}, "not positive"),
        ({}, {"sh": np.zeros((20, 5, 3), np.float32)}, "sh has shape"),
    ],
)  # fmt: skip
def test_a_file_that_holds_no_change_is_refused_and_named(
    saved: Path, header: dict[str, Any], arrays: dict[str, np.ndarray], message: str
) -> None:
    with pytest.raises(SceneDeltaError) as raised:
        SceneDelta.load(rewritten(saved, header, **arrays))
    assert str(raised.value).startswith(str(saved)) and message in str(raised.value)


@pytest.mark.parametrize("ids", [np.array([5], np.int32), np.array([[5]])])
def test_ids_of_another_type_or_shape_are_refused_with_what_was_found(ids: np.ndarray) -> None:
    with pytest.raises(SceneDeltaError) as raised:
        SceneDelta(removed=ids)
    found = f"removed hold {ids.tolist()}, {ids.dtype} {ids.shape}"
    assert str(raised.value) == f"scene delta: {found}; expected whole numbers from 0, int64 (M,)"


def test_an_array_that_claims_to_be_huge_is_refused_before_it_is_inflated(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "huge.npz", "w") as archive:
        with archive.open("removed.npy", "w") as member:
            np.lib.format.write_array_header_1_0(member, {"descr": "<i8", "fortran_order": False, "shape": (2**40,)})
        with archive.open("header.npy", "w") as member:
            text = json.dumps({"format": "gsseg-delta-1", "revision": None, "moves": []})
            np.lib.format.write_array(member, np.array(text))
    with pytest.raises(SceneDeltaError, match=r"huge\.npz.*expected at most"):
        SceneDelta.load(tmp_path / "huge.npz")


def test_what_is_added_may_not_have_more_colours_than_the_scene_has_room_for() -> None:
    sh = np.zeros((20, 4, 3))
    bright = GaussianScene.from_arrays(PART.means, PART.quats, PART.scales, PART.opacities, sh)
    delta = SceneDelta(added=bright, added_ids=np.arange(20) + 900, added_groups=np.zeros(20, np.int64))
    with pytest.raises(SceneDeltaError, match="9 coefficients of SH more than the scene"):
        LivingScene.of(SCENE).apply(delta)
    wide = GaussianScene.from_arrays(
        SCENE.means, SCENE.quats, SCENE.scales, SCENE.opacities, np.ones((len(SCENE), 4, 3))
    )
    dull = SceneDelta(added=PART, added_ids=np.arange(20) + 900, added_groups=np.zeros(20, np.int64))
    after, _ = LivingScene.of(wide).apply(dull)
    assert after.scene.sh_degree == 1 and not after.scene.sh[-20:, 1:].any()


def test_what_is_added_with_fewer_bands_of_sh_than_the_scene_keeps_its_colours() -> None:
    rng, wide = np.random.default_rng(3), [SCENE.means, SCENE.quats, SCENE.scales, SCENE.opacities]
    scene = GaussianScene.from_arrays(*wide, rng.normal(size=(len(SCENE), 16, 3)))
    sh = rng.normal(size=(20, 4, 3)).astype(np.float32)
    part = GaussianScene.from_arrays(PART.means, PART.quats, PART.scales, PART.opacities, sh)
    after, _ = LivingScene.of(scene).apply(
        SceneDelta(added=part, added_ids=np.arange(20) + 900, added_groups=np.zeros(20, np.int64))
    )
    np.testing.assert_array_equal(after.scene.sh[:-20], scene.sh)
    np.testing.assert_array_equal(after.scene.sh[-20:, :4], sh)
    assert not after.scene.sh[-20:, 4:].any()


def test_a_frame_can_be_saved_and_read_however_many_rounded_motions_made_it() -> None:
    living = LivingScene.of(SCENE)
    rounded = Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix() * (1 + 4e-7)  # as far off as one motion may be
    for _ in range(30):
        living, _ = living.apply(SceneDelta(moves=(GroupMove(0, Similarity(rotation=rounded)),)))
    (entry,) = living.frame_entries()
    expected = Rotation.from_rotvec([3, 6, 9]).as_matrix()
    np.testing.assert_allclose(read_similarity(entry).rotation, expected, atol=1e-5)


@pytest.mark.parametrize("revision", ["a", 1.5])
def test_a_revision_is_a_whole_number(revision: object) -> None:
    with pytest.raises(SceneDeltaError, match=f"revision is '?{revision}'?; expected a whole number"):
        SceneDelta(revision=revision)  # type: ignore[arg-type]


def test_ids_of_a_file_are_checked(tmp_path: Path) -> None:
    grown, _ = LivingScene.of(SCENE).apply(SceneDelta(removed=np.array([0])))
    twice = grown.scene.vertices.copy()
    twice["id_low"][1] = twice["id_low"][0]
    GaussianScene.from_vertices(twice, None).save(tmp_path / "twice.ply")
    with pytest.raises(SceneValueError, match=r"twice\.ply: ids are negative, or some are there twice"):
        LivingScene.of(GaussianScene.load(tmp_path / "twice.ply"))
    huge = grown.scene.vertices.copy()
    huge["id_high"] = 2**32 - 1
    with pytest.raises(GssegError, match="ids are negative"):
        LivingScene.of(GaussianScene.from_vertices(huge, None))
