"""Sections of the report page as HTML. Whatever comes from a file or a user goes through `text`."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any
from urllib.parse import quote

import numpy as np

from gsseg_core.report import charts
from gsseg_core.report.findings import TRUSTED, largest_confusions, most_confused
from gsseg_core.segmentation import Segmentation
from gsseg_core.text import html_text as text
from gsseg_core.text import percent

BINS = 25
MATRIX_CLASSES = 24
"""The matrix shows this many of the classes that are confused most."""
PAIRS = 10
WORST = 8


def embedded_json(value: object) -> str:
    """Write JSON that cannot end the element that it stands in."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def cards(figures: Iterable[tuple[str, str, str]]) -> str:
    """Show the main figures: what, how much, and a remark."""
    return (
        '<dl class="cards">'
        + "".join(
            f"<div><dt>{text(what)}</dt><dd><strong>{text(value)}</strong><small>{text(more)}</small></dd></div>"
            for what, value, more in figures
        )
        + "</dl>"
    )


def notices(warnings: Sequence[str]) -> str:
    """List what the user should look at."""
    if not warnings:
        return '<p class="notice good">Nothing in this run asks for a second look.</p>'
    items = "".join(f"<li>{text(warning)}</li>" for warning in warnings)
    return f'<div class="notice"><strong>Look at this</strong><ul>{items}</ul></div>'


def legend(
    names: Mapping[int, str],
    colors: np.ndarray,  # (K, 3)
    counts: np.ndarray,  # (K,)
    others: Sequence[tuple[int, str, tuple[int, int, int], int]],
) -> str:
    """List the classes with their colours; switches for the preview beside them.

    Parameters
    ----------
    names : mapping from id to name
        Of the classes.
    colors, counts : (K, 3) uint8, (K,) int
        Of the classes.
    others : sequence of (label in the preview, name, colour, count)
        Gaussians that belong to no class.
    """
    entries = [(k, name, tuple(colors[k].tolist()), int(counts[k])) for k, name in names.items() if counts[k]]
    rows = [
        f'<li><label><input type="checkbox" class="js-only" data-label="{label}" checked>{swatch(color)}'
        f'<bdi>{text(name)}</bdi></label><span class="count">{count:,}</span>'
        f'<button type="button" class="only js-only" data-label="{label}" aria-label="only {text(name)}">only</button>'
        "</li>"
        for label, name, color, count in [*entries, *others]
    ]
    return f'<ul class="legend">{"".join(rows)}</ul>'


def swatch(color: Sequence[int]) -> str:
    """Draw a patch of a colour."""
    red, green, blue = color
    return (
        '<svg class="swatch" viewBox="0 0 14 14" aria-hidden="true">'
        f'<rect width="14" height="14" rx="4" fill="rgb({red},{green},{blue})"/></svg>'
    )


def triple(name: str, remark: str, confusions: str, pictures: Sequence[tuple[str, str]]) -> str:
    """Show a view three times; `pictures` are (caption, data URI)."""
    shown = "".join(
        f'<figure><img src="{uri}" alt="view {text(name)}: {text(caption)}">'
        f"<figcaption>{text(caption)}</figcaption></figure>"
        for caption, uri in pictures
    )
    return (
        f'<article class="triple"><h3><bdi>{text(name)}</bdi> <small>{text(remark)}</small></h3>'
        f'<div class="pictures">{shown}</div><p class="faint">{text(confusions)}</p></article>'
    )


def class_table(
    classes: Sequence[Mapping[str, Any]],
    colors: np.ndarray,  # (K, 3)
    thumbnails: Mapping[int, tuple[str, str]],
    views: np.ndarray | None,  # (K,)
    num_views: int,
    ious: np.ndarray | None,  # (K,)
) -> str:
    """Make one row a class, in the order of the arrays; `thumbnails` are (view, data URI) by place in it."""
    header = ["", "class", "Gaussians", "mean confidence", "views that show it", "IoU with the masks", "file"]
    head = "".join(f'<th scope="col">{name}</th>' for name in header)
    rows = []
    for k, entry in enumerate(classes):
        confidence = entry["mean_confidence"]
        if k == 0 and not entry["gaussians"]:
            continue  # Masks need not show any background.
        iou = None if ious is None or np.isnan(ious[k]) else float(ious[k])
        view, uri = thumbnails.get(k, ("", ""))
        picture = f'<img class="thumb" src="{uri}" alt="" title="in view {text(view)}">' if uri else ""
        link = f'<a href="{quote(entry["ply"])}">PLY</a>' if entry["ply"] else "-"
        cells = [
            ("thumbnail", "", picture),
            ("name", "", f"{swatch(colors[k].tolist())}<bdi>{text(entry['name'])}</bdi> <small>{entry['id']}</small>"),
            ("number", header[2], f"{entry['gaussians']:,}"),
            ("share", header[3], _share(confidence)),
            ("number", header[4], "-" if views is None else f"{int(views[k])} <small>of {num_views}</small>"),
            ("share", header[5], _share(iou)),
            ("link", header[6], link),
        ]
        row = "".join(f'<td class="{kind}" data-name="{what}">{cell}</td>' for kind, what, cell in cells)
        rows.append(f"<tr>{row}</tr>")
    return f'<table class="classes"><thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table>'


def confidence_chart(segmentation: Segmentation) -> str:
    """Draw how sure the labelled Gaussians are, apart by where their label comes from."""
    labelled = segmentation.labels >= 0
    confidence, clustered = segmentation.confidence[labelled], segmentation.clustered[labelled]
    series = [
        (name, np.histogram(confidence[part], BINS, (0, 1))[0])
        for name, part in (("learnt", ~clustered), ("from their neighbours", clustered))
    ]
    keys = "".join(f'<span class="key"><i class="s{i}"></i>{name}</span>' for i, (name, _) in enumerate(series))
    return charts.histogram(series, 0.0, 1.0) + f'<p class="keys">{keys}</p>'


def confusion_section(
    confusion: np.ndarray,  # (K, K)
    names: Mapping[int, str],
) -> str:
    """Draw the matrix of the classes that are confused most, and name the largest confusions."""
    shown = most_confused(confusion, MATRIX_CLASSES)
    total = np.maximum(confusion.sum(axis=1, keepdims=True), 1)
    shares = (confusion / total)[np.ix_(shown, shown)]
    shares[shares < 0.002] = 0
    titles = [
        [f"{names[k]} called {names[y]}: {percent(float(shares[i, j]))} of its pixels" for j, y in enumerate(shown)]
        for i, k in enumerate(shown)
    ]
    everything = max(int(confusion.sum()), 1)
    rows = [
        [_bdi(names[k]), _bdi(names[y]), f"{pixels:,}", percent(pixels / everything)]
        for k, y, pixels in largest_confusions(confusion, PAIRS)
    ]
    matrix = charts.heatmap(shares, [names[k] for k in shown], titles)
    less = "" if len(shown) >= (confusion.sum(axis=1) > 0).sum() else f" The {len(shown)} classes confused most."
    return (
        '<p class="faint">Rows: what is predicted. Columns: what the masks say. Stronger is a larger share of the '
        f"row's pixels; off the diagonal the two differ.{less}</p>"
        f'<div class="beside"><div class="scroll" tabindex="0">{matrix}</div>'
        + plain_table(["predicted", "in the mask", "pixels", "of all"], rows, "pairs")
        + "</div>"
    )


def views_section(reliability: Sequence[Mapping[str, Any]]) -> str:
    """Draw the views by reliability, and list them, the worst first."""
    titles = [f"{view['name']}: {percent(view['reliability'])}" for view in reliability]
    drawn = charts.columns([view["reliability"] for view in reliability], titles, TRUSTED)
    header = ["view", "reliability", "not learnt from", "most often taken for something else"]
    rows = [
        [
            _bdi(view["name"]),
            _share(view["reliability"], "fill" if (view["reliability"] or 0) >= TRUSTED else "bad"),
            percent(view["unheard"]) if view["unheard"] else "-",
            "; ".join(map(_taken, view["confusions"])) or "-",
        ]
        for view in reliability
    ]
    worst = plain_table(header, rows[:WORST], "views")
    rest = plain_table(header, rows[WORST:], "views") if rows[WORST:] else ""
    more = f"<details><summary>The other {len(rows) - WORST} views</summary>{rest}</details>" if rest else ""
    return (
        f'{drawn}<p class="faint axis-note">the worst on the left; the line is at {percent(TRUSTED)}</p>{worst}{more}'
    )


def confusions_of(confusions: Sequence[Mapping[str, Any]]) -> str:
    """Say in words what was taken for what in a view; not yet escaped."""
    said = [f"{percent(c['share'])} of the pixels are {c['true']}, called {c['seen']}" for c in confusions]
    return "; ".join(said)


def timings(seconds: Mapping[str, float]) -> str:
    """Draw seconds per stage, and list them."""
    total = sum(seconds.values()) or 1.0
    rows = [
        [f'<i class="s{i % 8}"></i>{text(name)}', f"{value:.2f} s", percent(value / total)]
        for i, (name, value) in enumerate(seconds.items())
    ]
    rows.append(["total", f"{sum(seconds.values()):.2f} s", ""])
    return charts.stacked_bar(list(seconds.items())) + plain_table(["stage", "seconds", "share"], rows, "timings")


def settings_list(settings: Mapping[str, Any]) -> str:
    """List settings, or anything else by name, nested ones as `outer.inner`."""
    pairs = (f"<div><dt>{text(name)}</dt><dd>{text(value)}</dd></div>" for name, value in _flat(settings))
    return f'<dl class="settings">{"".join(pairs)}</dl>'


def plain_table(header: Sequence[str], rows: Iterable[Sequence[str]], css_class: str) -> str:
    """Make a table of cells that are HTML already."""
    head = "".join(f'<th scope="col">{name}</th>' for name in header)
    body = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
    return (
        f'<div class="scroll"><table class="{css_class}"><thead><tr>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )


def _share(value: float | None, css_class: str = "fill") -> str:
    if value is None:
        return "-"
    return f"<span>{percent(value)}</span>{charts.bar(value, percent(value), css_class)}"


def _taken(confusion: Mapping[str, Any]) -> str:
    return f"{_bdi(confusion['true'])} called {_bdi(confusion['seen'])} ({percent(confusion['share'])})"


def _bdi(name: object) -> str:
    return f"<bdi>{text(name)}</bdi>"


def _flat(settings: Mapping[str, Any], outer: str = "") -> Iterable[tuple[str, Any]]:
    for name, value in settings.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{outer}{name}.")
        else:
            yield f"{outer}{name}", value
