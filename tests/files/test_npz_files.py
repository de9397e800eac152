"""Arrays of an npz: believed only as far as their headers, and the scene, explain."""

from __future__ import annotations

import io
import json
import tracemalloc
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_scenes import HEIGHT, NAMES, NUM_CLASSES, WIDTH, balls_on_a_table, clean_views, ring, taught

from gsseg_core import csr_rows
from gsseg_core.data.view import View
from gsseg_core.errors import GssegError, MaskFormatError, MaskSizeError, StateFileError, UnknownLabelError
from gsseg_core.files import npz_files
from gsseg_core.files.limits import Limits
from gsseg_core.learn.learner_state import State
from gsseg_core.learn.vote_learner import VoteLearner
from gsseg_core.segmentation import Segmentation

SCENE, TRUTH = balls_on_a_table()
N = len(SCENE)


def rewritten(path: Path, header: dict[str, Any] | None = None, **arrays: Any) -> Path:
    """Change entries of the header, and arrays, of an npz; None takes an array out."""
    with np.load(path) as file:
        content: dict[str, Any] = dict(file)
    content["header"] = np.array(json.dumps({**json.loads(str(content["header"])), **(header or {})}))
    content.update(arrays)
    np.savez(path, **{name: array for name, array in content.items() if array is not None})
    return path


def with_bomb(path: Path, name: str, shape: tuple[int, ...], dtype: Any = np.float32) -> Path:
    """Put an array of zeros into an npz in place of one, of which only the header is true."""
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": np.dtype(dtype).str, "fortran_order": False, "shape": shape})
    with zipfile.ZipFile(path) as file:
        others = {member: file.read(member) for member in file.namelist() if member != f"{name}.npy"}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for member, content in others.items():
            file.writestr(member, content)
        with file.open(f"{name}.npy", "w", force_zip64=True) as member:
            member.write(head.getvalue())
            for _ in range(64):
                member.write(bytes(1 << 20))
    return path


def assert_refused_in_little_memory(read: Any, error: type[GssegError], *parts: str) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(error) as caught:
            read()
        assert tracemalloc.get_traced_memory()[1] < 16 << 20
    finally:
        tracemalloc.stop()
    message = str(caught.value)
    assert "\n" not in message and len(message) < 600 and "pickle" not in message
    for part in parts:
        assert part in message


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    codes = np.eye(NUM_CLASSES, dtype=np.float32)[TRUTH]
    codes[::7] = 0
    Segmentation.from_codes(SCENE, codes, NAMES).save(tmp_path / "segmentation.npz")
    return tmp_path / "segmentation.npz"


@pytest.fixture
def state(tmp_path: Path) -> Path:
    taught(VoteLearner(SCENE, NUM_CLASSES), clean_views(2)).state().save(tmp_path / "state.npz", SCENE.digest)
    return tmp_path / "state.npz"


BAD_ROWS = {
    "nan": np.full((N, NUM_CLASSES), np.nan, np.float32),
    "negative": np.tile(np.array([-1, 2, 0, 0], np.float32), (N, 1)),
    "infinite": np.full((N, NUM_CLASSES), np.inf, np.float32),
    "half": np.full((N, NUM_CLASSES), 0.5 / NUM_CLASSES, np.float32),
    "sure of two": np.ones((N, NUM_CLASSES), np.float32),
}


@pytest.mark.parametrize("kind", BAD_ROWS)
def test_probabilities_that_are_none_are_refused_by_name(saved: Path, kind: str) -> None:
    rewritten(saved, probabilities=BAD_ROWS[kind])
    assert_refused_in_little_memory(
        lambda: Segmentation.load(saved, SCENE), StateFileError, str(saved), "array probabilities", "expected"
    )


@pytest.mark.parametrize(
    ("arrays", "parts"),
    [
        ({"labels": np.full(N, 99, np.int32)}, ("array labels holds [99]", "expected ids of its 4 classes")),
        ({"labels": np.full(N, -3, np.int32)}, ("array labels holds [-3]",)),
        ({"labels": np.full(N, "red")}, ("array labels is <U3", "expected int32 of shape (626,)")),
        ({"labels": np.zeros(N)}, ("array labels is float64", "expected int32")),
        ({"labels": np.array(3, np.int32)}, ("array labels is int32 of shape ()",)),
        ({"labels": np.array([{}])}, ("'labels'", "expected numbers")),
        ({"labels": None}, ("there is no array 'labels'",)),
        ({"probabilities": np.zeros((N, 75), np.float32)}, ("of shape (626, 75)", "expected float32")),
        ({"probabilities": np.float32(1)}, ("of shape ()",)),
        ({"clustered": np.zeros(N, np.int8)}, ("array clustered is int8", "expected bool")),
        ({"clustered": np.ones(N, bool)}, ("array learnt", f"({N}, 4)")),
        ({"class_ids": np.array([0, 1, 2, 9], np.int32)}, ("array class_ids",)),
    ],
)  # fmt: skip
def test_arrays_of_another_type_shape_or_content_are_refused_by_name(
    saved: Path, arrays: dict[str, Any], parts: tuple[str, ...]
) -> None:
    rewritten(saved, **arrays)
    assert_refused_in_little_memory(lambda: Segmentation.load(saved, SCENE), StateFileError, str(saved), *parts)


@pytest.mark.parametrize(
    ("header", "part"),
    [
        ({"temperature": 0}, "temperature is 0"), ({"temperature": float("inf")}, "temperature is inf"),
        ({"temperature": float("nan")}, "temperature is nan"), ({"temperature": "hot"}, "temperature is 'hot'"),
        ({"temperature": -1.0}, "temperature is -1.0"), ({"temperature": True}, "temperature is True"),
        ({"temperature": 1e-300}, "temperature is 1e-300"),
        ({"class_names": ["a"]}, "class_names are ['a']"), ({"class_names": {"0": 1}}, "class_names are"),
        ({"class_names": {"1": "a", "2": "b", "3": "c", "4": "d"}}, "class_names lack 0"),
        ({"class_names": {"0": "a", "70000": "b"}}, "70000"), ({"class_names": {"x": "a"}}, "'x'"),
        ({"class_names": {"0": "x" * 9000}}, "array probabilities"), ({"class_names": None}, "class_names are None"),
        ({"format": 7}, "format is 7"), ({"format": "y" * 9000}, "format is 'yyy"),
    ],
)  # fmt: skip
def test_headers_that_make_no_sense_are_refused(saved: Path, header: dict[str, Any], part: str) -> None:
    rewritten(saved, header)
    assert_refused_in_little_memory(lambda: Segmentation.load(saved, SCENE), StateFileError, str(saved), part)


def test_a_header_of_what_are_no_characters_is_refused(saved: Path) -> None:
    with np.load(saved) as file:
        content = dict(file)
    words = content["header"].reshape(1).view(np.uint32).copy()
    words[-3] = 0xFFFFFFFF
    np.savez(saved, **{**content, "header": words.view(f"<U{len(words)}").reshape(())})
    assert_refused_in_little_memory(lambda: Segmentation.load(saved, SCENE), StateFileError, str(saved), "no character")


@pytest.mark.parametrize(
    ("header", "arrays", "part"),
    [
        ({"num_fused": float("inf")}, {}, "num_fused is inf"), ({"num_fused": 1}, {}, "num_fused is 1"),
        ({"num_fused": 10**30}, {}, "num_fused is 1000"), ({"shape": [N, 0]}, {}, "number of classes is 0"),
        ({"shape": [N, 10**9]}, {}, "number of classes is 1000000000"), ({"shape": [N + 1, 4]}, {}, "627 Gaussians"),
        ({"learnt": {"learner": "em", "num_views": 2}}, {"codes": np.full((N, 4), np.nan, np.float32)}, "array codes"),
        ({"learnt": {"learner": "em", "num_views": -1}}, {"codes": np.zeros((N, 4), np.float32)}, "num_views"),
        ({"learnt": {"learner": "em", "num_views": 2, "temperature": 0}}, {"codes": np.zeros((N, 4), np.float32)},
         "temperature is 0"),
        ({}, {"seen": np.array([3]), "votes": np.full((1, 4), -5)}, "array votes holds -5"),
        ({}, {"seen": np.array([3]), "votes": np.full((1, 4), np.nan)}, "array votes is float64"),
        ({}, {"seen": np.array([3]), "votes": np.full((1, 4), 2**62)}, "array votes sums to"),
        ({}, {"seen": np.array([-1]), "votes": np.zeros((1, 4), np.int64)}, "array seen"),
        ({}, {"seen": np.array([N]), "votes": np.zeros((1, 4), np.int64)}, "array seen"),
        ({}, {"seen": np.array([3, 3]), "votes": np.zeros((2, 4), np.int64)}, "array seen"),
        ({}, {"labels_0": np.full((HEIGHT, WIDTH), 9, np.int32)}, "holds the label 9"),
        ({}, {"labels_0": np.full((HEIGHT, WIDTH), -7, np.int32)}, "labels -7"),
        ({}, {"labels_0": np.full((HEIGHT, WIDTH), 1.5)}, "array labels_0 is float64"),
        ({}, {"pose_0": np.full((2, 4, 4), np.nan)}, "camera 'view0'"),
    ],
)  # fmt: skip
def test_a_state_that_no_session_could_have_is_refused(
    state: Path, header: dict[str, Any], arrays: dict[str, Any], part: str
) -> None:
    rewritten(state, header, **arrays)
    assert_refused_in_little_memory(lambda: State.load(state, SCENE.digest, N), StateFileError, str(state), part)


def one_vote(count: int = 1, column: int = 0, vote: Any = 9) -> dict[str, Any]:
    """Make sparse arrays of votes of the first Gaussian, all for one class."""
    counts = np.zeros(N, np.uint16)
    counts[0] = count
    return {
        "votes_counts": counts, "votes_indices": np.full(count, column, np.uint16),
        "votes_data": np.full(count, vote, np.int64 if isinstance(vote, int) else None),
    }  # fmt: skip


@pytest.mark.parametrize(
    ("arrays", "part"),
    [
        (one_vote(vote=-5), "array votes holds -5"), (one_vote(vote=2**62), "array votes sums to"),
        (one_vote(vote=np.nan), "array votes_data is float64"), (one_vote(vote=0), "array votes_data holds 0"),
        (one_vote(column=NUM_CLASSES), "array votes_indices holds 4; expected below 4"),
        (one_vote(column=65535), "array votes_indices holds 65535"),
        (one_vote(2), "array votes_indices does not rise in a row"),
        (one_vote(5), "array votes_counts holds 5; expected at most 4"),
        (one_vote() | {"votes_indices": np.array([2, 1], np.uint16)}, "shape (2,); expected uint16 of shape (1,)"),
        (one_vote(2) | {"votes_indices": np.array([2, 1], np.uint16)}, "array votes_indices does not rise in a row"),
        (one_vote() | {"votes_indices": np.array([-1])}, "array votes_indices is int64"),
        (one_vote() | {"votes_data": np.ones(2, np.int64)}, "array votes_data is int64 of shape (2,)"),
        (one_vote() | {"votes_data": np.ones((1, 1), np.int64)}, "array votes_data is int64 of shape (1, 1)"),
        ({"votes_counts": np.full(N, 65535, np.uint16)}, "array votes_counts holds 65535"),
        ({"votes_counts": np.full(N, -1)}, "array votes_counts is int64"),
        ({"votes_counts": np.zeros(N + 1, np.uint16)}, "array votes_counts is uint16 of shape (627,)"),
        ({"votes_counts": np.zeros(N, np.uint16)}, "array votes_indices is uint16"),
        ({"votes_counts": None}, "there is no array 'votes_counts'"), ({"votes_data": None}, "no array 'votes_data'"),
    ],
)  # fmt: skip
def test_sparse_votes_that_are_no_rows_of_votes_are_refused(state: Path, arrays: dict[str, Any], part: str) -> None:
    rewritten(state, **arrays)
    assert_refused_in_little_memory(lambda: State.load(state, SCENE.digest, N), StateFileError, str(state), part)
    assert_refused_in_little_memory(lambda: State.load_alone(state), StateFileError, str(state), part)


@pytest.mark.parametrize("entry", [np.nan, -1.0, 0.5, np.inf])
def test_sparse_codes_that_are_no_probabilities_are_refused(state: Path, entry: float) -> None:
    codes = {"codes_counts": np.ones(N, np.uint16), "codes_indices": np.zeros(N, np.uint16)}
    header = {"learnt": {"learner": "em", "num_views": 2}}
    rewritten(state, header, **codes, codes_data=np.full(N, entry, np.float32))
    assert_refused_in_little_memory(lambda: State.load(state, SCENE.digest, N), StateFileError, "array codes")
    rewritten(state, header, codes_data=np.ones(N, np.float32))
    assert len(State.load(state, SCENE.digest, N).learnt.codes.data) == N


@pytest.mark.parametrize(
    ("name", "dtype"), [("votes_counts", np.uint16), ("votes_indices", np.uint16), ("votes_data", np.int64)]
)
def test_votes_that_would_inflate_to_more_than_the_scene_explains_are_not_inflated(
    state: Path, name: str, dtype: Any
) -> None:
    with np.load(state) as file:
        shape = file[name].shape
    with_bomb(state, name, (1 << 24,), dtype)
    assert_refused_in_little_memory(lambda: State.load(state, SCENE.digest, N), StateFileError, f"array {name} is")
    with_bomb(state, name, shape, dtype)
    assert_refused_in_little_memory(
        lambda: State.load(state, SCENE.digest, N), StateFileError, "longer than its header"
    )


def test_two_views_of_one_name_are_refused_since_one_would_be_lost(state: Path) -> None:
    rewritten(state, {"views": [{"name": "a", "size": [WIDTH, HEIGHT]}] * 2})
    assert_refused_in_little_memory(lambda: State.load(state, SCENE.digest, N), StateFileError, "two views", "'a'")


def test_votes_against_classes_are_kept_where_masks_say_what_is_not_there(tmp_path: Path) -> None:
    view = clean_views(1)[0]
    partial = View.from_arrays(view.camera, view.read_labels() * (view.read_labels() == 1), supervised=[1])
    learner = taught(VoteLearner(SCENE, NUM_CLASSES), [partial])
    learner.state().save(tmp_path / "state.npz", SCENE.digest)
    votes = State.load(tmp_path / "state.npz", SCENE.digest, N).votes.dense(NUM_CLASSES)
    assert votes.min() < 0
    np.testing.assert_array_equal(votes, learner._votes.dense())


@pytest.mark.parametrize("name", ["labels", "probabilities", "clustered", "learnt"])
def test_an_array_that_would_inflate_to_more_than_the_scene_explains_is_not_inflated(saved: Path, name: str) -> None:
    with_bomb(saved, name, (1 << 24,))
    assert_refused_in_little_memory(lambda: Segmentation.load(saved, SCENE), StateFileError, f"array {name} is")


def test_an_array_is_read_no_further_than_its_header_says(saved: Path) -> None:
    with_bomb(saved, "labels", (N,), np.int32)
    assert_refused_in_little_memory(lambda: Segmentation.load(saved, SCENE), StateFileError, "longer than its header")


def test_arrays_beyond_the_limit_of_a_file_are_refused(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(npz_files, "LIMITS", Limits(max_npz_bytes=1000))
    assert_refused_in_little_memory(lambda: Segmentation.load(saved, SCENE), StateFileError, "max_npz_bytes", "1,000")


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("entries", [1, 20, 1 << 22])
def test_sparse_rows_are_read_and_written_as_numpy_does_it_with_their_zeros(
    tmp_path: Path, order: Any, entries: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(csr_rows, "_AT_A_TIME", entries)
    array = np.asarray(np.random.default_rng(0).integers(0, 3, (30, 7)).astype(np.float32), order=order)
    arrays = {"full": array, "none": np.zeros((0, 7), np.float32)}
    np.savez_compressed(tmp_path / "numpy.npz", **arrays)
    with npz_files.open_arrays(tmp_path / "numpy.npz", "arrays", StateFileError) as file:
        read = {name: file.expect_rows(name, np.float32, (None, 7)) for name in arrays}
        with pytest.raises(
            npz_files.UnfitError, match=r"array full is float32 of shape \(30, 7\); expected .*\(9, 7\)"
        ):
            file.expect_rows("full", np.float32, (9, 7))
    written = {name: npz_files.WithZeros(rows, 7) for name, rows in read.items()}
    npz_files.write_arrays(tmp_path / "ours.npz", {}, **written)
    with np.load(tmp_path / "ours.npz") as file:
        for name, expected in arrays.items():
            np.testing.assert_array_equal(read[name].dense(7), expected)
            assert file[name].dtype == np.float32
            np.testing.assert_array_equal(file[name], expected)


def test_probabilities_that_were_large_with_their_zeros_are_saved_sparse_and_load_as_the_same(
    saved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = Segmentation.load(saved, SCENE)
    monkeypatch.setattr(npz_files, "_MOST_WITH_ZEROS", 4 * N * NUM_CLASSES - 1)
    expected.save(saved)
    with np.load(saved) as file:
        names = {"probabilities_counts", "probabilities_indices", "probabilities_data", "learnt"}
        assert {name for name in file.files if name.startswith(("prob", "learnt"))} == names
    again = Segmentation.load(saved, SCENE)
    for rows, others in ((again.shares, expected.shares), (again.learnt, expected.learnt)):
        for ours, theirs in zip(rows, others, strict=True):
            np.testing.assert_array_equal(ours, theirs, strict=True)
    data = np.full(len(expected.shares.data), 0.3, np.float32)
    for arrays, parts in (
        ({"probabilities_data": data}, ("array probabilities sum to 0.",)),
        ({"probabilities_counts": np.full(N, 5, np.uint16)}, ("probabilities_counts holds 5; expected at most 4",)),
    ):
        expected.save(saved)
        rewritten(saved, **arrays)
        assert_refused_in_little_memory(lambda: Segmentation.load(saved, SCENE), StateFileError, *parts)


@pytest.mark.parametrize(("change", "part"), [(-4, "shorter"), (4, "longer")])
def test_sparse_rows_that_end_elsewhere_than_their_header_says_are_refused(saved: Path, change: int, part: str) -> None:
    with zipfile.ZipFile(saved) as file:
        members = {member: file.read(member) for member in file.namelist()}
    members["probabilities.npy"] = (members["probabilities.npy"] + bytes(4))[
        : len(members["probabilities.npy"]) + change
    ]
    with zipfile.ZipFile(saved, "w") as file:
        for member, content in members.items():
            file.writestr(member, content)
    assert_refused_in_little_memory(lambda: Segmentation.load(saved, SCENE), StateFileError, f"{part} than its header")


@pytest.mark.parametrize("order", ["C", "F"])
def test_what_numpy_writes_is_read_as_numpy_reads_it(tmp_path: Path, order: Any) -> None:
    arrays = {
        "text": np.array("käse"), "empty": np.empty((0, 3)), "one": np.float32(2),
        "many": np.asarray(np.arange(24.0).reshape(2, 3, 4), order=order), "yes": np.array([True, False]),
    }  # fmt: skip
    np.savez_compressed(tmp_path / "a.npz", **arrays)
    with npz_files.open_arrays(tmp_path / "a.npz", "arrays", StateFileError) as file:
        assert file.names == list(arrays)
        for name, array in arrays.items():
            read = file.read(name)
            assert read.dtype == array.dtype and read.shape == array.shape
            np.testing.assert_array_equal(read, array)


@pytest.mark.parametrize(
    ("arrays", "error", "part"),
    [
        ({"probabilities": np.float32(0.5)}, MaskFormatError, "of shape ()"),
        ({"probabilities": np.zeros((HEIGHT, WIDTH, 4), np.float32)}, MaskFormatError, "the classes last"),
        ({"probabilities": np.zeros((4, 9, 9), np.float32)}, MaskSizeError, "9 x 9 pixels; expected 64 x 48"),
        ({"probabilities": np.array(["a"])}, MaskFormatError, "<U1 of shape (1,)"),
        ({"probabilities": np.array([{}])}, MaskFormatError, "expected numbers"),
        ({"probabilities": np.zeros((4, HEIGHT, WIDTH), np.float32), "classes": np.array(3)}, UnknownLabelError, "ids"),
    ],
)
def test_soft_masks_of_another_form_are_refused_by_their_headers(
    tmp_path: Path, arrays: dict[str, Any], error: type[GssegError], part: str
) -> None:
    np.savez(tmp_path / "view0.npz", **arrays)
    view = View(ring(1)[0], tmp_path / "view0.npz", class_names=NAMES)
    assert_refused_in_little_memory(view.read_seen, error, "view0.npz", part)


def test_raw_bytes_and_bombs_in_place_of_a_soft_mask_are_refused(tmp_path: Path) -> None:
    view = View(ring(1)[0], tmp_path / "view0.npz", class_names=NAMES)
    with zipfile.ZipFile(tmp_path / "view0.npz", "w") as file:
        file.writestr("probabilities.npy", b"raw bytes")
    assert_refused_in_little_memory(view.read_seen, MaskFormatError, "'probabilities' is none of NumPy's")
    with_bomb(tmp_path / "view0.npz", "probabilities", (4, 2048, 2048))
    assert_refused_in_little_memory(view.read_seen, MaskSizeError, "2048 x 2048 pixels")


@pytest.mark.parametrize("method", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_damage_is_one_error_whatever_a_file_is_packed_with(tmp_path: Path, method: int) -> None:
    path = tmp_path / "state.npz"
    with zipfile.ZipFile(path, "w", method) as archive:
        archive.writestr("header.npy", bytes(1000))
    content = path.read_bytes()
    path.write_bytes(content[:45] + b"\xff" * 15 + content[60:])
    with pytest.raises(StateFileError, match=r"state\.npz: is not a saved state, or is damaged"):
        State.load_alone(path)


def test_a_sparse_array_takes_less_room_than_numpy_would_give_it(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    dense = np.where(rng.random((3_000, 40)) < 0.1, rng.random((3_000, 40)), 0).astype(np.float32)
    npz_files.write_npz(tmp_path / "ours.npz", {}, shares=npz_files.WithZeros(csr_rows.CSRRows.from_dense(dense), 40))
    np.savez_compressed(tmp_path / "numpys.npz", shares=dense)
    np.testing.assert_array_equal(np.load(tmp_path / "ours.npz")["shares"], dense)
    ours, numpys = (zipfile.ZipFile(tmp_path / name).getinfo("shares.npy") for name in ("ours.npz", "numpys.npz"))
    assert ours.compress_size < numpys.compress_size and ours.file_size == numpys.file_size
