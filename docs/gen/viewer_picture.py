"""Make docs/pictures/viewer.jpg: the viewer on the demo scene, in a real browser, after a click on the apple.

Usage: python docs/gen/viewer_picture.py  (after `gsseg demo`, which leaves its files in demo_out/)
"""

from __future__ import annotations

import sys
from contextlib import closing
from pathlib import Path

import numpy as np
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[2] / "tests/helpers"))
from browser import opened_page, screenshot, started_chromium

from gsseg_core.data.dataset import Dataset
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import Segmentation
from gsseg_core.viewer.access import listen
from gsseg_core.viewer.learnt_views import LearntFrom
from gsseg_core.viewer.model import Labelling, ViewModel
from gsseg_core.viewer.viewer import Viewer
from gsseg_core.viewer.viewpoint import camera_of

ROOT = Path(__file__).parents[2]
APPLE = 8


def main(demo: Path = ROOT / "demo_out", out: Path = ROOT / "docs/pictures/viewer.jpg") -> None:
    """Open the viewer, click, and take the picture."""
    scene = GaussianScene.load(demo / "scene/scene.ply")
    result = Segmentation.load(demo / "segmented/segmentation.npz", scene)
    views = [view for view in Dataset(demo / "scene").views("train") if view.has_mask]
    reliability = LearntFrom.read(demo / "segmented/report.json").reliability
    viewer = Viewer(ViewModel(scene, Labelling.of(result)), views, reliability, listener=listen(port=18400))
    with (
        closing(viewer),
        started_chromium() as browser,
        opened_page(browser, 1280, 800, tolerated="computeBoundingSphere") as page,
    ):
        page.goto(viewer.url)
        page.get_by_role("button", name="apple").wait_for(timeout=120_000)
        page.wait_for_timeout(20_000)  # The picture fades in, and the slowest machine draws it without a GPU.
        warning = page.get_by_text("Software WebGL rendering detected")
        if warning.count():
            page.locator(".mantine-Notification-closeButton").first.click()
        client = next(iter(viewer.server.get_clients().values()))
        camera = camera_of(client)
        (uv,), _ = camera.project(np.median(scene.means[result.labels == APPLE], axis=0, keepdims=True))
        page.mouse.click(float(uv[0]), float(uv[1]))
        page.get_by_text("views voted for it").wait_for(timeout=120_000)
        page.wait_for_timeout(3_000)
        Image.fromarray(screenshot(page)).save(out, quality=85)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
