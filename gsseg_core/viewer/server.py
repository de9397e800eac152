"""Starts viser's server on a guarded socket, and drops messages that the viewer has no use for.

viser checks neither who asks nor what a browser sends. It starts a server of the package `websockets`, and gets one
that checks both first. Where another version of viser starts its server in another way, the viewer does not start.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import gzip
import inspect
import io
import logging
import math
import threading
import warnings
from collections.abc import Callable, Iterator
from http import HTTPStatus
from typing import Any

import msgspec
import viser
import websockets.asyncio.server
from viser import _messages
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.http11 import Request, Response
from websockets.typing import Data

from gsseg_core.errors import SettingsError
from gsseg_core.viewer.access import Listener

MOST_BYTES = 2**20  # of one message from a browser; the largest is a small picture
LARGEST_WINDOW = 2**14  # pixels of a browser's picture, each way, at most
PATIENCE = 60.0  # seconds for a browser to say what it wants once it is connected, and to show that it is still there
_LARGEST_NUMBER, _LONGEST_TEXT = 1e9, 1000
_SOON = 0.02  # seconds until it is looked again whether the server is made

_HEARD = ("ViewerCameraMessage", "ScenePointerMessage", "GuiUpdateMessage", "GetRenderResponseMessage")
"""What a page sends that the viewer has a use for. viser itself would also take files, and open itself to everybody."""

_TAPS = b"""<script>addEventListener("pointerdown", (event) => {
  const { target, pointerId } = event;
  if (target.tagName === "CANVAS" && target.hasPointerCapture(pointerId)) target.releasePointerCapture(pointerId);
}, true);</script>"""
"""A browser gives a finger to what it touches from the beginning, and viser takes that for a drag of its own."""


def _tells_more(record: logging.LogRecord) -> bool:
    """Whether it says more than that somebody connected who is no browser, or left at once, as browsers do, too."""
    harmless = InvalidHandshake, ConnectionClosed, ConnectionError
    return not (record.exc_info and isinstance(record.exc_info[1], harmless))


_log = logging.getLogger(__name__)  # of the package `websockets`, which has a traceback for each of these
_log.addFilter(_tells_more)


def start_server(listener: Listener) -> viser.ViserServer:
    """Start viser's server on a listener, which has to stay open as long as the server runs.

    Raises `SettingsError` where this version of viser does not let itself be guarded.
    """
    # What is sent to a browser in the moment in which it leaves is nothing that people could mend.
    warnings.filterwarnings("ignore", "Queued a .* on a closed connection", UserWarning)
    # viser draws a box with its address whatever `verbose` says.
    with _guarding(listener) as guarded, contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host="127.0.0.1", port=listener.port, label="gsseg", verbose=False)
        if guarded.is_set() and all(hasattr(_messages, name) for name in _HEARD):
            return server
        server.stop()
    raise SettingsError(
        f"viser {viser.__version__} cannot be guarded against foreign pages; expected a version like 1.1, "
        "in which that works: pip install 'viser~=1.1'"
    )


@contextlib.contextmanager
def _guarding(listener: Listener) -> Iterator[threading.Event]:
    """Have the server that viser starts meanwhile guarded, and answer at the end; the event is set once it has."""
    real, guarded, over = websockets.asyncio.server.serve, threading.Event(), threading.Event()

    def serve(handler: Any, *_: object, process_request: Any = None, **options: Any) -> Any:
        async def process(connection: ServerConnection, request: Request) -> Response | None:
            asked = request.path, request.headers.get_all
            refusal = listener.refusal(*asked)
            if refusal is not None:
                return connection.respond(HTTPStatus.FORBIDDEN, f"gsseg: {refusal}\n")
            while not over.is_set():  # A page of an earlier viewer comes at once, before viser knows how to answer it.
                await asyncio.sleep(_SOON)
            response = process_request(connection, request)
            answer: Response | None = await response if inspect.isawaitable(response) else response
            if answer is not None:
                _let_tap(answer)
                answer.headers.update(listener.headers(*asked))
            return answer

        guarded.set()
        ours = {"sock": listener.socket, "create_connection": _Connection, "max_size": MOST_BYTES}
        ours |= {"open_timeout": PATIENCE, "ping_timeout": PATIENCE, "logger": _log}
        return real(handler, process_request=process, **{**options, **ours})

    websockets.asyncio.server.serve = serve  # type: ignore[assignment, misc]
    try:
        yield guarded
    finally:
        websockets.asyncio.server.serve = real  # type: ignore[misc]
        over.set()


def _let_tap(answer: Response) -> None:
    """Have the page, if it is what is sent, tell of taps as of clicks."""
    if answer.headers.get("Content-Type", "").startswith("text/html"):
        answer.body = _with_taps(bytes(answer.body), answer.headers.get("Content-Encoding") == "gzip")
        del answer.headers["Content-Length"]
        answer.headers["Content-Length"] = str(len(answer.body))


@functools.lru_cache(maxsize=2)
def _with_taps(page: bytes, zipped: bool) -> bytes:
    return gzip.compress(gzip.decompress(page) + _TAPS) if zipped else page + _TAPS


def understood(data: Any) -> bool:
    """Whether the bytes of a browser's message are one that the viewer can use.

    Not so where it is no message that a page of ours sends, has other fields or types than viser says, or numbers that
    mean nothing: NaN, infinities, a window without a height, a direction of no length.
    """
    try:
        content = msgspec.msgpack.decode(data)
        kind = content["type"]
        if kind not in _HEARD or not _is_sane(content):
            return False
        message = msgspec.convert(content, getattr(_messages, kind))
    except (msgspec.MsgspecError, TypeError, KeyError, ValueError, RecursionError):
        return False
    return _CHECKS[kind](message) if kind in _CHECKS else True


def _is_sane(content: object) -> bool:
    if isinstance(content, dict):
        return all(map(_is_sane, content)) and all(map(_is_sane, content.values()))
    if isinstance(content, list):
        return all(map(_is_sane, content))
    if isinstance(content, str):
        return len(content) <= _LONGEST_TEXT
    if isinstance(content, (int, float)):
        return math.isfinite(content) and abs(content) <= _LARGEST_NUMBER
    return content is None or isinstance(content, bytes)


def _sees(camera: _messages.ViewerCameraMessage) -> bool:
    sides = (camera.image_width, camera.image_height)
    return (
        all(0 < side <= LARGEST_WINDOW for side in sides)
        and 0.5 < math.hypot(*camera.wxyz) < 2
        and 1e-3 < camera.fov < math.pi - 1e-3
        and 0 < camera.near < camera.far
    )


def _points(pointer: _messages.ScenePointerMessage) -> bool:
    if pointer.event_type != "click":
        return len(pointer.screen_pos) == 2
    ray = pointer.ray_origin is not None and pointer.ray_direction is not None
    return ray and len(pointer.screen_pos) == 1 and math.hypot(*pointer.ray_direction or ()) > 1e-6


def _sets(update: _messages.GuiUpdateMessage) -> bool:
    return set(update.updates) == {"value"} and isinstance(update.updates["value"], (bool, int, float, str))


_CHECKS: dict[str, Callable[[Any], bool]] = {
    "ViewerCameraMessage": _sees, "ScenePointerMessage": _points, "GuiUpdateMessage": _sets
}  # fmt: skip


class _Connection(ServerConnection):
    """A connection that drops the messages for which `understood` is false."""

    async def recv(self, decode: bool | None = None) -> Data:  # type: ignore[override]
        while True:
            data = await super().recv(decode)
            if understood(data):
                return data
