"""What the tests of the ROS nodes share: a private context, node processes, and waits that always end.

Importing this module skips the importing test file where ROS is not installed. A test file imports the
fixture and its tests take `ros`:

    from ros_helpers import Ros, ros_fixture  # noqa: F401

    def test_something(ros: Ros) -> None:
        masks = ros.collect(Image, "mask")
        process = ros.start("replay_node", {"data": folder, "rate": 50.0})
        ros.wait_until(lambda: len(masks) == 4, "4 masks")
        assert process.wait() == 0, process.output
"""

from __future__ import annotations

import gc
import itertools
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from node_template import Copy, Template
from patience import PATIENCE, wait_until

from gsseg_ros.child_nodes import NODES, claimed_domain

try:
    # Set before any message class is imported: only then do they check their fields.
    os.environ.setdefault("ROS_PYTHON_CHECK_FIELDS", "1")
    from rclpy.context import Context
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
    from rclpy.impl.implementation_singleton import rclpy_implementation
    from rclpy.node import Node

    with warnings.catch_warnings():
        # Loads a parser that uses deprecated modules of Python; rclpy would do so at the first publisher.
        warnings.simplefilter("ignore", DeprecationWarning)
        import rosidl_generator_py  # noqa: F401
except ImportError as _error:
    pytest.skip(f"ROS is not installed ({_error})", allow_module_level=True)

REPOSITORY = Path(__file__).parents[2]
_counter = itertools.count(os.getpid() * 17)
_WORKER, _WORKERS = (
    int(os.environ.get(f"PYTEST_XDIST_WORKER{name}", alone).strip("gw")) for name, alone in (("", "0"), ("_COUNT", "1"))
)


def next_domain() -> tuple[int, socket.socket]:
    """Take a domain from 1 to 100 that no worker of this run has, nor a demo, and that is not used again soon.

    It is held until the socket closes; a context with a node holds it too.
    """
    share = 100 // _WORKERS
    return claimed_domain(_WORKER * share + count % share + 1 for count in _counter)


@contextmanager
def private_context(*args: str) -> Iterator[Context]:
    """A ROS context, made with these arguments, in a domain of its own."""
    (domain, claim), context = next_domain(), Context()
    with claim:
        context.init(args=list(args), domain_id=domain)
        try:
            yield context
        finally:
            context.shutdown()


class Process:
    """A node or another program, whose output, of both kinds, is collected as it comes."""

    def __init__(self, module: str, arguments: list[str], environment: Mapping[str, str]) -> None:
        self._lines: list[str] = []
        self._name = module
        self._process = _started(module, arguments, environment)
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    @property
    def output(self) -> str:
        """What it has written so far."""
        return "".join(self._lines)

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def running(self) -> bool:
        return self._process.poll() is None

    @property
    def stopped(self) -> bool:
        """Whether a signal has stopped all of its threads, or it has ended."""
        with suppress(OSError):  # Of a thread that has just ended.
            stats = [path.read_text() for path in Path(f"/proc/{self.pid}/task").glob("*/stat")]
            return all(stat.rpartition(")")[2].split()[0] in "TZX" for stat in stats)
        return False

    def wait(self, timeout: float = PATIENCE) -> int:
        """Wait for its end and return the exit code; fails the test if it does not end."""
        try:
            code = self._process.wait(timeout)
        except subprocess.TimeoutExpired:
            self.kill()
            pytest.fail(f"{self._name} did not end within {timeout:g} s; its output:\n{self.output}")
        self._reader.join(PATIENCE)
        return code

    def wait_for(self, text: str, timeout: float = PATIENCE) -> None:
        """Wait until the text has turned up in the output; fails the test if it does not."""
        deadline = time.monotonic() + timeout
        while text not in self.output:
            if not self.running:
                self._reader.join(PATIENCE)
            if time.monotonic() > deadline or (not self.running and text not in self.output):
                pytest.fail(f"{self._name} did not write {text!r}; its output:\n{self.output}")
            time.sleep(0.01)

    def send(self, number: signal.Signals) -> None:
        """Send a signal."""
        self._process.send_signal(number)

    def stop(self, timeout: float = PATIENCE) -> int:
        """End it as Ctrl-C does and return the exit code; kills it and fails the test if it does not end."""
        if self.running:
            self.send(signal.SIGINT)
        return self.wait(timeout)

    def kill(self) -> None:
        """End it whatever it does; harmless where it has ended."""
        self._process.kill()
        self._process.wait(PATIENCE)
        self._reader.join(PATIENCE)

    def _read(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as pipe:
            self._lines.extend(pipe)


def _started(module: str, arguments: list[str], environment: Mapping[str, str]) -> subprocess.Popen[str] | Copy:
    """Start a node as a copy, unless its environment is one that what it imports may read, or another program.

    With more threads than one for its products, NumPy starts them when it is imported, and copies would lack them.
    """
    alone = environment.get("OPENBLAS_NUM_THREADS") == "1"
    if module in NODES and alone and "PYTEST_CURRENT_TEST" in os.environ:
        if not _templates:
            _templates.append(Template(environment))
        if _templates[0].serves(environment):
            return _templates[0].start(NODES[module], arguments, environment)
    return subprocess.Popen(
        [sys.executable, "-m", NODES.get(module, f"gsseg_ros.{module}"), *arguments],
        cwd=REPOSITORY, env=dict(environment), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, text=True, errors="replace",
    )  # fmt: skip


_templates: list[Template] = []


class Ros:
    """A ROS context of its own in a domain of its own, with a node that a thread spins."""

    def __init__(self, folder: Path) -> None:
        self.domain, claim = next_domain()
        self.environment = {
            **os.environ,
            "ROS_DOMAIN_ID": str(self.domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_PYTHON_CHECK_FIELDS": "1", "ROS_LOG_DIR": str(folder / "ros_log"), "PYTHONUNBUFFERED": "1",
            "RCUTILS_COLORIZED_OUTPUT": "0",
        }  # fmt: skip
        self.context = Context()
        with claim:
            self.context.init(args=[], domain_id=self.domain)
            self.node = Node("test", context=self.context, use_global_arguments=False)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self._processes: list[Process] = []
        self._closing = False
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def start(self, module: str, parameters: Mapping[str, Any] | None = None, *arguments: str) -> Process:
        """Start a node in this domain; `arguments` are further ones for ROS, such as "-r", "mask:=/other"."""
        settings = [
            text
            for name, value in (parameters or {}).items()
            for text in ("-p", f"{name}:={json.dumps(_plain(value))}")
        ]
        process = Process(module, ["--ros-args", *settings, *arguments], self.environment)
        self._processes.append(process)
        return process

    def collect(self, kind: Any, topic: str, qos: Any = 30) -> list[Any]:
        """Subscribe, and return the list to which the messages are appended as they come."""
        messages: list[Any] = []
        self.node.create_subscription(kind, topic, messages.append, qos)
        return messages

    def wait_until(self, condition: Callable[[], Any], what: str, timeout: float = PATIENCE) -> None:
        """Wait as `wait_until` does; fails with the output of the processes."""
        try:
            wait_until(condition, what, timeout)
        except pytest.fail.Exception as failure:
            pytest.fail(f"{failure}; output of the nodes:\n" + "\n".join(p.output for p in self._processes))

    def result(self, future: Any, what: str = "an answer", timeout: float = PATIENCE) -> Any:
        """Wait for a future of a client of `node` (a service's or an action's) and return its result."""
        self.wait_until(future.done, what, timeout)
        return future.result()

    def run(self, work: Callable[[], Any]) -> Any:
        """Do something in the thread that spins, and return its result.

        An action's client loses an answer that comes before the call that asked for it has returned; so that call must
        not run beside the spinning.
        """
        task = self.executor.create_task(work)
        return self.result(task, "the spinning thread")

    def close(self) -> None:
        """Kill what still runs and take everything down."""
        for process in self._processes:
            process.kill()
        self._closing = True
        self.executor.wake()
        self._thread.join(PATIENCE)
        self.executor.shutdown(5)
        self.node.destroy_node()
        self.context.try_shutdown()
        assert not self._thread.is_alive(), "a callback of the test's node does not end"
        # Of an exception that nobody asked for, rclpy writes when it is collected: here, and not in a later test.
        gc.collect()

    def _spin(self) -> None:
        # Not executor.spin(): its end, asked for from another thread, races with its own clean-up.
        try:
            while not self._closing:
                # Of a client or subscription that the test took away in this moment.
                with suppress(rclpy_implementation.InvalidHandle):
                    self.executor.spin_once(timeout_sec=0.5)
        except ExternalShutdownException:
            pass


def _plain(value: Any) -> Any:
    return str(value) if isinstance(value, Path) else value


@contextmanager
def private_ros(folder: Path) -> Iterator[Ros]:
    """A private context, node and spinning thread, and processes in the same domain; all gone after the body."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        patch.setenv("ROS_LOG_DIR", str(folder / "ros_log"))
        ros = Ros(folder)
        try:
            yield ros
        finally:
            ros.close()


@pytest.fixture(name="ros")
def ros_fixture(tmp_path: Path) -> Iterator[Ros]:
    """A `Ros` for one test."""
    with private_ros(tmp_path) as ros:
        yield ros
