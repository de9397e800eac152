"""Changes the node's scene and keeps what was learnt: ~/update_scene, the topic scene_delta, and ~/merge_states."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from dataclasses import replace

from gsseg_msgs.msg import SceneDelta as SceneDeltaMessage
from gsseg_msgs.srv import MergeStates, UpdateScene
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup

from gsseg_core.errors import EmptySceneError, GssegError, SceneDeltaError
from gsseg_core.live.living_session import Changed, LivingSession
from gsseg_core.scene.scene_delta import SceneDelta
from gsseg_ros.delta_messages import delta_from_message
from gsseg_ros.errors import InvalidRequestError
from gsseg_ros.node.services import Services, answered, explain, in_turn
from gsseg_ros.qos import requests

_STAMP = re.compile(r"[0-9]+")


class SceneChanges:
    """Creates the services and the subscription, and answers them.

    What is wrong with a message of the topic goes to the log and to /diagnostics, and changes nothing. A learn job need
    not be canceled: what it learns is carried over to the scene as it is then.

    Parameters
    ----------
    services : Services
        Those of the node: requests here take turns with theirs.
    complain : callable
        Told in one line what is wrong with a message of the topic.
    show : callable
        Called after each change: has objects published as after a view, while clouds wait for the next run.
    await_fused : callable
        Waits until masks of some stamps that have come are fused: a change may name keyframes that are just under way.
    """

    def __init__(
        self,
        services: Services,
        complain: Callable[[str], None],
        show: Callable[[], None],
        await_fused: Callable[[set[str]], None],
    ) -> None:
        self.node, self.workspace, self.turns = services.node, services.workspace, services.turns
        self._complain, self._show, self._await_fused = complain, show, await_fused
        group = ReentrantCallbackGroup()
        for interface, name, handler in (
            (UpdateScene, "update_scene", self.update_scene),
            (MergeStates, "merge_states", self.merge_states),
        ):
            self.node.create_service(interface, f"~/{name}", handler, qos_profile=requests(), callback_group=group)
        # Reliable and one after the other: each change goes by the one before it.
        self.node.create_subscription(
            SceneDeltaMessage, "scene_delta", self.on_scene_delta, requests(),
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
        response.revision, response.num_gaussians = changed.revision, len(session.scene)
        for name in ("removed", "added", "views_kept", "views_lifted", "views_unknown"):
            setattr(response, f"num_{name}", getattr(changed, f"num_{name}"))
        response.scene_hash, response.seconds = session.scene.digest, time.perf_counter() - started

    def on_scene_delta(self, message: SceneDeltaMessage) -> None:
        """Change the scene by a message of the topic."""
        try:
            self.workspace.require_active()
            self._update(self.workspace.living_session, delta_from_message(message))
        except Exception as error:
            self.workspace.changes["refused"] += 1
            # What was not foreseen is logged with its traceback, too.
            why = str(error) if isinstance(error, GssegError) else explain(self.node, error)
            self._complain(f"topic scene_delta: {why.removeprefix('scene delta: ')}")

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
            self._show()
        response.num_views, response.class_names = session.num_fused, list(session.class_names.values())

    def _update(self, session: LivingSession, delta: SceneDelta) -> Changed:
        if stamps := {view for move in delta.moves for view in move.views if _STAMP.fullmatch(view)}:
            self._await_fused(stamps)
        try:
            changed = session.update(_with_names(delta, session) if stamps else delta)
        except (SceneDeltaError, EmptySceneError) as error:
            raise InvalidRequestError(str(error)) from error
        self._require_current(session)
        self.workspace.count(changed)
        self._show()
        return changed

    def _require_current(self, session: LivingSession) -> None:
        """Raise `InvalidRequestError` where another scene was loaded while a file was read."""
        if not self.workspace.has_scene or self.workspace.session is not session:
            raise InvalidRequestError("another scene was loaded meanwhile, and is unchanged; expected one that stays")


def _with_names(delta: SceneDelta, session: LivingSession) -> SceneDelta:
    """Replace stamps among the views of a change by the names of the views that carry them."""
    stamped: dict[str, list[str]] = {}
    for view in session.views:
        # The name of a view ends in its stamp, and at one stamp in the number of its camera; see `pairing`.
        for stamp in filter(_STAMP.fullmatch, view.name.split("_")[-2:]):
            stamped.setdefault(stamp, []).append(view.name)

    def named(views: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(name for view in views for name in stamped.get(view, [view]))

    return replace(delta, moves=tuple(replace(move, views=named(move.views)) for move in delta.moves))
