"""Sends requests to the node and waits for their answers; errors say what is missing or what failed."""

from __future__ import annotations

import contextlib
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

from gsseg_msgs.action import Learn
from rclpy.action import ActionClient

from gsseg_ros.client.spinner import Spinner
from gsseg_ros.errors import NodeUnavailableError, SegmentationError, error_name

GRACE_SECONDS = 3.0
"""For an answer on its way from a node that has just ended."""

ASK_SECONDS = 2.0
"""Until a question is asked again."""

CANCEL_SECONDS = 5.0
"""How long a goal that is given up may take to end."""

SILENT_SECONDS = 10.0
"""Without news of a goal until its result is asked for again: a node that was started anew knows of no goal."""


class Calls:
    """Calls services of one node."""

    def __init__(self, spinner: Spinner, node_name: str, find_timeout: float) -> None:
        self.spinner, self.node_name, self.find_timeout = spinner, node_name, find_timeout

    def call(self, client: Any, request: Any, timeout: float) -> Any:
        """Call a service and return the response, which is no error.

        Raises `SegmentationError`: the node answered an error; `NodeUnavailableError`: there is no such service, or no
        answer in time.
        """
        deadline = time.monotonic() + timeout
        self.find(client.service_is_ready, f"service {client.srv_name}", timeout)
        answer = self.spinner.run(lambda: client.call_async(request))
        try:
            self.settle(answer.done, client.service_is_ready, client.srv_name, deadline)
            return checked(answer.result())
        finally:
            client.remove_pending_request(answer)

    def ask(self, client: Any, question: Any, deadline: float) -> Any:
        """Ask what changes nothing, again and again; None if there is no answer by the deadline, or the service goes.

        An answer to someone the node has not heard of yet is lost, and the node may have been started anew meanwhile.
        """
        while time.monotonic() < deadline and client.service_is_ready():
            answer = self._asked(client, question, min(ASK_SECONDS, deadline - time.monotonic()))
            if answer.done():
                return answer.result()
        return None

    def _asked(self, client: Any, question: Any, seconds: float) -> Any:
        """Ask once, and wait so long; returns the future of the answer."""
        answer = self.spinner.run(lambda: client.call_async(question))
        self.spinner.wait_for(lambda: answer.done() or not client.service_is_ready(), seconds)
        client.remove_pending_request(answer)
        return answer

    def find(self, ready: Callable[[], bool], what: str, timeout: float) -> None:
        """Wait until a service or action of the node is there; raises `NodeUnavailableError`."""
        timeout = min(timeout, self.find_timeout)
        if not self.spinner.wait_for(ready, timeout):
            raise self.absent(what, timeout)

    def absent(self, what: str, timeout: float) -> NodeUnavailableError:
        """Make the error for a service or topic that is missing; it says what to check."""
        node = self.spinner.node
        others = sorted(
            f"{namespace.rstrip('/')}/{name}"
            for name, namespace in node.get_node_names_and_namespaces()
            if name != node.get_name()
        )
        return NodeUnavailableError(
            f"{self.node_name}: {what} was not there within {timeout:g} s; check that segment_node runs, under this "
            f"name, and with this ROS_DOMAIN_ID ({node.context.get_domain_id()}), ROS_AUTOMATIC_DISCOVERY_RANGE and "
            f"RMW_IMPLEMENTATION; nodes seen: {', '.join(others) or 'none'}"
        )

    def settle(self, settled: Callable[[], object], ready: Callable[[], bool], what: str, deadline: float) -> None:
        """Wait for the effect of a request, for as long as the node is there.

        Raises `NodeUnavailableError`: the node has gone, or the time is over.
        """
        in_time = self.spinner.wait_for(lambda: settled() or not ready(), deadline - time.monotonic())
        if not settled() and not self.spinner.wait_for(settled, GRACE_SECONDS if in_time else 0.0):
            raise self.unanswered(what, gone=in_time)

    def unanswered(self, what: str, gone: bool) -> NodeUnavailableError:
        """Make the error for a request that the node did not answer, as it is gone or in time."""
        why = "went away" if gone else "did not answer in time"
        return NodeUnavailableError(f"{self.node_name} {why} during {what}; check its log, and whether it still runs")


class LearnGoal:
    """A goal of the action `~/learn`, from being sent to its result."""

    def __init__(self, calls: Calls, action: ActionClient, goal: Learn.Goal) -> None:
        self._calls, self._action, self._goal = calls, action, goal
        self._feedback: deque[Any] = deque()
        self._accepting: Any = None
        self._questions: list[Any] = []  # for its result
        self._cancel_asked = self._cancel_sent = False

    def cancel(self) -> None:
        """Have it canceled, from any thread."""
        self._cancel_asked = True
        self._calls.spinner.wake()

    def run(self, on_feedback: Callable[[str, int, int, float], object] | None, deadline: float) -> Learn.Result:
        """Send it and wait for the result, which is no error; on any exception the goal is canceled."""
        try:
            self._calls.spinner.run(self._send)
            self._settle(self._accepting.done, deadline)
            handle = self._accepting.result()
            if not handle.accepted:
                self._accepting = None  # There is nothing to give up.
                why = f"{self._calls.node_name} rejected the goal: it is not active"
                raise SegmentationError(Learn.Result.NOT_ACTIVE, "NOT_ACTIVE", why)
            self._ask(handle)
            while self._feedback or not self._answers:
                self._await_news(deadline)
                if not self._has_news:
                    self._ask(handle)
                if self._to_be_canceled:
                    self._cancel_sent = True
                    self._calls.spinner.run(handle.cancel_goal_async)
                self._tell(on_feedback)
            answer = self._answers[0]
            if not answer.status:  # It is unknown: the node was started anew, and has no such goal.
                raise self._calls.unanswered("learn", gone=True)
        except BaseException:
            self._give_up()
            raise
        return checked(answer.result)

    @property
    def _answers(self) -> list[Any]:
        return [question.result() for question in self._questions if question.done()]

    @property
    def _to_be_canceled(self) -> bool:
        return self._cancel_asked and not self._cancel_sent

    @property
    def _has_news(self) -> bool:
        return bool(self._feedback or self._answers or self._to_be_canceled)

    def _ask(self, handle: Any) -> None:
        self._questions.append(self._calls.spinner.run(handle.get_result_async))

    def _await_news(self, deadline: float) -> None:
        """Wait for news, or until it is time to ask again."""
        latest = time.monotonic() + SILENT_SECONDS
        self._settle(lambda: self._has_news or time.monotonic() >= latest, deadline)

    def _send(self) -> None:
        self._accepting = self._action.send_goal_async(
            self._goal, lambda message: self._feedback.append(message.feedback)
        )

    def _settle(self, settled: Callable[[], object], deadline: float) -> None:
        self._calls.settle(settled, self._action.server_is_ready, "learn", deadline)

    def _tell(self, on_feedback: Callable[[str, int, int, float], object] | None) -> None:
        while self._feedback:
            feedback = self._feedback.popleft()
            if on_feedback is not None:
                on_feedback(feedback.stage, feedback.done, feedback.total, feedback.loss)

    def _give_up(self) -> None:
        """Cancel, and wait a little for the end, so that the node is free for the next goal."""
        spinner = self._calls.spinner
        if self._accepting is None:
            return
        with contextlib.suppress(Exception):
            spinner.wait_for(self._accepting.done, CANCEL_SECONDS)
            handle = self._accepting.result()
            spinner.run(handle.cancel_goal_async)
            spinner.wait_for(spinner.run(handle.get_result_async).done, CANCEL_SECONDS)


def checked(answer: Any) -> Any:
    """Return an answer (a Response or Result); raises `SegmentationError` if it is an error."""
    if answer.error_code:
        raise SegmentationError(answer.error_code, error_name(answer.error_code, type(answer)), answer.error_msg)
    return answer


def class_names(classes: Sequence[str | int]) -> list[str]:
    """Write classes, or a single one, as a request names them."""
    return [classes] if isinstance(classes, str) else [str(name) for name in classes]


def refinement(refine: bool | str, filter: bool) -> dict[str, Any]:
    """Write how to refine as the fields of a request: `refine` may name what comes after KNN clustering."""
    step = refine if isinstance(refine, str) else ""
    return {"skip_refinement": not refine, "skip_filter": not filter, "refine": step}
