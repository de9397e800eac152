"""Text shown to people: foreign names and messages made harmless to print, and tables for the terminal."""

from __future__ import annotations

import unicodedata
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

_WORST = 3  # views that `segment` names as those that agree least with the others
_JOINERS = "\u200c\u200d"  # change how their neighbours are written, as in Persian and in emoji, and nothing else
_LONGEST = 1000  # characters of a message, at most


def printable(text: str) -> str:
    r"""Return a text on one line, in which every character that steers or hides is seen as its escape.

    What a terminal obeys (ANSI sequences, backspaces, line ends), what turns the reading direction around, what is
    invisible, and halves of surrogate pairs, as in file names that are no UTF-8, become what Python writes for them:
    `\x1b`, `\u202e`, `\udcff`. The result can be encoded. Letters, marks, emoji and spaces of all languages stay.
    """
    if text.isprintable():
        return text
    return "".join(c if _stays(c) else c.encode("unicode_escape").decode("ascii") for c in text)


def one_line(text: str) -> str:
    """Give a message that holds foreign text as one `printable` line; of a very long one, its beginning and its end."""
    line = printable(text)
    return line if len(line) <= _LONGEST else f"{line[: _LONGEST // 2]} ... {line[-_LONGEST // 3 :]}"


def composed(name: str) -> str:
    """Write accented letters as one character, not as two as macOS does: names that look alike are alike."""
    return unicodedata.normalize("NFC", name)


def searched(text: str) -> str:
    """Write a name, or what is searched for in names, in large letters: ß is SS then, and any i of Turkish an I."""
    return composed(text.upper()).replace("\u0130", "I")


def clipped(value: object, most: int = 80) -> str:
    """Give a foreign name or value as it goes into a message or a table: printable, and not long."""
    text = str(value)
    return printable(text if len(text) <= most else text[: most - 3] + "...")


def quoted(value: object) -> str:
    """Give a foreign value as Python writes it, in quotes if it is text, as it goes into a message."""
    return clipped(repr(value))


def html_text(value: object) -> str:
    """Make anything harmless between tags and in quoted attributes: `printable`, without markup."""
    return escape(printable(str(value)))


def _stays(character: str) -> bool:
    return character.isprintable() or character in _JOINERS or unicodedata.category(character) == "Zs"


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Lay out rows in columns: the first flush left, the others flush right; long cells are shortened."""
    lines = [[clipped(cell, 60) for cell in row] for row in (header, *rows)]
    widths = [max(_width(line[i]) for line in lines) for i in range(len(header))]
    lines.insert(1, ["-" * width for width in widths])
    laid_out = []
    for line in lines:
        gaps = [" " * (width - _width(cell)) for cell, width in zip(line, widths, strict=True)]
        flush_right = [gap + cell for gap, cell in zip(gaps, line, strict=True)]
        laid_out.append("  ".join([line[0] + gaps[0], *flush_right[1:]]))
    return "\n".join(laid_out)


def _width(text: str) -> int:
    """Columns of a terminal that a text takes: a letter of East Asia or an emoji two, what joins its neighbour none."""
    return sum(
        0 if unicodedata.category(c) in ("Mn", "Me", "Cf") else 2 if unicodedata.east_asian_width(c) in "WF" else 1
        for c in text
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
    used = f"{counted(views['used'], 'view')} used" + (f", rejected: {rejected}" if rejected else "")
    checked = [view for view in views.get("reliability", []) if view["reliability"] is not None]
    worst = ", ".join(f"{clipped(view['name'])} ({percent(view['reliability'])})" for view in checked[:_WORST])
    if worst and views["used"] > 1:
        used += f"\nmasks that agree least with the other views: {worst}"
    if masks := report.get("masks"):
        used = f"masks: {masks_line(masks)}\n{used}"
    return f"""{table(["class", "Gaussians", "confidence"], classes)}

{used}
{counted(report["scene"]["gaussians"], "Gaussian")}: {gaussians["labelled"]:,} labelled \
({gaussians["from_neighbours"]:,} of them by their neighbours), {gaussians["removed"]:,} taken out of their object, \
{gaussians["unobserved"]:,} unobserved

{seconds_table(report["seconds"])}
{_memory_line(report["prepared_views"])}

Objects: {out}/classes
Pictures: {out}/pictures
Labels: {out}/segmentation.npz
Report: {out}/report.html, to look at; {out}/report.json"""


def _memory_line(prepared: Mapping[str, int]) -> str:
    in_memory, budget, in_file = (f"{prepared[part] / 2**20:,.0f} MiB" for part in ("in_memory", "budget", "in_file"))
    return f"prepared views: {in_memory} in memory (at most {budget}), {in_file} in a temporary file"


def masks_line(masks: Mapping[str, Any]) -> str:
    """Write what a report says of masks that another program wrote, or that were scaled."""
    scaled = f"; scaled by nearest pixel, {masks['scaled']}" if "scaled" in masks else ""
    return f"{masks['format']}, ids {masks['ids']}, {counted(masks['views'], 'view')}{scaled}"


def evaluation_summary(scores: Mapping[str, Any]) -> str:
    """Write what `gsseg eval` prints: scores per class and their means, in percent."""
    names = ("iou", "accuracy", "boundary_iou")
    rows = [
        [f"{entry['id']} {entry['name']}", *(percent(entry[name]) for name in names)] for entry in scores["classes"]
    ]
    mean = ["mean", *(percent(scores[f"mean_{name}"]) for name in names)]
    return table(["class", "IoU", "accuracy", "boundary IoU"], [*rows, mean]) + f"\n{counted(scores['views'], 'view')}"


def percent(value: float | None) -> str:
    """Write a ratio in percent, a dash where it is undefined; what is little is not nothing."""
    if value is None:
        return "-"
    return "<0.1 %" if 0 < value < 0.0005 else f"{100 * value:.1f} %"
