"""Drives the segmentation node from any Python program or notebook: requests block, and return arrays.

with SegmentationClient() as client:
    client.wait_until_active()
    client.learn()
    mug = client.segment().objects["mug"]
    print(mug.points, mug.confidence)
"""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Point
from gsseg_msgs.action import Learn
from gsseg_msgs.srv import Export, LoadScene, LoadState, Pick, RenderView, Reset, SaveState, Segment
from lifecycle_msgs.msg import State
from lifecycle_msgs.srv import GetState
from rclpy.action import ActionClient
from rclpy.context import Context

from gsseg_ros.client.answers import picked_object, rendered_view, segment_result
from gsseg_ros.client.calls import Calls, LearnGoal, class_names, refinement
from gsseg_ros.client.results import (
    Exported,
    LearnResult,
    LoadedScene,
    LoadedState,
    PickedObject,
    RenderedView,
    SavedState,
    SegmentResult,
    Viewpoint,
)
from gsseg_ros.client.run_clouds import RunClouds
from gsseg_ros.client.spinner import Spinner
from gsseg_ros.conversions import array_from_point, arrays_from_cloud, mask_image, viewpoint_messages
from gsseg_ros.errors import NodeUnavailableError

_SERVICES = {
    Segment: "segment", Pick: "pick", RenderView: "render_view", LoadScene: "load_scene", SaveState: "save_state",
    LoadState: "load_state", Export: "export", Reset: "reset", GetState: "get_state",
}  # fmt: skip

ASK_SECONDS, POLL_SECONDS = 2.0, 0.2
"""Until a question for the node's state is asked again, unanswered and answered."""


class SegmentationClient:
    """Talks to a segmentation node. Its methods block, and may be called from several threads.

    Every method raises `SegmentationError` where the node answers that it failed, and `NodeUnavailableError`, which is
    a TimeoutError, where there is no node or no answer in time; the message says what to check. Paths are those of the
    node's machine, below its parameter `data_root`, absolute or relative to that.

    Parameters
    ----------
    node_name : str
        Name of the node, with its namespace if it has one: "robot1/gsseg".
    context : rclpy.context.Context, optional
        Of the program, if the client is to live there; by default it has one of its own.
    domain_id : int, optional
        ROS domain, if not that of the environment.
    find_timeout : float
        Seconds to look for the node before it is taken for absent.
    """

    def __init__(
        self,
        node_name: str = "gsseg",
        *,
        context: Context | None = None,
        domain_id: int | None = None,
        find_timeout: float = 10.0,
    ) -> None:
        self._name = "/" + node_name.strip("/")
        self._spinner = Spinner("gsseg_client", context, domain_id)
        self._calls = Calls(self._spinner, self._name, find_timeout)
        node = self._spinner.node
        # The question for the state comes last: the node hears of them in this order, and an answer to someone it has
        # not heard of yet is lost; so once it has told its state, none is.
        self._learn: Any = ActionClient(node, Learn, f"{self._name}/learn")
        self._clients = {kind: node.create_client(kind, f"{self._name}/{name}") for kind, name in _SERVICES.items()}
        self._clouds = RunClouds(self._spinner, f"{self._name}/cloud")
        self._diagnostics: Any = None
        self._statuses: deque[Any] = deque(maxlen=10)
        self._learning: set[LearnGoal] = set()

    def __enter__(self) -> SegmentationClient:
        """Do nothing: it is ready."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close it."""
        self.close()

    def close(self) -> None:
        """Take the client away; the node goes on."""
        self._spinner.close()

    def wait_until_active(self, timeout: float = 120.0) -> None:
        """Wait until the node is there and active. At its first start after installing, kernels compile for a minute.

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
            # Asked again and again, for the node may have been started anew meanwhile.
            asked = self._spinner.run(lambda: client.call_async(GetState.Request()))
            if self._spinner.wait_for(asked.done, min(ASK_SECONDS, deadline - time.monotonic())):
                state = asked.result().current_state.label
                if asked.result().current_state.id == State.PRIMARY_STATE_ACTIVE:
                    return
                self._spinner.wait_for(lambda: False, min(POLL_SECONDS, deadline - time.monotonic()))
            client.remove_pending_request(asked)
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
        if self._diagnostics is None:
            self._diagnostics = self._spinner.node.create_subscription(
                DiagnosticArray, "/diagnostics", self._on_diagnostics, 10
            )
        said = None
        self._statuses.clear()
        while self._spinner.wait_for(lambda: self._statuses, deadline - time.monotonic()):
            said = self._statuses.popleft()
            values = {value.key: value.value for value in said.values}
            views = int(values.get("views fused", 0))
            if on_views is not None:
                on_views(views)
            if views >= count:
                return views
        if said is None:
            raise self._calls.absent("its status on /diagnostics", timeout)
        rejected = [f"{key}: {value}" for key, value in values.items() if key.startswith("rejected ")]
        raise NodeUnavailableError(
            f"{self._name} has fused {views} of {count} views after {timeout:g} s; it says: "
            + "; ".join([said.message, *rejected])
        )

    def learn(
        self,
        dataset_path: str | os.PathLike[str] = "",
        learner: str = "em",
        num_views: int = 0,
        max_steps: int = 0,
        on_feedback: Callable[[str, int, int, float], object] | None = None,
        *,
        labels: str | os.PathLike[str] = "",
        label_map: str | os.PathLike[str] = "",
        timeout: float = 3600.0,
    ) -> LearnResult:
        """Learn class probabilities. Ctrl-C, an error in `on_feedback`, or running out of time cancels it.

        Parameters
        ----------
        dataset_path : path
            Folder of a dataset, to learn from its train views; by default from the views that the node received.
        learner : str
            "em", "votes" or "gradient".
        num_views : int
            Use this many views, spread evenly; 0: all.
        max_steps : int
            Stop after this many steps; 0: when it converges.
        on_feedback : callable, optional
            Called in this thread with stage, done, total, loss (nats per pixel, NaN at first), ten times a second.
        labels, label_map : path
            The dataset's masks, plain or soft, and what renames their classes, as for `gsseg segment`; by default its
            folder labels, as they are.
        timeout : float
            Seconds.

        Raises
        ------
        SegmentationError
            Among others BUSY where another job is running, and CANCELED after `cancel`; then nothing has changed.
        """
        for name, count in (("num_views", num_views), ("max_steps", max_steps)):
            if not 0 <= count < 2**32:
                raise ValueError(f"{name} is {count}; expected a whole number from 0")
        goal = Learn.Goal(
            dataset_path=os.fspath(dataset_path), learner=learner, num_views=int(num_views), max_steps=int(max_steps),
            labels=os.fspath(labels), label_map=os.fspath(label_map),
        )  # fmt: skip
        deadline = time.monotonic() + timeout
        self._calls.find(self._learn.server_is_ready, f"action {self._name}/learn", timeout)
        running = LearnGoal(self._calls, self._learn, goal)
        self._learning.add(running)
        try:
            result = running.run(on_feedback, deadline)
        finally:
            self._learning.discard(running)
        return LearnResult(result.report, result.num_steps, result.converged, result.loss)

    def cancel(self) -> bool:
        """Cancel the `learn` that another thread is in, which then raises a CANCELED `SegmentationError` there.

        Returns
        -------
        bool
            Whether there was one. It may yet come to its end, if it was about to.
        """
        running = list(self._learning)
        for goal in running:
            goal.cancel()
        return bool(running)

    def segment(
        self,
        classes: Sequence[str | int] = (),
        min_confidence: float = 0.0,
        refine: bool | str = True,
        filter: bool = True,
        viewpoint: Viewpoint | None = None,
        publish: bool = True,
        *,
        timeout: float = 60.0,
    ) -> SegmentResult:
        """Get every object of the scene; the node publishes them, too.

        Parameters
        ----------
        classes : sequence of str or int
            Names or numbers of the classes wanted; by default all. What is published has all classes.
        min_confidence : float
            Leave out Gaussians less sure than this, 0 to 1.
        refine : bool or str
            Whether codes are refined by their neighbours, and what comes after that: "paper", outliers are removed, as
            by default, or "carve", objects are cut to their silhouettes, as `export` does by default.
        filter : bool
            Whether anything comes after that.
        viewpoint : Viewpoint, optional
            Where to draw a label image from, too.
        publish : bool
            False: the answer is for this caller alone, and no topic of the node changes.
        timeout : float
            Seconds.
        """
        deadline = time.monotonic() + timeout
        request = Segment.Request(
            classes=class_names(classes), min_confidence=float(min_confidence), publish_nothing=not publish,
            **refinement(refine, filter),
        )  # fmt: skip
        if viewpoint is not None:
            request.viewpoint_pose, request.viewpoint_camera = viewpoint_messages(viewpoint.camera)
        with self._clouds.kept():
            answer = self._call(Segment, request, timeout)
            cloud = None if publish else answer.cloud
            while cloud is None and (cloud := self._clouds.of_run(answer.report.header, deadline)) is None:
                answer = self._call(Segment, request, deadline - time.monotonic())
        return segment_result(answer, arrays_from_cloud(cloud))

    def pick(
        self,
        viewpoint: Viewpoint,
        mask: npt.NDArray[np.integer[Any]] | None = None,  # (H, W)
        inside: Sequence[tuple[float, float]] = (),
        outside: Sequence[tuple[float, float]] = (),
        *,
        timeout: float = 60.0,
    ) -> PickedObject:
        """Get one object that is shown in one view, by a mask or by points; needs nothing learnt, and changes nothing.

        Parameters
        ----------
        viewpoint : Viewpoint
            The view, without distortion.
        mask : (H, W) int, optional
            1 where the object is, 0 where not, -1 where nothing is said.
        inside, outside : sequences of (column, row)
            In place of a mask: pixels of the object, and pixels that are not of it.
        timeout : float
            Seconds.
        """
        pose, info = viewpoint_messages(viewpoint.camera)
        request = Pick.Request(viewpoint_pose=pose, viewpoint_camera=info)
        if mask is not None:
            request.mask = mask_image(mask, info.header, 16)
        for name, pixels in (("inside", inside), ("outside", outside)):
            setattr(request, name, [Point(x=float(column), y=float(row)) for column, row in pixels])
        return picked_object(self._call(Pick, request, timeout))

    def render_view(
        self,
        viewpoint: Viewpoint,
        refine: bool | str = True,
        filter: bool = True,
        with_confidence: bool = False,
        with_overlay: bool = False,
        *,
        timeout: float = 60.0,
    ) -> RenderedView:
        """Get what a viewpoint sees: label image, and on request confidence and a picture."""
        pose, info = viewpoint_messages(viewpoint.camera)
        request = RenderView.Request(
            viewpoint_pose=pose,
            viewpoint_camera=info,
            with_confidence=with_confidence,
            with_overlay=with_overlay,
            **refinement(refine, filter),
        )
        answer = self._call(RenderView, request, timeout)
        return rendered_view(answer)

    def load_scene(self, path: str | os.PathLike[str] = "", *, timeout: float = 120.0) -> LoadedScene:
        """Load another scene, and forget all views and what was learnt; by default the node's `scene_path` again."""
        answer = self._call(LoadScene, LoadScene.Request(path=os.fspath(path)), timeout)
        box = array_from_point(answer.box_min), array_from_point(answer.box_max)
        return LoadedScene(Path(answer.path), answer.scene_hash, answer.num_gaussians, box)

    def save_state(self, path: str | os.PathLike[str] = "", *, timeout: float = 60.0) -> SavedState:
        """Save votes, views and class probabilities; by default in gsseg_state.npz in `data_root`."""
        answer = self._call(SaveState, SaveState.Request(path=os.fspath(path)), timeout)
        return SavedState(Path(answer.path), answer.num_bytes, answer.num_views)

    def load_state(self, path: str | os.PathLike[str] = "", *, timeout: float = 60.0) -> LoadedState:
        """Load a saved state in place of the present one."""
        answer = self._call(LoadState, LoadState.Request(path=os.fspath(path)), timeout)
        return LoadedState(Path(answer.path), dict(enumerate(answer.class_names)), answer.num_views)

    def export(
        self,
        directory: str | os.PathLike[str] = "",
        classes: Sequence[str | int] = (),
        min_confidence: float = 0.0,
        refine: bool | str = True,
        filter: bool = True,
        format: str = "",
        collision: str = "",
        *,
        timeout: float = 120.0,
    ) -> Exported:
        """Write segmentation.npz, one PLY per class, and report.json; by default to gsseg_export in `data_root`.

        `format` and `collision` are those of `gsseg segment`; by default as the node's parameter `export_format` says,
        without meshes. Objects are cut to their silhouettes unless `refine` is "paper".
        """
        request = Export.Request(
            directory=os.fspath(directory),
            classes=class_names(classes),
            min_confidence=float(min_confidence),
            format=format,
            collision=collision,
            **refinement(refine, filter),
        )
        answer = self._call(Export, request, timeout)
        folder = Path(answer.directory)
        return Exported(folder, [folder / name for name in answer.files], answer.report)

    def reset(self, *, timeout: float = 30.0) -> int:
        """Forget all views and what was learnt, and clear the clouds; return how many views were forgotten."""
        return int(self._call(Reset, Reset.Request(), timeout).num_views_dropped)

    def _call(self, kind: Any, request: Any, timeout: float) -> Any:
        return self._calls.call(self._clients[kind], request, timeout)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self._statuses.extend(status for status in message.status if status.name == self._name)
