"""The action `~/learn`: learns from the views received or from a dataset folder, with feedback and cancel."""

from __future__ import annotations

import time
from typing import Any

from gsseg_msgs.action import Learn
from gsseg_msgs.msg import SegmentationReport
from rclpy.action.server import ActionServer, CancelResponse, GoalResponse, ServerGoalHandle
from rclpy.callback_groups import ReentrantCallbackGroup
from std_msgs.msg import Header

from gsseg_core.data.dataset import Dataset
from gsseg_core.learn.registry import LEARNERS
from gsseg_core.live.results import Outcome
from gsseg_core.live.session import LiveSession
from gsseg_core.refine.settings import UNREFINED
from gsseg_ros.errors import CanceledError, InvalidRequestError, NotActiveError, error_code, kind_of
from gsseg_ros.node.diagnostics import renamed_ids_of
from gsseg_ros.node.jobs import Job
from gsseg_ros.node.reports import Selection, finish, report_message
from gsseg_ros.node.services import Services, explain
from gsseg_ros.node.workspace import Run
from gsseg_ros.qos import FEEDBACK_DEPTH, reliable

FEEDBACK_PERIOD = 0.1
"""Seconds between two messages of feedback, at least; a new stage is always told."""

MAX_STEPS = 1_000_000
"""Steps at most that a goal may ask for: so many over four thousand views can be counted in its feedback."""


class LearnAction:
    """Runs one learn job at a time; a second goal is aborted with BUSY.

    A goal is rejected while the node is not active.

    When it is done, the learnt objects are published, before refinement as in its report. Canceled or failed, it has
    learnt nothing; objects of ids per-view that it had repaired by then stay so, and are shown as after a view.
    """

    def __init__(self, services: Services) -> None:
        self._services, self._workspace = services, services.workspace
        self._server = ActionServer(
            services.node, Learn, "~/learn", self._execute, goal_callback=self._welcome,
            cancel_callback=lambda goal: CancelResponse.ACCEPT, callback_group=ReentrantCallbackGroup(),
            feedback_pub_qos_profile=reliable(FEEDBACK_DEPTH),
        )  # fmt: skip

    def close(self) -> None:
        """Take the action away."""
        self._server.destroy()

    def _welcome(self, goal: Learn.Goal) -> GoalResponse:
        try:
            self._workspace.require_active()
        except NotActiveError as error:
            self._services.complaints.add(kind_of(error), f"a goal of learn is rejected: {error}")
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def _execute(self, goal: ServerGoalHandle) -> Learn.Result:
        result = Learn.Result()
        try:
            self._workspace.require_active()
            with self._workspace.slot.take("learn") as job, self._workspace.run("learn") as run:
                self._learn(goal, job, run, result)
            goal.succeed()
        except Exception as error:
            result = Learn.Result(error_code=error_code(error, Learn.Result), error_msg=explain(self._services, error))
            if isinstance(error, CanceledError) and goal.is_cancel_requested:
                goal.canceled()
            else:
                goal.abort()
        return result

    def _learn(self, goal: ServerGoalHandle, job: Job, run: Run, result: Learn.Result) -> None:
        request, session = goal.request, self._workspace.session
        learner = request.learner or "em"
        if learner not in LEARNERS:
            raise InvalidRequestError(f"learner is '{learner[:60]}'; expected one of {', '.join(LEARNERS)}")
        if request.max_steps > MAX_STEPS:
            raise InvalidRequestError(f"max_steps is {request.max_steps}; expected at most {MAX_STEPS}")
        dataset = None
        if request.dataset_path:
            with run.watch.stage("load"):
                dataset = self._dataset(request)
        elif request.labels or request.label_map:
            raise InvalidRequestError("labels and label_map are those of a dataset; expected dataset_path beside them")
        self._workspace.placement.finish(job.check)  # What is learnt of views stays as it is where they move.
        version, known, scene = session.version, renamed_ids_of(session), session.scene
        try:
            outcome = session.learn(
                learner,
                dataset,
                num_views=request.num_views or None,
                max_steps=request.max_steps or None,
                report=_Feedback(goal, job),
                watch=run.watch,
            )
        except Exception:
            if session.version != version:
                self._services.show()
            raise
        with run.watch.stage("compare"):
            wrong_frames = self._workspace.frames.look(session, scene, outcome)
        for note in (wrong_frames, "" if known else renamed_ids_of(session)):
            if note:
                self._services.node.get_logger().warning(note)
        self._workspace.number(run)
        result.num_steps, result.converged, result.loss = outcome.num_steps, outcome.converged, outcome.loss
        result.report = self._report(session, outcome, run)

    def _dataset(self, request: Learn.Goal) -> Dataset:
        """Open the dataset of a goal; raises `InvalidRequestError` where its ids are no classes."""
        workspace = self._workspace
        folder = workspace.existing(request.dataset_path)
        labels, label_map = (workspace.existing_in(folder, path) for path in (request.labels, request.label_map))
        dataset = Dataset(folder, labels or "labels", label_map=label_map, within=workspace.root)
        if dataset.masks is not None and dataset.masks.per_view:
            raise InvalidRequestError(
                f"{labels}: ids hold in their own view only, as {dataset.masks.format} has them; expected masks whose "
                "ids mean the same in every view (gsseg segment learns from the others)"
            )
        return dataset

    def _report(self, session: LiveSession, outcome: Outcome, run: Run) -> SegmentationReport:
        settings, version = self._workspace.settings, session.version
        raw = session.segmentation(UNREFINED, run.watch)
        selection = Selection(session, raw, sorted(raw.class_names), 0.0, settings.scene_to_map)
        with run.watch.stage("boxes"):
            header = Header(stamp=run.stamp, frame_id=settings.map_frame)
            objects, outputs = selection.objects(header, run.revision), self._services.outputs()
        with outputs.turn(run.revision, lambda: self._workspace.holds(run)) as newest:
            if newest:
                outputs.publish_objects(objects)
        if session.version != version:  # Views that came meanwhile are not in these objects.
            self._services.show()
        report = report_message(run, selection, UNREFINED, settings.map_frame)
        if outcome.rejected:
            reasons = sorted(set(outcome.rejected.values()))
            report.rejection_reasons = [reason.replace(" ", "_") for reason in reasons]
            report.rejection_counts = [list(outcome.rejected.values()).count(reason) for reason in reasons]
            report.num_views_rejected = len(outcome.rejected)
        return finish(report, run)


class _Feedback:
    """Tells the client how far the work is, and stops it when that was asked."""

    def __init__(self, goal: ServerGoalHandle, job: Job) -> None:
        self._goal, self._job = goal, job
        self._told: tuple[str, float] = ("", 0.0)

    def __call__(self, stage: str, done: int, total: int, loss: float) -> None:
        if self._goal.is_cancel_requested or not self._goal.is_active:
            self._job.cancel()
        self._job.check()
        now = time.monotonic()
        if stage == self._told[0] and now - self._told[1] < FEEDBACK_PERIOD and done < total:
            return
        self._told = (stage, now)
        feedback: Any = Learn.Feedback(stage=stage, done=done, total=total, loss=loss)
        self._goal.publish_feedback(feedback)
