"""The executor of the node, which can be waited for."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from rclpy.executors import Executor, ExternalShutdownException, ShutdownException, TimeoutException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.task import Task

from gsseg_ros.node.services import AT_WORK, WAITING, describe

InvalidHandle = rclpy_implementation.InvalidHandle

THREADS = AT_WORK + WAITING + 7
"""Those that requests hold that take long, one for a learn job, one for a transition, one for obstacles, and always
some for messages, parameters, diagnostics, the lifecycle state, and requests that are refused at once."""


class NodeExecutor(Executor):
    """Runs callbacks of a node in a pool of threads, as rclpy's `MultiThreadedExecutor`, and logs what they raise.

    That one's `shutdown` waits for no callback, which then meets a node that is gone; and its `spin_once` raises what
    a callback has raised.
    """

    def __init__(self, node: Node) -> None:
        super().__init__(context=node.context)
        self._log = node.get_logger()
        self._pool = ThreadPoolExecutor(THREADS, "callback")
        self._heard = True
        self.add_node(node)

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Start the next callback that is due within so many seconds."""
        try:
            self._pool.submit(self._run, self.wait_for_ready_callbacks(timeout_sec)[0])
        except (TimeoutException, ShutdownException, ExternalShutdownException, InvalidHandle):
            pass  # The last where a topic was taken away in this moment: the next time it is not asked for any more.
        except Exception as error:
            self._log.error(describe(error))

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """Start no callback any more, and wait for those that were started, as Python would at its end."""
        self._pool.shutdown()
        return super().shutdown(timeout_sec)

    def silence(self) -> None:
        """Log nothing any more: the node is taken away from callbacks that cannot be waited for."""
        self._heard = False

    def _make_handler(self, entity: Any, node: Any, take: Callable[[Any], Any], *rest: Any) -> Task:
        """Make what takes in a message, a request or an event that has come, and runs its callback.

        Where taking it in raises an error, rclpy keeps the callback group busy for good: a single mask for which there
        was too little memory, and the node would hear nothing any more. Here it is lost, and all others go on.
        """

        def taken(entity: Any) -> Any:
            try:
                return take(entity)
            except InvalidHandle:  # Of an event whose topic was taken away meanwhile; rclpy sees to all others.
                return None
            except Exception as error:
                name = getattr(entity, "topic_name", "") or getattr(entity, "srv_name", "") or type(entity).__name__
                self._log.error(f"{name}: what has come cannot be taken in, and is lost: {describe(error)}")
                return None

        return super()._make_handler(entity, node, taken, *rest)

    def _run(self, task: Task) -> None:
        try:
            task()
            task.result()
        except Exception as error:
            if self._heard:
                self._log.error(describe(error))
