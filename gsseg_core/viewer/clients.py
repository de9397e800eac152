"""Renders for every browser: sends it splats to draw, or images that are drawn here, whichever is faster."""

from __future__ import annotations

import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import viser
import viser.transforms as vtf

from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.viewer.picture import Picture
from gsseg_core.viewer.server_frames import CameraOf, Frames
from gsseg_core.viewer.splats import SplatNodes, Splats

AUTO, BROWSER, SERVER = "auto", "browser", "server"
DRAWN_BY = (AUTO, BROWSER, SERVER)
"""Who draws: each browser, this program, or whoever is faster."""

SLOW = 0.3
"""Seconds more that splats may take a browser than a picture without them."""

_TRIAL, _TRIAL_SIZE = 2500, 0.1
"""Splats of the trial, and their standard deviation as a part of half the picture's height."""

_FAINT = 2
"""Opacity of the trial, of 255: it is drawn like all others, and hardly seen."""

# A browser may leave while its picture is made. That is no news.
warnings.filterwarnings("ignore", message="Queued a .* on a closed connection", category=UserWarning)

_PATIENCE = 60.0
_SMALL = (48, 64)


class ClientRenderer:
    """Renders for one browser: by the splats that it draws itself, or by images that are drawn here.

    Parameters
    ----------
    client : viser.ClientHandle
        The browser.
    splats : Splats
        What it may draw.
    camera_of : CameraOf
        Where it looks from.
    drawn_by : str
        One of `DRAWN_BY`.
    device : str
        Where images are drawn.
    """

    def __init__(
        self, client: viser.ClientHandle, splats: Splats, camera_of: CameraOf, drawn_by: str, device: str
    ) -> None:
        self._client, self._splats = client, splats
        self._lock = threading.Lock()
        self._picture: Picture | None = None
        self._nodes = SplatNodes(client, splats) if drawn_by == BROWSER else None
        self._frames = Frames(client, camera_of, device) if drawn_by != BROWSER else None

    @property
    def bytes_sent(self) -> int:
        """Bytes of Gaussians sent, before compression."""
        return self._nodes.bytes_sent if self._nodes else 0

    @property
    def draws(self) -> bool:
        """Whether the browser draws by itself."""
        return self._nodes is not None

    def show(self, picture: Picture) -> None:
        """Show a picture from now on."""
        with self._lock:
            self._picture = picture
            if self._nodes:
                self._nodes.show(picture.nodes)
            if self._frames:
                self._frames.show(picture)

    def send_splats(self) -> None:
        """Have the browser draw by itself, before the images that it gets."""
        with self._lock:
            self._nodes = SplatNodes(self._client, self._splats)
            if self._picture:
                self._nodes.show(self._picture.nodes)

    def take_splats_back(self) -> None:
        """Leave the browser with images alone."""
        with self._lock:
            if self._nodes:
                self._nodes.show({})
            self._nodes = None

    def stop_images(self) -> None:
        """Leave the browser with what it draws by itself."""
        self.close()
        self._client.scene.set_background_image(None)
        self._client.flush()

    def close(self) -> None:
        """Send no more images."""
        with self._lock:
            frames, self._frames = self._frames, None
        if frames:
            frames.close()


class ClientRenderers:
    """Renders for all browsers that are connected to a server.

    Parameters
    ----------
    server : viser.ViserServer
        To which they connect.
    scene : GaussianScene
        What they look at.
    camera_of : CameraOf
        Where one looks from.
    drawn_by : str
        One of `DRAWN_BY`. In `AUTO`, a browser gets images until it has shown that it draws fast.
    device : str
        Where images are drawn.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        scene: GaussianScene,
        camera_of: CameraOf,
        drawn_by: str = AUTO,
        device: str = "cpu",
    ) -> None:
        self._splats, self._camera_of, self._drawn_by, self._device = Splats(scene), camera_of, drawn_by, device
        self._lock = threading.Lock()
        self._renderers: dict[int, ClientRenderer] = {}
        self._picture: Picture | None = None
        server.on_client_connect(self._join)
        server.on_client_disconnect(self._leave)

    @property
    def bytes_sent(self) -> int:
        """Bytes of Gaussians sent to the browsers of now, before compression."""
        return sum(renderer.bytes_sent for renderer in self._all())

    @property
    def drawing(self) -> int:
        """Count the browsers that draw by themselves."""
        return sum(renderer.draws for renderer in self._all())

    def show(self, picture: Picture) -> None:
        """Show a picture from now on."""
        with self._lock:
            self._picture = picture
            for renderer in self._renderers.values():
                renderer.show(picture)

    def close(self) -> None:
        """Send nothing more."""
        for renderer in self._all():
            renderer.close()

    def _all(self) -> list[ClientRenderer]:
        with self._lock:
            return list(self._renderers.values())

    def _join(self, client: viser.ClientHandle) -> None:
        renderer = ClientRenderer(client, self._splats, self._camera_of, self._drawn_by, self._device)
        with self._lock:
            self._renderers[client.client_id] = renderer
            if self._picture:
                renderer.show(self._picture)
        if self._drawn_by == AUTO:
            try:
                self._decide(client, renderer)
            except (RuntimeError, TimeoutError, OSError, ValueError):  # It has left, or cannot even draw the trial.
                return

    def _leave(self, client: viser.ClientHandle) -> None:
        with self._lock:
            renderer = self._renderers.pop(client.client_id, None)
        if renderer:
            renderer.close()

    @staticmethod
    def _decide(client: viser.ClientHandle, renderer: ClientRenderer) -> None:
        alone = time_of_picture(client)
        with trial(client):
            slow = time_of_picture(client) - alone > SLOW
        if not slow:
            renderer.send_splats()
            slow = time_of_picture(client) - alone > SLOW
            renderer.take_splats_back() if slow else renderer.stop_images()
        if slow:
            client.add_notification(
                "The server draws",
                "This browser draws slowly, as without a GPU, so it gets images. `--draw browser` leaves it to itself.",
                auto_close_seconds=8.0,
            )


def time_of_picture(client: viser.ClientHandle) -> float:
    """Seconds that a browser takes to draw what it has now, and to send a small image of that.

    Raises
    ------
    RuntimeError, TimeoutError
        The browser has left, or does not answer.
    """
    for _ in range(2):  # The first may be without what has just been sent: splats are sorted beside the drawing.
        start = time.monotonic()
        client.get_render(*_SMALL, timeout=_PATIENCE)
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
