"""Association by sparse products and only where something has changed, beside a dense twin that does all again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from per_view_ids import row_of_objects
from scipy import sparse

from gsseg_core.objects import association
from gsseg_core.objects.association import associate
from gsseg_core.objects.lifted_segments import Lifted, Profiles
from gsseg_core.objects.move_kernels import add_objects, by_view, explain_segments
from gsseg_core.objects.sparse_products import product_above
from gsseg_core.objects.stacked_segments import Stack, Voters

DOUBT = 1.0
WEIGHTS = sparse.csr_matrix(np.full((1, 2), 4, np.float32))


def drawn_views(seed: int, num: int, background: bool) -> list[Lifted]:
    """Views of a row of objects, cut up and merged; with background, the first segment of each view is that.

    In some, segments are parts of wholes.
    """
    rng = np.random.default_rng(seed)
    views = [row_of_objects(rng, 0.4, 0.15) for _ in range(num)]
    views[::3] = [replace(view, wholes=view.ids - view.ids % 3 % 2) for view in views[::3]]
    return [replace(view, ids=np.arange(len(view))) for view in views] if background else views


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.integers(0, 12), st.integers(1, 9), st.integers(1, 40), st.floats(0, 2))
def test_what_is_large_in_a_product_is_kept_and_nothing_else(
    seed: int, rows: int, inner: int, columns: int, least: float
) -> None:
    rng = np.random.default_rng(seed)
    left, right = (
        np.where(rng.random(shape) < 0.4, rng.integers(1, 4, shape), 0).astype(np.float32)
        for shape in ((rows, inner), (inner, columns))
    )
    group, bars = rng.integers(0, 3, columns), (least * rng.random((rows, 3))).astype(np.float32)
    found = product_above(sparse.csr_matrix(left), sparse.csr_matrix(right), bars, group)
    whole = left @ right
    np.testing.assert_array_equal(found.toarray(), np.where(whole > bars[:, group], whole, 0))
    assert found.dtype == np.float32 and found.nnz == np.count_nonzero(whole > bars[:, group])


def test_a_product_does_not_depend_on_how_many_rows_there_is_room_for(monkeypatch: pytest.MonkeyPatch) -> None:
    stack = Stack(drawn_views(0, 6, True))
    at_once = stack.overlaps()[0]
    monkeypatch.setattr("gsseg_core.objects.sparse_products._SCRATCH", 700)
    in_parts = stack.overlaps()[0]
    for name in ("data", "indices", "indptr"):
        np.testing.assert_array_equal(getattr(at_once, name), getattr(in_parts, name))


@pytest.mark.parametrize("background", [False, True])
def test_overlaps_are_those_of_the_formulas(background: bool) -> None:
    views = drawn_views(1, 5, background)
    stack = Stack(views)
    weights = np.concatenate([view.weights.toarray() for view in views]).astype(np.float64)  # (n, I)
    sums = np.stack([view.weights.toarray().sum(axis=0) for view in views]).astype(np.float64)  # s, (views, I)
    scaled = weights / np.sqrt(sums)[stack.view]
    overlap, seen = scaled @ scaled.T, scaled @ np.sqrt(sums).T
    hidden = np.zeros_like(seen)
    hidden[:, stack.view[stack.background]] = overlap[:, stack.background]
    small = overlap <= 0.01 * seen[:, stack.view]
    overlap = np.where(small | stack.background, 0, overlap)
    assert small.any() and stack.wholes.shape[1] > 4
    expected = np.concatenate([overlap, overlap @ stack.wholes.toarray()], axis=1), seen, hidden
    for found, right in zip(stack.overlaps(), expected, strict=True):
        found = found.toarray() if sparse.issparse(found) else found
        np.testing.assert_allclose(found, right[~stack.background], rtol=1e-5, atol=1e-5)


def merged_by_comparing_all_anew(
    clusters: association._Clusters, votes: association._Votes, voters: Voters, level: float, surface: float
) -> tuple[association._Clusters, association._Votes]:
    """The twin of `_merged`."""
    while True:
        every = np.arange(len(clusters.seen))
        votes = association._Votes.of(clusters, every, voters, DOUBT)
        pairs = votes.pairs(every, clusters.borders, surface, level)
        if not len(pairs.first):
            return clusters, votes
        number = np.unique(association._match(pairs, len(every)), return_inverse=True)[1]
        clusters = clusters.merged(number)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("surface", [0.0, 0.6])
def test_comparing_only_what_has_merged_gives_what_comparing_all_gives(seed: int, surface: float) -> None:
    stack = Stack(drawn_views(seed, 9, seed % 2 == 0))
    start = association._Clusters.single(stack)
    votes = association._Votes.of(start, np.arange(len(start.seen)), stack.voters, DOUBT)
    for level in (0.6, 0.3):
        found, found_votes = association._merged(start, votes, stack.voters, level, surface)
        twin, twin_votes = merged_by_comparing_all_anew(start, votes, stack.voters, level, surface)
        assert found.of.max() < start.of.max()
        np.testing.assert_array_equal(found.of, twin.of)
        for name in ("counts", "shown"):
            np.testing.assert_array_equal(getattr(found_votes, name), getattr(twin_votes, name))
        np.testing.assert_array_equal(found_votes.whole.toarray(), twin_votes.whole.toarray())
        start, votes = found, found_votes


def explained_densely(profile: np.ndarray, view: Lifted, objects: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """The twin of `Profiles.common`, by the weights (N, K) of the objects."""
    weights, rest = view.weights.toarray().astype(np.float64), profile[view.gaussians].copy()
    if objects is not None:
        for a, k in enumerate(objects):
            rest[:, k] -= weights[a]
        rest[rest < 1e-6] = 0
    total = rest.sum(axis=1, keepdims=True)
    return weights @ np.divide(rest, total, out=np.zeros_like(rest), where=total > 0), weights @ (total[:, 0] > 0)


def best_of(common: np.ndarray, known: np.ndarray) -> np.ndarray:
    """The object of the largest IoU with each segment, by what is in common with each, (L, K)."""
    iou = common / np.maximum(known[:, None] + common.sum(axis=0) - common, 1e-12)
    return np.asarray(iou.argmax(axis=1))


def drawn_objects(views: list[Lifted]) -> tuple[list[np.ndarray], np.ndarray]:
    """Twelve objects that segments are of, by chance, and their weights (N, K); ten Gaussians more than any sees."""
    rng = np.random.default_rng(0)
    objects, dense = [rng.integers(0, 12, len(view)) for view in views], np.zeros((330, 12))
    for view, numbers in zip(views, objects, strict=True):
        for a, k in enumerate(numbers):
            dense[view.gaussians, k] += view.weights[a].toarray().ravel()
    return objects, dense


def test_what_segments_have_in_common_with_objects_is_that_of_the_definition() -> None:
    views = drawn_views(2, 5, True)
    objects, dense = drawn_objects(views[1:])
    profiles, view = Profiles.empty(330), views[0]
    for other, numbers in zip(views[1:], objects, strict=True):
        profiles.add(other, numbers)
    found, expected = profiles.common(view), explained_densely(dense, view, None)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)
    best, seen = profiles.explain(view)
    np.testing.assert_array_equal(best, best_of(*expected))
    np.testing.assert_allclose(seen, expected[1] / view.weights.toarray().sum(axis=1), rtol=1e-6)


@pytest.mark.parametrize("background", [False, True])
def test_what_explains_segments_is_said_by_the_other_views_alone(background: bool) -> None:
    views = drawn_views(2, 5, background)
    objects, dense = drawn_objects(views)
    stack = Stack(views)
    weights = stack.weights().T.tocsr()
    entries, numbers = (weights.indptr, weights.indices, weights.data), np.concatenate(objects)
    own = by_view(*entries, stack.starts, *stack.gaussians())
    best, known = explain_segments(own, *add_objects(*entries, numbers, 12), numbers, 12)
    for view, of_view, part in zip(views, objects, stack.starts, strict=False):
        common, expected = explained_densely(dense, view, of_view)
        rows = slice(part, part + len(view))
        np.testing.assert_allclose(known[rows], expected, rtol=1e-9, atol=1e-9)
        np.testing.assert_array_equal(best[rows], best_of(common, expected))
    assert len(set(best.tolist())) > 6


def test_the_weights_of_each_view_come_by_gaussian() -> None:
    views = drawn_views(3, 4, False)
    stack = Stack(views)
    weights = stack.weights().T.tocsr()
    own = by_view(weights.indptr, weights.indices, weights.data, stack.starts, *stack.gaussians())
    for v, view in enumerate(stack.views):
        first, last = own.firsts[v : v + 2]
        part = slice(own.indptr[first], own.indptr[last])
        transposed = view.weights.T.tocsr()
        np.testing.assert_array_equal(own.indptr[first : last + 1] - own.indptr[first], transposed.indptr)
        np.testing.assert_array_equal(own.segments[part] - stack.starts[v], transposed.indices)
        np.testing.assert_array_equal(own.weights[part], transposed.data)


def test_a_segment_that_no_other_view_knows_of_is_explained_by_nothing() -> None:
    alone, other = (Lifted(np.ones(1, np.int32), np.arange(n, n + 2, dtype=np.int32), WEIGHTS) for n in (0, 2))
    assert associate({"alone": alone, "other": other}).objects == {"alone": [1], "other": [2]}
