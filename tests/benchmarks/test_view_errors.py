"""Views with errors from 0 to 1: nothing changes at 0, more at more, each kind changes only what it says."""

from __future__ import annotations

import numpy as np
import pytest
from small_scenes import balls_on_a_table, clean_views, make_grid, ring
from view_errors import STRONGEST, PoseErrors, corrupt_views, errors_at, jitter, typical_depth
from wrong_masks import WrongMasks

from gsseg_core.data.view import View
from gsseg_core.errors import SettingsError

MASK_KINDS = [kind for kind in STRONGEST if kind != "jittered poses"]
VIEWS = clean_views(12)


def wrong_share(kind: str, strength: float, seed: int = 0) -> float:
    """Share of wrong pixels over views of a grid of objects."""
    labels = make_grid()
    views = [View.from_arrays(ring(1)[0], labels[:48, :64]) for _ in range(20)]
    wrong = corrupt_views(views, seed, *errors_at(kind, strength))
    return float(np.mean([view.read_labels() != labels[:48, :64] for view in wrong]))


@pytest.mark.parametrize("kind", STRONGEST)
def test_strength_0_changes_nothing(kind: str) -> None:
    for view, wrong in zip(VIEWS, corrupt_views(VIEWS, 0, *errors_at(kind, 0.0)), strict=True):
        np.testing.assert_array_equal(view.read_labels(), wrong.read_labels())
        assert wrong.camera is view.camera


@pytest.mark.parametrize("kind", MASK_KINDS)
def test_more_strength_makes_more_pixels_wrong(kind: str) -> None:
    shares = [wrong_share(kind, strength) for strength in (0.0, 0.25, 0.5, 0.75, 1.0)]
    assert shares[0] == 0
    assert (np.diff(shares) > 0).all()


@pytest.mark.parametrize("kind", STRONGEST)
def test_the_same_seed_gives_the_same_views_and_another_one_others(kind: str) -> None:
    first, again, other = (corrupt_views(VIEWS, seed, *errors_at(kind, 1.0)) for seed in (0, 0, 1))

    def content(views: list[View]) -> list[bytes]:
        return [view.read_labels().tobytes() + view.camera.world_to_camera.tobytes() for view in views]

    assert content(first) == content(again) != content(other)


@pytest.mark.parametrize("kind", MASK_KINDS)
def test_wrong_masks_leave_the_poses_alone(kind: str) -> None:
    views = corrupt_views(VIEWS, 0, *errors_at(kind, 1.0))
    assert all(wrong.camera is view.camera for wrong, view in zip(views, VIEWS, strict=True))


def test_wrong_poses_leave_masks_and_intrinsics_alone() -> None:
    for view, wrong in zip(VIEWS, corrupt_views(VIEWS, 0, *errors_at("jittered poses", 1.0)), strict=True):
        np.testing.assert_array_equal(wrong.read_labels(), view.read_labels())
        np.testing.assert_array_equal(wrong.camera.K, view.camera.K)
        assert (wrong.camera.world_to_camera != view.camera.world_to_camera).any()


def test_poses_are_off_by_as_much_as_asked() -> None:
    camera, rng = ring(1)[0], np.random.default_rng(0)
    turns, moves = [], []
    for _ in range(500):
        wrong = jitter(camera, rng, PoseErrors(rotation=2.0, translation=0.1))
        turn = wrong.world_to_camera[:3, :3] @ camera.world_to_camera[:3, :3].T
        turns.append(np.degrees(np.arccos((np.trace(turn) - 1) / 2)))
        moves.append(np.linalg.norm(wrong.center - camera.center))
    assert np.sqrt(np.mean(np.square(turns))) == pytest.approx(2.0, rel=0.1)
    assert np.sqrt(np.mean(np.square(moves))) == pytest.approx(0.1, rel=0.1)


def test_a_camera_that_is_only_turned_stays_where_it_is() -> None:
    camera = ring(1)[0]
    wrong = jitter(camera, np.random.default_rng(0), PoseErrors(rotation=5.0))
    np.testing.assert_allclose(wrong.center, camera.center, atol=1e-12)


def test_turns_and_moves_are_drawn_apart() -> None:
    camera = ring(1)[0]
    both = jitter(camera, np.random.default_rng(0), PoseErrors(rotation=1.0, translation=0.2))
    turned = jitter(camera, np.random.default_rng(0), PoseErrors(rotation=1.0))
    np.testing.assert_allclose(both.world_to_camera[:3, :3], turned.world_to_camera[:3, :3])


def test_wrong_poses_do_not_change_the_draws_of_the_masks() -> None:
    masks = WrongMasks(missed=0.3, swapped=0.3)
    still, moved = (corrupt_views(VIEWS, 3, masks, poses) for poses in (None, PoseErrors(1.0, 0.1)))
    for first, second in zip(still, moved, strict=True):
        np.testing.assert_array_equal(first.read_labels(), second.read_labels())


def test_more_strength_misses_the_same_objects_and_some_more() -> None:
    some, many = (corrupt_views(VIEWS, 0, *errors_at("missed objects", strength)) for strength in (0.4, 0.8))
    for view, few, more in zip(VIEWS, some, many, strict=True):
        truth = view.read_labels()
        assert ((few.read_labels() == truth) >= (more.read_labels() == truth)).all()


def test_typical_depth_is_that_of_what_is_seen() -> None:
    scene, _ = balls_on_a_table()
    assert typical_depth(scene, ring(4)) == pytest.approx(np.hypot(3, 3), rel=0.1)
    with pytest.raises(SettingsError, match="none of 0 cameras"):
        typical_depth(scene, [])


@pytest.mark.parametrize(
    ("kind", "strength", "words"),
    [("fog", 0.5, "missed objects"), ("holes", 1.5, r"\[0, 1\]"), ("holes", float("nan"), r"\[0, 1\]")],
)
def test_unknown_kinds_and_impossible_strengths_are_refused(kind: str, strength: float, words: str) -> None:
    with pytest.raises(SettingsError, match=words):
        errors_at(kind, strength)


@pytest.mark.parametrize("wrong", [{"rotation": -1.0}, {"translation": float("nan")}])
def test_impossible_pose_errors_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(SettingsError, match=next(iter(wrong))):
        PoseErrors(**wrong)
