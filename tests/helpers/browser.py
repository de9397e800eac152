"""A real Chromium without a screen, for tests that look at pages as people do.

The fixture `page` of conftest.py is what tests ask for. The browser is the machine's own: nothing is ever downloaded.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np
from patience import PATIENCE
from PIL import Image

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

VARIABLE = "GSSEG_CHROMIUM"
"""Environment variable with the path of the browser, where it has another name than the usual ones."""

# The first one is Chromium without windows, which take two thirds of the processor time of a page.
_NAMES = (
    "chromium-headless-shell", "chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome"
)  # fmt: skip

# WebGL in software, which every machine has; and no talk with anybody but the page's own server.
_FLAGS = (
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-gpu-compositing",
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)

# A page that draws all the time, as the viewer does, would keep a core busy by WebGL in software.
_FEW_FRAMES = """
const frame = window.requestAnimationFrame.bind(window);
window.requestAnimationFrame = draw => setTimeout(() => frame(draw), 200);
window.cancelAnimationFrame = clearTimeout;
"""


def find_chromium() -> str | None:
    """Path of the Chromium: what `GSSEG_CHROMIUM` names, or the first of the usual names on PATH; None without one."""
    named = os.environ.get(VARIABLE)
    return shutil.which(named) if named else next(filter(None, map(shutil.which, _NAMES)), None)


def why_missing() -> str | None:
    """Say what a test in the browser lacks; None if nothing."""
    try:
        import playwright.sync_api  # noqa: F401
    except ImportError:
        return "playwright is not installed (pip install '.[dev]')"
    if find_chromium() is None:
        named = os.environ.get(VARIABLE)
        return f"{VARIABLE} names {named}, which is no program" if named else f"none of {', '.join(_NAMES)} is on PATH"
    return None


@contextmanager
def started_chromium() -> Iterator[Browser]:
    """Start the browser with a profile of its own, and end it."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=find_chromium(), headless=True, args=list(_FLAGS), timeout=1000 * PATIENCE
        )
        try:
            yield browser
        finally:
            browser.close()


@contextmanager
def opened_page(
    browser: Browser, width: int = 960, height: int = 720, tolerated: str = "", **options: Any
) -> Iterator[Page]:
    """Open an empty page; at the end, what it threw or logged as an error is one, as a warning is for Python.

    What holds the text `tolerated`, if that is given, is let pass. `options` are further ones of Playwright's contexts.
    """
    complaints: list[str] = []
    context = browser.new_context(viewport={"width": width, "height": height}, accept_downloads=True, **options)
    context.set_default_timeout(1000 * PATIENCE)  # Of pictures, too, which a busy machine takes half a minute to take.
    context.add_init_script(_FEW_FRAMES)
    page = context.new_page()
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
    try:
        yield page
    finally:
        context.close()
    complaints = [text for text in complaints if not tolerated or tolerated not in text]
    assert not complaints, f"the page complained: {complaints}"


def screenshot(page: Page) -> np.ndarray:
    """What the page shows now, (H, W, 3) uint8."""
    return np.asarray(Image.open(BytesIO(page.screenshot())).convert("RGB"))
