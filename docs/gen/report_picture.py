"""Draws docs/pictures/report.jpg, the report of the demo scene: python docs/gen/report_picture.py [DEMO_OUT].

It needs Playwright and a Chromium on PATH, as the tests do (tests/helpers/browser.py).
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from PIL import Image

from gsseg_core.demo.run import run_demo

ROOT = Path(__file__).parents[2]
WIDTH, HEIGHT = 1240, 1330

sys.path.insert(0, str(ROOT / "tests/helpers"))
from browser import opened_page, screenshot, started_chromium  # noqa: E402


def main(demo: Path) -> None:
    """Open the page, wait for its preview, and save what it shows."""
    with started_chromium() as chromium, opened_page(chromium, WIDTH, HEIGHT) as page:
        page.goto((demo / "segmented/report.html").resolve().as_uri())
        page.wait_for_selector(".stage canvas[data-frames]")
        picture = Image.fromarray(screenshot(page))
    picture.resize((900, round(900 * HEIGHT / WIDTH)), Image.Resampling.LANCZOS).save(
        ROOT / "docs/pictures/report.jpg", quality=82, optimize=True
    )


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(Path(sys.argv[1]))
    else:
        with tempfile.TemporaryDirectory() as folder:
            run_demo(folder)
            main(Path(folder))
