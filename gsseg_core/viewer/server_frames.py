"""Renders images on the server for browsers that draw splats slowly."""

from __future__ import annotations

import threading

import numpy as np
import viser

from gsseg_core.errors import explained
from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.view_operator import ViewOperator
from gsseg_core.scene.camera import Camera
from gsseg_core.viewer.picture import Picture
from gsseg_core.viewer.viewpoint import camera_of

FINE_ROWS, QUICK_ROWS = 720, 320  # rows of an image, at most, once nothing changes any more, and until then
RESTS = 0.2  # seconds without a change after which an image is drawn finely
_QUALITY = 90  # of JPEG, of 100


class Frames:
    """Renders images for one browser: a new one whenever its camera moves or the picture changes.

    A change is answered by a coarse image at once, and by a fine one when no other has followed. What has become
    outdated while an image was drawn is left out, so the browser is never more than one image behind.
    """

    def __init__(self, client: viser.ClientHandle, device: str = "cpu") -> None:
        self._client, self._device = client, device
        self._picture: Picture | None = None
        self._operators: dict[int, ViewOperator] = {}
        self._stale, self._closing = threading.Event(), threading.Event()
        client.camera.on_update(lambda camera: self._stale.set())
        self._thread = threading.Thread(target=self._keep_drawing, name="frames", daemon=True)
        self._thread.start()

    def show(self, picture: Picture) -> None:
        """Show a picture from now on."""
        self._picture = picture
        self._stale.set()

    def close(self) -> None:
        """Draw no more; the last image stays."""
        self._closing.set()
        self._stale.set()
        self._thread.join()
        self._operators.clear()  # viser's handle and this refer to each other: only a search for circles frees the two.

    def _keep_drawing(self) -> None:
        while self._stale.wait() and not self._closing.is_set():
            self._stale.clear()
            if self._picture is None:
                continue
            self._send(self._picture, QUICK_ROWS)
            if not self._stale.wait(RESTS):
                self._send(self._picture, FINE_ROWS)

    def _send(self, picture: Picture, rows: int) -> None:
        # A window may be so small that nothing can be seen in it; and viser warns of a browser that has just left. An
        # image for which memory runs out is left out: the next one may be drawn.
        try:
            self._draw(picture, rows)
        except Exception as error:
            if explained(error) is None and not isinstance(error, UserWarning):
                raise

    def _draw(self, picture: Picture, rows: int) -> None:
        camera, operator = camera_of(self._client, rows), self._operators.get(rows)
        # While the camera rests, the last one will do.
        if operator is None or not _alike(operator.camera, camera):
            operator = self._operators[rows] = make_operator(picture.scene, camera, self._device)
        image = picture.draw(operator)
        if not self._closing.is_set():
            self._client.scene.set_background_image(image, format="jpeg", jpeg_quality=_QUALITY)
            self._client.flush()


def _alike(a: Camera, b: Camera) -> bool:
    return np.array_equal(a.K, b.K) and np.array_equal(a.world_to_camera, b.world_to_camera)
