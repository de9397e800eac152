"""Spins a node in a thread of its own, for programs that wait for answers instead of living in callbacks."""

from __future__ import annotations

import atexit
import concurrent.futures
import threading
from collections.abc import Callable
from typing import Any, TypeVar

from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node

from gsseg_core.text import one_line
from gsseg_ros.enduring_executor import EnduringExecutor

T = TypeVar("T")

TURN_SECONDS = 0.1
"""How long a turn of the thread lasts at most; what is waited for is looked at after every turn."""


class _Executor(EnduringExecutor, SingleThreadedExecutor):
    def _complain(self, what: str, error: Exception) -> None:
        (node,) = self.get_nodes()
        node.get_logger().error(one_line(f"{what}: {type(error).__name__}: {error}"))


class Spinner:
    """Spins a node in a thread, and wakes the threads that wait after each turn.

    The node is in a context of its own, unless one is given, which is the caller's to shut down: so neither
    `rclpy.init` nor the arguments of the program matter, and Ctrl-C stays a KeyboardInterrupt. Callbacks of what is
    made on `node` run in the thread, and must be short and not raise.
    """

    def __init__(self, name: str, context: Context | None = None, domain_id: int | None = None) -> None:
        if context is not None and domain_id is not None:
            raise ValueError("both context and domain_id are given; expected one: a context has its domain already")
        self._name, self._own = name, context is None
        self._context = Context() if context is None else context
        if self._own:
            self._context.init(args=[], domain_id=domain_id)
        self.node = Node(
            name, context=self._context, use_global_arguments=False, enable_rosout=False, start_parameter_services=False
        )
        self._executor = _Executor(context=self._context)
        self._executor.add_node(self.node)
        self._turned = threading.Condition()
        self._closing = self._ended = False
        self._thread = threading.Thread(target=self._spin, name=name, daemon=True)
        self._thread.start()
        # A thread in the middle of a turn when the interpreter goes away would crash.
        atexit.register(self.close)

    def wait_for(self, condition: Callable[[], Any], timeout: float) -> bool:
        """Wait until a condition holds, which is checked in the caller's thread; return whether it does.

        Raises `RuntimeError`: the spinner was closed, or its context shut down: nothing will change any more.
        """
        with self._turned:
            held = self._turned.wait_for(lambda: self._ended or condition(), timeout)
        if self._ended:
            raise RuntimeError(f"{self._name} is closed, or its ROS context was shut down")
        return bool(held)

    def run(self, function: Callable[[], T], timeout: float = 30.0) -> T:
        """Run a function in the thread, between two callbacks, and return what it returns.

        Requests are sent so: rclpy loses the answer to an action's request where it comes before the call that sent
        the request returns.
        """
        outcome: concurrent.futures.Future[T] = concurrent.futures.Future()

        def work() -> None:
            try:
                outcome.set_result(function())
            except Exception as error:  # For the caller, and not for the thread.
                outcome.set_exception(error)

        self._executor.create_task(work)
        self.wait_for(outcome.done, timeout)
        return outcome.result(0)

    def wake(self) -> None:
        """Wake all threads that wait, so that they check their conditions."""
        with self._turned:
            self._turned.notify_all()

    def close(self) -> None:
        """End the thread and take the node away; all who wait get an error. May be called again."""
        atexit.unregister(self.close)
        if self._closing:
            return
        self._closing = True
        self._executor.wake()
        self._thread.join()
        self._executor.shutdown()
        self.node.destroy_node()
        if self._own:
            self._context.try_shutdown()

    def _spin(self) -> None:
        # Not executor.spin(): its end, asked for from another thread, races with its own clean-up.
        try:
            while not self._closing:
                self._executor.spin_once(timeout_sec=TURN_SECONDS)
                self.wake()
        except ExternalShutdownException:
            pass
        finally:
            self._ended = True
            self.wake()
