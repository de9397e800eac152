"""An executor that continues after a message, a request or an event that cannot be processed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.executors import Executor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.task import Task

InvalidHandle = rclpy_implementation.InvalidHandle


class EnduringExecutor(Executor):
    """Loses a message, a request or an event that cannot be processed, and continues with all others.

    rclpy keeps its callback group busy for good, and raises the error where it spins: a single message for which there
    was too little memory, and the node would hear nothing any more.
    """

    def _complain(self, what: str, error: Exception) -> None:
        """Write to the log what was lost, and why."""
        raise NotImplementedError

    def _make_handler(self, entity: Any, node: Any, take: Callable[[Any], Any], *rest: Any) -> Task:
        """Make what takes in a message, a request or an event that has come, and runs its callback."""

        def taken(entity: Any) -> Any:
            try:
                return take(entity)
            except InvalidHandle:  # Of an event whose topic was taken away meanwhile; rclpy sees to all others.
                return None
            except Exception as error:
                name = getattr(entity, "topic_name", "") or getattr(entity, "srv_name", "") or type(entity).__name__
                self._complain(f"{name}: what was received cannot be processed, and is lost", error)
                return None

        return super()._make_handler(entity, node, taken, *rest)
