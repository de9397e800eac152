"""A learner's state on disk: whole or not at all, and only for its own scene."""

from __future__ import annotations

import json
import os
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import sparse
from small_scenes import NUM_CLASSES, balls_on_a_table, clean_views, taught

from gsseg_core.csr_rows import starts
from gsseg_core.errors import PathTakenError, StateFileError, StateMismatchError, WriteError
from gsseg_core.learn import learner_state as state_file
from gsseg_core.learn.learner import Learner
from gsseg_core.learn.learner_state import Learnt, State
from gsseg_core.learn.vote_learner import VoteLearner
from gsseg_core.live.session import LiveSession

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


def as_older(path: Path, kind: str) -> Path:
    """Write a state as older versions did: votes and codes with all their zeros."""
    with np.load(path) as file:
        arrays = dict(file)
    header = json.loads(str(arrays.pop("header"))) | {"format": kind}
    n, k = header["shape"]
    for name in ("votes", "codes"):
        counts, indices, data = (arrays.pop(f"{name}_{part}") for part in ("counts", "indices", "data"))
        arrays[name] = sparse.csr_array((data, indices, starts(counts.astype(int))), shape=(n, k)).toarray()
    arrays["seen"] = np.flatnonzero(arrays["votes"].any(axis=1))
    arrays["votes"] = arrays["votes"][arrays["seen"]]
    older = path.with_name(f"{kind}.npz")
    np.savez_compressed(older, header=np.array(json.dumps(header)), **arrays)
    return older


@pytest.mark.parametrize("kind", [state_file.WITH_ZEROS, state_file.WHOLE_RAYS])
def test_states_of_older_versions_with_all_their_zeros_are_the_same_states(tmp_path: Path, kind: str) -> None:
    path, learner = tmp_path / "state.npz", taught(fresh(), VIEWS).fit()
    codes = learner.code_rows_.only(np.arange(len(SCENE)) % 3 > 0)
    learnt = Learnt("em", codes, len(VIEWS), 2.0, learner.evidence())
    replace(learner.state(), learnt=learnt).save(path, SCENE.digest)
    found = State.load(path, SCENE.digest, len(SCENE))
    older = State.load(as_older(path, kind), SCENE.digest, len(SCENE))
    for wanted, *given in (
        (learner.state().votes, found.votes, older.votes), (codes, found.learnt.codes, older.learnt.codes),
    ):  # fmt: skip
        for rows in given:
            for one, other in zip(rows, wanted, strict=True):
                np.testing.assert_array_equal(one, other)
                assert one.dtype == other.dtype
    assert (found.whole_rays, older.whole_rays) == (False, kind == state_file.WHOLE_RAYS)
    assert found.num_fused == older.num_fused == 3 and [view.name for view in older.views] == [*learner.views]
    older.save(path, SCENE.digest)
    again = State.load(path, SCENE.digest, len(SCENE))
    assert again.whole_rays == older.whole_rays, "votes of whole rays stay so until a session casts them anew"
    session = LiveSession(SCENE)
    session.load(path)
    np.testing.assert_array_equal(session._live._votes.dense(), learner._votes.dense())


def test_a_state_takes_room_for_what_is_not_zero_and_numpy_and_scipy_read_it(tmp_path: Path) -> None:
    votes, k = taught(fresh(), VIEWS).state().votes, 5000
    State(votes, k, [], len(VIEWS)).save(tmp_path / "state.npz", SCENE.digest)
    with np.load(tmp_path / "state.npz") as file:
        indptr = np.append(0, np.cumsum(file["votes_counts"], dtype=int))
        read = sparse.csr_array((file["votes_data"], file["votes_indices"], indptr), shape=(len(SCENE), k))
    np.testing.assert_array_equal(read.toarray(), votes.dense(k))
    with zipfile.ZipFile(tmp_path / "state.npz") as file:
        assert sum(member.file_size for member in file.infolist()) < 12 * len(votes.data) + 2 * len(SCENE) + 4000


def test_a_state_whose_rows_are_broken_is_refused_and_changes_nothing(saved: Path) -> None:
    with np.load(saved) as file:
        arrays = dict(file)
    learner = taught(fresh(), VIEWS[:1])
    for name, broken in (
        ("votes_counts", np.roll(arrays["votes_counts"], 1)[:-1]), ("votes_indices", arrays["votes_indices"] + 4),
        ("votes_indices", arrays["votes_indices"][::-1]), ("votes_data", -arrays["votes_data"]),
        ("votes_data", arrays["votes_data"] * 0.5), ("votes_data", arrays["votes_data"][:-1]),
    ):  # fmt: skip
        np.savez(saved, **{**arrays, name: broken})
        assert_refused(learner, saved, StateFileError)


@pytest.mark.parametrize(
    ("dropped", "message"),
    [
        (np.zeros((2, 16), np.uint8), r"array dropped is of 2 views; expected at most 1"),
        (
            np.zeros((1, 15), np.uint8),
            r"array dropped is uint8 of shape \(1, 15\); expected uint8 of shape \(any, 16\)",
        ),
        (np.zeros((1, 16), np.int8), "array dropped is int8"),
    ],
)
def test_views_that_are_no_longer_kept_are_listed_and_no_more_of_them_than_there_can_be(
    tmp_path: Path, dropped: np.ndarray, message: str
) -> None:
    session = LiveSession(SCENE, max_views=len(VIEWS) - 1)
    for view in VIEWS:
        assert session.fuse(view) is None
    path = tmp_path / "state.npz"
    session.save(path)
    listed = State.load_alone(path)[1]
    assert listed.dropped == (VIEWS[0].digest,) and listed.all_known
    again = LiveSession(SCENE)
    again.load(path)
    again.save(tmp_path / "again.npz")
    assert State.load_alone(tmp_path / "again.npz")[1].dropped == listed.dropped
    with np.load(path) as file:
        arrays = dict(file)
    np.savez(path, **{**arrays, "dropped": dropped})
    with pytest.raises(StateFileError, match=message):
        State.load_alone(path)


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
