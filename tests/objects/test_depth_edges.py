"""Edges of the surface that a view sees: where they are, and what part of the borders of segments runs along them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from per_view_ids import in_halves
from small_scenes import balls_on_a_table, clean_views, look_at

from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.objects import depth_edges as module
from gsseg_core.objects.depth_edges import DepthEdges, borders, depth_edges
from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.depth import Surface
from gsseg_core.raster.view_renderer import PixelGrid

SCENE, _ = balls_on_a_table()
VIEWS = clean_views(8)


def edges_of(inverse: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> DepthEdges:
    """Find the edges where the inverse depth of a view is this, whatever the scene is."""
    depth = 1 / inverse
    monkeypatch.setattr(
        module, "surface", lambda scene, operator, grid: Surface(*map(grid.of, (np.ones_like(depth), depth)))
    )
    camera = look_at("v", np.array([0, -3.0, 1.0]), width=inverse.shape[1], height=inverse.shape[0])
    return depth_edges(SCENE, make_operator(SCENE, camera))


def test_a_plane_has_no_edge_however_it_lies_and_a_step_has_one_on_its_far_side(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rows, columns = np.mgrid[:60, :80]
    plane = 0.2 + 0.001 * rows + 0.0005 * columns
    inner = np.s_[8:-8, 8:-8]  # At the rim of the image a plane seems to end.
    assert edges_of(plane, monkeypatch).strength[inner].max() < 1e-6
    step = np.where(columns < 40, 1.5, 1.0) * plane
    for scale in (1.0, 0.01):
        strength = edges_of(scale * step, monkeypatch).strength
        assert (strength[inner][:, 30:33] == 1).all() and strength[inner][:, [10, 50]].max() < 1e-6


def test_large_views_are_looked_at_in_a_size_that_generators_see(monkeypatch: pytest.MonkeyPatch) -> None:
    edges = edges_of(np.full((300, 1000), 0.5), monkeypatch)
    assert edges.grid == PixelGrid(0, 3) and edges.strength.shape == (100, 334)


@pytest.mark.parametrize("number", range(3))
def test_objects_end_where_the_surface_does_and_their_parts_do_not(number: int) -> None:
    view = in_halves(VIEWS[number], 1)
    labels, half = view.read_labels(), int(view.read_labels().max())
    ids = np.unique(labels)
    found = borders(labels, ids, depth_edges(SCENE, make_operator(SCENE, view.camera)))
    length, edges = (part.toarray() for part in found)
    share = np.divide(edges, length, out=np.full_like(length, np.nan), where=length > 0)
    table, one, other = (int(np.flatnonzero(ids == k)[0]) for k in (0, 1, half))
    assert share[one, other] < 0.5 < 0.75 < np.nanmin(share[table])


def slow_borders(labels: np.ndarray, ids: list[int], strength: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Go from pixel to pixel, where none is unknown."""
    length, edges = np.zeros((2, len(ids), len(ids)))
    rows, columns = labels.shape
    for r in range(rows):
        for c in range(columns):
            for down, right in ((0, 1), (1, 0)):
                if r + down == rows or c + right == columns:
                    continue
                one, other = int(labels[r, c]), int(labels[r + down, c + right])
                if one != other and one in ids and other in ids:
                    for a, b in ((one, other), (other, one)):
                        length[ids.index(a), ids.index(b)] += 1
                        edges[ids.index(a), ids.index(b)] += max(strength[r, c], strength[r + down, c + right])
    return length, edges


@given(st.integers(0, 2**32 - 1))
def test_borders_are_those_of_their_definition(seed: int) -> None:
    random = np.random.default_rng(seed)
    labels, strength = random.integers(0, 5, (7, 9)), random.random((7, 9)).astype(np.float32)
    ids = random.permutation(5)[: random.integers(1, 6)]
    found = borders(labels, ids, DepthEdges(strength, PixelGrid(0, 1)))
    for one, other in zip(found, slow_borders(labels, ids.tolist(), strength), strict=True):
        np.testing.assert_allclose(one.toarray(), other, rtol=1e-6)


def test_segments_with_a_narrow_seam_between_them_border_on_each_other_and_with_a_wide_one_do_not() -> None:
    edges = DepthEdges(np.ones((10, 30), np.float32), PixelGrid(0, 1))
    for width, length in ((0, 10), (6, 10), (7, 0)):
        labels = np.full((10, 30), UNKNOWN)
        labels[:, :10], labels[:, 10 + width :] = 3, 8
        assert borders(labels, np.array([8, 3]), edges).length.toarray().tolist() == [[0, length], [length, 0]]


def test_a_mask_without_a_known_pixel_has_no_border() -> None:
    edges = DepthEdges(np.ones((4, 4), np.float32), PixelGrid(0, 2))
    labels = np.full((8, 8), UNKNOWN)
    labels[1, 1] = 2  # The grid misses it.
    assert borders(labels, np.array([2]), edges).length.nnz == 0
