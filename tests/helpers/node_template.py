"""Nodes that begin as copies of a process that has what they need of the core: two thirds of their start are that.

It has imported modules and loaded kernels. This file is the program of that process; `Template` starts it, once for the
tests of a worker, and asks it for nodes. Nothing of ROS is imported and no kernel runs before a process is copied,
since that starts threads, which copies lack; then all goes on as in `python -m`. Nodes that people start, by the demo,
launch files, `ros2 run` and the pages of the documentation, begin in the tests as theirs do.
"""

from __future__ import annotations

import atexit
import gc
import importlib
import json
import os
import re
import runpy
import selectors
import signal
import socket
import subprocess
import sys
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]
OWN = {"ROS_DOMAIN_ID", "ROS_LOG_DIR", "PYTEST_CURRENT_TEST", "TORCHINDUCTOR_CACHE_DIR"}
"""Variables that nothing reads while it is imported: a node may have its own. PyTorch sets the last one itself, where
any test of a worker learns with it, and PyTorch is not imported."""


class Copy:
    """A node that began as a copy, with what `subprocess.Popen` has of it."""

    def __init__(self, said: socket.socket, output: int) -> None:
        self._said = said
        self.pid = int(said.recv(100))
        self.stdout = open(output, encoding="utf-8", errors="replace")  # noqa: SIM115
        self.returncode: int | None = None

    def poll(self) -> int | None:
        """Exit code, or None while it runs."""
        try:
            return self.wait(0)
        except subprocess.TimeoutExpired:
            return None

    def wait(self, timeout: float) -> int:
        """Wait for its end; returns the exit code."""
        if self.returncode is None:
            self._said.settimeout(timeout)
            try:
                self.returncode = int(self._said.recv(100))
            except (TimeoutError, BlockingIOError):
                raise subprocess.TimeoutExpired("a node", timeout) from None
            self._said.close()
        return self.returncode

    def send_signal(self, number: signal.Signals) -> None:
        """Send a signal, unless it has ended."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        """End it at once."""
        self.send_signal(signal.SIGKILL)


class Template:
    """The process that copies itself."""

    def __init__(self, environment: Mapping[str, str]) -> None:
        self._environment = _shared(environment)
        self._asked, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            command = [sys.executable, __file__, str(theirs.fileno())]
            self._process = subprocess.Popen(
                command, cwd=REPOSITORY, env=dict(environment), stdin=subprocess.DEVNULL, pass_fds=[theirs.fileno()]
            )
        atexit.register(self._end)

    def serves(self, environment: Mapping[str, str]) -> bool:
        """Whether what was imported is what a node of this environment would import."""
        return _shared(environment) == self._environment

    def start(self, module: str, arguments: list[str], environment: Mapping[str, str]) -> Copy:
        """Start a node."""
        said, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        output, written = os.pipe()
        with theirs:
            own = {name: environment[name] for name in OWN & environment.keys()}
            request = json.dumps([module, arguments, own]).encode()
            socket.send_fds(self._asked, [request], [theirs.fileno(), written])
            os.close(written)
        return Copy(said, output)

    def _end(self) -> None:
        self._asked.close()
        self._process.wait()


def _shared(environment: Mapping[str, str]) -> dict[str, str]:
    return {name: value for name, value in environment.items() if name not in OWN}


def _serve(asked: socket.socket) -> tuple[str, list[str]]:
    """Make copies; returns in each of them, with what it is to run. The process itself ends with who asks it."""
    running: dict[int, tuple[int, socket.socket]] = {}  # by the file that tells of its end
    with selectors.DefaultSelector() as selector:
        selector.register(asked, selectors.EVENT_READ)
        while True:
            for key, _ in selector.select():
                if key.fileobj is not asked:
                    selector.unregister(key.fileobj)
                    number, said = running.pop(key.fd)
                    os.close(key.fd)
                    with said, suppress(OSError):  # Nobody may wait for it any more.
                        said.send(str(os.waitstatus_to_exitcode(os.waitpid(number, 0)[1])).encode())
                    continue
                request, files, _, _ = socket.recv_fds(asked, 1 << 20, 2)
                if not request:
                    for number, _ in running.values():
                        os.kill(number, signal.SIGKILL)
                    sys.exit()
                said, output = socket.socket(fileno=files[0]), files[1]
                number = os.fork()
                if number == 0:
                    for file, (_, other) in running.items():
                        os.close(file)
                        other.close()
                    asked.close()
                    said.close()
                    os.dup2(output, 1)
                    os.dup2(output, 2)
                    os.close(output)
                    module, arguments, own = json.loads(request)
                    os.environ.update(own)
                    return module, arguments
                os.close(output)
                said.send(str(number).encode())
                file = os.pidfd_open(number)
                running[file] = number, said
                selector.register(file, selectors.EVENT_READ)


def _load_kernels() -> None:
    """Load all kernels that are kept of the modules that are imported, as their first calls would."""
    from numba.core.caching import FunctionCache
    from numba.core.dispatcher import Dispatcher

    importlib.import_module("gsseg_core.raster.cpu.tile_operator")  # The first view would.
    for kernel in [thing for thing in gc.get_objects() if isinstance(thing, Dispatcher)]:
        if isinstance(cache := kernel._cache, FunctionCache):
            for key in cache._cache_file._load_index():
                if key == cache._index_key(key[0], kernel.targetctx.codegen()):
                    kernel.compile(key[0])


if __name__ == "__main__":
    sys.path[0] = str(REPOSITORY)
    for file in sorted(REPOSITORY.glob("gsseg_ros/node/*.py")):
        for module in re.findall(r"^from (gsseg_core\S*) import", file.read_text(), re.MULTILINE):
            importlib.import_module(module)
    _load_kernels()
    assert len(os.listdir("/proc/self/task")) == 1, "what is imported or loaded starts threads"
    gc.freeze()
    # numba refuses to run kernels in children of a process that has loaded OpenMP: they would lack its threads. There
    # are none yet, but only of grandchildren does numba not think so.
    if child := os.fork():
        sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
    module, arguments = _serve(socket.socket(fileno=int(sys.argv[1])))
    sys.argv[1:] = arguments
    runpy.run_module(module, run_name="__main__", alter_sys=True)
