"""The segments of one view as sparse rows: which Gaussians make up each, and in which order they come."""

from __future__ import annotations

import numba as nb
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy import sparse
from small_scenes import balls_on_a_table, clean_views

from gsseg_core.objects.lifted_segments import Lifted, Profiles, without_gaps
from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.observation import LabelWeights

few_weights = st.sampled_from([0.0, 0.125, 0.25, 1.0, 3.0])  # of which many are alike
any_weights = st.floats(2.0**-20, 2.0**10, width=32)


@st.composite
def label_weights(draw: st.DrawFn) -> LabelWeights:
    kind, number = draw(st.sampled_from([few_weights, any_weights])), draw(st.integers(0, 6))
    parts = [draw(st.dictionaries(st.integers(0, 40), kind, max_size=12)) for _ in range(number)]
    gaussians, weights = (
        np.array([one for part in parts for one in values(part)], dtype)
        for values, dtype in ((sorted, np.int32), (lambda part: [part[g] for g in sorted(part)], np.float32))
    )
    start = np.cumsum([0, *map(len, parts)])
    return LabelWeights(np.arange(number, dtype=np.int32) * 7, start, gaussians, weights)


def slow_lifted(seen: LabelWeights, kept: float) -> list[tuple[int, dict[int, float]]]:
    """Each id with its Gaussians, the heaviest id first; of equal ones that with the first Gaussian."""
    found, total, running = [], 0.0, 0.0
    for label, first, last in zip(seen.classes.tolist(), seen.start[:-1], seen.start[1:], strict=True):
        pairs = zip(seen.gaussians[first:last].tolist(), seen.weights[first:last].tolist(), strict=True)
        ranked, size, heavy = sorted(pairs, key=lambda pair: (-pair[1], pair[0])), 0.0, {}
        for _, weight in ranked:
            size += weight
        total += size
        for gaussian, weight in ranked:
            running += weight
            if running - weight - (total - size) < kept * size and weight > 0:
                heavy[gaussian] = weight
        if size > 0:
            found.append((-size, min(heavy, default=2**63), label, heavy))
    return [(label, heavy) for _, _, label, heavy in sorted(found, key=lambda one: one[:2])]


@given(label_weights(), st.sampled_from([0.0, 0.3, 0.5, 0.8, 1.0]))
def test_a_segment_is_its_heaviest_gaussians_to_the_last_bit_whatever_is_alike_empty_or_zero(
    seen: LabelWeights, kept: float
) -> None:
    lifted, expected = Lifted.of(seen, kept), slow_lifted(seen, kept)
    assert lifted.ids.tolist() == [label for label, _ in expected]
    assert lifted.gaussians.tolist() == sorted({g for _, heavy in expected for g in heavy})
    assert lifted.weights.shape == (len(expected), len(lifted.gaussians)) and lifted.weights.has_canonical_format
    types = lifted.ids.dtype, lifted.gaussians.dtype, lifted.weights.dtype, lifted.weights.indices.dtype
    assert types == (np.int32, np.int32, np.float32, np.int32)
    for (_, heavy), first, last in zip(expected, lifted.weights.indptr[:-1], lifted.weights.indptr[1:], strict=True):
        columns, weights = lifted.weights.indices[first:last], lifted.weights.data[first:last]
        assert dict(zip(lifted.gaussians[columns].tolist(), weights.tolist(), strict=True)) == heavy


def test_a_view_is_lifted_alike_by_its_observation_its_weights_and_any_number_of_threads() -> None:
    scene, _ = balls_on_a_table()
    view, threads, found = clean_views(1)[0], nb.get_num_threads(), []
    try:
        for count in (1, nb.config.NUMBA_NUM_THREADS):
            nb.set_num_threads(count)
            operator, labels = make_operator(scene, view.camera), view.read_labels()
            found += [Lifted.of(operator.observe(labels).by_label()), Lifted.of(operator.lift(labels))]
    finally:
        nb.set_num_threads(threads)
    for other in found[1:]:
        for name in ("ids", "gaussians"):
            np.testing.assert_array_equal(getattr(other, name), getattr(found[0], name))
        for name in ("data", "indices", "indptr"):
            np.testing.assert_array_equal(getattr(other.weights, name), getattr(found[0].weights, name))


@given(st.lists(st.integers(0, 60)))
def test_numbers_get_places_without_gaps_as_unique_gives_them(numbers: list[int]) -> None:
    array = np.array(numbers, np.int64)
    for found, expected in zip(without_gaps(array), np.unique(array, return_inverse=True), strict=True):
        assert found.dtype == np.int32
        np.testing.assert_array_equal(found, expected)


def test_views_that_are_added_for_ever_take_no_more_and_more_memory() -> None:
    rng, profiles, gaussians = np.random.default_rng(0), Profiles.empty(50), np.arange(50, dtype=np.int32)
    expected, kept = np.zeros((50, 4)), []
    for _ in range(60):
        weights = rng.integers(1, 9, (4, 50)).astype(np.float32)
        profiles.add(Lifted(np.arange(4, dtype=np.int32), gaussians, sparse.csr_matrix(weights)), np.arange(4))
        expected += weights.T
        kept.append(profiles._sum.nnz + sum(part.nnz for part in profiles._more))
    assert max(kept) <= 3 * expected.size
    np.testing.assert_array_equal(profiles.weights.toarray(), expected)
