"""The viewer in a real browser: what is seen on the page, and what its buttons, sliders and clicks do."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from browser import opened_page, screenshot
from labellings import labelled, probabilities_of
from parts_of_balls import tree_of_balls
from patience import PATIENCE
from small_scenes import NAMES, clean_views, write_dataset

from gsseg_core.cli.main import main
from gsseg_core.errors import SettingsError
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import Segmentation
from gsseg_core.viewer.access import listen
from gsseg_core.viewer.live_source import LiveUpdate
from gsseg_core.viewer.model import BY_RELIABILITY, TRUE_COLOURS, Labelling, ViewModel

pytest.importorskip("viser")

from shown_viewer import SCENE, TRUTH, Shown, on_a_page

from gsseg_core.viewer import clients, splats
from gsseg_core.viewer.clients import AUTO, BROWSER, SERVER
from gsseg_core.viewer.viewer import Viewer
from gsseg_core.viewer.viewpoint import camera_of

if TYPE_CHECKING:
    from playwright.sync_api import Browser

LEARNT = labelled(TRUTH.astype(np.int32), np.eye(4, dtype=np.float32)[TRUTH] * np.float32(0.9), dict(NAMES))


@pytest.fixture(scope="module", params=[BROWSER, SERVER])
def opened(chromium: Browser, request: pytest.FixtureRequest) -> Iterator[Shown]:
    views = clean_views(3)
    reliability = {view.name: 0.2 + 0.3 * i for i, view in enumerate(views)}
    viewer = Viewer(ViewModel(SCENE, LEARNT), views, reliability, listener=listen(port=18080), draw=request.param)
    with on_a_page(viewer, chromium) as shown:
        yield shown


@pytest.fixture
def shown(opened: Shown) -> Shown:
    """The page with everything switched on."""
    while opened.viewer.state.undo():
        pass
    opened.viewer.state.change(lambda model: model.show_all())
    opened.tab("Classes")
    opened.wait(lambda: opened.looks_like(1, 2), "all classes")
    return opened


def test_the_page_loads_and_splats_are_drawn(shown: Shown) -> None:
    background = shown.picture()[-1, 0]
    assert (np.abs(shown.picture() - background).max(axis=2) > 30).mean() > 0.05
    for k in NAMES:
        shown.page.get_by_role("button", name=f"{NAMES[k]} {int((k == TRUTH).sum())}").wait_for()  # The only one.


def test_a_class_toggle_changes_the_picture_and_sends_no_gaussian(
    shown: Shown, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, sent = shown.picture(), []
    monkeypatch.setattr(splats.SplatNodes, "_send", lambda *node: sent.append(node))
    shown.press("red ball 60")
    shown.wait(lambda: not shown.looks_like(1), "the red ball to go")
    assert shown.looks_like(2)
    shown.press("red ball 60")
    shown.wait(lambda: shown.looks_like(1), "the red ball to come back")
    shown.wait(lambda: np.abs(shown.picture() - before).max(axis=2).mean() < 2, "the picture as it was")
    assert not sent


def test_a_class_is_isolated_and_another_is_removed(shown: Shown) -> None:
    mug = f"{NAMES[2]} {int((TRUTH == 2).sum())}"
    shown.pressing("switch it on or off", "only this")
    shown.press(mug)
    shown.wait(lambda: shown.looks_like(2, without=[1]), "the mug alone")
    shown.pressing("only this", "remove")
    shown.press(mug)
    shown.wait(lambda: not shown.looks_like(2), "nothing")
    assert 2 in shown.viewer.state.model.removed
    shown.pressing("remove", "switch it on or off")
    shown.press("show all")
    shown.wait(lambda: shown.looks_like(1, 2), "all classes")


def test_a_search_leaves_the_classes_whose_names_have_the_word(shown: Shown) -> None:
    field, ball = (
        shown.page.locator(".mantine-TextInput-input:visible:not([value^='ws'])"),
        shown.page.get_by_role("button", name="red ball 60"),
    )
    field.fill("MUG")
    ball.wait_for(state="hidden", timeout=PATIENCE * 1000)
    assert shown.page.get_by_role("button", name="cup/mug 60").is_visible()
    field.fill("")
    ball.wait_for(timeout=PATIENCE * 1000)


def test_a_slider_acts_at_once(shown: Shown) -> None:
    slider = shown.page.get_by_role("slider").first
    slider.focus()
    slider.press("End")
    shown.wait(lambda: shown.looks_like(without=[1, 2]), "all to be less sure than that")
    assert shown.viewer.state.model.min_confidence == 1.0
    slider.press("Home")
    shown.wait(lambda: shown.looks_like(1), "the red ball")


def test_true_colours_and_reliability_change_the_picture(shown: Shown) -> None:
    shown.viewer.state.change(lambda model: model.isolate(0))
    shown.wait(lambda: not shown.looks_like(1), "the table alone")
    before = shown.picture()
    shown.viewer.state.set_mode(BY_RELIABILITY)
    assert shown.viewer.state.model.reliability is not None
    shown.wait(lambda: np.abs(shown.picture() - before).mean() > 3, "other colours")
    shown.viewer.state.set_mode(TRUE_COLOURS)
    shown.wait(lambda: np.abs(shown.picture() - before).mean() < 3, "the table's own, that of its class")
    shown.viewer.state.set_mode("class")


def test_a_click_tells_the_class_its_probabilities_and_the_views_that_voted_for_it(shown: Shown) -> None:
    for k in (1, 3):
        shown.page.mouse.click(*shown.pixel_of(k))
        shown.says(f"{NAMES[k]}, class {k}")
        shown.says(f"probabilities: {NAMES[k]} 0.90")
        shown.says("3 views voted for it")
        shown.says(f"view0: {NAMES[k]}")
    shown.page.mouse.click(5, 200)
    shown.says("Nothing is there.")


def test_a_click_on_an_object_offers_its_parts_and_a_level_can_be_chosen(chromium: Browser) -> None:
    model = ViewModel(SCENE, LEARNT, class_ids=tuple(NAMES), tree=tree_of_balls())
    viewer = Viewer(model, listener=listen(port=18080), draw=SERVER)
    with on_a_page(viewer, chromium) as shown:
        page = shown.page
        assert not page.get_by_role("button", name="its parts").is_visible()
        page.mouse.click(*shown.pixel_of(1))
        shown.press("its parts")
        shown.says("red ball.2  ")
        shown.wait(lambda: viewer.state.model.ids() == [0, 2, 3, 4, 5], "the parts")
        upper, lower = (viewer.state.model.ids().index(node) for node in (5, 4))
        shown.wait(lambda: shown.looks_like(upper, lower, without=[1]), "its halves")
        page.mouse.click(*shown.pixel_of(1))
        shown.press("its whole")
        shown.wait(lambda: viewer.state.granularity == 0.5, "the ball")
        shown.pressing("objects", "wholes at 0.30")
        shown.says("whole_001")
        assert viewer.state.model.shown().all()


def test_the_camera_jumps_to_a_view_and_its_mask_lies_over_it(shown: Shown) -> None:
    shown.tab("Views")
    shown.press("next")
    pose = shown.viewer.state.views[1].camera.world_to_camera
    # The browser may tell on the way where it is already, and not yet where it looks.
    shown.wait(lambda: np.allclose(camera_of(shown.client).world_to_camera, pose, atol=1e-2), "the camera")
    shown.viewer.state.change(lambda model: model.isolate(3))
    x, y = shown.pixel_of(1)
    tinted = np.array(shown.viewer.state.model.color(1))

    def is_tinted() -> bool:
        pixel = screenshot(shown.page)[int(y), int(x)].astype(int)
        return bool(np.argmax(pixel) == np.argmax(tinted) and np.ptp(pixel) > 40)

    shown.wait(is_tinted, "the mask")
    shown.press("take the mask off")
    shown.wait(lambda: not is_tinted(), "the scene")


def test_an_export_is_a_valid_ply_of_what_is_shown(shown: Shown, tmp_path: Path) -> None:
    shown.viewer.state.change(lambda model: model.isolate(2))
    shown.tab("Save")
    with shown.page.expect_download(timeout=PATIENCE * 1000) as download:
        shown.press("what is shown")
    download.value.save_as(tmp_path / "some.ply")
    exported = GaussianScene.load(tmp_path / "some.ply")
    assert exported.vertices.tobytes() == SCENE.subset(TRUTH == 2).vertices.tobytes()
    shown.viewer.state.change(lambda model: model.toggle(2))
    shown.press("what is shown")
    shown.says("none of its 626 Gaussians is in the subset")


def test_an_export_has_the_format_that_is_chosen(shown: Shown, tmp_path: Path) -> None:
    shown.viewer.state.change(lambda model: model.isolate(2))
    shown.tab("Save")
    shown.page.locator("input[role=combobox][value=ply]").click()
    shown.page.get_by_role("option", name="glb").click()
    with shown.page.expect_download(timeout=PATIENCE * 1000) as download:
        shown.press("what is shown")
    assert download.value.suggested_filename == "selection.glb"
    download.value.save_as(tmp_path / "selection.glb")
    assert (tmp_path / "selection.glb").read_bytes().startswith(b"glTF")


def test_a_shift_click_corrects_a_label_and_can_be_taken_back(shown: Shown, tmp_path: Path) -> None:
    shown.tab("Correct")
    shown.page.locator("input[role=combobox][value=background]").click()
    shown.page.get_by_role("option", name="cup/mug").click()
    x, y = shown.pixel_of(1)
    shown.page.keyboard.down("Shift")
    shown.page.mouse.click(x, y)
    shown.page.keyboard.up("Shift")
    shown.says("1 correction; the last one changed")
    now = shown.viewer.state.model.labelling.labels
    assert (now[TRUTH == 1] == 2).sum() > 10 and (now[TRUTH != 1] == TRUTH[TRUTH != 1]).mean() > 0.99
    with shown.page.expect_download(timeout=PATIENCE * 1000) as download:
        shown.tab("Save")
        shown.press("the segmentation, as npz")
    download.value.save_as(tmp_path / "s.npz")
    assert np.array_equal(Segmentation.load(tmp_path / "s.npz", SCENE).labels, now)
    shown.tab("Correct")
    shown.press("take the last one back")
    shown.wait(lambda: np.array_equal(shown.viewer.state.model.labelling.labels, TRUTH), "the old labels")


def test_a_shift_drag_corrects_what_is_in_the_box(shown: Shown) -> None:
    x, y = shown.pixel_of(1)
    shown.page.keyboard.down("Shift")
    shown.page.mouse.move(x - 15, y - 15)
    shown.page.mouse.down()
    shown.page.mouse.move(x, y, steps=3)
    shown.page.mouse.move(x + 15, y + 15, steps=3)
    shown.page.mouse.up()
    shown.page.keyboard.up("Shift")
    state = shown.viewer.state

    def is_corrected() -> bool:
        with state.lock:  # What follows from a correction is there when the lock is free again.
            return len(state.corrections) == 1

    shown.wait(is_corrected, "the correction")
    assert (probabilities_of(shown.viewer.state.objects) != probabilities_of(LEARNT))[TRUTH == 1].any()
    (drawn,) = shown.viewer.state.corrections.drawn
    assert drawn.votes.sum() > 100  # px


def test_codes_of_a_live_source_refresh_the_picture(chromium: Browser) -> None:
    class Source:
        """Says nothing at first, and then all at once."""

        ready = False

        def wait(self, timeout: float) -> LiveUpdate | None:
            if not self.ready:
                time.sleep(0.02)
                return None
            self.ready = False
            return LiveUpdate(LEARNT, 7)

        def close(self) -> None:
            pass

    source = Source()
    viewer = Viewer(
        ViewModel(SCENE, Labelling.unknown(len(SCENE))), source=source, listener=listen(port=18080), draw=SERVER
    )
    with closing(viewer), opened_page(chromium, 960, 640, tolerated="computeBoundingSphere") as page:
        page.goto(viewer.url)
        shown = Shown(viewer, page)
        shown.wait(lambda: (np.ptp(shown.picture(), axis=(0, 1)) > 30).any(), "grey splats")
        assert {row.label for row in viewer.state.model.rows()} == {-1}
        source.ready = True
        shown.wait(lambda: shown.looks_like(1, 2), "the classes")
        shown.tab("Save")
        shown.says("live: 7 views so far")


def test_who_is_to_draw_must_be_known() -> None:
    with pytest.raises(SettingsError, match="draw is 'gpu'; expected one of auto, browser, server"):
        Viewer(ViewModel(SCENE, LEARNT), draw="gpu")


@pytest.mark.parametrize(("limit", "draws"), [(-np.inf, False), (np.inf, True)])
def test_a_browser_gets_images_until_it_has_shown_that_it_draws_fast(
    chromium: Browser, monkeypatch: pytest.MonkeyPatch, limit: float, draws: bool
) -> None:
    monkeypatch.setattr(clients, "SLOW", limit)
    monkeypatch.setattr(clients, "NOTICE", None)  # Where it closed by itself, a busy machine might look too late.
    monkeypatch.setattr(clients, "_PATIENCE", PATIENCE)
    viewer = Viewer(ViewModel(SCENE, LEARNT), clean_views(1), listener=listen(port=18080), draw=AUTO)
    with on_a_page(viewer, chromium) as shown:
        (renderer,) = viewer.renderers.by_client.values()
        if draws:
            shown.wait(lambda: renderer.frames is None, "the browser to draw")
        else:
            shown.says("This browser draws slowly")
        assert (renderer.nodes is not None) == draws
        viewer.state.change(lambda model: model.isolate(2))
        shown.wait(lambda: shown.looks_like(2, without=[1]), "the mug alone")


def test_a_browser_that_gives_no_picture_in_time_is_told_that_it_gets_images() -> None:
    client = MagicMock(camera=MagicMock(fov=1.0, aspect=1.0, position=np.zeros(3), wxyz=np.eye(4)[0]))
    client.get_render.side_effect = TimeoutError
    server = MagicMock()
    server.get_clients.return_value = {client.client_id: client}
    renderers = clients.ClientRenderers(server, SCENE, AUTO, "cpu")
    renderers._join(client)
    assert "draws slowly" in client.add_notification.call_args.args[1]
    (renderer,) = renderers.by_client.values()
    assert renderer.nodes is None and renderer.frames is not None
    renderers.close()


def test_the_command_serves_the_page_until_it_is_interrupted(tmp_path: Path) -> None:
    data = write_dataset(tmp_path / "data")
    command = [sys.executable, "-m", "gsseg_core.cli", "view", str(data / "scene.ply"), "--data", str(data), "--quiet"]
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen([*command, "--port", "18085"], **pipes) as process:
        try:
            assert process.stdout is not None and process.stderr is not None
            said = process.stdout.readline()
            assert said.startswith("gsseg: 626 Gaussians at http://localhost:"), process.stderr.read()
            with urllib.request.urlopen(said.split(" at ")[1].split()[0], timeout=PATIENCE) as page:
                assert b"<html" in page.read()
            process.send_signal(signal.SIGINT)
            assert process.communicate(timeout=PATIENCE) == ("", "") and process.returncode == 0
        finally:
            process.kill()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere.ply"], "nowhere.ply"),
        (["data/scene.ply", "--segmentation", "nowhere.npz"], "nowhere.npz"),
        (["data/scene.ply", "--data", "nowhere"], "nowhere"),
        (["data/scene.ply", "--port", "70000"], "port is 70000; expected 1 to 65535"),
        (["data/scene.ply", "--ros", "--segmentation", "s.npz"], "both --ros and --segmentation are given"),
    ],
)
def test_wrong_inputs_give_one_clear_error(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    write_dataset(tmp_path / "data")
    monkeypatch.chdir(tmp_path)
    assert main(["view", *arguments, "--quiet"]) == 2
    error = capsys.readouterr().err
    assert message in error and error.startswith("gsseg: error: ") and error.count("\n") == 1


def test_without_viser_one_error_says_what_to_install(tmp_path: Path) -> None:
    code = (
        "import sys; sys.modules['viser'] = None\n"
        "from gsseg_core.cli.main import main\n"
        f"sys.exit(main(['view', {str(tmp_path / 'scene.ply')!r}]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=PATIENCE)
    expected = "gsseg: error: `gsseg view` needs viser, which is missing: pip install 'gsseg[view]'\n"
    assert (done.returncode, done.stderr) == (2, expected)
