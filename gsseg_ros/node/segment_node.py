"""The lifecycle node `gsseg`: fuses posed masks as they arrive, learns and segments on request."""

from __future__ import annotations

import importlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.srv import ChangeState, GetAvailableStates, GetAvailableTransitions, GetState
from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions

from gsseg_core.freed_memory import keep_freed_memory, search_no_imports_at_the_end
from gsseg_core.live.living_session import LivingSession
from gsseg_core.warm_up import warm_up
from gsseg_ros.node import declarations, diagnostics, parameters
from gsseg_ros.node.complaints import Complaints
from gsseg_ros.node.inputs import Inputs
from gsseg_ros.node.learn_action import LearnAction
from gsseg_ros.node.node_executor import NodeExecutor
from gsseg_ros.node.obstacles import Obstacles
from gsseg_ros.node.outputs import Outputs
from gsseg_ros.node.parameters import Settings
from gsseg_ros.node.scene_changes import SceneChanges
from gsseg_ros.node.scene_frame import SceneFrame
from gsseg_ros.node.services import Services, describe
from gsseg_ros.node.sim_time import SimTime, steady_timer
from gsseg_ros.node.viewpoints import Lookup
from gsseg_ros.node.workspace import Workspace
from gsseg_ros.node_parameters import warn_of_unknown
from gsseg_ros.shared_memory import make_room

STOP_SECONDS = 3.0
"""How long a job gets to stop when the node is deactivated or shut down."""

SUCCESS = TransitionCallbackReturn.SUCCESS

LIBRARIES = ("scipy.ndimage", "scipy.optimize", "scipy.spatial")
"""What requests use and do not load themselves: where memory is short, OpenBLAS, which comes with these, tries for ever
to get its own while it is loaded, and the node would answer nobody any more."""

LATE_SECONDS = 3.0
"""What a job gets beyond that at the end of the node, where it would have nobody left to answer."""

ANSWER_TURNS, CANCEL_TURNS = 6, 40
"""At the end of the node, turns of the executor for answers under way, and for that to a job that it has canceled;
counted, not timed, so that they are enough on a busy machine, too. One that finds nothing to do takes 0.05 s."""


class SegmentNode(LifecycleNode):
    """Wires topics, services and the action to a `Workspace`.

    configure: reads the parameters, loads the scene. activate: listens. deactivate: stops a running job and listening,
    keeps what was learnt. cleanup: forgets it. Services and the action are there from the start; until then services
    answer NOT_ACTIVE, and goals are rejected.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("gsseg", **kwargs)
        # The state can be asked for whatever goes on, also while it changes.
        lifecycle = ReentrantCallbackGroup()
        for service in self.services:
            if service.srv_type in (ChangeState, GetState, GetAvailableStates, GetAvailableTransitions):
                service.callback_group = lifecycle
                lifecycle.add_entity(service)
            if service.srv_type is ChangeState:
                service.callback = self._answered(service.callback)
        self.configuring = False
        declarations.declare(self)
        warn_of_unknown(self)
        self.workspace = Workspace(Settings.read(self), lambda: self.get_clock().now().to_msg())
        self.inputs: Inputs | None = None
        self.obstacles: Obstacles | None = None
        self._outputs: Outputs | None = None
        self._scene_frame: SceneFrame | None = None
        self._out_of_place = False  # Whether what is latched is from where the scene lay before.
        self.workspace.placement.settled = self._publish_again
        self.workspace.placement.refused = self.get_logger().warning
        self._complaints = Complaints(self.get_logger().warning)
        self._requests = Services(
            self, self.workspace, self._complaints, self._require_outputs, self._lookup, self._show_change
        )
        self._changes = SceneChanges(self._requests, self._await_fused)
        self._learn = LearnAction(self._requests)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._sim_time = SimTime(self)
        # In a group of its own, since it may wait for the session. That /clock does not come, it may have to tell.
        steady_timer(self, 1.0, self._tell, MutuallyExclusiveCallbackGroup())
        self.add_on_set_parameters_callback(self._check_parameters)
        if hasattr(self, "add_pre_set_parameters_callback"):  # Humble has it not.
            self.add_pre_set_parameters_callback(parameters.with_typed_lists)
        self._told_after = hasattr(self, "add_post_set_parameters_callback")  # Humble has the one before alone.
        if self._told_after:
            self.add_post_set_parameters_callback(self._take_parameters)

    def autostart(self) -> None:
        """Configure and activate, unless the parameter says not to; what fails is logged and can be tried again."""
        if not self.workspace.settings.autostart:
            self.get_logger().info("waiting to be configured and activated (autostart is false)")
            return
        try:
            if self.trigger_configure() == TransitionCallbackReturn.SUCCESS:
                self.trigger_activate()
        except RuntimeError as error:
            self.get_logger().warning(f"autostart stops: somebody else has asked for a lifecycle transition ({error})")

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Read the parameters and load the scene; where that fails all is as it was before."""
        self.configuring = True
        try:
            return self._attempt("configured", self._configure, undo=self._forget)
        finally:
            self.configuring = False

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to listen; where that fails all is as it was before."""
        return self._attempt("activated", self._activate, undo=self.stop)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop a running job, and listening."""
        return self._attempt("deactivated", self.stop)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Forget the scene and all that was learnt."""
        return self._attempt("cleaned up", self._forget)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop, from any state."""
        return self._attempt("shut down", self._stop_and_forget)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Go back to unconfigured after an error in a transition."""
        return self._attempt("brought back to unconfigured", self._stop_and_forget)

    def _attempt(
        self, what: str, step: Callable[[], object], undo: Callable[[], object] | None = None
    ) -> TransitionCallbackReturn:
        """Take a step of a transition and log why it fails, since rclpy drops what a transition raises.

        `undo` takes away what is half built, so that the node stays in the state it was in; without, it is an error.
        """
        try:
            step()
        except Exception as error:
            self.get_logger().error(f"cannot be {what}: {describe(error)}")
            if undo is not None and self._attempt("taken back to the state before", undo) == SUCCESS:
                return TransitionCallbackReturn.FAILURE
            return TransitionCallbackReturn.ERROR
        return SUCCESS

    def _configure(self) -> None:
        settings = Settings.read(self)
        self.workspace.configure(settings)
        warm_up(settings.device, self.get_logger().info)
        for name in LIBRARIES:
            importlib.import_module(name)
        if settings.scene_path:
            self.workspace.load_scene(*self.workspace.parameter_path("scene_path"), nullcontext())
        self._outputs = Outputs(self, settings.cameras)
        self._outputs.announce(self.workspace.label_space.classes)
        self._scene_frame = SceneFrame(self, settings.map_frame, settings.scene_frame)
        self._scene_frame.publish(self.workspace.settings.scene_to_map, self.get_clock().now().to_msg())
        if (session := self.workspace.loaded) is not None:
            self.get_logger().info(f"loaded {session.scene.path}: {len(session.scene):,} Gaussians")
        else:
            self.get_logger().warning("no scene yet: set the parameter scene_path, or call ~/load_scene")

    def _activate(self) -> None:
        self.inputs = Inputs(self, self.workspace, self._require_outputs(), self._complaints)
        self.obstacles = Obstacles(self, self.workspace, self._complaints)
        self.workspace.active = True
        warn_of_unknown(self, of_topics=True)
        if self._out_of_place:
            threading.Thread(target=self._publish_again, name="publish again").start()
        topics = ", ".join(self.inputs.arrivals)
        self.get_logger().info(
            f"active: listening to {topics}; services and the action are below {self.get_fully_qualified_name()}/"
        )

    def stop(self) -> None:
        """Stop a running job, wait for the requests at work, and stop listening."""
        self.workspace.active = False
        if not self.workspace.slot.cancel(STOP_SECONDS):
            self.get_logger().warning(f"a job did not stop within {STOP_SECONDS:g} s; continuing without it")
        if not self.workspace.requests.drained(STOP_SECONDS):
            self.get_logger().warning(f"a request did not end within {STOP_SECONDS:g} s; it will publish nothing")
        if self.obstacles is not None:
            self.obstacles.close()
            self.obstacles = None
        if self.inputs is not None:
            self.inputs.close()
            self.inputs = None
        self.workspace.retire()

    def close(self) -> None:
        """Stop all threads and take the node away."""
        self.stop()
        self._learn.close()
        self.destroy_node()

    def _stop_and_forget(self) -> None:
        try:
            self.stop()
        finally:
            self._forget()

    def _forget(self) -> None:
        self.workspace.close()
        if self._outputs is not None:
            self._outputs.close()
            self._outputs = None
        if self._scene_frame is not None:
            self._scene_frame.close()
            self._scene_frame = None
        self._out_of_place = False

    def _answered(self, handler: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        """Refuse a transition that does not start in the present state; in rclpy's own hands that ends the node."""

        def answer(request: ChangeState.Request, response: ChangeState.Response) -> ChangeState.Response:
            try:
                return handler(request, response)
            except RuntimeError as error:
                self.get_logger().warning(f"transition {request.transition.id} refused: {error}")
                return ChangeState.Response(success=False)

        return answer

    def _require_outputs(self) -> Outputs:
        if self._outputs is None:
            self.workspace.require_active()
            raise AssertionError("an active node has outputs")
        return self._outputs

    def _lookup(self) -> Lookup | None:
        inputs = self.inputs  # In another thread the node may be deactivated meanwhile.
        return inputs.tf.look_up if inputs is not None and inputs.tf is not None else None

    def _check_parameters(self, changed: Sequence[Parameter]) -> SetParametersResult:
        configured = self.configuring or self._outputs is not None
        result = parameters.check(self, changed, configured, self.workspace.require_allowed)
        if result.successful and not self._told_after:
            self._take_parameters(changed)
        return result

    def _take_parameters(self, changed: Sequence[Parameter]) -> None:
        names = {parameter.name for parameter in changed} & declarations.AT_ONCE
        if not names:
            return
        with self.workspace.placement.fusing:
            # Those that are set already are read as they are now: another thread may have set them since.
            before, settings = self.workspace.settings, Settings.read(self, () if self._told_after else changed)
            frame = self._scene_frame  # In another thread the node may be cleaned up meanwhile.
            if frame is None or not any(name.startswith("scene_to_map.") for name in names):
                self.workspace.settings = settings
                return
            self._out_of_place = True
            self.workspace.placement.change(
                before.scene_to_map, settings.scene_to_map, lambda: setattr(self.workspace, "settings", settings)
            )
            frame.publish(settings.scene_to_map, self.get_clock().now().to_msg())

    def _publish_again(self) -> None:
        """Publish anew what was published when the scene lay elsewhere, if the node is active; else it is due then."""
        inputs, outputs = self.inputs, self._outputs  # In another thread the node may be cleaned up meanwhile.
        if not self.workspace.active or inputs is None or outputs is None:
            return
        session = self.workspace.loaded
        if session is None or not session.has_codes:
            self._out_of_place = False
            return
        following = session.num_views
        if isinstance(session, LivingSession):
            following = sum(view.group is None for view in session.views)  # Others move with their group.
        left = session.num_fused - session.num_views
        notes = ["; ~/learn learns from where views are now"] * (session.learnt is not None)
        notes += [f"; votes of {left} that are not kept any more stay as they were"] * (left > 0)
        self.get_logger().info(
            f"scene_to_map has changed: votes of {following} views were cast anew from where their cameras are in "
            f"the scene now{''.join(notes)}"
        )
        if outputs.latched is None:
            inputs.live.show_objects()
        else:
            self._requests.publish_again(outputs.latched)
        self._out_of_place = not self.workspace.active  # Deactivated meanwhile, it has published nothing.

    def _show_change(self) -> None:
        if (inputs := self.inputs) is not None:
            inputs.live.changed()

    def _await_fused(self, stamps: set[str]) -> None:
        if (inputs := self.inputs) is not None:
            inputs.await_fused(stamps)

    def _tell(self) -> None:
        inputs, clock_problem = self.inputs, self._sim_time.problem()
        name, stamp = self.get_fully_qualified_name(), self._sim_time.stamp()
        self._diagnostics.publish(diagnostics.diagnostic_array(name, self.workspace, inputs, stamp, clock_problem))
        diagnostics.complain(self._complaints, inputs, clock_problem)


def _end(executor: NodeExecutor, node: SegmentNode) -> None:
    """Stop the node, and take it away; a canceled job is still answered, which rclpy sends from the executor."""
    slot = node.workspace.slot
    turns = CANCEL_TURNS if slot.busy else ANSWER_TURNS
    node.stop()
    latest = time.monotonic() + LATE_SECONDS
    while slot.busy and time.monotonic() < latest:
        executor.spin_once(0.05)
    for _ in range(turns):
        executor.spin_once(0.05)
    executor.shutdown()  # Before the node goes, which callbacks may be using.
    node.close()


def main(args: list[str] | None = None) -> int:
    """Run the node until SIGINT or SIGTERM; returns the exit code: 0, or 2 for arguments that cannot be used."""
    keep_freed_memory()
    search_no_imports_at_the_end()
    make_room()
    # rclpy's own handlers would take the context away under a running job, and its spin() does not always notice.
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    try:
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        node = SegmentNode()
    except Exception as error:  # What ROS raises for arguments and parameters that it cannot take is not public.
        print(f"segment_node: error: {' '.join(str(error).split())}", file=sys.stderr)
        rclpy.try_shutdown()
        return 2
    executor = NodeExecutor(node)
    # Not here: signals are heard in this thread, and to compile kernels takes half a minute and more.
    starting = threading.Thread(target=node.autostart, name="autostart", daemon=True)
    starting.start()
    try:
        while not stop.is_set():
            executor.spin_once(0.2)
    finally:
        if node.configuring:
            # There is nothing yet that could be lost, and no way to stop a compiler.
            executor.silence()
            node.destroy_node()
            os._exit(0)
        starting.join(STOP_SECONDS)
        _end(executor, node)
        rclpy.shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
