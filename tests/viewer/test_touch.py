"""The viewer under fingers: a tablet or a phone has neither a Shift key nor a pointer that hovers."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
import pytest
from labellings import labelled
from patience import PATIENCE
from small_scenes import NAMES

pytest.importorskip("viser")

from shown_viewer import SCENE, TRUTH, Shown, on_a_page

from gsseg_core.viewer.access import listen
from gsseg_core.viewer.clients import SERVER
from gsseg_core.viewer.model import ViewModel
from gsseg_core.viewer.viewer import Viewer

if TYPE_CHECKING:
    from playwright.sync_api import Browser

LEARNT = labelled(TRUTH.astype(np.int32), np.eye(4, dtype=np.float32)[TRUTH] * np.float32(0.9), dict(NAMES))


@pytest.fixture
def tablet(chromium: Browser) -> Iterator[Shown]:
    viewer = Viewer(ViewModel(SCENE, LEARNT), listener=listen(port=18700), draw=SERVER)
    with on_a_page(viewer, chromium, has_touch=True) as shown:
        yield shown


def test_a_tap_asks_as_a_click_does_and_what_was_tapped_is_corrected_without_a_shift_key(tablet: Shown) -> None:
    tablet.tab("Correct")
    tablet.press("correct what was clicked last")
    tablet.says("expected a click in the picture first")
    tablet.page.touchscreen.tap(*tablet.pixel_of(1))
    tablet.says(f"{NAMES[1]}, class 1")
    tablet.page.locator("input[role=combobox][value=background]").tap()
    tablet.page.get_by_role("option", name="cup/mug").tap()
    tablet.page.get_by_role("button", name="correct what was clicked last").tap()
    tablet.says("1 correction; the last one changed")
    now = tablet.viewer.state.model.labelling.labels
    assert (now[TRUTH == 1] == 2).sum() > 10 and (now[TRUTH != 1] == TRUTH[TRUTH != 1]).mean() > 0.99


def test_classes_are_large_enough_for_a_finger(tablet: Shown) -> None:
    button = tablet.page.get_by_role("button", name=f"{NAMES[1]} {int((TRUTH == 1).sum())}")
    button.wait_for(timeout=PATIENCE * 1000)
    box = button.bounding_box()
    assert box is not None and box["height"] >= 24
