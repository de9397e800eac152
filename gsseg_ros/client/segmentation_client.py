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
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from geometry_msgs.msg import Point
from gsseg_msgs.action import Learn
from gsseg_msgs.srv import Pick, RenderView, Segment
from rclpy.action import ActionClient

from gsseg_ros.client.calls import LearnGoal, class_names, refinement
from gsseg_ros.client.results import (
    LearnResult,
    PickedObject,
    RenderedView,
    SegmentResult,
    Viewpoint,
    seconds_of,
)
from gsseg_ros.client.run_clouds import RunClouds
from gsseg_ros.client.scene_requests import SceneRequests
from gsseg_ros.cloud_messages import arrays_from_cloud
from gsseg_ros.conversions import labels_from_image, mask_image, picture_from_image, viewpoint_messages
from gsseg_ros.object_messages import box_from_object
from gsseg_ros.qos import FEEDBACK_DEPTH, reliable


class SegmentationClient(SceneRequests):
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

    def _reach(self, node: Any) -> None:
        self._learn: Any = ActionClient(
            node, Learn, f"{self._name}/learn", feedback_sub_qos_profile=reliable(FEEDBACK_DEPTH)
        )
        self._learning: set[LearnGoal] = set()
        self._clouds = RunClouds(self._spinner, f"{self._name}/cloud")

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
            Among others BUSY where another job is running, and CANCELED after `cancel`; then nothing has been learnt.
        ValueError
            A number of views or steps is below 0.
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
        granularity: float | None = None,
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
        granularity : float, optional
            Of a node with ids per-view: level of parts and wholes, from 0, wholes, to 1, all parts, or below 0 the
            objects; by default what the node's parameter says.
        timeout : float
            Seconds.
        """
        deadline = time.monotonic() + timeout
        request = Segment.Request(
            classes=class_names(classes), min_confidence=float(min_confidence), publish_nothing=not publish,
            granularity=[] if granularity is None else [float(granularity)], **refinement(refine, filter),
        )  # fmt: skip
        if viewpoint is not None:
            request.viewpoint_pose, request.viewpoint_camera = viewpoint_messages(viewpoint.camera)
        with self._clouds.kept():
            answer = self._call(Segment, request, timeout)
            cloud = None if publish else answer.cloud
            while cloud is None and (cloud := self._clouds.of_run(answer.report, deadline)) is None:
                answer = self._call(Segment, request, deadline - time.monotonic())
        points, rgb, labels, confidence = arrays_from_cloud(cloud)
        asked = np.isin(labels, [summary.class_id for summary in answer.report.classes])
        drawn = labels_from_image(answer.label_image, "label_image") if answer.label_image.width else None
        boxes = {thing.id: box_from_object(thing) for thing in answer.objects}
        return SegmentResult(points[asked], labels[asked], confidence[asked], rgb[asked], answer.report, drawn, boxes)

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
        answer = self._call(Pick, request, timeout)
        cloud, index = arrays_from_cloud(answer.cloud), np.array(answer.indices, np.int64)
        box = box_from_object(answer.object) if len(index) else None
        return PickedObject(index, cloud.points, cloud.confidence, box, seconds_of(answer.stages))

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
        return RenderedView(
            labels_from_image(answer.label_image, "label_image"),
            picture_from_image(answer.confidence_image, "confidence_image") if answer.confidence_image.width else None,
            picture_from_image(answer.overlay_image, "overlay_image") if answer.overlay_image.width else None,
            seconds_of(answer.stages),
        )
