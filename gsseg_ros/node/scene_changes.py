"""Changes the node's scene and keeps what was learnt: ~/update_scene, the topic scene_delta, and ~/merge_states."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Container
from dataclasses import replace
from functools import partial

from gsseg_msgs.msg import SceneDelta as SceneDeltaMessage
from gsseg_msgs.srv import MergeStates, UpdateScene
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup

from gsseg_core.errors import EmptySceneError, GssegError, SceneDeltaError
from gsseg_core.live.living_session import Changed, LivingSession
from gsseg_core.scene.scene_delta import SceneDelta
from gsseg_ros.delta_messages import delta_from_message
from gsseg_ros.errors import InvalidRequestError
from gsseg_ros.node.complaints import SCENE_DELTA
from gsseg_ros.node.services import Services, answered, explain, in_turn
from gsseg_ros.node.view_names import ViewName
from gsseg_ros.qos import reliable


class SceneChanges:
    """Creates the services and the subscription, and answers them.

    What is wrong with a message of the topic goes to the log and to /diagnostics, and changes nothing.
    A learn job need not be canceled: what it learns is carried over to the scene as it is then. `await_fused` waits
    until masks of some stamps that have come are fused: a change may name keyframes that are just under way.
    """

    def __init__(self, services: Services, await_fused: Callable[[set[str]], None]) -> None:
        self.node, self.workspace, self.turns = services.node, services.workspace, services.turns
        self.complaints, self._services, self._await_fused = services.complaints, services, await_fused
        self._complain = partial(services.complaints.add, SCENE_DELTA)
        group = ReentrantCallbackGroup()
        for interface, name, handler in (
            (UpdateScene, "update_scene", self.update_scene),
            (MergeStates, "merge_states", self.merge_states),
        ):
            self.node.create_service(interface, f"~/{name}", handler, qos_profile=reliable(), callback_group=group)
        # Reliable and one after the other: each change goes by the one before it.
        self.node.create_subscription(
            SceneDeltaMessage, "scene_delta", self.on_scene_delta, reliable(),
            callback_group=MutuallyExclusiveCallbackGroup(),
        )  # fmt: skip

    @answered
    @in_turn
    def update_scene(self, request: UpdateScene.Request, response: UpdateScene.Response) -> None:
        """Change the scene by arrays or a file."""
        workspace, started = self.workspace, time.perf_counter()
        session = workspace.living_session
        if request.path:
            delta = SceneDelta.load(workspace.existing(request.path), workspace.root)
        else:
            delta = delta_from_message(request.delta)
        with workspace.run("update_scene"):
            changed = self._update(session, delta)
        response.revision, response.num_gaussians = changed.revision, len(changed.scene)
        for name in ("removed", "added", "views_kept", "views_lifted", "views_unknown"):
            setattr(response, f"num_{name}", getattr(changed, f"num_{name}"))
        response.scene_hash, response.seconds = changed.scene.digest, time.perf_counter() - started

    def on_scene_delta(self, message: SceneDeltaMessage) -> None:
        """Change the scene by a message of the topic."""
        try:
            with self.workspace.requests.one():
                self.workspace.require_active()
                self._update(self.workspace.living_session, delta_from_message(message))
        except Exception as error:
            self.workspace.changes["refused"] += 1
            # What was not foreseen is logged with its traceback, too.
            why = str(error) if isinstance(error, GssegError) else explain(self._services, error)
            message = f"topic scene_delta: {why.removeprefix('scene delta: ')}"
            self.workspace.refused_change = (time.monotonic(), message)
            self._complain(message)

    @answered
    @in_turn
    def merge_states(self, request: MergeStates.Request, response: MergeStates.Response) -> None:
        """Add what other robots have learnt of the scene."""
        workspace = self.workspace
        if not request.paths:
            raise InvalidRequestError("paths are empty; expected at least one state")
        session, paths = workspace.living_session, [workspace.existing(path) for path in request.paths]
        with workspace.slot.take("merge_states"), workspace.run("merge_states"):
            self._require_current(session)
            response.num_merged = session.merge(paths, workspace.root)
            self._services.show()
            response.num_views, response.class_names = session.num_fused, list(session.class_names.values())

    def _update(self, session: LivingSession, delta: SceneDelta) -> Changed:
        if stamps := {view for move in delta.moves for view in move.views if view.isdecimal()}:
            self._await_fused(stamps)
        try:
            # Between what it is named by, where views are and what is fused, nothing else may happen.
            with self.workspace.placement.fusing:
                delta = _with_names(delta, session, self.workspace.activations) if stamps else delta
                self.workspace.placement.bring(view for move in delta.moves for view in move.views)
                changed = session.update(delta)
        except (SceneDeltaError, EmptySceneError) as error:
            raise InvalidRequestError(str(error)) from error
        self._require_current(session)
        self.workspace.count(changed)
        self._services.show()
        return changed

    def _require_current(self, session: LivingSession) -> None:
        """Raise `InvalidRequestError` where another scene was loaded while a file was read."""
        if self.workspace.loaded is not session:
            raise InvalidRequestError(
                "another scene was loaded meanwhile, and was not changed; expected the request again, if it is for "
                "that one"
            )


def _with_names(delta: SceneDelta, session: LivingSession, own: Container[str]) -> SceneDelta:
    """Replace stamps among the views of a change by the names of the views that carry them.

    Where time was set back, or the node was activated again, these are those of the last time of each camera. Views of
    its own activations go before others, which may be another robot's: in one simulator they carry the same stamps.
    """
    stamped: dict[str, dict[str, list[ViewName]]] = {}  # by stamp and camera
    for name in filter(None, map(ViewName.of, session.view_names)):
        newest = stamped.setdefault(name.stamp, {}).setdefault(name.camera, [])
        if newest and newest[0].activation in own and name.activation not in own:
            continue
        if newest and (newest[0].activation, newest[0].epoch) != (name.activation, name.epoch):
            newest.clear()
        newest.append(name)

    def named(views: tuple[str, ...]) -> tuple[str, ...]:
        found = ([str(name) for names in stamped.get(view, {}).values() for name in names] or [view] for view in views)
        return tuple(itertools.chain.from_iterable(found))

    return replace(delta, moves=tuple(replace(move, views=named(move.views)) for move in delta.moves))
