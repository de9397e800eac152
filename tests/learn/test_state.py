"""A learner's state on disk: whole or not at all, and only for its own scene."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from small_scenes import NUM_CLASSES, balls_on_a_table, clean_views, taught

from gsseg_core.errors import PathTakenError, StateFileError, StateMismatchError, WriteError
from gsseg_core.learn import learner_state as state_file
from gsseg_core.learn.learner import Learner
from gsseg_core.learn.learner_state import State
from gsseg_core.learn.vote_learner import VoteLearner

SCENE, TRUTH = balls_on_a_table()
VIEWS = clean_views(3)


def fresh() -> Learner:
    return VoteLearner(SCENE, NUM_CLASSES)


def save(learner: Learner, path: Path) -> None:
    learner.state().save(path, learner.scene.digest)


def restore(learner: Learner, path: Path) -> None:
    learner.adopt(State.load(path, learner.scene.digest, len(learner.scene)))


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    path = tmp_path / "state.npz"
    save(taught(fresh(), VIEWS), path)
    return path


def assert_refused(learner: Learner, path: Path, error: type[Exception]) -> None:
    """The learner holds one view before, and the very same after."""
    before, votes = dict(learner.views), learner._votes.dense()
    with pytest.raises(error, match=path.name) as caught:
        restore(learner, path)
    assert "\n" not in str(caught.value)
    assert learner.views == before
    np.testing.assert_array_equal(learner._votes.dense(), votes)
    learner.fit()


def test_a_saved_state_comes_back_exactly_and_can_be_added_to_and_taken_from(saved: Path) -> None:
    original, restored = taught(fresh(), VIEWS), taught(fresh(), clean_views(2, "other", 0.5))
    restore(restored, saved)
    assert list(restored.views) == list(original.views)
    for name, view in restored.views.items():
        np.testing.assert_array_equal(view.read_labels(), original.views[name].read_labels())
        np.testing.assert_array_equal(view.camera.world_to_camera, original.views[name].camera.world_to_camera)
        np.testing.assert_array_equal(view.camera.K, original.views[name].camera.K)
    np.testing.assert_array_equal(restored.fit().codes_, original.fit().codes_)
    for learner in (original, restored):
        learner.retract(VIEWS[1].name)
    np.testing.assert_array_equal(restored._votes.dense(), original._votes.dense())
    for view in (VIEWS[0], VIEWS[2]):
        restored.retract(view.name)
    assert not restored._votes.dense().any()


def test_a_learner_without_views_can_be_saved_and_restored(tmp_path: Path) -> None:
    save(fresh(), tmp_path / "empty.npz")
    learner = taught(fresh(), VIEWS[:1])
    restore(learner, tmp_path / "empty.npz")
    assert not learner.views and not learner._votes.dense().any()


def test_a_state_of_another_scene_is_refused(saved: Path) -> None:
    other = balls_on_a_table(seed=1)[0]
    assert_refused(taught(VoteLearner(other, NUM_CLASSES), VIEWS[:1]), saved, StateMismatchError)


def test_a_missing_empty_truncated_or_foreign_file_is_refused_and_changes_nothing(saved: Path, tmp_path: Path) -> None:
    learner, content = taught(fresh(), VIEWS[:1]), saved.read_bytes()
    assert_refused(learner, tmp_path / "missing.npz", StateFileError)
    assert_refused(learner, tmp_path, StateFileError)
    path = tmp_path / "broken.npz"
    for broken in (b"", b"no archive", content[:40], content[: len(content) // 2], content[:-10], content[100:]):
        path.write_bytes(broken)
        assert_refused(learner, path, StateFileError)
    np.savez(path, labels=np.zeros(3))
    assert_refused(learner, path, StateFileError)
    np.save(tmp_path / "array.npy", np.zeros(3))
    assert_refused(learner, tmp_path / "array.npy", StateFileError)


def test_flipped_bytes_anywhere_are_refused_or_do_no_harm(saved: Path) -> None:
    learner, content = taught(fresh(), VIEWS[:1]), saved.read_bytes()
    reference = taught(fresh(), VIEWS)._votes.dense()
    for place in np.linspace(0, len(content) - 1, 150).astype(int):
        broken = bytearray(content)
        broken[place] ^= 0xFF
        saved.write_bytes(broken)
        before = learner._votes
        try:
            restore(learner, saved)
        except (StateFileError, StateMismatchError):
            assert learner._votes is before
        else:
            np.testing.assert_array_equal(learner._votes.dense(), reference)


def test_a_failed_save_leaves_the_earlier_state_whole(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before, learner = saved.read_bytes(), taught(fresh(), VIEWS[:1])

    def disk_full(path: Path, header: object, **arrays: object) -> None:
        path.write_bytes(b"half of ")
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr(state_file, "write_arrays", disk_full)
    with pytest.raises(WriteError, match=r"state\.npz: cannot be written \(No space left"):
        save(learner, saved)
    assert saved.read_bytes() == before and list(saved.parent.iterdir()) == [saved]
    monkeypatch.undo()
    with pytest.raises(WriteError):
        save(learner, saved / "below" / "a_file.npz")
    restore(fresh(), saved)


def test_a_state_replaces_a_state_and_nothing_else(saved: Path, tmp_path: Path) -> None:
    learner = taught(fresh(), VIEWS[:1])
    save(learner, saved)
    restore(fresh(), saved)
    for name in ("scene.ply", "other.npz", "empty.npz"):
        (tmp_path / name).write_bytes(b"of the user" * (name != "empty.npz"))
    np.savez_compressed(tmp_path / "foreign.npz", header=np.array('{"format": "something"}'), votes=np.ones(3))
    (tmp_path / "folder.npz").mkdir()
    (tmp_path / "dangling.npz").symlink_to("nowhere")
    for name in ("scene.ply", "other.npz", "empty.npz", "foreign.npz", "folder.npz", "dangling.npz"):
        path = tmp_path / name
        before = path.read_bytes() if path.is_file() else None
        with pytest.raises(PathTakenError, match=f"{name}: is there and is no saved state; expected a new file"):
            save(learner, path)
        assert before is None or path.read_bytes() == before
