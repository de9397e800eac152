"""The connection of a client to a segmentation node: its services, and waiting for the node and its views."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, TypeVar

from diagnostic_msgs.msg import DiagnosticArray
from gsseg_msgs.srv import (
    Export,
    LoadScene,
    LoadState,
    MergeStates,
    Pick,
    RenderView,
    Reset,
    SaveState,
    Segment,
    UpdateScene,
)
from lifecycle_msgs.msg import State
from lifecycle_msgs.srv import GetState
from rclpy.context import Context

from gsseg_ros.client.calls import Calls
from gsseg_ros.client.spinner import Spinner
from gsseg_ros.errors import NodeUnavailableError

_SERVICES = {
    Segment: "segment", Pick: "pick", RenderView: "render_view", LoadScene: "load_scene", SaveState: "save_state",
    LoadState: "load_state", Export: "export", Reset: "reset", UpdateScene: "update_scene",
    MergeStates: "merge_states", GetState: "get_state",
}  # fmt: skip

POLL_SECONDS = 0.2
"""Until the node's state is asked for again."""

SILENT_SECONDS = 5.0
"""Of a node that says once a second how it is."""


Self = TypeVar("Self", bound="Connection")


class Connection:
    """Reaches one node; see `SegmentationClient`, whose arguments these are."""

    def __init__(
        self,
        node_name: str = "gsseg",
        *,
        context: Context | None = None,
        domain_id: int | None = None,
        find_timeout: float = 30.0,
    ) -> None:
        self._name = "/" + node_name.strip("/")
        self._spinner = Spinner("gsseg_client", context, domain_id)
        self._calls = Calls(self._spinner, self._name, find_timeout)
        node = self._spinner.node
        # The question for the state comes last: the node hears of them in this order, and an answer to someone it has
        # not heard of yet is lost; so once it has told its state, none is.
        self._reach(node)
        self._clients = {kind: node.create_client(kind, f"{self._name}/{name}") for kind, name in _SERVICES.items()}
        self._diagnostics: Any = None
        self._status: Any = None  # what the node told last of itself

    def _reach(self, node: Any) -> None:
        """Make what else the node is reached by."""

    def __enter__(self: Self) -> Self:
        """Do nothing: it is ready."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close it."""
        self.close()

    def close(self) -> None:
        """Take the client away; the node goes on. What is asked for afterwards raises `RuntimeError`."""
        self._spinner.close()

    def wait_until_active(self, timeout: float = 120.0) -> None:
        """Wait until the node is there and active. At its first start after installing, kernels compile.

        Raises
        ------
        NodeUnavailableError
            It is not, within `timeout` seconds.
        """
        deadline = time.monotonic() + timeout
        client, state = self._clients[GetState], "not answering"
        if not self._spinner.wait_for(client.service_is_ready, timeout):
            raise self._calls.absent(f"service {client.srv_name}", timeout)
        while time.monotonic() < deadline:
            told = self._calls.ask(client, GetState.Request(), deadline)
            if told is not None:
                state = told.current_state.label
                if told.current_state.id == State.PRIMARY_STATE_ACTIVE:
                    return
            self._spinner.wait_for(lambda: False, min(POLL_SECONDS, deadline - time.monotonic()))
        raise NodeUnavailableError(
            f"{self._name} is {state} after {timeout:g} s; expected active: its log says why it could not be "
            "configured, or it waits for a lifecycle manager (parameter autostart)"
        )

    def wait_for_views(self, count: int, timeout: float = 60.0, on_views: Callable[[int], object] | None = None) -> int:
        """Wait until the node has fused a number of views; it reports that number once a second.

        Parameters
        ----------
        count : int
            Views since the scene was loaded or reset.
        timeout : float
            Seconds.
        on_views : callable, optional
            Called with their number whenever the node says it.

        Returns
        -------
        int
            Views fused.

        Raises
        ------
        NodeUnavailableError
            They were not, in time; the message says what the node has to say about its inputs.
        """
        deadline, views = time.monotonic() + timeout, 0
        self._spinner.run(self._hear_diagnostics)
        before = said = self._status
        while (news := self._status_after(said, deadline)) is not said:
            said, heard = news, time.monotonic()
            values = {value.key: value.value for value in said.values}
            views = int(values.get("views fused", 0))
            if on_views is not None:
                on_views(views)
            if views >= count:
                return views
        if said is before:
            raise self._calls.absent("its status on /diagnostics", timeout)
        found = f"{self._name} has fused {views} of {count} views after {timeout:g} s"
        if (silence := time.monotonic() - heard) > SILENT_SECONDS:
            why = f"and has said nothing for the last {silence:.0f} s; check its log, and whether it still runs"
            raise NodeUnavailableError(f"{found}, {why}")
        rejected = [f"{key}: {value}" for key, value in values.items() if key.startswith("rejected ")]
        raise NodeUnavailableError(f"{found}; it says: " + "; ".join([said.message, *rejected]))

    def _call(self, kind: Any, request: Any, timeout: float) -> Any:
        return self._calls.call(self._clients[kind], request, timeout)

    def _status_after(self, known: Any, deadline: float) -> Any:
        """Wait until the node has said something after what is known, and give that; at the deadline what is known."""
        self._spinner.wait_for(lambda: self._status is not known, deadline - time.monotonic())
        return self._status

    def _hear_diagnostics(self) -> None:
        if self._diagnostics is None:
            self._diagnostics = self._spinner.node.create_subscription(
                DiagnosticArray, "/diagnostics", self._on_diagnostics, 10
            )

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self._status = next((status for status in message.status if status.name == self._name), self._status)
