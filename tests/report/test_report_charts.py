"""Charts of the report page draw the numbers that they are given."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from report_cases import Outline

from gsseg_core.report import charts


@given(st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 10**6)), min_size=1, max_size=30))
def test_areas_of_a_histogram_are_the_counts(counts: list[tuple[int, int]]) -> None:
    both = np.array(counts)
    drawn = Outline(charts.histogram([("one", both[:, 0]), ("<two>", both[:, 1])], 0.0, 1.0))
    heights = [
        np.array([float(bar["height"]) for bar in drawn.tagged("rect") if bar["class"] == f"s{i}"]) for i in (0, 1)
    ]
    largest = max(int(both.sum(axis=1).max()), 1)
    for i, height in enumerate(heights):
        np.testing.assert_allclose(height / 162 * largest, both[both[:, i] > 0, i], atol=0.006 / 162 * largest)
    assert any("<two>" in said for said in drawn.said) == bool(both[:, 1].any())


def test_parts_of_a_bar_add_up_and_no_share_leaves_it() -> None:
    drawn = Outline(charts.stacked_bar([("load", 1.0), ("<learn>", 3.0)]))
    assert [float(part["width"]) for part in drawn.tagged("rect")] == [25, 75]
    assert [float(Outline(charts.bar(share, "")).tagged("rect")[1]["width"]) for share in (-1, 0.25, 7)] == [0, 25, 100]
    Outline(charts.stacked_bar([])), Outline(charts.stacked_bar([("nothing", 0.0)]))


def test_views_below_the_line_and_without_a_figure_are_marked() -> None:
    drawn = Outline(charts.columns([0.2, 0.9, None], ["a", "b", "c<"], 0.7))
    assert [column["class"] for column in drawn.tagged("rect")] == ["bad", "fill", "none"]
    heights = [float(column["height"]) for column in drawn.tagged("rect")]
    assert heights == [6, 27, 1] and "c<" in drawn.said


def test_matrix_draws_what_is_not_zero_in_its_place() -> None:
    names = ["a", "b", "a name that is much too long"]
    drawn = Outline(charts.heatmap(np.array([[1, 0, 0], [0.5, 0.5, 0], [0, 0, 1]]), names, [names] * 3))
    kinds = [cell["class"] for cell in drawn.tagged("rect")]
    assert kinds == ["track", "fill", "bad", "fill", "fill"]
    below = drawn.tagged("rect")[2]
    assert float(below["y"]) > float(below["x"]) - charts.NAMES_PX + charts.SLANTED_PX
    assert "a name that is mu…" in drawn.said
