"""Renders images on the server for browsers that draw splats slowly."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress

import numpy as np
import viser

from gsseg_core.errors import GssegError
from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.view_operator import ViewOperator
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.viewer.picture import Picture

FINE_ROWS, QUICK_ROWS = 720, 320
"""Most rows of an image once nothing changes any more, and until then."""

RESTS = 0.2
"""Seconds without a change after which an image is drawn finely."""

_QUALITY = 90

CameraOf = Callable[[viser.ClientHandle, int], Camera]
"""Makes the camera of what a browser looks at, of at most so many rows."""


class Frames:
    """Renders images for one browser: a new one whenever its camera moves or the picture changes.

    A change is answered by a coarse image at once, and by a fine one when no other has followed. What has become
    outdated while an image was drawn is left out, so the browser is never more than one image behind.

    Parameters
    ----------
    client : viser.ClientHandle
        The browser.
    camera_of : CameraOf
        Where it looks from.
    device : str
        Where images are drawn.
    """

    def __init__(self, client: viser.ClientHandle, camera_of: CameraOf, device: str = "cpu") -> None:
        self._client, self._camera_of, self._device = client, camera_of, device
        self._picture: Picture | None = None
        self._changed = -RESTS
        self._known: dict[int, ViewOperator] = {}
        self._stale, self._closing = threading.Event(), threading.Event()
        client.camera.on_update(lambda camera: self._change())
        self._thread = threading.Thread(target=self._keep_drawing, name="frames", daemon=True)
        self._thread.start()

    def show(self, picture: Picture) -> None:
        """Show a picture from now on."""
        self._picture = picture
        self._change()

    def close(self) -> None:
        """Draw no more; the last image stays."""
        self._closing.set()
        self._stale.set()
        self._thread.join()

    def _change(self) -> None:
        self._changed = time.monotonic()
        self._stale.set()

    def _keep_drawing(self) -> None:
        while self._stale.wait() and not self._closing.is_set():
            self._stale.clear()
            if self._picture is None:
                continue
            changing = time.monotonic() - self._changed < RESTS
            # A window may be so small that nothing can be seen in it; and viser warns of a browser that has just left.
            with suppress(GssegError, UserWarning):
                self._send(self._picture, QUICK_ROWS if changing else FINE_ROWS)
            if changing and not self._stale.wait(RESTS):
                self._stale.set()

    def _send(self, picture: Picture, rows: int) -> None:
        image = picture.draw(self._operator(picture.scene, rows))
        if self._closing.is_set():
            return
        self._client.scene.set_background_image(image, format="jpeg", jpeg_quality=_QUALITY)
        self._client.flush()

    def _operator(self, scene: GaussianScene, rows: int) -> ViewOperator:
        """Make the view operator for so many rows; while the camera rests, reuse the last one."""
        camera = self._camera_of(self._client, rows)
        known = self._known.get(rows)
        if known is None or not _alike(known.camera, camera):
            known = self._known[rows] = make_operator(scene, camera, self._device)
        return known


def _alike(a: Camera, b: Camera) -> bool:
    same = a.width == b.width and np.array_equal(a.K, b.K)
    return same and np.array_equal(a.world_to_camera, b.world_to_camera)
