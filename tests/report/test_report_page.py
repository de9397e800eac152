"""The report page: what it tells, markup that holds whatever the names are, and nothing from elsewhere."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from report_cases import NASTY, Outline, run_with_nasty_names, segmented
from small_scenes import balls_on_a_table

from gsseg_core.csr_rows import CSRRows
from gsseg_core.errors import WriteError
from gsseg_core.report.findings import MaskChecks
from gsseg_core.report.page import environment, report_page, write_report_page
from gsseg_core.report.pictures import ViewImages
from gsseg_core.report.sections import PageInputs, confusion, preview
from gsseg_core.segmentation import REMOVED, Segmentation
from gsseg_core.text import printable

SCENE, TRUTH = balls_on_a_table()


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run_with_nasty_names(tmp_path_factory.mktemp("report"))


@pytest.fixture(scope="module")
def text(out: Path) -> str:
    return (out / "report.html").read_text("utf-8")


@pytest.fixture(scope="module")
def outline(text: str) -> Outline:
    return Outline(text)


def test_every_element_is_closed_and_every_picture_and_chart_is_described(outline: Outline) -> None:
    assert [tag for tag, _ in outline.elements[:2]] == ["html", "head"]
    ids = [attributes["id"] for _, attributes in outline.elements if "id" in attributes]
    assert len(ids) == len(set(ids)) >= 10
    assert all("alt" in attributes for attributes in outline.tagged("img"))
    charts_drawn = [attributes for attributes in outline.tagged("svg") if attributes.get("aria-hidden") != "true"]
    assert charts_drawn and all(attributes["aria-label"] for attributes in charts_drawn)
    links = {attributes["href"] for attributes in outline.tagged("a") if attributes["href"].startswith("#")}
    assert links == {f"#{section['id']}" for section in outline.tagged("section")}


def test_names_that_are_read_from_the_right_leave_warnings_in_order(out: Path) -> None:
    report, (result, _) = json.loads((out / "report.json").read_text()), segmented()
    name = "\u05db\u05d9\u05e1\u05d0 \u2069</bdi>"
    report["views"]["reliability"][0] |= {"name": name, "reliability": 0.1}
    report["views"]["renamed"] = [{"name": name, "others_say": "cup"}]
    page = report_page(PageInputs(report, SCENE, result, MaskChecks([], {}, False), ViewImages(SCENE)))
    shown = "\u05db\u05d9\u05e1\u05d0 \\u2069&lt;/bdi&gt;"
    assert f"of its pixels: <bdi>{shown}</bdi>. Wrong ids" in page
    assert f"and no mask shows both: <bdi>{shown} (cup)</bdi>. Did" in page


def test_page_asks_for_nothing_from_elsewhere_and_may_not(outline: Outline, out: Path, text: str) -> None:
    for _, attributes in outline.elements:
        for name in ("src", "href", "action", "srcset", "poster"):
            address = attributes.get(name, "data:")
            if not address.startswith(("data:", "#")):
                assert name == "href" and (out / address).is_file(), address
    assert "url(" not in text and "@import" not in text
    policy = next(a["content"] for a in outline.tagged("meta") if a.get("http-equiv") == "Content-Security-Policy")
    assert "default-src 'none'" in policy and "unsafe" not in policy and "http" not in policy


def test_policy_lets_only_the_one_script_and_style_sheet_of_the_page_work(text: str, outline: Outline) -> None:
    policy = next(a["content"] for a in outline.tagged("meta") if a.get("http-equiv") == "Content-Security-Policy")
    for tag in ("script", "style"):
        (body,) = re.findall(rf"<{tag}>(.*?)</{tag}>", text, re.DOTALL)
        digest = base64.b64encode(hashlib.sha256(body.encode()).digest()).decode()
        assert f"{tag}-src 'sha256-{digest}';" in policy
    assert not any(name.startswith("on") or name == "style" for _, a in outline.elements for name in a)


def test_markup_in_names_is_text(outline: Outline) -> None:
    assert len(outline.tagged("script")) == 3
    assert not any("onerror" in attributes for _, attributes in outline.elements)
    said = "".join(outline.said)
    assert NASTY[1] in said and NASTY[2] in said
    assert "</script></td>&amp; \\u202e\u05d1" in said


def test_page_is_small_and_tells_what_report_json_tells(out: Path, outline: Outline) -> None:
    assert (out / "report.html").stat().st_size < 1_000_000
    report = json.loads((out / "report.json").read_text())
    assert report["page"] == "report.html" and 0 < report["seconds"]["report page"] < 60
    said = " ".join(outline.said)
    for entry in report["classes"]:
        assert f"{entry['gaussians']:,}" in said and f"{100 * entry['mean_confidence']:.1f} %" in said
    for view in report["views"]["reliability"]:
        assert view["name"] in said and f"{100 * view['reliability']:.1f} %" in said
    known = [view["reliability"] for view in report["views"]["reliability"] if view["reliability"] is not None]
    assert f"{100 * sum(known) / len(known):.1f} %" in said
    for name, value in [*report["versions"].items(), ("refine.beta", 0.65), ("learner", "em")]:
        assert name in said and str(value) in said
    for stage in ("load", "observe", "learn", "check views", "refine", "export", "pictures"):
        assert stage in said


def test_a_learner_without_error_models_gets_a_page_too(tmp_path: Path) -> None:
    text = (run_with_nasty_names(tmp_path, learner="votes") / "report.html").read_text("utf-8")
    page = Outline(text)
    sections = {section["id"] for section in page.tagged("section")}
    assert "reliability" not in sections and {"preview", "views-shown", "classes", "confusion"} <= sections
    assert "what was learnt, from this view too" in "".join(page.said)


def test_a_run_of_which_no_mask_can_be_shown_gets_a_page_too(out: Path) -> None:
    report = json.loads((out / "report.json").read_text())
    del report["views"]["reliability"]
    result, _ = segmented()
    page = Outline(report_page(PageInputs(report, SCENE, result, MaskChecks([], {}, False), ViewImages(SCENE))))
    sections = {section["id"] for section in page.tagged("section")}
    assert sections == {"preview", "classes", "confidence", "time", "settings"}
    assert not page.tagged("img")


def test_where_no_other_view_predicts_anything_the_page_tells_of_no_comparison(out: Path) -> None:
    report, (result, checked) = json.loads((out / "report.json").read_text()), segmented()
    alone = replace(checked.checks[0], counts=CSRRows.empty(result.num_classes))
    run = PageInputs(report, SCENE, result, MaskChecks([alone], checked.views, True), ViewImages(SCENE))
    page = Outline(report_page(run))
    assert "confusion" not in {section["id"] for section in page.tagged("section")}
    assert "IoU: between" not in (said := "".join(page.said)) and "of 1" not in said


def test_masks_that_are_as_predicted_leave_no_table_without_a_row() -> None:
    sections = environment().get_template("sections.html.j2").module
    told = {"names": ["a"], "shares": [[1.0]], "most": None, "pairs": []}
    assert "they are the same" in (made := str(sections.confusion(told))) and "<table" not in made  # type: ignore[attr-defined]


def test_the_parts_of_a_page_of_a_vocabulary_are_made_in_its_length_not_its_square(
    out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    result, checked = segmented()
    count, asked = 65_535, []
    names = {**result.class_names, **{k: f"class {k}" for k in range(4, count)}}
    monkeypatch.setattr(Segmentation, "num_classes", property(lambda self: asked.append(1) or len(self.class_names)))
    report = json.loads((out / "report.json").read_text())
    run = PageInputs(report, SCENE, replace(result, class_names=names), checked, ViewImages(SCENE))
    few = PageInputs(report, SCENE, result, checked, ViewImages(SCENE))
    assert confusion(run) == confusion(few)
    assert run.ious is not None and few.ious is not None
    np.testing.assert_array_equal(run.ious[:4], few.ious)
    assert np.isnan(run.ious[4:]).all() and len(run.ious) == count
    assert preview(run)["legend"] == preview(few)["legend"]
    assert len(asked) < 100, "to count the names takes as long as to list them"


def test_a_page_that_cannot_be_written_leaves_the_earlier_one(
    out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    report = json.loads((out / "report.json").read_text())
    result, checked = segmented()
    path, inputs = tmp_path / "report.html", PageInputs(report, SCENE, result, checked, ViewImages(SCENE))
    write_report_page(path, inputs)
    before = path.read_bytes()

    def full(*_: object) -> None:
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(WriteError, match=r"report\.html: cannot be written \(No space left"):
        write_report_page(path, inputs)
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


def test_packages_carry_the_files_that_are_no_modules() -> None:
    root = Path(__file__).parents[2]
    declared = re.search(r"package_data=\{(.*?)\}", (root / "setup.py").read_text(), re.DOTALL)
    assert declared is not None
    names = {name for name in re.findall(r'"(.*?)"', declared[1]) if not name.startswith("gsseg_")}
    files = (path for package in ("gsseg_core", "gsseg_ros") for path in (root / package).rglob("*.*"))
    others = {path.name for path in files if path.suffix not in (".py", ".pyc", ".nbi", ".nbc")}
    assert {"page.css", "page.html.j2", "page.js"} <= others == names


@given(st.text() | st.text(alphabet="<>&\"'/!-\x00\x7f\ud800"))
def test_any_name_stays_text_in_elements_in_attributes_and_in_json(name: str) -> None:
    template = '<p title="{{ name }}">{{ name }}</p><script>{{ {"name": name} | tojson }}</script>'
    text = environment().from_string(template).render(name=name)
    page = Outline(text)
    assert [tag for tag, _ in page.elements] == ["p", "script"]
    assert "".join(page.said) == page.elements[0][1]["title"]
    assert "".join(page.said) == printable(name)
    embedded = text.partition("<script>")[2].removesuffix("</script>")
    assert "<" not in embedded and json.loads(embedded) == {"name": name}


def test_what_is_said_to_be_taken_out_is_said_of_what_and_how_it_is_drawn(out: Path) -> None:
    report, (result, checked) = json.loads((out / "report.json").read_text()), segmented()
    for labels in (np.maximum(result.labels, 0), np.where(result.labels == 1, np.int32(REMOVED), result.labels)):
        run = PageInputs(report, SCENE, replace(result, labels=labels), checked, ViewImages(SCENE))
        page = report_page(run)
        assert (">taken out</bdi>" in page) == ("What refinement took out of its object" in page) == (labels < 0).any()


def test_one_class_is_not_called_classes_and_thousands_are_told_apart(out: Path) -> None:
    report = json.loads((out / "report.json").read_text())
    others = {"name": "", "confidence": None, "warnings": [], "sections": [], "policy": "", "style": "", "script": ""}
    for classes, told in ((report["classes"][:2], "of 1 class"), (report["classes"][1:2] * 1200, "of 1,200 classes")):
        page = environment().get_template("page.html.j2").render(report={**report, "classes": classes}, **others)
        assert f"<small>{told}</small>" in page


def test_one_view_is_not_called_views() -> None:
    sections = environment().get_template("sections.html.j2").module
    view = {"name": "a", "reliability": 1.0, "rejected_share": None, "confusions": []}
    for others, told in (([view], "The other 1 view<"), ([view] * 2, "The other 2 views<")):
        assert told in str(sections.reliability({"worst": [view], "others": others, "trusted": 0.7}))  # type: ignore[attr-defined]
        assert f"over {told[10:-1]}." in str(
            sections.classes({"classes": [], "many": 1, "num_views": len(others), "held_out": True})  # type: ignore[attr-defined]
        )
