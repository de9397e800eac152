"""A small run whose report is looked at by several test files, its class names as nasty as they come."""

from __future__ import annotations

from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
from small_scenes import NUM_CLASSES, balls_on_a_table, clean_views, ring, taught, write_dataset

from gsseg_core import pipeline
from gsseg_core.learn.em.em_learner import EMLearner
from gsseg_core.learn.mask_reliability import MaskChecker
from gsseg_core.report.findings import MaskChecks
from gsseg_core.segmentation import Segmentation

NASTY = {
    0: "background",
    1: "<script>document.title='pwned'</script>",
    2: "\"'><img src=https://example.org/x onerror=\"document.title='pwned'\">",
    3: "</script></td>&amp; \u202e\u05d1",
}


_VOID = {"meta", "link", "img", "input", "br", "hr"}


def run_with_nasty_names(folder: Path, **options: Any) -> Path:
    """Segment the balls; returns the folder of results."""
    scene, truth = balls_on_a_table()
    data = write_dataset(folder / "data", scene, truth, ring(9), NASTY)
    pipeline.segment(data / "scene.ply", data, folder / "out", **options)
    return folder / "out"


@cache
def segmented() -> tuple[Segmentation, MaskChecks]:
    """What clean views of the balls give."""
    scene, _ = balls_on_a_table()
    views = clean_views(6)
    learner = EMLearner(scene, NUM_CLASSES)
    taught(learner, views).fit()
    result = Segmentation.from_codes(scene, learner.codes_, {k: f"class {k}" for k in range(NUM_CLASSES)})
    return result, MaskChecks(MaskChecker(learner).check_all(), {view.name: view for view in views}, held_out=True)


def minimal_report(**changes: Any) -> dict[str, Any]:
    """Give the parts of `report.json` of a run without fault that warnings are made from."""
    report = {
        "scene": {"gaussians": 100},
        "views": {"used": 9, "rejected": {}, "reliability": [{"name": "a", "reliability": 0.99}]},
        "gaussians": {"unobserved": 0},
        "classes": [{"id": 0, "name": "background", "gaussians": 0}, {"id": 1, "name": "cup", "gaussians": 50}],
    }
    return {**report, **changes}


def painted(*rectangles: tuple[int, slice, slice], size: tuple[int, int] = (48, 64)) -> np.ndarray:
    """A label map of zeros with rectangles of labels."""
    labels = np.zeros(size, np.int32)
    for label, rows, columns in rectangles:
        labels[rows, columns] = label
    return labels


class Outline(HTMLParser):
    """Elements of a page, after checking that each one is closed where it should be."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.said: list[str] = []
        self._open: list[str] = []
        self.feed(page)
        self.close()
        assert not self._open, f"never closed: {self._open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {name: value or "" for name, value in attrs}))
        if tag not in _VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {name: value or "" for name, value in attrs}))

    def handle_endtag(self, tag: str) -> None:
        assert self._open and self._open[-1] == tag, f"</{tag}> closes {self._open[-1:]}, line {self.getpos()[0]}"
        self._open.pop()

    def handle_data(self, data: str) -> None:
        if not self._open or self._open[-1] not in ("script", "style"):
            self.said.append(data)

    def tagged(self, tag: str) -> list[dict[str, str]]:
        return [attributes for name, attributes in self.elements if name == tag]
