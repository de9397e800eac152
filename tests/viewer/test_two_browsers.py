"""Two browsers on one viewer: neither what one does nor its leaving confuses the other."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from browser import opened_page
from labellings import labelled
from patience import PATIENCE
from small_scenes import NAMES, clean_views

pytest.importorskip("viser")

from shown_viewer import SCENE, TRUTH, Shown, on_a_page

from gsseg_core.data.view import View
from gsseg_core.segmentation import Segmentation
from gsseg_core.viewer.access import listen
from gsseg_core.viewer.clients import SERVER
from gsseg_core.viewer.model import ViewModel
from gsseg_core.viewer.viewer import Viewer

if TYPE_CHECKING:
    from playwright.sync_api import Browser

LEARNT = labelled(TRUTH.astype(np.int32), np.eye(4, dtype=np.float32)[TRUTH] * np.float32(0.9), dict(NAMES))


@pytest.fixture
def both(chromium: Browser) -> Iterator[tuple[Shown, Shown]]:
    """Two pages of a viewer, the one that was there first before the other."""
    viewer = Viewer(ViewModel(SCENE, LEARNT), clean_views(3), listener=listen(port=18600), draw=SERVER)
    with (
        on_a_page(viewer, chromium) as first,
        opened_page(chromium, 960, 640, tolerated="computeBoundingSphere") as page,
    ):
        page.goto(viewer.url)
        second = Shown(viewer, page)
        second.wait(lambda: second.looks_like(1), "the picture of the second")
        yield first, second


def test_a_mask_hangs_before_the_browser_that_asked_for_it_until_that_takes_it_off(both: tuple[Shown, Shown]) -> None:
    first, second = both
    first.viewer.state.change(lambda model: model.isolate(3))

    def masked(shown: Shown) -> bool:
        return shown.looks_like(1)  # which is hidden but in the mask

    for shown in both:
        shown.wait(lambda shown=shown: not masked(shown), "the box alone")  # type: ignore[misc]
        shown.tab("Views")
        shown.press("go there")
        shown.wait(lambda shown=shown: masked(shown), "the mask")  # type: ignore[misc]
    first.press("take the mask off")
    first.wait(lambda: not masked(first), "the scene")
    assert masked(second)


def test_a_correction_of_a_browser_that_left_meanwhile_is_seen_by_the_other(
    both: tuple[Shown, Shown], monkeypatch: pytest.MonkeyPatch
) -> None:
    stays, leaves = both
    state, asked, gone = stays.viewer.state, threading.Event(), threading.Event()
    correct = state.correct

    def slowly(view: View) -> int:
        asked.set()
        assert gone.wait(PATIENCE)
        return correct(view)

    monkeypatch.setattr(state, "correct", slowly)
    leaves.page.keyboard.down("Shift")
    leaves.page.mouse.click(*stays.pixel_of(1))
    leaves.page.keyboard.up("Shift")
    leaves.wait(asked.is_set, "the correction")
    leaves.page.close()
    stays.wait(lambda: len(stays.viewer.server.get_clients()) == 1, "the other to leave")
    gone.set()
    stays.tab("Correct")
    stays.says("1 correction; the last one changed")
    stays.wait(lambda: not stays.looks_like(1), "the ball to be background")


def test_a_browser_that_is_reloaded_while_it_saves_can_save_again(
    both: tuple[Shown, Shown], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    shown, _ = both
    asked, gone, save = threading.Event(), threading.Event(), Segmentation.save

    def slowly(result: Segmentation, path: Path) -> None:
        asked.set()
        assert gone.wait(PATIENCE)
        save(result, path)

    monkeypatch.setattr(Segmentation, "save", slowly)
    shown.tab("Save")
    shown.press("the segmentation, as npz")
    shown.wait(asked.is_set, "the saving")
    shown.page.reload()
    shown.tab("Save")
    gone.set()
    with shown.page.expect_download(timeout=PATIENCE * 1000) as download:
        shown.press("the segmentation, as npz")
    download.value.save_as(tmp_path / "s.npz")
    assert np.array_equal(Segmentation.load(tmp_path / "s.npz", SCENE).labels, TRUTH)
