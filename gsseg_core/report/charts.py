"""Charts of the report page as inline SVG, drawn by hand: they take their colours from the page's style sheet.

Text in them is escaped here; whatever a caller hands in may hold anything.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsseg_core.text import html_text

MATRIX_PX, LARGEST_CELL, SMALLEST_CELL = 420, 30, 16
NAMES_PX, SLANTED_PX, OVERHANG = 130, 110, 60


def bar(share: float, label: str, css_class: str = "fill") -> str:
    """Draw a horizontal bar filled up to a share in [0, 1]; as wide as its place."""
    width = 100 * min(max(share, 0.0), 1.0)
    return (
        f'<svg class="bar" viewBox="0 0 100 6" preserveAspectRatio="none" role="img" aria-label="{html_text(label)}">'
        f'<rect class="track" width="100" height="6"/><rect class="{css_class}" width="{width:.1f}" height="6"/></svg>'
    )


def stacked_bar(parts: Sequence[tuple[str, float]]) -> str:
    """Draw the parts of a whole side by side, the i-th in the style sheet's colour `.s<i>`."""
    total = sum(value for _, value in parts) or 1.0
    x, drawn = 0.0, []
    for i, (name, value) in enumerate(parts):
        width = 100 * value / total
        title = html_text(f"{name}: {value:.2f} s")
        drawn.append(f'<rect class="s{i % 8}" x="{x:.2f}" width="{width:.2f}" height="6"><title>{title}</title></rect>')
        x += width
    return (
        '<svg class="stack" viewBox="0 0 100 6" preserveAspectRatio="none" role="img" '
        f'aria-label="seconds per stage, as in the table below">{"".join(drawn)}</svg>'
    )


def columns(values: Sequence[float | None], titles: Sequence[str], low: float) -> str:
    """Draw one thin column per value in [0, 1], a stub where there is none; those below `low` in a warning colour."""
    step = 100 / max(len(values), 1)
    width = min(0.8 * step, 6.0)
    drawn = []
    for i, (value, title) in enumerate(zip(values, titles, strict=True)):
        height = 1.0 if value is None else max(30 * value, 0.3)
        kind = "none" if value is None else "bad" if value < low else "fill"
        drawn.append(
            f'<rect class="{kind}" x="{(i + 0.5) * step - width / 2:.2f}" y="{30 - height:.2f}" width="{width:.2f}" '
            f'height="{height:.2f}"><title>{html_text(title)}</title></rect>'
        )
    y = 30 - 30 * low
    return (
        '<svg class="columns" viewBox="0 0 100 30" preserveAspectRatio="none" role="img" '
        f'aria-label="a column for each view, the worst first">{"".join(drawn)}'
        f'<line class="mark" x1="0" x2="100" y1="{y:.2f}" y2="{y:.2f}"/></svg>'
    )


def histogram(
    series: Sequence[tuple[str, np.ndarray]],  # each (B,)
    low: float,
    high: float,
) -> str:
    """Draw counts per bin, the series stacked; with an axis from `low` to `high`.

    Parameters
    ----------
    series : sequence of (str, (B,) array)
        Name and counts; the i-th is drawn in the style sheet's colour `.s<i>`, the first at the bottom.
    low, high : float
        Where the first bin begins and the last one ends.
    """
    width, height, left, top, bottom = 400, 200, 44, 12, 26
    plot, floor = width - left - 8, height - bottom
    total = np.sum([counts for _, counts in series], axis=0)
    bins, largest = len(total), max(int(total.max(initial=0)), 1)
    step, unit = plot / bins, (floor - top) / largest
    drawn, below = [], np.zeros(bins)
    edges = np.linspace(low, high, bins + 1)
    for i, (name, counts) in enumerate(series):
        for j in np.flatnonzero(counts).tolist():
            title = html_text(f"{edges[j]:.2f} to {edges[j + 1]:.2f}: {int(counts[j]):,} {name}")
            y, size = floor - unit * (below[j] + counts[j]), unit * counts[j]
            drawn.append(
                f'<rect class="s{i}" x="{left + j * step + 0.5:.1f}" y="{y:.2f}" width="{step - 1:.1f}" '
                f'height="{size:.2f}"><title>{title}</title></rect>'
            )
        below = below + counts
    for value in np.linspace(low, high, 6):
        x = left + plot * (value - low) / (high - low)
        drawn.append(f'<text x="{x:.1f}" y="{height - 8}" text-anchor="middle">{value:.1f}</text>')
    for count in (largest, largest / 2):
        y = floor - unit * count
        drawn.append(f'<line class="grid" x1="{left}" x2="{left + plot}" y1="{y:.1f}" y2="{y:.1f}"/>')
        drawn.append(f'<text x="{left - 6}" y="{y + 4:.1f}" text-anchor="end">{_short(count)}</text>')
    drawn.append(f'<line class="axis" x1="{left}" x2="{left + plot}" y1="{floor}" y2="{floor}"/>')
    return f'<svg class="chart" viewBox="0 0 {width} {height}" role="img" aria-label="histogram">{"".join(drawn)}</svg>'


def heatmap(
    shares: np.ndarray,  # (R, R)
    names: Sequence[str],
    titles: Sequence[Sequence[str]],
) -> str:
    """Draw a square matrix of shares in [0, 1]: the diagonal in one colour, what lies off it in another.

    Parameters
    ----------
    shares : (R, R) array
        Zero where nothing is drawn.
    names : sequence of str
        One for each row and column.
    titles : sequence of sequences of str
        What to say of each cell.
    """
    cell = max(min(MATRIX_PX // max(len(names), 1), LARGEST_CELL), SMALLEST_CELL)
    left, top, size = NAMES_PX, SLANTED_PX, len(names) * cell
    width, height = left + size + OVERHANG, top + size + 4
    drawn = [f'<rect class="track" x="{left}" y="{top}" width="{size}" height="{size}"/>']
    for i, name in enumerate(names):
        middle, short = (i + 0.5) * cell, html_text(_cut(name))
        drawn.append(f'<text x="{left - 6}" y="{top + middle + 4:.1f}" text-anchor="end">{short}</text>')
        x, y = left + middle + 4, top - 6
        drawn.append(f'<text x="{x:.1f}" y="{y}" transform="rotate(-60 {x:.1f} {y})">{short}</text>')
    for i, j in zip(*(index.tolist() for index in np.nonzero(shares)), strict=True):
        # Differences are few: raised like this, a share of 1 % is still to be seen.
        opacity, kind = max(float(shares[i, j]) ** 0.4, 0.1), "fill" if i == j else "bad"
        drawn.append(
            f'<rect class="{kind}" x="{left + j * cell + 0.5}" y="{top + i * cell + 0.5}" width="{cell - 1}" '
            f'height="{cell - 1}" opacity="{opacity:.2f}"><title>{html_text(titles[i][j])}</title></rect>'
        )
    return (
        f'<svg class="heatmap" width="{width}" height="{height}" viewBox="0 0 {width} {height}" role="img" '
        f'aria-label="confusion between classes; the largest are in the table">{"".join(drawn)}</svg>'
    )


def _cut(name: str, length: int = 18) -> str:
    return name if len(name) <= length else name[: length - 1] + "…"


def _short(count: float) -> str:
    for unit, suffix in ((1e6, "M"), (1e3, "k")):
        if count >= unit:
            return f"{count / unit:.3g}{suffix}"
    return f"{count:.3g}"
