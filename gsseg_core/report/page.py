"""`report.html`: what a run found, in one file that needs nothing else, for people.

The page fetches nothing: its Content-Security-Policy forbids that, and lets only the one script run whose hash it
names, so that a name with markup in it could not do harm even if it were not escaped.
"""

from __future__ import annotations

import base64
import functools
import hashlib
import os
from collections.abc import Callable, Mapping
from importlib.resources import files
from typing import TYPE_CHECKING

from gsseg_core.files.atomic import write_atomically
from gsseg_core.report import sections
from gsseg_core.report.findings import warnings_of
from gsseg_core.report.sections import PageInputs
from gsseg_core.several_at_once import several_at_once
from gsseg_core.text import clipped, counted, percent, printable

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup

# Sections that are made beside each other, before the others, which choose views by what these have rendered.
FIRST = ("preview", "views-shown")
SECTIONS: Mapping[str, tuple[str, Callable[[PageInputs], sections.Content | None]]] = {
    "preview": ("In 3D", sections.preview),
    "views-shown": ("Masks beside predictions", sections.views_shown),
    "classes": ("Classes", sections.classes),
    "confusion": ("Confusion between classes", sections.confusion),
    "reliability": ("Views by reliability", sections.reliability),
    "confidence": ("Confidence", sections.confidence),
    "time": ("Time", lambda run: run.report),
    "settings": ("Settings and versions", lambda run: run.report),
}
"""Sections of the page by anchor: title, and what is handed to the macro of that name; None leaves the section out."""
TEMPLATE = "page.html.j2"
_BEGIN, _END = "\u2068", "\u2069"  # of a name in a sentence; a name itself holds neither, once it is printable


def write_report_page(path: str | os.PathLike[str], run: PageInputs) -> None:
    """Write the page, atomically (`WriteError`); its links to PLYs are relative to it."""
    page = report_page(run)
    with write_atomically(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def report_page(run: PageInputs) -> str:
    """Put the page together, as HTML."""
    report, labelled = run.report, run.segmentation.labels >= 0
    made = _contents(run)
    style, script = (files("gsseg_core.report").joinpath(f"page.{kind}").read_text("utf-8") for kind in ("css", "js"))
    policy = (
        f"default-src 'none'; img-src data:; style-src {_hash(style)}; script-src {_hash(script)}; "
        "base-uri 'none'; form-action 'none'"
    )
    return (
        environment()
        .get_template(TEMPLATE)
        .render(
            report={"run": None, **report},
            name=os.path.basename(report["scene"]["path"]),
            confidence=float(run.segmentation.confidence[labelled].mean()) if labelled.any() else None,
            warnings=[_isolated(one) for one in warnings_of(report, run.ious, _in_sentence)],
            sections=[(anchor, title, made[anchor]) for anchor, (title, _) in SECTIONS.items() if anchor in made],
            policy=policy,
            style=style,
            script=script,
        )
    )


def _contents(run: PageInputs) -> dict[str, sections.Content]:
    """Make the contents of the sections that there are, by anchor."""
    at_once = several_at_once(lambda anchor: SECTIONS[anchor][1](run), FIRST)
    made = dict(zip(FIRST, at_once, strict=True))
    # Of these, what takes time works on several views at once itself.
    made |= {anchor: make(run) for anchor, (_, make) in SECTIONS.items() if anchor not in FIRST}
    return {anchor: content for anchor, content in made.items() if content is not None}


@functools.cache  # Compiling the templates takes longer than filling them in.
def environment() -> Environment:
    """Make what fills the templates in: every value is made printable and escaped, and none may be missing."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    made = Environment(
        loader=PackageLoader("gsseg_core.report", ""),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=lambda value: value if hasattr(value, "__html__") else printable(str(value)),
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    made.filters.update(counted=counted, percent=percent, thousands="{:,}".format)
    made.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "allow_nan": False}
    return made


def load_templates() -> None:
    """Compile the templates now, so that who writes a page later does not wait for that."""
    for name in (TEMPLATE, "sections.html.j2", "charts.html.j2"):  # each imports the next
        environment().get_template(name)


def _in_sentence(name: str) -> str:
    return f"{_BEGIN}{clipped(name)}{_END}"


def _isolated(sentence: str) -> Markup:
    """HTML of a sentence, in which names that are read from the right leave what is around them in order."""
    from markupsafe import Markup, escape

    return escape(sentence).replace(_BEGIN, Markup("<bdi>")).replace(_END, Markup("</bdi>"))


def _hash(content: str) -> str:
    return "'sha256-" + base64.b64encode(hashlib.sha256(content.encode()).digest()).decode() + "'"
