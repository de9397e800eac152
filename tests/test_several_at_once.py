"""Several views at once give what one after the other gives, in the same order, and never more are in memory."""

from __future__ import annotations

import threading
import weakref

import numba as nb
import numpy as np
import pytest
from patience import PATIENCE

from gsseg_core.csr_rows import CSRRows
from gsseg_core.several_at_once import each_with_made, meanwhile, several_at_once


@pytest.fixture(autouse=True)
def kernels_have_run() -> None:
    CSRRows.from_dense(np.eye(3, dtype=np.float32))


@pytest.fixture
def two_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have two views at once on any machine, in this session of tests with one thread, too."""
    monkeypatch.setattr("gsseg_core.several_at_once.numba.get_num_threads", lambda: 2)


@pytest.mark.parametrize("count", [0, 1, 2, 3, 10])
@pytest.mark.usefixtures("two_threads")
def test_results_come_in_the_order_of_the_items(count: int) -> None:
    assert list(several_at_once(lambda i: i * i, range(count))) == [i * i for i in range(count)]


@pytest.mark.usefixtures("two_threads")
def test_two_are_worked_on_at_once_and_no_more_are_begun_than_are_wanted() -> None:
    meeting, begun = threading.Barrier(2, timeout=PATIENCE), []

    def work(i: int) -> int:
        begun.append(i)
        if i < 2:
            meeting.wait()
        return i

    results = several_at_once(work, range(100))
    assert next(results) == 0
    results.close()
    assert set(begun) <= {0, 1, 2}


@pytest.mark.usefixtures("two_threads")
def test_items_come_with_what_is_made_of_them_each_told_before_it_and_all_at_the_end() -> None:
    told: list[tuple[str, int, int]] = []
    found = []
    for item, made in each_with_made(len, ["a", "bc", "def"], "cpu", lambda *step: told.append(step), "count"):
        found.append((item, made, told[-1]))
    assert found == [("a", 1, ("count", 0, 3)), ("bc", 2, ("count", 1, 3)), ("def", 3, ("count", 2, 3))]
    assert told[-1] == ("count", 3, 3)


@pytest.mark.usefixtures("two_threads")
def test_an_error_comes_in_its_turn_and_ends_the_work() -> None:
    def work(i: int) -> int:
        if i == 3:
            raise KeyError(i)
        return i

    results = several_at_once(work, range(100))
    assert [next(results) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(KeyError):
        next(results)
    assert list(results) == []


@pytest.fixture
def given(monkeypatch: pytest.MonkeyPatch) -> dict[threading.Thread, int]:
    """How many threads the kernels of each thread were given last."""
    given: dict[threading.Thread, int] = {}

    def note(number: int) -> None:
        given[threading.current_thread()] = number

    monkeypatch.setattr("gsseg_core.several_at_once.numba.set_num_threads", note)
    return given


@pytest.mark.usefixtures("two_threads")
def test_each_of_the_two_has_half_of_the_threads_and_so_has_who_takes_what_they_make(
    given: dict[threading.Thread, int],
) -> None:
    for _ in several_at_once(lambda i: i, range(4)):
        assert set(given.values()) == {1} and threading.current_thread() in given
    assert given.pop(threading.current_thread()) == 2
    assert set(given.values()) == {1}


@pytest.mark.usefixtures("two_threads")
def test_who_stops_early_has_all_threads_again(given: dict[threading.Thread, int]) -> None:
    results = several_at_once(lambda i: i, range(4))
    next(results)
    results.close()
    assert given[threading.current_thread()] == 2


def test_on_a_gpu_as_many_are_worked_on_as_there_are_threads(
    monkeypatch: pytest.MonkeyPatch, given: dict[threading.Thread, int]
) -> None:
    monkeypatch.setattr("gsseg_core.several_at_once.numba.get_num_threads", lambda: 8)
    meeting = threading.Barrier(8, timeout=PATIENCE)
    assert sorted(several_at_once(lambda i: (meeting.wait(), i)[1], range(8), "cuda")) == list(range(8))
    assert given.pop(threading.current_thread()) == 8
    assert set(given.values()) == {1}


class OutOfMemoryError(RuntimeError):
    """What PyTorch calls its own."""


class Tensor:
    """What takes memory of a GPU."""


@pytest.mark.usefixtures("given")
def test_where_a_gpu_has_not_the_memory_for_as_many_fewer_are_worked_on_and_none_is_left_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("gsseg_core.several_at_once.numba.get_num_threads", lambda: 8)
    meeting, held = threading.Barrier(8, timeout=PATIENCE), dict[int, weakref.ref[Tensor]]()

    def work(i: int) -> int:
        if i < 8 and i not in held:
            tensor = Tensor()
            held[i] = weakref.ref(tensor)
            meeting.wait()
            raise OutOfMemoryError(i)
        assert i >= 8 or all(ref() is None for ref in held.values())
        return i

    assert list(several_at_once(work, range(12), "cuda")) == list(range(12))
    assert len(held) == 8


@pytest.mark.parametrize(("device", "tries"), [("cuda", 2), ("cpu", 1)])
def test_what_no_memory_is_enough_for_is_an_error(monkeypatch: pytest.MonkeyPatch, device: str, tries: int) -> None:
    monkeypatch.setattr("gsseg_core.several_at_once.numba.get_num_threads", lambda: 2)
    tried = []

    def work(i: int) -> None:
        tried.append(i)
        raise OutOfMemoryError(i)

    with pytest.raises(OutOfMemoryError):
        next(several_at_once(work, [7], device))
    assert tried == [7] * tries


@pytest.mark.parametrize("why", ["one thread", "kernels of one caller at a time"])
def test_else_the_caller_works_alone(monkeypatch: pytest.MonkeyPatch, why: str) -> None:
    monkeypatch.setattr("gsseg_core.several_at_once.numba.get_num_threads", lambda: 1 if why == "one thread" else 2)
    monkeypatch.setattr("gsseg_core.several_at_once.numba.threading_layer", lambda: "workqueue")
    threads = set(several_at_once(lambda _: threading.get_ident(), range(3)))
    assert threads == {threading.get_ident()}


def test_kernels_of_two_threads_give_the_same_bits() -> None:
    arrays = [np.random.default_rng(i).random((2000, 7), np.float32) for i in range(6)]
    expected = [CSRRows.from_dense(array).normalised().data for array in arrays]
    found = list(several_at_once(lambda array: CSRRows.from_dense(array).normalised().data, arrays))
    assert all(map(np.array_equal, found, expected))
    assert nb.get_num_threads() >= 1


def test_what_is_done_meanwhile_is_done_at_the_end_and_its_error_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsseg_core.several_at_once.kernels_run_beside_each_other", lambda: True)
    done: list[int] = []
    with meanwhile(lambda: done.append(threading.get_ident()), "cuda"):
        pass
    assert len(done) == 1 and done[0] != threading.get_ident()
    with pytest.raises(ZeroDivisionError), meanwhile(lambda: 1 // 0, "cuda"):
        pass


def test_without_a_gpu_nothing_is_done_meanwhile() -> None:
    with meanwhile(lambda: pytest.fail("the body has all cores at work"), "cpu"):
        pass
