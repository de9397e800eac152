"""The report page in a real Chromium: it draws, answers, is quiet, and does without JavaScript and on a phone."""

from __future__ import annotations

import base64
import re
from functools import partial
from io import BytesIO
from typing import TYPE_CHECKING

import numpy as np
import pytest
from browser import opened_page
from parts_of_balls import SCENE, TRUTH, halved, seen_as
from PIL import Image
from report_cases import NASTY, run_with_nasty_names
from small_scenes import NAMES, look_at, many_classes, ring, write_dataset

from gsseg_core import pipeline
from gsseg_core.data.dataset import Dataset
from gsseg_core.data.label_images import write_mask

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from playwright.sync_api import Browser, Locator, Page

CANVAS = ".stage canvas"


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Address of a page."""
    return (run_with_nasty_names(tmp_path_factory.mktemp("report")) / "report.html").as_uri()


@pytest.fixture(scope="module")
def long_report(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Address of a page of more classes than fit on it one by one, some of them under very long names."""
    folder, (scene, truth) = tmp_path_factory.mktemp("long"), many_classes(24)
    long = {4: "x" * 200, 5: "a thing on the table " * 9, 6: "\u05e9" * 9, 7: "object_007", 8: "Tu\u0308r"}
    long |= {9: "\u0130stanbul \u0131\u015f\u0131kl\u0131", 10: "Stra\u00dfe"}
    names = {k: f"class {k}" for k in range(24)} | NASTY | long
    cameras = [look_at(f"view{i}", np.array([0.1 * i, -0.9, 1.5]), 160, 120, 90.0) for i in range(4)]
    data = write_dataset(folder / "data", scene, truth, cameras, names)
    pipeline.segment(data / "scene.ply", data, folder / "out")
    return (folder / "out/report.html").as_uri()


@pytest.fixture
def opened(page: Page, report: str) -> Page:
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    page.goto(report)
    page.wait_for_selector(f"{CANVAS}[data-frames]")
    assert [url for url in asked if not url.startswith("data:")] == [report]
    return page


def shot(place: Locator) -> np.ndarray:
    return np.asarray(Image.open(BytesIO(place.screenshot())).convert("RGB")).astype(int)


def after(page: Page, change: Callable[[], object]) -> np.ndarray:
    """What the preview shows once it has drawn what changed."""
    frames = int(page.locator(CANVAS).get_attribute("data-frames") or 0)
    change()
    # Not by wait_for_function, which needs eval, and that the page's policy forbids.
    page.locator(f"{CANVAS}:not([data-frames='{frames}'])").wait_for()
    page.evaluate("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")  # It may be older.
    return shot(page.locator(CANVAS))


def changed(one: np.ndarray, other: np.ndarray) -> float:
    """Share of the pixels that differ."""
    return float((np.abs(one - other).max(axis=2) > 24).mean())


def test_preview_draws_the_scene_and_toggles_of_classes_change_it(opened: Page) -> None:
    whole = shot(opened.locator(CANVAS))
    empty = after(opened, opened.locator("[data-all='0']").click)
    assert empty[: len(empty) // 2].std(axis=(0, 1)).max() < 3
    assert changed(whole, empty) > 0.2
    only_one = after(opened, opened.locator(".only[data-label='1']").click)
    assert 0.005 < changed(only_one, empty) < 0.2
    again = after(opened, opened.locator("[data-all='1']").click)
    assert changed(again, whole) < 0.05
    without = after(opened, opened.locator(".legend input[data-label='1']").click)
    # What goes is where the class alone was, unless something stood in front of it.
    gone = np.abs(without - again).max(axis=2) > 24
    alone = np.abs(only_one - empty).max(axis=2) > 24
    assert gone.mean() > 0.002 and (gone & ~alone).mean() < 0.01


def test_colours_can_be_switched(opened: Page) -> None:
    shown = [after(opened, opened.locator(f"[data-mode='{mode}']").click) for mode in (0, 1, 2)]
    assert min(changed(shown[i], shown[j]) for i, j in ((0, 1), (0, 2), (1, 2))) > 0.05
    assert opened.locator("[data-mode='2']").get_attribute("aria-pressed") == "true"
    assert opened.locator(".ramp").is_visible()


def test_preview_turns_moves_zooms_and_cuts(opened: Page) -> None:
    canvas = opened.locator(CANVAS)
    before = shot(canvas)  # It scrolls the canvas into view, too.
    box = canvas.bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2

    def drag() -> None:
        opened.mouse.move(x, y)
        opened.mouse.down()
        opened.mouse.move(x + 120, y + 40)
        opened.mouse.up()

    turned = after(opened, drag)
    canvas.focus()
    nearer = after(opened, lambda: opened.keyboard.press("+"))
    rolled = after(opened, lambda: opened.mouse.wheel(0, -400))
    cut = after(opened, lambda: opened.locator(".cut").fill("70"))
    outside = after(opened, lambda: opened.locator(".looks").select_option("-1"))
    for one, other in ((before, turned), (turned, nearer), (nearer, rolled), (rolled, cut), (before, outside)):
        assert changed(one, other) > 0.01


def test_a_search_leaves_the_classes_whose_names_have_the_word(opened: Page) -> None:
    for section, rows in (("#classes", ".classes tbody tr"), ("#preview", ".legend li")):
        opened.locator(f"{section} .search").fill("SCRIPT")
        assert 0 < (found := opened.locator(f"{rows}:visible").count()) < opened.locator(rows).count()
        assert opened.locator(f"{section} output.faint").text_content() == f"{found} found"
        opened.locator(f"{section} .search").fill("")
        assert opened.locator(f"{rows}:visible").count() == opened.locator(rows).count() > 1
        assert opened.locator(f"{section} output.faint").text_content() == ""


def test_nasty_names_do_nothing(opened: Page) -> None:
    assert opened.title() == "gsseg: scene.ply"
    assert opened.locator("script").count() == 3
    assert opened.locator("img[src^='http']").count() == 0
    assert opened.locator("#classes bdi").nth(1).inner_text() == "<script>document.title='pwned'</script>"


@pytest.mark.parametrize(("scheme", "width"), [("light", 320), ("dark", 360)])
def test_a_phone_shows_all_of_it_without_scrolling_sideways(
    chromium: Browser, report: str, scheme: str, width: int
) -> None:
    with opened_page(chromium, width, 740, color_scheme=scheme) as page:
        page.goto(report)
        page.wait_for_selector(f"{CANVAS}[data-frames]")
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        paper = [
            int(x) for x in page.evaluate("getComputedStyle(document.body).backgroundColor").strip("rgb()").split(",")
        ]
        assert (sum(paper) < 150) == (scheme == "dark")
        figure = page.locator(".chart text").first.bounding_box()
        assert figure is not None and figure["height"] > 10, (
            "the chart is drawn smaller than elsewhere, its figures are not"
        )
        assert shot(page.locator(CANVAS)).std() > 5


@pytest.mark.parametrize("width", [320, 360, 1280])
def test_long_names_and_many_classes_break_no_figure_and_make_no_page_wider(
    chromium: Browser, long_report: str, width: int
) -> None:
    figures = "td.number, td.share span, td.link a, .pairs td:nth-child(n + 3), .settings dd"
    broken = f"""() => [...document.querySelectorAll("{figures}")]
        .filter((figure) => {{
          const range = document.createRange();
          range.selectNodeContents(figure);
          const bottoms = [...range.getClientRects()].map((line) => line.bottom);
          return Math.max(...bottoms) - Math.min(...bottoms) > 9;
        }}).map((figure) => figure.textContent)"""
    cut_off = """() => [...document.querySelectorAll(".heatmap text")].filter((name) => {
        const own = name.getBoundingClientRect(), room = name.closest("svg").getBoundingClientRect();
        return own.left < room.left || own.top < room.top || own.right > room.right;
    }).map((name) => name.textContent)"""
    beside = """() => [...document.querySelectorAll(".classes thead th")].filter((head) => {
        const range = document.createRange(), next = head.nextElementSibling;
        range.selectNodeContents(head);
        return next?.checkVisibility() && range.getBoundingClientRect().right > next.getBoundingClientRect().left;
    }).map((head) => head.textContent)"""
    with opened_page(chromium, width, 740) as page:
        page.goto(long_report)
        page.wait_for_selector(f"{CANVAS}[data-frames]")
        assert page.locator(".classes.many").count() == 1
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        assert page.evaluate(broken) == []
        assert page.evaluate(cut_off) == []
        page.evaluate("document.querySelector('.legend').classList.add('many')")
        for names in ("th.name", ".legend bdi"):
            name = page.locator(f"{names}:has-text('object_007')")
            whole = name.evaluate("name => name.scrollWidth <= name.clientWidth")
            assert whole, f"the names that objects get are told apart by their end: {names}"
        assert page.evaluate(beside) == []


@pytest.mark.parametrize("typed", ["t\u00fcr", "istanbul", "I\u015eIKLI", "\u0130stanbul", "strasse", "STRA\u00dfE"])
def test_a_search_finds_letters_however_they_are_written_small_or_large(
    page: Page, long_report: str, typed: str
) -> None:
    page.goto(long_report)
    page.locator("#classes .search").fill(typed)
    assert page.locator("#classes tbody tr:visible").count() == 1


def test_a_tablet_shows_what_a_pointer_would_have_to_find(chromium: Browser, long_report: str) -> None:
    with opened_page(chromium, 1024, 768, has_touch=True, is_mobile=True) as page:
        page.goto(long_report)
        page.wait_for_selector(f"{CANVAS}[data-frames]")
        page.evaluate("document.querySelector('.legend').classList.add('many')")
        assert page.locator(".only").first.evaluate("only => getComputedStyle(only).opacity") == "1"


def test_keys_move_the_scene_and_leave_the_browser_its_own(opened: Page) -> None:
    canvas = opened.locator(CANVAS)
    canvas.focus()
    pressed = ("ArrowLeft", "ArrowRight", "ArrowRight", "ArrowLeft", "Shift+ArrowRight", "Shift+ArrowLeft")
    _, here, turned, back, moved, again = (after(opened, partial(opened.keyboard.press, key)) for key in pressed)
    assert min(changed(one, other) for one, other in ((here, turned), (here, moved), (turned, moved))) > 0.005
    assert max(changed(here, back), changed(here, again)) < 0.002
    for key, held in (("+", "ctrlKey"), ("-", "ctrlKey"), ("-", "metaKey"), ("ArrowLeft", "altKey")):
        press = f"new KeyboardEvent('keydown', {{key: '{key}', {held}: true, cancelable: true}})"
        assert canvas.evaluate(f"canvas => canvas.dispatchEvent({press})"), "the browser's zoom, or the page before"


def test_a_screen_reader_is_told_what_everything_is(opened: Page) -> None:
    assert opened.get_by_role("application", name="shift they move it").count() == 1
    assert opened.get_by_role("region", name="matrix of confusions").count() == 1
    assert opened.get_by_role("group", name="classes to show").get_by_role("button").count() == 2
    for table in (".classes", ".views", ".timings"):
        rows = opened.locator(f"{table} tbody tr")
        assert opened.locator(f"{table} tbody th[scope=row]").count() == rows.count() > 0, table
    assert opened.locator("td.share [role=img]").count() == 0, "the figure stands beside the bar"
    told = opened.locator(".chart").get_attribute("aria-label") or ""
    labelled = sum(int(count.replace(",", "")) for count in re.findall(r"up to [\d.]+: ([\d,]+?)(?:, |$)", told))
    drawn = re.findall(r": ([\d,]+) ", " ".join(opened.locator(".chart title").all_text_contents()))
    assert labelled == sum(int(count.replace(",", "")) for count in drawn) > 0


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_all_text_stands_out_from_what_is_behind_it(chromium: Browser, report: str, scheme: str) -> None:
    with opened_page(chromium, color_scheme=scheme) as page:
        page.goto(report)
        page.wait_for_selector(f"{CANVAS}[data-frames]")
        faint = page.evaluate("""() => {
          const parts = (color) => color.match(/[\\d.]+/g).map(Number);
          const luminance = (color) => parts(color).slice(0, 3).map((c) => c / 255)
            .map((c) => (c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4))
            .reduce((sum, c, i) => sum + c * [0.2126, 0.7152, 0.0722][i], 0);
          const behind = (place) => {
            const color = getComputedStyle(place).backgroundColor;
            return parts(color)[3] === 0 ? behind(place.parentElement) : color;
          };
          const found = [];
          for (const place of document.querySelectorAll("body *:not(script, .hint)")) {
            const text = [...place.childNodes].some((one) => one.nodeType === 3 && one.data.trim());
            if (!text || !place.checkVisibility()) continue;
            const { color, fill } = getComputedStyle(place);
            const inks = [place instanceof SVGElement ? fill : color, behind(place)];
            const [low, high] = inks.map(luminance).sort((a, b) => a - b);
            if ((high + 0.05) / (low + 0.05) < 4.5) found.push(place.tagName + " " + place.textContent.slice(0, 40));
          }
          return found;
        }""")
        assert faint == []


def test_forced_colours_leave_keys_and_what_is_pressed(chromium: Browser, report: str) -> None:
    with opened_page(chromium, forced_colors="active") as page:
        page.goto(report)
        page.wait_for_selector(f"{CANVAS}[data-frames]")
        paper = "place => getComputedStyle(place).backgroundColor"
        pressed, other = (page.locator(f"[data-mode='{mode}']").evaluate(paper) for mode in (0, 1))
        assert pressed != other
        assert len({page.locator(f".keys .s{i}").evaluate(paper) for i in (0, 1)}) == 2


def test_a_page_that_one_comes_back_to_shows_what_its_controls_say(opened: Page, report: str) -> None:
    opened.locator(".cut").fill("70")
    opened.locator("#classes .search").fill("script")
    opened.locator(".legend input").first.uncheck()
    opened.goto("about:blank")
    opened.go_back()
    opened.wait_for_selector(f"{CANVAS}[data-frames]")
    opened.wait_for_timeout(300)  # A browser puts back what was typed once the page has loaded.
    assert opened.locator(".cut").input_value() == "0" and opened.locator("#classes .search").input_value() == ""
    assert opened.locator(".legend input:not(:checked)").count() == 0


def test_a_page_that_was_saved_in_use_begins_anew(chromium: Browser, opened: Page, tmp_path: Path) -> None:
    opened.locator("[data-mode='2']").click()
    for section in ("#preview", "#classes"):
        opened.locator(f"{section} .search").fill("script")
    saved = re.sub(' data-frames="[0-9]+"', "", opened.content())  # It would count on from there.
    (tmp_path / "saved.html").write_text(saved, "utf-8")
    with opened_page(chromium) as page:
        page.goto((tmp_path / "saved.html").as_uri())
        page.wait_for_selector(f"{CANVAS}[data-frames]")
        assert page.locator("[aria-pressed='true']").get_attribute("data-mode") == "0"
        assert not page.locator(".ramp").is_visible()
        assert not any(page.locator(f"{rows}[hidden]").count() for rows in (".legend li", ".classes tbody tr"))
    with opened_page(chromium) as page:
        page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
        page.goto((tmp_path / "saved.html").as_uri())
        assert page.locator(".poster").is_visible() and not page.locator(".controls").is_visible()


def test_a_preview_that_the_browser_loses_leaves_its_picture(opened: Page) -> None:
    opened.locator(CANVAS).evaluate("c => c.getContext('webgl2').getExtension('WEBGL_lose_context').loseContext()")
    opened.locator(".poster").wait_for()
    assert not opened.locator(".controls").is_visible()
    assert "loaded anew" in opened.locator("#preview").inner_text()


def test_names_that_are_read_from_the_right_leave_sentences_in_order(opened: Page) -> None:
    for said in opened.locator(".triple > p").all():
        assert said.locator("bdi").count() == 2 * said.inner_text().count(", called ")


def test_paper_gets_dark_letters_an_undistorted_preview_and_nothing_to_press(chromium: Browser, report: str) -> None:
    with opened_page(chromium, color_scheme="dark") as page:
        page.goto(report)
        page.wait_for_selector(f"{CANVAS}[data-frames]")
        page.emulate_media(media="print")
        assert max(map(int, page.evaluate("getComputedStyle(document.body).color").strip("rgb()").split(","))) < 100
        # On paper the canvas is as high as the list of classes, and is not drawn anew.
        assert page.evaluate("getComputedStyle(document.querySelector('.stage canvas')).objectFit") == "contain"
        for pressed in ("nav", ".controls", ".search", ".hint", ".only"):
            assert not any(one.is_visible() for one in page.locator(pressed).all())
        assert page.evaluate("getComputedStyle(document.querySelector('i.s0')).printColorAdjust") == "exact"


def test_the_preview_is_not_black_when_it_is_printed_or_saved_as_a_picture(opened: Page) -> None:
    # Until it is on the screen, it is there in any case.
    opened.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => setTimeout(done))))")
    kept = opened.locator(CANVAS).evaluate("c => c.toDataURL().split(',')[1]")
    assert np.asarray(Image.open(BytesIO(base64.b64decode(kept))).convert("L")).std() > 5


def test_a_sheet_of_paper_has_all_classes_and_all_pictures(chromium: Browser, long_report: str) -> None:
    with opened_page(chromium, 718, 1040) as page:  # A4 between the usual margins
        page.goto(long_report)
        page.wait_for_selector(f"{CANVAS}[data-frames]")
        page.emulate_media(media="print")
        assert page.evaluate("document.documentElement.scrollWidth") <= 718
        for kind in (".legend", ".pictures", ".scroll"):
            for whole in page.locator(kind).all():
                cut = "e => Math.max(e.scrollWidth - e.clientWidth, e.scrollHeight - e.clientHeight)"
                assert whole.evaluate(cut) <= 1, kind
        assert page.locator(".classes th.name, .classes td.link").first.is_visible()


def test_everything_but_the_preview_works_without_javascript(chromium: Browser, report: str) -> None:
    with opened_page(chromium, java_script_enabled=False) as page:
        page.goto(report)
        assert page.locator(".poster").is_visible() and not page.locator(CANVAS).is_visible()
        assert not page.locator(".controls").is_visible() and page.locator("noscript p").is_visible()
        assert page.locator(".classes tbody tr").count() == 4 and page.locator(".legend li").first.is_visible()
        assert shot(page.locator(".poster")).std() > 5
        assert page.locator(".triple img").count() == 9


def test_levels_recolour_the_preview_and_parts_stand_under_their_object(
    page: Page, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("levels")
    data = write_dataset(folder / "data", SCENE, TRUTH, ring(24), NAMES)
    for i, view in enumerate(Dataset(data).views("train")):
        labels = seen_as(view, halved(1) if i % 2 else TRUTH).read_labels()
        write_mask(data / "labels" / f"{view.name}.png", labels, 8)
    pipeline.segment(data / "scene.ply", data, folder / "out", ids="per-view", learner="votes")
    page.goto((folder / "out/report.html").as_uri())
    page.wait_for_selector(f"{CANVAS}[data-frames]")
    rows = page.locator(".legend li:visible bdi")
    objects, before = rows.all_text_contents(), shot(page.locator(CANVAS))
    assert page.locator(".level-name").text_content() == "objects"
    assert page.locator(".level").get_attribute("aria-valuetext") == "objects"
    most = page.locator(".level").get_attribute("max")
    fine = after(page, lambda: page.locator(".level").fill(str(most)))
    assert page.locator(".level-name").text_content().startswith("parts at 0.")
    assert page.locator(".level").get_attribute("aria-valuetext") == page.locator(".level-name").text_content()
    parts = [name for name in rows.all_text_contents() if name not in objects]
    assert len(parts) == 2 and {name[-2:] for name in parts} == {".1", ".2"}
    assert changed(before, fine) > 0.002
    assert changed(after(page, lambda: page.locator(".level").fill("0")), before) < 0.002
    page.locator("#classes .parts summary").click()
    assert page.locator("#classes .parts bdi").all_text_contents() == sorted(parts)
    page.locator("#classes .search").fill(parts[0])
    assert page.locator("#classes tbody tr:visible th > bdi").all_text_contents() == [
        parts[0].removesuffix(parts[0][-2:])
    ]
