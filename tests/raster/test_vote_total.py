"""Votes in pages are those of a dense array, and take little memory where neighbours have few classes."""

from __future__ import annotations

import pickle
from itertools import permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsseg_core.csr_rows import CSRRows
from gsseg_core.raster import vote_total
from gsseg_core.raster.vote_total import PAGE, PairVotes, VoteTotal
from gsseg_core.spatial.row_order import RowOrder, inverse

UNITS = 2.0**24


def cast(rng: np.random.Generator, n: int, k: int) -> tuple[PairVotes, CSRRows]:
    """Draw a view's votes: pairs of some Gaussians with labels, of which each is for and against some classes."""
    num_labels = int(rng.integers(1, 6))
    label_votes = rng.choice([-1.0, 0.0, 0.5, 1.0], (num_labels, k))
    of = np.sort(rng.choice(n, int(rng.integers(0, n + 1)), replace=False))
    count = rng.integers(1, num_labels + 1, len(of))
    labels = [rng.permutation(num_labels)[:number] for number in count]
    gaussians = np.repeat(of, count).astype(np.int32)
    ends = np.cumsum(count)
    cuts = np.sort(rng.integers(0, len(of) + 1, 3)) if len(of) else np.zeros(3, int)
    borders = np.concatenate([[0], np.concatenate([[0], ends])[cuts], [len(gaussians)]])
    weights = rng.random(len(gaussians), np.float32)
    labels = np.concatenate([np.empty(0, np.int64), *labels]).astype(np.int32)
    return PairVotes(gaussians, labels, weights, np.stack([borders[:-1], borders[1:]], axis=1)), CSRRows.from_dense(
        label_votes
    )


def some_order(rng: np.random.Generator, n: int) -> RowOrder | None:
    """Draw an order of Gaussians in pages, half of the time."""
    order = rng.permutation(n).astype(np.int32)
    return RowOrder(order, inverse(order)) if rng.random() < 0.5 else None


def dense_votes(shape: tuple[int, int], votes: PairVotes, label_votes: CSRRows) -> np.ndarray:
    """What a view votes, (N, K) int64, one after the other."""
    out, by_label = np.zeros(shape, np.int64), label_votes.dense(shape[1])
    for i, label, weight in zip(votes.gaussians, votes.labels, votes.weights, strict=True):
        out[i] += np.rint(np.float64(weight) * by_label[label] * UNITS).astype(np.int64)
    return out


sizes = st.sampled_from([1, 3, PAGE - 1, PAGE, PAGE + 1, 3 * PAGE + 7])


@given(sizes, st.integers(1, 7), st.integers(0, 2**31))
def test_views_that_are_added_and_taken_back_in_any_order_leave_the_sums_of_a_dense_twin(
    n: int, k: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    total, expected, there = VoteTotal(n, k, some_order(rng, n)), np.zeros((n, k), np.int64), []
    for _ in range(8):
        if there and rng.random() < 0.4:
            view, sign = there.pop(int(rng.integers(len(there)))), -1
        else:
            view, sign = cast(rng, n, k), 1
            there.append(view)
        total.add(*view, sign)
        expected += sign * dense_votes((n, k), *view)
        np.testing.assert_array_equal(total.dense(), expected)
    for found, wanted in zip(total.rows(), CSRRows.from_dense(expected), strict=True):
        np.testing.assert_array_equal(found, wanted)
        assert found.dtype == wanted.dtype
    for view in there:
        total.add(*view, -1)
    assert not len(total.rows().data)


@pytest.mark.parametrize("stage", ["_number_pairs", "_make_room", "add_pairs"])
def test_ctrl_c_that_is_heard_when_a_kernel_has_ended_changes_nothing(
    stage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(0)
    first, second = cast(rng, 700, 5), cast(rng, 700, 5)
    total, owner = VoteTotal(700, 9), VoteTotal if stage == "_make_room" else vote_total
    total.add(*first)
    before, work = total.dense(), getattr(owner, stage)

    def interrupted(*given: object) -> None:
        monkeypatch.setattr(owner, stage, work)
        work(*given)
        raise KeyboardInterrupt

    for sign in (1, -1):
        monkeypatch.setattr(owner, stage, interrupted)
        with pytest.raises(KeyboardInterrupt):
            total.add(*second, sign)
        np.testing.assert_array_equal(total.dense(), before)
        total.add(*second, sign)
        np.testing.assert_array_equal(total.dense() - before, sign * dense_votes((700, 9), *second))
        before = total.dense()


def test_the_order_of_views_and_of_gaussians_in_pages_changes_nothing_but_the_pages() -> None:
    rng = np.random.default_rng(0)
    views, found = [cast(rng, 700, 5) for _ in range(3)], []
    for order in permutations(views):
        total = VoteTotal(700, 5, some_order(rng, 700))
        for view in order:
            total.add(*view)
        found.append(total.rows())
    for rows in found[1:]:
        for one, other in zip(found[0], rows, strict=True):
            np.testing.assert_array_equal(one, other)


@given(sizes, st.integers(1, 7), st.integers(0, 2**31))
def test_rows_go_in_and_come_out_whole_or_part_by_part(n: int, k: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    votes = rng.integers(-(2**60), 2**60, (n, k)) * (rng.random((n, k)) < 0.3)
    total = VoteTotal.from_rows(CSRRows.from_dense(votes), k, some_order(rng, n))
    assert total.shape == (n, k)
    np.testing.assert_array_equal(total.dense(), votes)
    in_parts, step = VoteTotal(n, k, some_order(rng, n)), int(rng.integers(1, n + 1))
    for first in range(0, n, step):
        in_parts.add_rows(CSRRows.from_dense(votes[first : first + step]), first)
    np.testing.assert_array_equal(in_parts.dense(), votes)
    in_parts.add_rows(CSRRows.from_dense(-votes))
    assert not in_parts.dense().any()


@given(sizes, st.integers(1, 7), st.integers(1, 9), st.integers(0, 2**31))
def test_a_copy_is_independent_and_classes_come_and_go(n: int, k: int, other: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    first, second = (rng.integers(-5, 6, (n, k)) * (rng.random((n, k)) < 0.3) for _ in range(2))
    total = VoteTotal.from_rows(CSRRows.from_dense(first), k, some_order(rng, n))
    copies = total.copy(), pickle.loads(pickle.dumps(total))
    total.add_rows(CSRRows.from_dense(second))
    for copy in copies:
        np.testing.assert_array_equal(copy.dense(), first)
        copy.add_rows(CSRRows.from_dense(-first))
    expected = first + second
    np.testing.assert_array_equal(total.dense(), expected)
    total.resize(other)
    expected = np.pad(expected[:, :other], ((0, 0), (0, max(other - k, 0))))
    np.testing.assert_array_equal(total.dense(), expected)
    more = rng.integers(-5, 6, (n, other))
    total.add_rows(CSRRows.from_dense(more))
    np.testing.assert_array_equal(total.dense(), expected + more)


def test_classes_without_votes_come_and_go_without_a_copy_of_the_votes_of_others() -> None:
    total = VoteTotal.from_rows(CSRRows.from_dense(np.ones((600, 2), np.int64)), 2)
    pages = total._pages
    total.resize(50)
    total.resize(2)
    assert total._pages is pages
    total.resize(1)
    assert len(total._pages) == -(-600 // PAGE)


def test_of_many_classes_neighbours_have_few_and_that_is_what_is_kept() -> None:
    n, k = 100 * PAGE, 300
    votes = np.zeros((n, k), np.int64)
    for i, classes in enumerate(np.random.default_rng(0).integers(0, k, (100, 6))):
        votes[i * PAGE : (i + 1) * PAGE, classes] = 1 + i
    total = VoteTotal.from_rows(CSRRows.from_dense(votes), k)
    np.testing.assert_array_equal(total.dense(), votes)
    assert total.nbytes < 8 * n * k / 25
    assert total.most_classes(total.nbytes) == k == total.most_classes(0)
    assert total.most_classes(total.nbytes + 4 * 100 * 17) == k + 17, "a class without votes takes 4 bytes of a block"
    # Where neighbours are anywhere among all, they are found again by an order that knows where.
    order = np.random.default_rng(1).permutation(n).astype(np.int32)
    anywhere = CSRRows.from_dense(votes[inverse(order)])
    found = VoteTotal.from_rows(anywhere, k, RowOrder(order, inverse(order)))
    np.testing.assert_array_equal(found.dense(), votes[inverse(order)])
    assert found.nbytes == total.nbytes < VoteTotal.from_rows(anywhere, k).nbytes / 5


def test_without_memory_nothing_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    first, second = cast(rng, 600, 3), cast(rng, 600, 7)
    total = VoteTotal(600, 7)
    total.add(*first)
    before = total.dense()

    def full(*shape: object) -> np.ndarray:
        raise MemoryError

    with monkeypatch.context() as patch:
        patch.setattr(vote_total.np, "zeros", full)
        with pytest.raises(MemoryError):
            total.add(*second)
    np.testing.assert_array_equal(total.dense(), before)
    with monkeypatch.context() as patch:
        patch.setattr(vote_total.np, "arange", full)  # the last array that fewer classes take
        with pytest.raises(MemoryError):
            total.resize(1)
    np.testing.assert_array_equal(total.dense(), before)
    total.add(*second)
    np.testing.assert_array_equal(total.dense(), before + dense_votes((600, 7), *second))
