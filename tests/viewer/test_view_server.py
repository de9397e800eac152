"""The viewer against foreign pages, hostile names and browsers that say what makes no sense."""

from __future__ import annotations

import http.client
import math
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from browser import opened_page
from labellings import labelled
from patience import PATIENCE, wait_until
from small_scenes import balls_on_a_table, clean_views

pytest.importorskip("viser")

import msgspec
import viser
import websockets.asyncio.server
import zstandard
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect

from gsseg_core.errors import SettingsError
from gsseg_core.viewer import answer as view_answer
from gsseg_core.viewer import server as view_server
from gsseg_core.viewer.access import listen
from gsseg_core.viewer.clients import SERVER
from gsseg_core.viewer.model import Labelling, ViewModel
from gsseg_core.viewer.viewer import Viewer
from gsseg_core.viewer.viewpoint import camera_of

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Locator


PORT = 18200

SCENE, TRUTH = balls_on_a_table()
PLAIN = {0: "background", 1: "red ball", 2: "mug", 3: "book"}
CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [0.0, 1.0, 0.0, 0.0],
    "position": [0.0, 0.0, 3.0],
    "fov": 1.0,
    "near": 0.01,
    "far": 1000.0,
    "image_height": 240,
    "image_width": 320,
    "look_at": [0.0, 0.0, 0.0],
    "up_direction": [0.0, 0.0, 1.0],
}
CLICK = {
    "type": "ScenePointerMessage",
    "event_type": "click",
    "ray_origin": [0.0, 0.0, 3.0],
    "ray_direction": [0.0, 0.0, -1.0],
    "screen_pos": [[0.5, 0.5]],
    "modifier": None,
}


def labelling(names: dict[int, str]) -> Labelling:
    return labelled(TRUTH.astype(np.int32), np.eye(4, dtype=np.float32)[TRUTH] * np.float32(0.9), names)


@contextmanager
def served(host: str = "127.0.0.1", names: dict[int, str] = PLAIN, **options: Any) -> Iterator[Viewer]:
    with closing(
        Viewer(ViewModel(SCENE, labelling(names)), listener=listen(host, PORT), draw=SERVER, **options)
    ) as viewer:
        yield viewer


@pytest.fixture(scope="module")
def viewer() -> Iterator[Viewer]:
    with served() as opened:
        yield opened


def port_of(viewer: Viewer) -> int:
    return int(viewer.server.get_port())


def status(viewer: Viewer, path: str = "/", **headers: str) -> tuple[int, http.client.HTTPMessage]:
    """Ask for the page at 127.0.0.1, under whatever name."""
    with closing(http.client.HTTPConnection("127.0.0.1", port_of(viewer), timeout=PATIENCE)) as connection:
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        answer.read()
        return answer.status, answer.headers


def connected(viewer: Viewer, host: str = "localhost", origin: str | None = None, **headers: str) -> ClientConnection:
    """Connect as a page does, to 127.0.0.1, under whatever name."""
    return connect(
        f"ws://{host}:{port_of(viewer)}",
        sock=socket.create_connection(("127.0.0.1", port_of(viewer))),
        origin=origin,  # type: ignore[arg-type]
        additional_headers=headers,
        subprotocols=[f"viser-v{viser.__version__}"],  # type: ignore[list-item]
        max_size=None,
        open_timeout=PATIENCE,
        max_queue=None,  # What is not read yet must not keep pings from being answered.
        ping_interval=None,
    )


def say(page: ClientConnection, message: dict[str, Any], **changes: Any) -> None:
    page.send(msgspec.msgpack.encode({**message, **changes}))


def heard(page: ClientConnection, kind: str, label: str | None = None) -> dict[str, Any]:
    """Wait for a message of a kind, that of the widget of this label."""
    deadline = time.monotonic() + PATIENCE
    while True:
        frame = page.recv(timeout=deadline - time.monotonic())
        assert isinstance(frame, bytes)
        packed = frame[16 : 16 + int.from_bytes(frame[8:16], "little")]
        for message in msgspec.msgpack.decode(zstandard.decompress(packed))["messages"]:
            if message["type"] == kind and label in (None, message.get("props", {}).get("label")):
                found: dict[str, Any] = message
                return found


def test_the_own_page_is_answered_and_may_load_and_connect_to_its_own_server_alone(viewer: Viewer) -> None:
    code, headers = status(viewer, Host=f"localhost:{port_of(viewer)}")
    policy = headers["Content-Security-Policy"]
    assert code == 200 and f"ws://localhost:{port_of(viewer)} " in policy and "frame-ancestors 'none'" in policy
    assert "http" not in policy and "*" not in policy
    with connected(viewer, origin=f"http://localhost:{port_of(viewer)}") as page:
        assert heard(page, "ReplayDoneMessage")


def test_a_name_that_was_made_to_point_here_gets_neither_page_nor_websocket(viewer: Viewer) -> None:
    assert status(viewer, Host=f"evil.example:{port_of(viewer)}")[0] == 403
    with pytest.raises(InvalidStatus, match="403"):
        connected(viewer, "evil.example", f"http://evil.example:{port_of(viewer)}")


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://localhost:3000"])
def test_a_foreign_page_gets_neither_page_nor_websocket(viewer: Viewer, origin: str) -> None:
    assert status(viewer, Origin=origin)[0] == 403
    with pytest.raises(InvalidStatus, match="403"):
        connected(viewer, origin=origin)
    assert not viewer.server.get_clients()


def test_other_machines_need_the_token_for_the_page_and_for_the_websocket() -> None:
    with served("0.0.0.0") as viewer:
        address, _, query = viewer.url.partition("/?")
        assert address == f"http://localhost:{port_of(viewer)}" and query.startswith("token=")
        assert status(viewer)[0] == status(viewer, "/?token=wrong")[0] == 403
        with pytest.raises(InvalidStatus, match="403"):
            connected(viewer, origin=address)
        code, headers = status(viewer, f"/?{query}")
        cookie = headers["Set-Cookie"].partition(";")[0]
        assert code == status(viewer, Cookie=cookie)[0] == 200
        with connected(viewer, origin=address, Cookie=cookie) as page:
            assert heard(page, "ReplayDoneMessage")
        with pytest.raises(InvalidStatus, match="403"):
            connected(viewer, origin="http://evil.example", Cookie=cookie)


def test_a_browser_without_a_height_is_answered_and_gets_images_once_it_has_one(
    viewer: Viewer, capfd: pytest.CaptureFixture[str]
) -> None:
    with connected(viewer) as page:
        say(page, CAMERA, image_height=0)
        say(page, CAMERA)
        assert heard(page, "BackgroundImageMessage")
        for sizes in ({"image_height": 0}, {"image_width": 0}):
            say(page, CAMERA, **sizes)
            # An answer asks for the camera, too.
            say(page, CLICK, ray_origin=[100.0] * 3, ray_direction=[1.0] * 3)
            assert "Nothing is there." in told(page)
            say(page, CLICK, ray_direction=(SCENE.means[0] - CAMERA["position"]).tolist())
            assert "Gaussian 0, " in told(page)
        say(page, CAMERA, position=[0.0, 0.1, 3.0])
        assert heard(page, "BackgroundImageMessage")
    assert capfd.readouterr() == ("", "")


def told(page: ClientConnection) -> str:
    """What the panel answers next."""
    while True:
        updates = heard(page, "GuiUpdateMessage")["updates"]
        if "content" in updates:
            return str(updates["content"])


@pytest.mark.parametrize(
    "message",
    [
        {**CAMERA, "image_height": 0},
        {**CAMERA, "image_height": -1},
        {**CAMERA, "image_height": "480"},
        {**CAMERA, "image_width": 10**7},
        {**CAMERA, "position": [math.nan, 0.0, 0.0]},
        {**CAMERA, "position": [0.0, 0.0]},
        {**CAMERA, "wxyz": [0.0] * 4},
        {**CAMERA, "fov": math.inf},
        {**CAMERA, "fov": 0.0},
        {**CAMERA, "look_at": None},
        {**CLICK, "ray_direction": [0.0] * 3},
        {**CLICK, "ray_direction": None},
        {**CLICK, "screen_pos": []},
        {**CLICK, "screen_pos": [[math.nan, 0.5]]},
        {**CLICK, "event_type": "rect-select"},
        {**CLICK, "event_type": "kick"},
        {"type": "GuiUpdateMessage", "uuid": "x", "updates": {"update_cb": []}},
        {"type": "GuiUpdateMessage", "uuid": "x", "updates": {"value": math.nan}},
        {"type": "GuiUpdateMessage", "uuid": "x", "updates": {"value": "x" * 10**5}},
        {"type": "GuiUpdateMessage", "uuid": "x", "updates": {"value": {"a": [1]}}},
        {"type": "GuiUpdateMessage", "uuid": 7},
        {"type": "ShareUrlRequest"},
        {"type": "FileTransferStartUpload", "source_component_uuid": "x"},
        {"type": "NoSuchMessage"},
        {"type": ["ViewerCameraMessage"]},
        {},
        [],
        None,
        "ViewerCameraMessage",
    ],
)
def test_what_makes_no_sense_is_not_heard(message: object) -> None:
    assert not view_server.understood(msgspec.msgpack.encode(message))


def test_what_pages_say_is_heard_and_what_is_no_message_is_not() -> None:
    good = [CAMERA, CLICK, {**CLICK, "event_type": "rect-select", "screen_pos": [[0.1, 0.1], [0.2, 0.2]]}]
    good += [{"type": "GuiUpdateMessage", "uuid": "x", "updates": {"value": value}} for value in (True, 1, 0.5, "a")]
    assert all(view_server.understood(msgspec.msgpack.encode(message)) for message in good)
    for data in (b"", b"\xff", b"\xc1", b"\x91" * 10**5, "text", msgspec.msgpack.encode(CAMERA)[:-1]):
        assert not view_server.understood(data)


def test_whatever_a_browser_says_the_viewer_answers_the_next_one(
    viewer: Viewer, capfd: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(3)
    bad = [math.nan, math.inf, -1, 0, 1e300, None, "x", [], {}, [math.nan] * 3, b"\0", True]
    handles = list(viewer.server.gui._gui_input_handle_from_uuid)
    with connected(viewer) as page:
        say(page, CAMERA)
        for _ in range(300):
            message: dict[str, Any] = dict([CAMERA, CLICK][rng.integers(2)])
            for key in rng.choice(list(message), rng.integers(1, 3)):
                message[str(key)] = bad[rng.integers(len(bad))]
            say(page, message)
            value = [math.nan, "nan", -5, 1e300, "junk", None, [], "x" * 5000][rng.integers(5)]
            if not isinstance(value, str):
                say(page, {"type": "GuiUpdateMessage", "uuid": str(rng.choice(handles)), "updates": {"value": value}})
            page.send(rng.bytes(int(rng.integers(0, 60))))
        page.send("text")
        say(page, {"type": "GuiUpdateMessage", "uuid": 1, "updates": {}}, pad="x" * 10**5)
        say(page, CLICK)
        say(page, CAMERA, position=[0.0, 0.2, 3.0])
        assert heard(page, "BackgroundImageMessage")
    with connected(viewer) as page:
        say(page, CAMERA)
        assert heard(page, "BackgroundImageMessage")
    assert "Traceback" not in capfd.readouterr().err


def test_names_that_look_alike_are_told_apart_in_the_list_of_classes() -> None:
    names = {0: "background", 1: "cup", 2: "cup", 3: "cup (2)", 4: "a" * 10**4 + "b", 5: "a" * 10**4 + "c", 6: "\x1b"}
    learnt = labelled(TRUTH.astype(np.int32), np.eye(7, dtype=np.float32)[TRUTH], names)
    viewer = Viewer(ViewModel(SCENE, learnt), listener=listen(port=PORT), draw=SERVER)
    with closing(viewer), connected(viewer) as page:
        options = heard(page, "GuiDropdownMessage", "class")["props"]["options"]
    assert options == ["background", "cup", "cup (2)", "cup (2) (3)", "a" * 80, "a" * 80 + " (5)", r"\x1b"]


def test_a_viser_that_cannot_be_guarded_does_not_stay_open(monkeypatch: pytest.MonkeyPatch) -> None:
    stopped: list[bool] = []

    class Other:
        """Starts its server in some other way."""

        def __init__(self, **_: object) -> None:
            pass

        def stop(self) -> None:
            stopped.append(True)

    monkeypatch.setattr(viser, "ViserServer", Other)
    refused = pytest.raises(SettingsError, match=r"cannot be guarded .*; expected a version")
    with closing(listen(port=PORT)) as listener, refused:
        view_server.start_server(listener)
    assert stopped == [True]


def test_a_browser_on_a_busy_machine_is_given_time(monkeypatch: pytest.MonkeyPatch) -> None:
    given: dict[str, Any] = {}
    monkeypatch.setattr(websockets.asyncio.server, "serve", lambda _, **options: given.update(options))
    with closing(listen(port=PORT)) as listener, view_server._guarding(listener):
        websockets.asyncio.server.serve(None, open_timeout=1)  # type: ignore[arg-type]
    assert given["open_timeout"] == given["ping_timeout"] == view_server.PATIENCE


class Asked(ThreadingHTTPServer):
    """A server of somebody else, which counts what it is asked for."""

    def __init__(self) -> None:
        asked = self.asked = list[str]()

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                asked.append(self.path)
                self.send_error(404)

            def log_message(self, *_: object) -> None:
                pass

        super().__init__(("127.0.0.1", 0), Handler)
        threading.Thread(target=self.serve_forever, daemon=True).start()

    def close(self) -> None:
        self.shutdown()
        self.server_close()


def test_markup_in_names_and_errors_runs_nothing_and_fetches_nothing(
    chromium: Browser, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(view_answer, "NOTICE", None)  # Where it closed by itself, a busy machine might look too late.
    with ExitStack() as stack:
        other = stack.enter_context(closing(Asked()))
        fetched = f"http://127.0.0.1:{other.server_address[1]}/fetched"
        script = "x<iframe srcdoc=\"<script>parent.document.title='hacked'</script>\">"
        names = {0: "background", 1: script, 2: f"<img src={fetched}>\x1b[31m\u202e", 3: f"![]({fetched})"}
        view = clean_views(1)[0]
        view = replace(view, camera=replace(view.camera, name=names[3]))
        viewer = stack.enter_context(served(names=names, views=[view]))
        page = stack.enter_context(opened_page(chromium, 960, 640, tolerated="computeBoundingSphere"))
        page.goto(viewer.url)
        wait_until(lambda: page.wait_for_timeout(50) or viewer.server.get_clients(), "the page")
        client = next(iter(viewer.server.get_clients().values()))
        for label in (1, 3):
            answer = page.locator("strong").get_by_text(names[label], exact=True)

            def answered(label: int = label, answer: Locator = answer) -> bool:
                camera = camera_of(client)
                ((x, y),), _ = camera.project(SCENE.means[label == TRUTH].mean(axis=0, keepdims=True))
                page.mouse.click(float(x), float(y))
                page.wait_for_timeout(100)
                return answer.is_visible()

            wait_until(answered, "the answer to a click")
            page.get_by_text(f"{names[3]}: {names[label]}, ").wait_for(timeout=1000 * PATIENCE)
        assert page.get_by_text(rf"<img src={fetched}>\x1b[31m\u202e").count()
        for name in (names[3], script):
            with viewer.panel.answer.telling(client):
                raise SettingsError(f"told of {name}")
            page.get_by_text(f"told of {name}").nth(1).wait_for(timeout=1000 * PATIENCE)
        assert page.title() != "hacked" and not page.locator("iframe").count() and not other.asked


def test_a_browser_with_the_printed_address_gets_the_page_and_one_without_the_token_does_not(chromium: Browser) -> None:
    with served("0.0.0.0") as viewer, opened_page(chromium, tolerated="403") as page:
        refused = page.goto(viewer.url.partition("?")[0])
        assert refused is not None and refused.status == 403 and "address that `gsseg view` printed" in page.content()
        page.goto(viewer.url)
        wait_until(lambda: page.wait_for_timeout(50) or viewer.server.get_clients(), "the page")


def test_an_address_that_makes_the_page_connect_elsewhere_does_not(chromium: Browser, viewer: Viewer) -> None:
    with closing(Asked()) as other, closing(chromium.new_page()) as page:  # It complains, and should.
        page.set_default_timeout(1000 * PATIENCE)
        said: list[str] = []
        page.on("console", lambda message: said.append(message.text))
        port = other.server_address[1]
        for query, sign in (
            (f"websocket=ws://127.0.0.1:{port}", "websocket is not connected"),
            (f"playbackPath=http://127.0.0.1:{port}/a.viser", "violates"),
        ):
            page.goto(f"{viewer.url}/?{query}")
            wait_until(lambda sign=sign: page.wait_for_timeout(50) or any(sign in text for text in said), sign)  # type: ignore[misc]
        assert not other.asked
