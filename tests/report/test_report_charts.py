"""Charts of the report page draw the numbers that they are given."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from report_cases import Outline

from gsseg_core.report.page import environment

CHARTS = environment().get_template("charts.html.j2").module


def drawn(kind: str, *numbers: object) -> Outline:
    return Outline(str(getattr(CHARTS, kind)(*numbers)))


@given(st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 10**6)), min_size=1, max_size=30))
def test_areas_of_a_histogram_are_the_counts(counts: list[tuple[int, int]]) -> None:
    both = np.array(counts)
    chart = drawn("histogram", ["one", "<two>"], counts)
    heights = [
        np.array([float(bar["height"]) for bar in chart.tagged("rect") if bar["class"] == f"s{i}"]) for i in (0, 1)
    ]
    largest = max(int(both.sum(axis=1).max()), 1)
    for i, height in enumerate(heights):
        np.testing.assert_allclose(height / 162 * largest, both[both[:, i] > 0, i], atol=0.006 / 162 * largest)
    assert any("<two>" in said for said in chart.said) == bool(both[:, 1].any())


def test_parts_of_a_bar_add_up_and_no_share_leaves_it() -> None:
    chart = drawn("stacked_bar", {"load": 1.0, "<learn>": 3.0})
    assert [float(part["width"]) for part in chart.tagged("rect")] == [25, 75]
    assert [float(drawn("bar", share).tagged("rect")[1]["width"]) for share in (-1, 0.25, 7)] == [0, 25, 100]
    drawn("stacked_bar", {}), drawn("stacked_bar", {"nothing": 0.0})


def test_views_below_the_line_and_without_a_figure_are_marked() -> None:
    views = [{"name": name, "reliability": value} for name, value in (("a", 0.2), ("b", 0.9), ("c<", None))]
    chart = drawn("columns", views, 0.7)
    assert [column["class"] for column in chart.tagged("rect")] == ["bad", "fill", "none"]
    heights = [float(column["height"]) for column in chart.tagged("rect")]
    assert heights == [6, 27, 1] and "c<: -" in chart.said


def test_matrix_draws_what_is_not_zero_in_its_place() -> None:
    names = ["a", "b", "a name that is much too long"]
    chart = drawn("heatmap", names, [[1, 0, 0], [0.5, 0.5, 0], [0, 0, 1]])
    kinds = [cell["class"] for cell in chart.tagged("rect")]
    assert kinds == ["track", "fill", "bad", "fill", "fill"]
    first, below = chart.tagged("rect")[1:3]
    assert float(below["y"]) > float(first["y"]) and below["x"] == first["x"]
    assert "a name that is mu…" in chart.said and "b called a: 50.0 % of its pixels" in chart.said
