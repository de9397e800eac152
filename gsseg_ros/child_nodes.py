"""Runs nodes as child processes in a ROS domain of their own, and ends them with whoever started them."""

from __future__ import annotations

import contextlib
import json
import os
import random
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gsseg_core.errors import GssegError

STOP_SECONDS = 10.0
"""How long a child gets to end by itself."""

NODES = {"segment_node": "gsseg_ros.node.segment_node", "replay_node": "gsseg_ros.replay.replay_node"}
"""What `python -m` runs for each node."""


class ChildError(GssegError):
    """A node that runs as a child process has ended too early."""


class ChildNode:
    """`python -m` with one of `NODES` and parameters; what it writes goes to a log file."""

    def __init__(self, module: str, parameters: Mapping[str, Any], environment: Mapping[str, str], log: Path) -> None:
        self.module, self.log = module, log
        values = [text for name, value in parameters.items() for text in ("-p", f"{name}:={json.dumps(value)}")]
        with log.open("wb") as output:
            self._process = subprocess.Popen(
                [sys.executable, "-m", NODES[module], "--ros-args", *values],
                env={**os.environ, **environment},
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
            )

    @property
    def done(self) -> bool:
        """Whether it has ended as it should.

        Raises
        ------
        ChildError
            It has failed.
        """
        code = self._process.poll()
        if code:
            lines = self.log.read_text(errors="replace").split("\n")
            last = next((line for line in reversed(lines) if line.strip()), "nothing")
            raise ChildError(f"{self.module} ended with code {code}; the last line of its log {self.log}: {last}")
        return code == 0

    def interrupt(self) -> None:
        """Ask it to end."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)

    def wait(self, timeout: float) -> None:
        """Wait for its end; kills it when the time is over."""
        try:
            self._process.wait(timeout)
        finally:
            self._process.kill()
            self._process.wait()


class ChildNodes:
    """Starts nodes, and ends them with the body of a `with` statement, whatever ends that.

    Parameters
    ----------
    folder : path
        For the logs.

    Attributes
    ----------
    domain_id : int
        ROS domain of the children.
    environment : dict
        What makes a process one of theirs; `ROS_DOMAIN_ID` and so on.
    logs : list of pathlib.Path
        One for each child so far.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.domain_id = free_domain()
        self.environment = {
            "ROS_DOMAIN_ID": str(self.domain_id),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_LOG_DIR": str(folder / "ros"),
            "RCUTILS_COLORIZED_OUTPUT": "0",
        }
        self._folder = folder
        self._children: list[ChildNode] = []

    @property
    def logs(self) -> list[Path]:
        """The log of each child so far."""
        return [child.log for child in self._children]

    def start(self, module: str, parameters: Mapping[str, Any]) -> ChildNode:
        """Start a node of this package."""
        child = ChildNode(module, parameters, self.environment, self._folder / f"{module}.log")
        self._children.append(child)
        return child

    def check(self) -> None:
        """Raise `ChildError` if a child has failed."""
        for child in self._children:
            _ = child.done

    def __enter__(self) -> ChildNodes:
        """Do nothing: children come later."""
        return self

    def __exit__(self, *_: object) -> None:
        """End all children."""
        deadline = time.monotonic() + STOP_SECONDS
        for child in self._children:
            child.interrupt()
        for child in self._children:
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.wait(max(0.0, deadline - time.monotonic()))


def free_domain() -> int:
    """Find a ROS domain in which no process of this machine is, 1 to 100."""
    domains = random.sample(range(1, 101), 100)
    return next(filter(is_free, domains), domains[0])


def is_free(domain: int) -> bool:
    """Whether no process of this machine is in a ROS domain."""
    for process in range(4):  # The first may have left before the others.
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                # The port that DDS gives to this process of a domain for being found.
                probe.bind(("", 7400 + 250 * domain + 10 + 2 * process))
            except OSError:
                return False
    return True
