"""Access to the viewer: opens the socket that it listens on, and decides which requests it answers.

Any page in a browser can send requests to this machine and its neighbours. So the viewer answers only requests whose
Host is one of its own names, against DNS rebinding, and whose Origin is its own page, against requests across sites.
Where others than this machine's users can reach it, a token is asked for, too.
"""

from __future__ import annotations

import errno
import hmac
import ipaddress
import queue
import re
import secrets
import socket
import threading
from collections.abc import Callable, Sequence
from typing import Any
from urllib.parse import parse_qs

from gsseg_core.errors import SettingsError
from gsseg_core.text import printable

PATIENCE = 5.0  # seconds to find out what the name of a host means, at most
MOST_TRIED = 1000  # ports that are tried, one after the other
_LOOPBACK_NAMES = ("localhost", "127.0.0.1", "[::1]")
_HOST = re.compile(r"(\[[0-9a-f:.]+\]|[a-z0-9._-]+)(:[0-9]{1,5})?")

_WHY_NOT = {
    errno.EADDRNOTAVAIL: "it is no address of this machine; expected one, or 127.0.0.1, or 0.0.0.0 for all of them, "
    "see --host",
    errno.EACCES: "that is not allowed; expected a port above 1023, see --port",
}

HeaderValues = Callable[[str], Sequence[str]]  # all values of a header in a request, by its name


class Listener:
    """Listens on a socket that was opened for a host as the user gave it, and checks requests; close it at last."""

    def __init__(self, opened: socket.socket, host: str) -> None:
        self.socket, self._host = opened, host
        address, self.port = opened.getsockname()[:2]
        ip = ipaddress.ip_address(address.partition("%")[0])
        self.everywhere = ip.is_unspecified  # whether it listens at all addresses of this machine
        # What a browser must show; None where only this machine can connect.
        self.token = None if ip.is_loopback else secrets.token_urlsafe(16)

    def close(self) -> None:
        """Listen no more."""
        self.socket.close()

    @property
    def url(self) -> str:
        """Where to look, the token included."""
        name = "localhost" if self.everywhere or self._host == "127.0.0.1" else _in_url(self._host)
        return f"http://{name}:{self.port}" + (f"/?token={self.token}" if self.token else "")

    def refusal(self, path: str, values: HeaderValues) -> str | None:
        """Say why a request for a path, query included, is not answered, for a page or a websocket; None if it is."""
        host = _only(values("Host"))
        if host is None or not self._is_called(host):
            return (
                f"Host is {printable(str(host))[:80]}; expected {' or '.join(self._names())}, "
                "or what `gsseg view` was told with --host."
            )
        # A browser sends it with every websocket and with every request of a foreign page that could do harm.
        origins = values("Origin")
        if origins and _only(origins) not in (f"http://{host}", f"https://{host}"):
            return f"Origin is {printable(origins[0])[:80]}; expected the page of the viewer itself."
        if self.token and not self._shows_token(path, values):
            return "The token is missing or wrong; expected the whole address that `gsseg view` printed."
        return None

    def headers(self, path: str, values: HeaderValues) -> dict[str, str]:
        """Make the headers of every page that is sent: what it may load and connect to, and who may show it.

        That is its own server alone: viser's page connects to any that its address names, as `?websocket=...`.
        """
        host = _only(values("Host"))
        own = "'self' data: blob:"
        sent = {
            "Content-Security-Policy": f"default-src {own} 'unsafe-inline' 'unsafe-eval'; "
            f"connect-src {own} ws://{host} wss://{host}; frame-src 'none'; object-src 'none'; "
            "frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
            "Cross-Origin-Resource-Policy": "same-origin",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
        }
        if self.token and _is(self.token, _tokens(path)):
            # The page's websocket has another address, without the query.
            sent["Set-Cookie"] = f"{self._cookie}={self.token}; Path=/; HttpOnly; SameSite=Strict"
        return sent

    @property
    def _cookie(self) -> str:
        return f"gsseg-{self.port}"  # Cookies do not know ports, and there may be several viewers.

    def _names(self) -> list[str]:
        return list(dict.fromkeys([*_LOOPBACK_NAMES, _in_url(self._host).lower()]))

    def _is_called(self, host: str) -> bool:
        """Whether a name and port are its own. The port may be another one: it may have been forwarded, as by ssh."""
        matched = _HOST.fullmatch(host.lower())
        if not matched:
            return False
        name = matched[1]
        if name in self._names():
            return True
        # Nobody can make an address, or the name of this machine, mean something else; and the token is asked for.
        machine = socket.gethostname().lower().partition(".")[0]
        return self.token is not None and (name.partition(".")[0] == machine or _is_address(name))

    def _shows_token(self, path: str, values: HeaderValues) -> bool:
        assert self.token is not None
        shown = _tokens(path)
        for cookie in ";".join(values("Cookie")).split(";"):
            name, _, value = cookie.strip().partition("=")
            if name == self._cookie:
                shown.append(value)
        return _is(self.token, shown)


def listen(host: str = "127.0.0.1", port: int = 8080) -> Listener:
    """Listen at a name or address of this machine; if the port is taken, at the next one that is free.

    Raises `SettingsError` where the host is not known or not this machine's, or no port is free or allowed. That takes
    ten seconds at most.
    """
    if not 0 < port < 2**16:
        raise SettingsError(f"port is {port}; expected 1 to 65535")
    family, place = _resolved(host)
    last = min(port + MOST_TRIED, 2**16) - 1
    for candidate in range(port, last + 1):
        try:
            return Listener(socket.create_server((place[0], candidate, *place[2:]), family=family), host)
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                continue
            why = _WHY_NOT.get(error.errno or 0, f"{error.strerror}; expected an address of this machine, see --host")
            raise SettingsError(f"cannot listen at {printable(host)}, port {candidate}: {why}") from error
    raise SettingsError(
        f"cannot listen at {printable(host)}: ports {port} to {last} are all taken; expected a free one, see --port"
    )


def _resolved(host: str) -> tuple[int, tuple[Any, ...]]:
    """Address family and socket address of a host, of which the second entry is to be a port."""
    answers: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def ask() -> None:
        try:
            answers.put(socket.getaddrinfo(host or "\0", None, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE))
        except (OSError, ValueError) as error:
            answers.put(error)

    threading.Thread(target=ask, name="host name", daemon=True).start()  # It may take minutes, and cannot be ended.
    try:
        answer = answers.get(timeout=PATIENCE)
    except queue.Empty:
        answer = None
    if not isinstance(answer, list):
        why = f"has no answer after {PATIENCE:g} s" if answer is None else "is not known"
        raise SettingsError(
            f"host {printable(host)!r} {why}; expected a name or an address of this machine, such as 127.0.0.1, or "
            "0.0.0.0 for all of them"
        )
    family, _, _, _, place = answer[0]
    return family, place


def _tokens(path: str) -> list[str]:
    """Find what the query of a path, which may be any text, gives for tokens."""
    return parse_qs(path.partition("?")[2]).get("token", [])


def _only(values: Sequence[str]) -> str | None:
    return values[0] if len(values) == 1 else None


def _is(token: str, shown: Sequence[str]) -> bool:
    return any(hmac.compare_digest(token.encode(), one.encode("utf-8", "replace")) for one in shown)


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name.strip("[]"))
    except ValueError:
        return False
    return True


def _in_url(host: str) -> str:
    return f"[{host}]" if ":" in host else host
