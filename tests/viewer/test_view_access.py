"""Who may look: which requests are answered, and addresses at which one cannot listen."""

from __future__ import annotations

import errno
import socket
import threading
from collections.abc import Callable, Sequence
from contextlib import closing, suppress

import pytest
from patience import PATIENCE

from gsseg_core.cli.main import main
from gsseg_core.errors import SettingsError
from gsseg_core.viewer import access as view_access
from gsseg_core.viewer.access import Listener, listen

PORT = 18300


def values(**headers: str | Sequence[str]) -> Callable[[str], Sequence[str]]:
    """Headers of a request, each once or as often as it is given."""
    listed = {name: [value] if isinstance(value, str) else list(value) for name, value in headers.items()}
    return lambda name: listed.get(name, [])


def test_this_machine_is_answered_under_each_of_its_names_and_through_a_forwarded_port() -> None:
    with closing(listen(port=PORT)) as listener:
        assert listener.token is None and listener.url == f"http://localhost:{listener.port}"
        for host in (
            f"localhost:{listener.port}",
            f"127.0.0.1:{listener.port}",
            "[::1]:9000",
            "LOCALHOST",
            "localhost",
        ):
            assert listener.refusal("/", values(Host=host)) is None
            assert listener.refusal("/", values(Host=host, Origin=f"http://{host}")) is None
        assert listener.refusal("/", values(Host="localhost:80", Origin="https://localhost:80")) is None


@pytest.mark.parametrize(
    "host",
    [
        "evil.example:8080",
        "localhost.evil.example",
        "192.168.1.7:8080",
        "",
        "a@localhost",
        "localhost:8080/",
        "[::1",
        "\x1b",
    ],
)
def test_a_name_that_is_not_its_own_is_refused_so_that_nobody_can_make_theirs_point_here(host: str) -> None:
    with closing(listen(port=PORT)) as listener:
        refusal = listener.refusal("/", values(Host=host))
        assert refusal is not None and "expected localhost" in refusal and refusal.isprintable()
        assert listener.refusal("/", values()) and listener.refusal("/", values(Host=["localhost", "localhost"]))


@pytest.mark.parametrize(
    "origin",
    ["http://evil.example", "null", "http://localhost:3000", "http://localhost", "file://", "", "localhost:8080"],
)
def test_a_page_from_elsewhere_is_refused_even_one_of_this_machine(origin: str) -> None:
    with closing(listen(port=PORT)) as listener:
        refusal = listener.refusal("/", values(Host="localhost:8080", Origin=origin))
        assert refusal is not None and "expected the page of the viewer itself" in refusal
        twice = values(Host="localhost:8080", Origin=["http://localhost:8080"] * 2)
        assert listener.refusal("/", twice) is not None


def test_where_others_can_connect_a_token_is_asked_for_that_the_address_holds() -> None:
    with closing(listen("0.0.0.0", PORT)) as listener:
        assert listener.token and len(listener.token) >= 20
        assert listener.url == f"http://localhost:{listener.port}/?token={listener.token}"
        right, host = f"/?token={listener.token}", socket.gethostname()
        for name in ("localhost:1", "192.168.1.7:8080", "[fe80::1]", host, f"{host.partition('.')[0]}.local"):
            assert listener.refusal(right, values(Host=name)) is None
            for path in (
                "/",
                "/?token=",
                "/?token=wrong",
                f"/?other={listener.token}",
                "/?token=\u00e4",
                "//[x?token=wrong",
            ):
                assert "The token is missing or wrong" in str(listener.refusal(path, values(Host=name)))
        assert listener.refusal(right, values(Host="evil.example:8080"))
        assert listener.refusal(right, values(Host="localhost:1", Origin="http://evil.example"))
        cookie = listener.headers(right, values(Host="localhost:1"))["Set-Cookie"]
        assert "HttpOnly" in cookie and "SameSite=Strict" in cookie
        kept = f"other=1; {cookie.partition(';')[0]}"
        assert listener.refusal("/", values(Host="localhost:1", Cookie=kept)) is None
        assert "Set-Cookie" not in listener.headers("/", values(Host="localhost:1", Cookie=kept))
        assert listener.refusal("/", values(Host="localhost:1", Cookie=f"gsseg-{listener.port}=wrong"))


def test_every_token_is_another_one() -> None:
    with closing(listen("0.0.0.0", PORT)) as one, closing(listen("0.0.0.0", PORT)) as other:
        assert one.port != other.port and one.token != other.token


def test_a_taken_port_is_passed_over_and_without_a_free_one_there_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def all_taken(*_: object, **__: object) -> None:
        raise OSError(errno.EADDRINUSE, "taken")

    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with closing(listen(port=port)) as listener:
            assert listener.port > port
    monkeypatch.setattr(socket, "create_server", all_taken)
    with pytest.raises(SettingsError, match=r"ports 65535 to 65535 are all taken; expected a free"):
        listen(port=65535)


@pytest.mark.parametrize("port", [0, -1, 65536, 10**9])
def test_a_port_that_is_none_is_refused(port: int) -> None:
    with pytest.raises(SettingsError, match=rf"port is {port}; expected 1 to 65535"):
        listen(port=port)


@pytest.mark.parametrize(
    ("host", "message"),
    [
        (
            "203.0.113.7",
            "cannot listen at 203.0.113.7, port 8080: it is no address of this machine; expected one, or 127.",
        ),
        ("no such host", "host 'no such host' is not known; expected a name or an address of this machine"),
        ("a" * 80 + ".example", "is not known; expected"),
        ("", "host is ''; expected a value"),
    ],
)
def test_an_address_that_is_not_this_machines_gives_one_clear_error_before_anything_long_runs(
    host: str, message: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("viser")
    monkeypatch.setattr(view_access, "PATIENCE", PATIENCE)
    assert main(["view", "nowhere.ply", "--host", host]) == 2  # Nobody has looked for the scene, which is not there.
    error = capsys.readouterr().err
    assert message in error and error.startswith("gsseg: error: ") and error.count("\n") == 1


def test_a_name_server_that_never_answers_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    gone = threading.Event()
    monkeypatch.setattr(view_access, "PATIENCE", 0.1)
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: gone.wait(PATIENCE))
    try:
        with pytest.raises(SettingsError, match=r"host 'slow\.example' has no answer after 0\.1 s; expected a name"):
            listen("slow.example")
    finally:
        gone.set()


def test_addresses_of_version_6_are_written_as_browsers_want_them() -> None:
    try:
        opened = socket.create_server(("::1", 0), family=socket.AF_INET6)
    except OSError:
        pytest.skip("no IPv6 here")
    with closing(Listener(opened, "::1")) as listener:
        assert listener.url == f"http://[::1]:{listener.port}" and listener.token is None
        assert listener.refusal("/", values(Host=f"[::1]:{listener.port}")) is None


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_who_connects_and_is_no_browser_is_no_word_in_the_log(host: str, caplog: pytest.LogCaptureFixture) -> None:
    pytest.importorskip("viser")
    from gsseg_core.viewer.server import start_server

    page = b"GET //[x HTTP/1.1\r\nHost: localhost\r\n\r\n"
    with closing(listen(host, PORT)) as listener:
        server = start_server(listener)
        for said in (b"", b"\x16\x03\x01", b"POST / HTTP/1.1\r\nHost: localhost\r\n\r\n", page, bytes(20_000)):
            with socket.create_connection(("127.0.0.1", listener.port), timeout=PATIENCE) as client:
                client.sendall(said)
                client.shutdown(socket.SHUT_WR)
                with suppress(ConnectionResetError):
                    while client.recv(1 << 16):
                        pass
        server.stop()
    assert not caplog.records
