"""How the viewer begins and ends: pages that are still open, browsers that have left, and a node that is gone."""

from __future__ import annotations

import socket
import threading
from contextlib import closing, redirect_stdout
from io import StringIO
from unittest.mock import MagicMock

import pytest
from patience import PATIENCE
from small_scenes import NAMES, balls_on_a_table

pytest.importorskip("viser")

from viser.infra._infra import WebsockServer

from gsseg_core.viewer import viewer as viewer_module
from gsseg_core.viewer.access import listen
from gsseg_core.viewer.clients import SERVER, ClientRenderers
from gsseg_core.viewer.live_source import LiveUpdate
from gsseg_core.viewer.model import Labelling, ViewModel
from gsseg_core.viewer.server import start_server
from gsseg_core.viewer.viewer import Viewer

SCENE, _ = balls_on_a_table()


def test_nothing_is_drawn_for_a_browser_that_left_before_it_was_known() -> None:
    server, client = MagicMock(), MagicMock()
    server.get_clients.return_value = {}
    renderers = ClientRenderers(server, SCENE, SERVER, "cpu")
    renderers._leave(client)
    renderers._join(client)
    assert not renderers.by_client


def test_a_page_that_is_still_open_connects_to_the_next_viewer_once_that_is_made(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    real, listener = WebsockServer.start, listen(port=18310)
    page = socket.create_connection(("127.0.0.1", listener.port))

    def start(server: WebsockServer) -> None:
        real(server)
        asked = {"Host": f"127.0.0.1:{listener.port}", "Upgrade": "websocket", "Connection": "Upgrade"}
        asked |= {"Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==", "Sec-WebSocket-Version": "13"}
        lines = ["GET / HTTP/1.1", *(f"{name}: {value}" for name, value in asked.items()), "", ""]
        page.sendall("\r\n".join(lines).encode())
        page.settimeout(0.3)
        with pytest.raises(TimeoutError):
            page.recv(1)  # What viser would do with it needs what it has not made yet.

    monkeypatch.setattr(WebsockServer, "start", start)
    with closing(listener), closing(page):
        server = start_server(listener)
        try:
            page.settimeout(PATIENCE)
            assert page.recv(12) == b"HTTP/1.1 101"
        finally:
            with redirect_stdout(StringIO()):
                server.stop()


def test_to_close_does_not_wait_for_the_answer_of_a_node_that_is_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    class Source:
        """Waits until it is closed, and then raises what a closed connection does."""

        def __init__(self) -> None:
            self.asked, self.closed = threading.Event(), threading.Event()

        def wait(self, timeout: float) -> LiveUpdate | None:
            self.asked.set()
            assert self.closed.wait(PATIENCE), "nobody closes it"
            raise RuntimeError("it is closed")

        def close(self) -> None:
            self.closed.set()

    monkeypatch.setattr(viewer_module, "SOURCE_SECONDS", 0.01)
    source = Source()
    model = ViewModel(SCENE, Labelling.unknown(len(SCENE), NAMES))
    with closing(Viewer(model, source=source, listener=listen(port=18300), draw=SERVER)):
        assert source.asked.wait(PATIENCE)
