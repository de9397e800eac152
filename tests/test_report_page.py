"""The report page: figures that are right, markup that holds whatever the names are, and nothing from elsewhere."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from report_cases import NASTY, minimal_report, painted, run_with_nasty_names, segmented
from small_scenes import NUM_CLASSES, balls_on_a_table, look_at

from gsseg_core import report_charts as charts
from gsseg_core import report_html
from gsseg_core.dataset import View
from gsseg_core.errors import WriteError
from gsseg_core.masks import UNKNOWN
from gsseg_core.pictures import palette
from gsseg_core.reliability import ViewCheck, hold_against
from gsseg_core.report_findings import (
    Evidence,
    class_ious,
    largest_confusions,
    mean_reliability,
    most_confused,
    warnings_of,
)
from gsseg_core.report_page import report_page, write_report_page
from gsseg_core.report_pictures import THUMBNAIL_PX, ViewImages, draw_triple, jpeg_uri, thumbnails
from gsseg_core.report_preview import RECORD, look_from, make_preview, up_of
from gsseg_core.scene import GaussianScene
from gsseg_core.segmentation import REMOVED, UNOBSERVED, Segmentation

SCENE, TRUTH = balls_on_a_table()
VOID = {"meta", "link", "img", "input", "br", "hr"}


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
        if tag not in VOID:
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
    assert "</script></td>&amp; \u202e\u05d1\ufffd\ufffd" in said


def test_page_is_small_and_tells_what_report_json_tells(out: Path, outline: Outline) -> None:
    assert (out / "report.html").stat().st_size < 1_000_000
    report = json.loads((out / "report.json").read_text())
    assert report["page"] == "report.html" and 0 < report["seconds"]["report page"] < 60
    said = " ".join(outline.said)
    for entry in report["classes"]:
        assert f"{entry['gaussians']:,}" in said and f"{100 * entry['mean_confidence']:.1f} %" in said
    for view in report["views"]["reliability"]:
        assert view["name"] in said and f"{100 * view['reliability']:.1f} %" in said
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
    page = Outline(report_page(report, SCENE, result, Evidence([], {}, False), ViewImages(SCENE)))
    sections = {section["id"] for section in page.tagged("section")}
    assert sections == {"preview", "classes", "confidence", "time", "settings"}
    assert not page.tagged("img")


def test_a_page_that_cannot_be_written_leaves_the_earlier_one(
    out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    report = json.loads((out / "report.json").read_text())
    result, evidence = segmented()
    path = tmp_path / "report.html"
    write_report_page(path, report, SCENE, result, evidence, ViewImages(SCENE))
    before = path.read_bytes()

    def full(*_: object) -> None:
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(WriteError, match=r"report\.html: cannot be written \(No space left"):
        write_report_page(path, report, SCENE, result, evidence, ViewImages(SCENE))
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


def test_package_carries_the_style_sheet_and_the_script() -> None:
    root = Path(__file__).parents[1]
    declared = re.search(r"package_data=\{\"gsseg_core\": \[(.*?)\]\}", (root / "setup.py").read_text())
    assert declared is not None
    others = {path.name for path in (root / "gsseg_core").iterdir() if path.is_file() and path.suffix != ".py"}
    assert {"report_page.css", "report_page.js"} <= others == set(re.findall(r'"(.*?)"', declared[1]))


@given(st.text() | st.text(alphabet="<>&\"'/!-\x00\x7f\ud800"))
def test_any_name_stays_text_in_elements_in_attributes_and_in_json(name: str) -> None:
    page = Outline(f'<p title="{report_html.text(name)}">{report_html.text(name)}</p>')
    assert [tag for tag, _ in page.elements] == ["p"]
    assert "".join(page.said) == page.elements[0][1]["title"]
    assert len("".join(page.said)) == len(name)
    script = report_html.embedded_json({"name": name})
    assert "<" not in script and json.loads(script) == {"name": name}


# What the figures are.


def check(name: str, classes: list[int], counts: list[list[int]]) -> ViewCheck:
    pixels = np.array(counts, np.int64)
    return ViewCheck(name, int(pixels.sum()), np.array(classes, np.int32), pixels)


def test_confusion_is_the_sum_over_views_and_ignores_what_is_no_class() -> None:
    one = check("one", [0, 2], [[50, 3], [10, 0], [7, 30]])
    other = check("other", [1, UNKNOWN], [[4, 1], [5, 1], [0, 1]])
    confusion = Evidence([one, other], {}, True).confusion(3)
    np.testing.assert_array_equal(confusion, [[50, 4, 3], [10, 5, 0], [7, 0, 30]])
    np.testing.assert_allclose(class_ious(confusion), [50 / 74, 5 / 19, 30 / 40])
    assert largest_confusions(confusion, 3) == [(1, 0, 10), (2, 0, 7), (0, 1, 4)]
    assert most_confused(confusion, 2) == [0, 1]


def test_iou_of_a_class_that_is_nowhere_is_not_a_number() -> None:
    ious = class_ious(np.diag([3, 0, 2]))
    assert ious[0] == ious[2] == 1 and np.isnan(ious[1])
    assert most_confused(np.diag([3, 0, 2]), 5) == [0, 2]


def test_a_view_shows_what_fills_more_than_a_few_of_its_pixels() -> None:
    checks = [check("a", [0], [[9_998], [2], [0]]), check("b", [0], [[9_000], [1_000], [0]])]
    assert Evidence(checks, {}, True).views_showing(3).tolist() == [2, 1, 0]


def test_examples_are_the_worst_the_median_and_the_best_view() -> None:
    checks = [check(f"v{right}", [0, 1], [[right, 100 - right], [0, 0]]) for right in (70, 95, 20, 80, 99)]
    blank = check("blank", [0], [[0], [0]])
    chosen = [(what, entry.name) for what, entry in Evidence([*checks, blank], {}, True).examples()]
    assert chosen == [("worst", "v20"), ("median", "v80"), ("best", "v99")]
    assert len(Evidence(checks[:2], {}, True).examples()) == 2
    assert Evidence([blank], {}, True).examples() == Evidence([], {}, True).examples() == []


def test_a_run_without_fault_gets_no_warning() -> None:
    assert warnings_of(minimal_report(), np.array([np.nan, 0.9])) == []
    assert mean_reliability(minimal_report()) == 0.99


CUP = {"id": 1, "name": "cup", "gaussians": 0}
DOUBTFUL = [{"name": "v7", "reliability": 0.5}, {"name": "v8", "reliability": None}]


@pytest.mark.parametrize(
    ("changes", "iou", "said"),
    [
        ({"views": {"used": 2, "rejected": {}}}, 0.9, "from 2 views only"),
        (
            {"views": {"used": 9, "rejected": {"no mask": 2, "too far": 1}}},
            0.9,
            "3 views could not be used: 2 no mask, 1 too far",
        ),
        (
            {"views": {"used": 9, "rejected": {}, "reliability": DOUBTFUL}},
            0.9,
            "1 of 2 masks disagrees with the other views in more than 30 % of its pixels: v7",
        ),
        ({"classes": [CUP]}, 0.9, "1 class got no Gaussian: cup"),
        ({}, 0.3, "overlap by less than half (IoU below 0.5): cup"),
        ({"gaussians": {"unobserved": 40}}, 0.9, "40 % of the Gaussians were seen by no mask"),
    ],
)
def test_each_fault_gets_its_warning(changes: dict[str, object], iou: float, said: str) -> None:
    (warning,) = warnings_of(minimal_report(**changes), np.array([np.nan, iou]))
    assert said in warning


def test_many_names_are_cut_short() -> None:
    views = [{"name": f"v{i}", "reliability": 0.1} for i in range(9)]
    (warning,) = warnings_of(minimal_report(views={"used": 9, "rejected": {}, "reliability": views}))
    assert "v0, v1, v2, v3, v4 and 4 more" in warning


# What the pictures show.


def view_of(name: str, labels: np.ndarray) -> View:
    return View.from_arrays(look_at(name, np.array([3.0, 0, 3])), labels)


def test_thumbnail_is_cut_from_the_view_that_shows_the_class_whole() -> None:
    cut_off = view_of("cut_off", painted((1, slice(0, 20), slice(0, 30))))
    whole = view_of("whole", painted((1, slice(10, 26), slice(20, 44))))
    tiny = view_of("tiny", painted((1, slice(10, 12), slice(20, 22))))
    views = {view.name: view for view in (cut_off, whole, tiny)}
    evidence = Evidence([hold_against(view, view.read_labels(), 3) for view in views.values()], views, True)
    images = ViewImages(SCENE)
    for view in views.values():
        images.keep(view, np.where(view.read_labels()[..., None] == 1, np.uint8(200), np.uint8(100)).repeat(3, axis=2))
    found = thumbnails(range(3), evidence, images, palette(3))
    assert set(found) == {0, 1}
    name, picture = found[1]
    assert name == "whole" and picture.shape == (THUMBNAIL_PX, THUMBNAIL_PX, 3)
    bright, middle = (picture == 200).all(axis=2), THUMBNAIL_PX // 2
    # 16 x 24 px in a square of 36: two thirds of the width, the rest dimmed.
    assert bright[middle, middle] and 0.2 < bright.mean() < 0.35
    assert (picture[:8] < 100).all() and (picture == palette(3)[1]).all(axis=2).any()


def test_what_only_the_mask_says_is_on_no_thumbnail() -> None:
    view = view_of("a", painted((1, slice(10, 20), slice(10, 20)), (2, slice(30, 40), slice(10, 20))))
    predicted = painted((1, slice(10, 20), slice(10, 20)))
    evidence = Evidence([hold_against(view, predicted, 3)], {"a": view}, True)
    assert set(thumbnails(range(3), evidence, ViewImages(SCENE), palette(3))) == {0, 1}


def test_differences_are_red_and_only_they() -> None:
    labels = painted((1, slice(10, 20), slice(10, 20)))
    labels[0] = UNKNOWN
    view = view_of("a", labels)
    predicted = painted((1, slice(10, 20), slice(15, 25)))
    images = ViewImages(SCENE)
    images.keep(view, np.full((48, 64, 3), 120, np.uint8))
    triple = draw_triple(hold_against(view, predicted, 2), view, images, palette(2))
    red = triple.difference[..., 0] > triple.difference[..., 1].astype(int) + 80
    np.testing.assert_array_equal(red, (labels != predicted) & (labels != UNKNOWN))
    assert all(picture.shape == (48, 64, 3) and picture.dtype == np.uint8 for picture in triple)


def test_pictures_are_shrunk_not_grown() -> None:
    from io import BytesIO

    from PIL import Image

    for width, shown in ((640, 100), (40, 40)):
        uri = jpeg_uri(np.zeros((20, width, 3), np.uint8), 100)
        with Image.open(BytesIO(base64.b64decode(uri.removeprefix("data:image/jpeg;base64,")))) as image:
            assert image.size[0] == shown


def test_a_photo_is_preferred_and_a_broken_one_or_one_of_another_size_is_rendered_over(tmp_path: Path) -> None:
    from dataclasses import replace

    from PIL import Image

    Image.new("RGB", (64, 48), (10, 200, 30)).save(tmp_path / "good.png")
    Image.new("RGB", (32, 24), (10, 200, 30)).save(tmp_path / "small.png")
    (tmp_path / "broken.png").write_bytes(b"\x89PNG\r\n\x1a\nno")
    for name, is_photo in (("good", True), ("small", False), ("broken", False), ("missing", False)):
        view = replace(view_of(name, painted()), image_path=tmp_path / f"{name}.png")
        image = ViewImages(SCENE).of(view)
        assert image.shape == (48, 64, 3) and (image == (10, 200, 30)).all() == is_photo


# What the preview holds.


def result_of(labels: np.ndarray, scene: GaussianScene = SCENE) -> Segmentation:
    codes = np.eye(NUM_CLASSES, dtype=np.float32)[np.maximum(labels, 0)] * 0.75
    names = {k: str(k) for k in range(NUM_CLASSES)}
    none = np.zeros(len(labels), bool)
    return Segmentation(labels.astype(np.int32), codes, names, scene.digest, none, codes[none])


def test_preview_reads_back_to_half_a_step_and_marks_what_has_no_class() -> None:
    labels = TRUTH.copy()
    labels[:3], labels[3:5] = UNOBSERVED, REMOVED
    preview = make_preview(SCENE, result_of(labels))
    assert RECORD.itemsize == 20 and len(base64.b64decode(preview.as_text())) == 20 * len(preview.records)
    assert preview.left_out == 5 and preview.records["position"].max() == 65535  # those that hang far above
    kept = slice(0, len(SCENE) - 5)
    step = (preview.high - preview.low) / 65535
    means = preview.low + preview.records["position"] * step
    assert (np.abs(means - SCENE.means[kept]) <= 0.51 * step + 1e-6).all()
    np.testing.assert_array_equal(preview.records["label"][5:], labels[5:-5])
    assert (preview.records["label"][:3] == NUM_CLASSES).all() and (
        preview.records["label"][3:5] == NUM_CLASSES + 1
    ).all()
    low, high = preview.log_scales
    scales = np.exp(low + preview.records["scale"] / 255 * (high - low))
    np.testing.assert_allclose(scales, SCENE.scales[kept], rtol=0.51 * (high - low) / 255 + 1e-6)
    np.testing.assert_allclose(preview.records["color"] / 255, SCENE.colors()[kept], atol=0.51 / 255)
    np.testing.assert_allclose(preview.records["quat"] / 127, SCENE.quats[kept], atol=0.51 / 127)
    assert (preview.records["confidence"] == 191).all()
    json.dumps(preview.header(), allow_nan=False)


def test_a_thinned_preview_keeps_small_classes_covers_as_much_and_is_always_the_same() -> None:
    rng = np.random.default_rng(1)
    labels = np.repeat([1, 2, 3], [4900, 60, 40])
    scene = GaussianScene.from_arrays(
        rng.uniform(-1, 1, (5000, 3)), np.tile([1.0, 0, 0, 0], (5000, 1)), np.full((5000, 3), 0.01),
        np.full(5000, 0.9), np.zeros((5000, 1, 3)),
    )  # fmt: skip
    preview, again = (make_preview(scene, result_of(labels, scene), 1000) for _ in range(2))
    np.testing.assert_array_equal(preview.records, again.records)
    assert len(preview.records) == 1000 and preview.left_out == 4000
    assert np.bincount(preview.records["label"]).tolist() == [0, 900, 60, 40]
    growth = np.exp(preview.log_scales[0]) / 0.01
    assert growth == pytest.approx(np.sqrt(5), rel=0.05)


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 40), st.integers(1, 50), st.integers(0, 1000))
def test_no_scene_is_too_small_or_too_flat_for_a_preview(count: int, most: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    means = rng.normal(size=(count, 3)) * rng.choice([0.0, 1e-6, 1e6], 3)
    scene = GaussianScene.from_arrays(
        means, rng.normal(size=(count, 4)), rng.uniform(1e-8, 10, (count, 3)), rng.uniform(0.01, 0.99, count),
        rng.normal(size=(count, 1, 3)) * 5,
    )  # fmt: skip
    preview = make_preview(scene, result_of(rng.integers(-2, NUM_CLASSES, count), scene), most)
    assert len(preview.records) + preview.left_out == count and len(preview.records) <= most
    assert json.loads(json.dumps(preview.header(), allow_nan=False))["count"] == len(preview.records)


def test_a_camera_looks_at_what_it_sees_and_up_is_where_people_hold_it() -> None:
    preview = make_preview(SCENE, result_of(TRUTH))
    (place,) = look_from([look_at("a", np.array([3.0, 0, 3]))], preview)
    np.testing.assert_allclose(place["eye"], [3, 0, 3], atol=1e-6)
    assert np.linalg.norm(place["target"]) < 1.5  # the table lies around the origin
    assert place["fov"] == pytest.approx(2 * np.arctan(24 / 55))
    assert up_of([look_at("a", np.array([3.0, 0, 3])), look_at("b", np.array([-3.0, 0, 3]))])[2] > 0.99
    assert up_of([]) == [0, -1, 0]


# What the charts draw.


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
