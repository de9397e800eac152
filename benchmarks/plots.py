"""Line charts and scatter plots as SVG: small files that show what changed in them, and no library to install."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from gsseg_core.files.atomic import write_atomically

COLORS = ("#2f6fd0", "#7fb0ec", "#d1495b", "#4a9c5d", "#e09f3e")
INK, FAINT, GRID = "#202226", "#80838a", "#e4e5e8"
WIDTH, HEIGHT, LEFT, TOP, GAP = 250, 150, 44, 48, 52  # of a panel and around it, px

Series = Mapping[str, Sequence[tuple[float, float]]]


@dataclass(frozen=True)
class Axis:
    """What an axis shows, from where to where, and where it has lines."""

    name: str
    low: float
    high: float
    step: float

    @property
    def ticks(self) -> list[float]:
        """Where the lines are."""
        return [self.low + i * self.step for i in range(round((self.high - self.low) / self.step) + 1)]

    def place(self, value: float) -> float:
        """Share of the way from the low end to the high one, cut off at both."""
        return min(max((value - self.low) / (self.high - self.low), 0.0), 1.0)


def draw_panels(
    path: Path, panels: Mapping[str, Series], x: Axis, y: Axis, *, columns: int = 3, lines: bool = True
) -> None:
    """Write panels with the same axes side by side, a legend above them.

    Parameters
    ----------
    path : pathlib.Path
        An .svg file.
    panels : mapping of str to mapping of str to points
        Series by name, by title of the panel. A series has the same colour in all panels.
    x, y : Axis
        Of all panels.
    columns : int
        Panels in a row.
    lines : bool
        Join the points of a series.
    """
    names = list(dict.fromkeys(name for series in panels.values() for name in series))
    colors = dict(zip(names, COLORS, strict=False))
    columns = min(columns, len(panels))
    rows = -(-len(panels) // columns)
    width, height = LEFT + columns * (WIDTH + GAP) - GAP + 12, TOP + rows * (HEIGHT + GAP + 14) + 6
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" viewBox="0 0 {width} {height}" '
        'font-family="sans-serif" font-size="11">',
        f'<rect width="{width}" height="{height}" fill="white"/>',
        *_legend(colors if len(names) > 1 else {}),
    ]
    for i, (title, series) in enumerate(panels.items()):
        left, top = LEFT + i % columns * (WIDTH + GAP), TOP + i // columns * (HEIGHT + GAP + 14)
        parts += [f'<g transform="translate({left} {top})">', *_frame(title, x, y)]
        for name, points in series.items():
            places = [(WIDTH * x.place(a), HEIGHT * (1 - y.place(b))) for a, b in points]
            if lines:
                path_of = " ".join(f"{a:.1f},{b:.1f}" for a, b in places)
                parts.append(f'<polyline points="{path_of}" fill="none" stroke="{colors[name]}" stroke-width="1.8"/>')
            parts += [f'<circle cx="{a:.1f}" cy="{b:.1f}" r="2.4" fill="{colors[name]}"/>' for a, b in places]
        parts.append("</g>")
    with write_atomically(path) as temporary:
        temporary.write_text("\n".join([*parts, "</svg>", ""]), encoding="utf-8")


def _legend(colors: Mapping[str, str]) -> list[str]:
    parts, left = [], float(LEFT)
    for name, color in colors.items():
        parts.append(f'<rect x="{left:.0f}" y="10" width="18" height="4" fill="{color}"/>')
        parts.append(f'<text x="{left + 24:.0f}" y="16" fill="{INK}">{escape(name)}</text>')
        left += 46 + 6.2 * len(name)
    return parts


def _frame(title: str, x: Axis, y: Axis) -> list[str]:
    parts = [f'<text x="0" y="-8" fill="{INK}" font-weight="bold">{escape(title)}</text>']
    for value in y.ticks:
        place = HEIGHT * (1 - y.place(value))
        parts.append(f'<line x1="0" x2="{WIDTH}" y1="{place:.1f}" y2="{place:.1f}" stroke="{GRID}"/>')
        parts.append(f'<text x="-6" y="{place + 4:.1f}" fill="{FAINT}" text-anchor="end">{value:g}</text>')
    for value in x.ticks:
        place = WIDTH * x.place(value)
        parts.append(f'<line x1="{place:.1f}" x2="{place:.1f}" y1="0" y2="{HEIGHT}" stroke="{GRID}"/>')
        parts.append(f'<text x="{place:.1f}" y="{HEIGHT + 14}" fill="{FAINT}" text-anchor="middle">{value:g}</text>')
    middle = f'<text x="{WIDTH / 2:.0f}" y="{HEIGHT + 30}" fill="{INK}" text-anchor="middle">{escape(x.name)}</text>'
    beside = (
        f'<text transform="translate(-32 {HEIGHT / 2:.0f}) rotate(-90)" fill="{INK}" text-anchor="middle">'
        f"{escape(y.name)}</text>"
    )
    return [*parts, middle, beside]
