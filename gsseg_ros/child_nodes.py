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
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from gsseg_core.errors import GssegError

STOP_SECONDS = 10.0
"""How long a child gets to end by itself."""

_CLAIMANT = 119
"""Number of a process in its domain that DDS gives to none, as no machine has so many there; its port is a claim."""

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
        """Whether it has ended as it should. Raises `ChildError`: it has failed."""
        code = self._process.poll()
        if code:
            lines = self.log.read_text(errors="replace").split("\n")
            last = next((line for line in reversed(lines) if line.strip()), "nothing")
            raise ChildError(f"{self.module} ended with code {code}; the last line of its log {self.log}: {last}")
        return code == 0

    @property
    def pid(self) -> int:
        """Number of its process."""
        return self._process.pid

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

    `environment` is what makes a process one of theirs: `ROS_DOMAIN_ID` and so on. Logs go into the folder.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.domain_id, self._claim = claimed_domain(random.sample(range(1, 101), 100))
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
        """End all children, and leave their domain to others."""
        deadline = time.monotonic() + STOP_SECONDS
        for child in self._children:
            child.interrupt()
        for child in self._children:
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.wait(max(0.0, deadline - time.monotonic()))
        self._claim.close()


def claimed_domain(candidates: Iterable[int]) -> tuple[int, socket.socket]:
    """Take the first ROS domain in which no process of this machine is, until the socket that is returned closes.

    Who only looks, and joins later, may meet another there who did the same meanwhile. Raises `ChildError`: there is
    none.
    """
    for domain in candidates:
        claim = _bound(domain, _CLAIMANT)
        if claim is None:
            continue
        if all(_is_free(domain, process) for process in range(4)):  # The first may have left before the others.
            return domain, claim
        claim.close()
    raise ChildError("in each ROS domain from 1 to 100 there is a process of this machine; expected one that is free")


def _is_free(domain: int, process: int) -> bool:
    probe = _bound(domain, process)
    if probe is not None:
        probe.close()
    return probe is not None


def _bound(domain: int, process: int) -> socket.socket | None:
    """Take the port that DDS gives to a process of a domain for being found; None if it is taken."""
    bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        bound.bind(("", 7400 + 250 * domain + 10 + 2 * process))
    except OSError:
        bound.close()
        return None
    return bound
