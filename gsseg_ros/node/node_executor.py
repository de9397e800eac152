"""The executor of the node, which can be waited for."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

from rclpy.executors import ExternalShutdownException, ShutdownException, TimeoutException
from rclpy.node import Node
from rclpy.task import Task

from gsseg_ros.enduring_executor import EnduringExecutor, InvalidHandle
from gsseg_ros.node.services import AT_WORK, WAITING, describe

THREADS = AT_WORK + WAITING + 7
"""Those that requests hold that take long, one for a learn job, one for a transition, one for obstacles, and always
some for messages, parameters, diagnostics, the lifecycle state, and requests that are refused at once."""


class NodeExecutor(EnduringExecutor):
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

    def _complain(self, what: str, error: Exception) -> None:
        self._log.error(f"{what}: {describe(error)}")

    def _run(self, task: Task) -> None:
        try:
            task()
            task.result()
        except Exception as error:
            if self._heard:
                self._log.error(describe(error))
