"""Plain-text tables for the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from gsseg_core.printable import clipped

LEAST = 3
"""Views that are named as those that agree least with the others."""


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Lay out rows in columns: the first flush left, the others flush right; long cells are shortened."""
    lines = [[clipped(cell, 60) for cell in row] for row in (header, *rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(header))]
    lines.insert(1, ["-" * width for width in widths])
    return "\n".join(
        "  ".join(
            cell.ljust(width) if i == 0 else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        )
        for line in lines
    )


def counted(count: int, thing: str, things: str = "") -> str:
    """Write how many there are of something, such as "1 view" or "1,200 views"."""
    return f"{count:,} {thing if count == 1 else things or thing + 's'}"


def seconds_table(seconds: Mapping[str, float]) -> str:
    """Seconds per stage, and their sum."""
    rows = [[name, f"{value:.2f}"] for name, value in seconds.items()]
    return table(["stage", "seconds"], [*rows, ["total", f"{sum(seconds.values()):.2f}"]])


def segment_summary(report: Mapping[str, Any], out: str) -> str:
    """Write what `gsseg segment` prints: classes, counts, seconds, and where the files are."""
    classes = [
        [f"{entry['id']} {entry['name']}", f"{entry['gaussians']:,}", percent(entry["mean_confidence"])]
        for entry in report["classes"]
        if entry["gaussians"]
    ]
    views, gaussians = report["views"], report["gaussians"]
    rejected = ", ".join(f"{count} {why}" for why, count in views["rejected"].items())
    checked = [view for view in views.get("reliability", []) if view["reliability"] is not None]
    worst = ", ".join(f"{clipped(view['name'])} ({percent(view['reliability'])})" for view in checked[:LEAST])
    return "\n\n".join(
        [
            table(["class", "Gaussians", "confidence"], classes),
            f"{counted(views['used'], 'view')} used"
            + (f", rejected: {rejected}" if rejected else "")
            + (f"\nmasks that agree least with the other views: {worst}" if worst else "")
            + "\n"
            f"{counted(report['scene']['gaussians'], 'Gaussian')}: {gaussians['labelled']:,} labelled "
            f"({gaussians['from_neighbours']:,} of them by their neighbours), {gaussians['removed']:,} removed by the "
            f"filter, {gaussians['unobserved']:,} unobserved",
            seconds_table(report["seconds"]),
            f"Objects: {out}/classes\nPictures: {out}/pictures\n"
            f"Labels: {out}/segmentation.npz\nReport: {out}/report.html, to look at; {out}/report.json",
        ]
    )


def evaluation_summary(scores: Mapping[str, Any]) -> str:
    """Write what `gsseg eval` prints: scores per class and their means, in percent."""
    names = ("iou", "accuracy", "boundary_iou")
    rows = [
        [f"{entry['id']} {entry['name']}", *(percent(entry[name]) for name in names)] for entry in scores["classes"]
    ]
    mean = ["mean", *(percent(scores[f"mean_{name}"]) for name in names)]
    return table(["class", "IoU", "accuracy", "boundary IoU"], [*rows, mean]) + f"\n{counted(scores['views'], 'view')}"


def percent(value: float | None) -> str:
    """Write a ratio in percent, a dash where it is undefined."""
    return "-" if value is None else f"{100 * value:.1f} %"
