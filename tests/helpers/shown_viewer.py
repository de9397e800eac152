"""A viewer on a page in a real browser: what is seen there, and how it is used."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
from browser import opened_page, screenshot
from patience import PATIENCE, wait_until
from small_scenes import balls_on_a_table

from gsseg_core.export.pictures import FILL
from gsseg_core.viewer.viewer import Viewer
from gsseg_core.viewer.viewpoint import camera_of

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

SCENE, TRUTH = balls_on_a_table()


class Shown:
    """A viewer, and a page of it."""

    def __init__(self, viewer: Viewer, page: Page) -> None:
        self.viewer, self.page = viewer, page

    @property
    def client(self) -> Any:
        return next(iter(self.viewer.server.get_clients().values()))

    def picture(self) -> np.ndarray:
        """The part of the page that the panel leaves free, (H, W, 3)."""
        return screenshot(self.page)[200:, :600].astype(int)

    def wait(self, condition: Callable[[], Any], what: str) -> None:
        wait_until(condition, what, pause=lambda: self.page.wait_for_timeout(50))

    def looks_like(self, *labels: int, without: Sequence[int] = ()) -> bool:
        """Whether the colours of some classes, and none of others, are anywhere in the picture."""
        picture = self.picture()
        hue = picture - picture.mean(axis=2, keepdims=True)

        def is_there(label: int) -> bool:
            color = np.array(self.viewer.state.model.color(label))
            return int((np.abs(hue - FILL * (color - color.mean())).max(axis=2) < 12).sum()) > 40

        return all(map(is_there, labels)) and not any(map(is_there, without))

    def pixel_of(self, label: int) -> tuple[float, float]:
        """Where the middle of a class is on the page."""
        camera = camera_of(self.client)
        (uv,), _ = camera.project(SCENE.means[label == TRUTH].mean(axis=0, keepdims=True))
        return float(uv[0]), float(uv[1])

    def press(self, name: str, nth: int = 0) -> None:
        self.page.get_by_role("button", name=name).nth(nth).click()

    def pressing(self, did: str, does: str) -> None:
        """Choose what a press on a class does."""
        self.page.locator(f"input[role=combobox][value='{did}']").click()
        self.page.get_by_role("option", name=does).click()

    def tab(self, name: str) -> None:
        self.page.get_by_role("tab", name=name).click()

    def says(self, text: str) -> None:
        self.page.get_by_text(text).first.wait_for(timeout=PATIENCE * 1000)


@contextmanager
def on_a_page(viewer: Viewer, chromium: Browser, **options: Any) -> Iterator[Shown]:
    """Show a viewer on a page; `options` are further ones of Playwright's contexts."""
    # three.js complains of the splats' own geometry, which is flat, wherever one points at it.
    with closing(viewer), opened_page(chromium, 960, 640, "computeBoundingSphere", **options) as page:
        page.goto(viewer.url)
        shown = Shown(viewer, page)
        shown.wait(lambda: viewer.server.get_clients(), "the page")
        shown.wait(lambda: shown.looks_like(1), "the first picture")
        yield shown
