"""Renders for every browser: sends it splats to draw, or images that are drawn here, whichever is faster."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass

import numpy as np
import viser
import viser.transforms as vtf

from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.viewer.picture import Picture
from gsseg_core.viewer.server_frames import Frames
from gsseg_core.viewer.splats import SplatNodes, Splats

AUTO, BROWSER, SERVER = "auto", "browser", "server"
DRAWN_BY = (AUTO, BROWSER, SERVER)  # who draws: each browser, this program, or whoever is faster
SLOW = 0.3  # seconds more that splats may take a browser than a picture without them
_TRIAL, _TRIAL_SIZE = 2500, 0.1  # splats of the trial, and their standard deviation in halves of the picture's height
_FAINT = 2  # opacity of the trial, of 255: it is drawn like all others, and hardly seen
NOTICE: float | None = 8.0  # seconds for which a browser is told why it gets images; None: until closed
_PATIENCE = 60.0  # seconds for a browser to draw a picture
_SMALL = (48, 64)  # rows and columns of the image of it that it sends


@dataclass
class ClientRenderer:
    """Renders for one browser, which draws by itself, gets images, or both."""

    nodes: SplatNodes | None  # what it draws by itself
    frames: Frames | None  # the images that it gets

    def show(self, picture: Picture) -> None:
        """Show a picture from now on."""
        frames = self.frames  # It may be closed by another thread.
        if self.nodes:
            self.nodes.show(picture.nodes)
        if frames:
            frames.show(picture)

    def close(self) -> None:
        """Send no more images."""
        frames, self.frames = self.frames, None
        if frames:
            frames.close()


class ClientRenderers:
    """Renders for all browsers that are connected to a server.

    `drawn_by` is one of `DRAWN_BY`: in `AUTO`, a browser gets images until it has shown that it draws fast. `device` is
    where images are drawn.
    """

    def __init__(self, server: viser.ViserServer, scene: GaussianScene, drawn_by: str, device: str) -> None:
        self._server, self._splats, self._drawn_by, self._device = server, Splats(scene), drawn_by, device
        self._lock = threading.Lock()
        self._picture: Picture | None = None
        self.by_client: dict[int, ClientRenderer] = {}  # the browsers of now, by viser's id
        server.on_client_connect(self._join)
        server.on_client_disconnect(self._leave)

    def show(self, picture: Picture) -> None:
        """Show a picture from now on."""
        with self._lock:
            self._picture = picture
            for renderer in self.by_client.values():
                renderer.show(picture)

    def close(self) -> None:
        """Send nothing more."""
        for renderer in list(self.by_client.values()):
            renderer.close()

    def _join(self, client: viser.ClientHandle) -> None:
        nodes = SplatNodes(client, self._splats) if self._drawn_by == BROWSER else None
        renderer = ClientRenderer(nodes, Frames(client, self._device) if nodes is None else None)
        with self._lock:
            self.by_client[client.client_id] = renderer
            if self._picture:
                renderer.show(self._picture)
        if client.client_id not in self._server.get_clients():
            self._leave(client)  # Once more: it may have left before it was known here.
        elif self._drawn_by == AUTO:
            with suppress(RuntimeError, OSError, ValueError):  # It has left.
                self._decide(client, renderer)

    def _leave(self, client: viser.ClientHandle) -> None:
        with self._lock:
            renderer = self.by_client.pop(client.client_id, None)
        if renderer:
            renderer.close()

    def _decide(self, client: viser.ClientHandle, renderer: ClientRenderer) -> None:
        """Try how fast a browser draws, first a few splats and then all, and have it draw or tell it why not."""
        alone = time_of_picture(client)
        with trial(client):
            fast = time_of_picture(client) - alone <= SLOW
        if fast:
            with self._lock:
                renderer.nodes = nodes = SplatNodes(client, self._splats)
                if self._picture:
                    nodes.show(self._picture.nodes)
            if time_of_picture(client) - alone <= SLOW:
                renderer.close()
                client.scene.set_background_image(None)
                client.flush()
                return
            with self._lock:
                nodes.show({})
                renderer.nodes = None
        client.add_notification(
            "The server draws",
            "This browser draws slowly, as without a GPU, so the server sends it images. "
            "`--draw browser` prevents that.",
            auto_close_seconds=NOTICE,
        )


def time_of_picture(client: viser.ClientHandle) -> float:
    """Seconds that a browser takes to draw what it has now, and to send a small image of that; NaN if it gives none.

    Raises `RuntimeError` where the browser has left.
    """
    for _ in range(2):  # The first may be without what has just been sent: splats are sorted beside the drawing.
        start = time.monotonic()
        try:
            client.get_render(*_SMALL, timeout=_PATIENCE)
        except TimeoutError:
            return math.nan
    return time.monotonic() - start


@contextmanager
def trial(client: viser.ClientHandle) -> Iterator[None]:
    """Put some splats before a browser, so faint that nobody sees them, and take them away again."""
    camera, rng = client.camera, np.random.default_rng(0)
    half = np.tan(camera.fov / 2)
    there = np.column_stack([rng.uniform(-half, half, (_TRIAL, 2)) * (camera.aspect, 1), np.ones(_TRIAL)])
    node = client.scene.add_gaussian_splats(
        "/trial",
        centers=(camera.position + there @ vtf.SO3(camera.wxyz).as_matrix().T).astype(np.float32),
        covariances=np.tile(np.eye(3, dtype=np.float32) * (_TRIAL_SIZE * half) ** 2, (_TRIAL, 1, 1)),
        rgbs=np.zeros((_TRIAL, 3), np.uint8),
        opacities=np.full((_TRIAL, 1), _FAINT, np.uint8),
    )
    try:
        yield
    finally:
        node.remove()
        client.flush()
