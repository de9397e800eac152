"""Answers the node's services: each request becomes calls of the core, each error an error code and one line."""

from __future__ import annotations

import functools
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeAlias

from gsseg_msgs.srv import Export, LoadScene, LoadState, Pick, RenderView, Reset, SaveState, Segment
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.lifecycle import LifecycleNode
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from gsseg_core.errors import GssegError, memory_ran_out
from gsseg_core.export.class_files import mesh_file_name, write_classes
from gsseg_core.export.collision import check_collision, collision_meshes
from gsseg_core.export.summary import RunReport
from gsseg_core.files.json_files import write_json
from gsseg_core.live.session import LiveSession
from gsseg_core.refine.settings import RefineSettings
from gsseg_core.scene.scene_writers import check_format
from gsseg_core.segmentation import Segmentation
from gsseg_core.text import one_line
from gsseg_ros.camera_infos import is_rectified
from gsseg_ros.errors import InvalidRequestError, error_code, kind_of
from gsseg_ros.node.complaints import Complaints
from gsseg_ros.node.jobs import Turns
from gsseg_ros.node.output_folders import pinned_folder, require_own_folder, staged_export
from gsseg_ros.node.outputs import Outputs
from gsseg_ros.node.picking import fill_answer, pick_object
from gsseg_ros.node.reports import Selection, empty_report, finish, report_message, stage_timings
from gsseg_ros.node.request_fields import checked_confidence, chosen_classes, level_of, refinement
from gsseg_ros.node.scene_frame import placed, placed_by
from gsseg_ros.node.viewpoints import Lookup, draw, viewpoint
from gsseg_ros.node.workspace import Run, Workspace
from gsseg_ros.object_messages import point_message
from gsseg_ros.qos import reliable

STATE_FILE, EXPORT_FOLDER = "gsseg_state.npz", "gsseg_export"

_PUBLISHED = ("min_confidence", "skip_refinement", "skip_filter", "refine", "granularity")
"""Fields of a request of ~/segment that decide what is published."""

AT_WORK, WAITING = 2, 4
"""Most long requests that work at a time, and that wait besides; each holds a thread of the executor."""

Handler: TypeAlias = Callable[..., None]
"""A method that fills in the response to a request."""


def answered(handler: Handler) -> Callable[..., Any]:
    """Make a handler answer every error with its code and one line; nothing that a request asks may end the node."""

    @functools.wraps(handler)
    def answer(self: Services, request: Any, response: Any) -> Any:
        try:
            with self.workspace.requests.one():
                self.workspace.require_active()
                handler(self, request, response)
        except Exception as error:
            response = type(response)()  # Nothing half filled in goes out.
            response.error_code = error_code(error, type(response))
            response.error_msg = explain(self, error)
        return response

    return answer


def in_turn(handler: Handler) -> Handler:
    """Make a handler wait until few others are at work; where many wait already it raises `BusyError` at once."""

    @functools.wraps(handler)
    def work(self: Services, request: Any, response: Any) -> None:
        with self.turns.take(handler.__name__):
            self.workspace.require_active()  # It may have waited for long.
            handler(self, request, response)

    return work


def explain(services: Services, error: Exception) -> str:
    """Log what went wrong, and say it in one line; what was not foreseen is logged with its traceback."""
    if isinstance(error, GssegError):
        services.complaints.add(kind_of(error), str(error))  # Clients may ask again and again until it is otherwise.
        return str(error)
    services.node.get_logger().error(describe(error))
    return one_line(f"{_unforeseen(error)}; the node's log has the details")


def describe(error: Exception) -> str:
    """Describe an error in one line if it was foreseen, with its traceback if not."""
    if isinstance(error, GssegError):
        return str(error)
    return one_line(_unforeseen(error)) + f"\n{traceback.format_exc()}"


def _unforeseen(error: Exception) -> str:
    """Name what went wrong; where memory is short, a thread or a library that found none says so in its own words."""
    return f"unexpected {'MemoryError' if memory_ran_out(error) else type(error).__name__}: {error}"


class Services:
    """Creates the services and answers their requests.

    The outputs exist while the node is configured, and what looks up transforms while it is active and has tf2_ros.
    `show` is called after each change of what is known: objects are published as after a view, clouds wait for the next
    run.
    """

    def __init__(
        self,
        node: LifecycleNode,
        workspace: Workspace,
        complaints: Complaints,
        outputs: Callable[[], Outputs],
        lookup: Callable[[], Lookup | None],
        show: Callable[[], None],
    ) -> None:
        self.node, self.workspace, self.complaints, self.show = node, workspace, complaints, show
        self.turns = Turns(AT_WORK, WAITING)
        self.outputs, self._lookup = outputs, lookup
        # Reentrant: a request must not wait for another one to be answered.
        group = ReentrantCallbackGroup()
        for interface, name, handler in (
            (Segment, "segment", self.segment),
            (Pick, "pick", self.pick),
            (RenderView, "render_view", self.render_view),
            (LoadScene, "load_scene", self.load_scene),
            (SaveState, "save_state", self.save_state),
            (LoadState, "load_state", self.load_state),
            (Export, "export", self.export),
            (Reset, "reset", self.reset),
        ):
            node.create_service(interface, f"~/{name}", handler, qos_profile=reliable(), callback_group=group)

    @answered
    @in_turn
    def segment(self, request: Segment.Request, response: Segment.Response) -> None:
        """Segment the scene, answer with what was asked for, and publish all classes, unless that is not wanted."""
        outputs = self.outputs()
        with self.workspace.run("segment") as run:
            overlay, version = Image(), self.workspace.session.version
            selection, refine = self._select(request, run)
            settings = self.workspace.settings  # As the selection has them: the scene may have been put elsewhere.
            self.workspace.number(run)
            if request.viewpoint_camera.width:
                camera = viewpoint(request, settings, self._lookup())
                header = Header(stamp=run.stamp, frame_id=request.viewpoint_camera.header.frame_id)
                with run.watch.stage("render"):
                    with_overlay = outputs.wants_overlay() and not request.publish_nothing
                    drawing = draw(selection, camera, header, with_overlay=with_overlay)
                response.label_image, overlay = drawing.labels, drawing.overlay
            header = self._header(run)
            if request.publish_nothing:
                response.cloud = selection.objects_cloud(header)
                with run.watch.stage("boxes"):
                    response.objects = selection.objects(header, run.revision).objects
                response.report = finish(report_message(run, selection, refine, settings.map_frame), run)
                return
            everything = selection.of_all_classes
            with run.watch.stage("boxes"):
                objects = everything.objects(header, run.revision)
            with outputs.turn(run.revision, lambda: self.workspace.holds(run)) as newest:
                if newest:
                    with run.watch.stage("publish"):
                        outputs.publish_clouds(everything, header)
                topics = outputs.topics(everything.result.class_names)
                report = finish(report_message(run, everything, refine, settings.map_frame, topics), run)
                if newest:
                    outputs.publish_objects(objects)
                    if overlay.width:
                        outputs.publish_overlay(overlay)
                    outputs.publish_report(report)
                    outputs.latched = Segment.Request(**{name: getattr(request, name) for name in _PUBLISHED})
            if selection.session.version != version:  # Views that came meanwhile are not in these objects.
                self.show()
            # What is published is serialised by now.
            report.classes = [summary for summary in report.classes if summary.class_id in selection.chosen]
            response.report = report
            response.objects = [thing for thing in objects.objects if thing.id in selection.chosen]

    def publish_again(self, request: Segment.Request) -> None:
        """Publish anew what a request has had published, of what is known now; while many others are at work, wait."""
        while self.segment(request, Segment.Response()).error_code == Segment.Response.BUSY:
            self.turns.await_place()

    @answered
    @in_turn
    def pick(self, request: Pick.Request, response: Pick.Response) -> None:
        """Pick one object of one view."""
        settings, scene = self.workspace.settings, self.workspace.session.scene
        inputs = (
            [f"{camera}/{role}".lstrip("/") for role in ("mask", "camera_info")] for camera in settings.cameras or ("",)
        )
        rectified = all(is_rectified(settings.rectified, *map(self.node.resolve_topic_name, names)) for names in inputs)
        with self.workspace.run("pick") as run:
            with run.watch.stage("pick"):
                picked = pick_object(request, scene, settings, self._lookup(), rectified=rectified)
            run.stamp = self.node.get_clock().now().to_msg()
            with run.watch.stage("boxes"):
                fill_answer(response, picked, request.name, scene, settings.scene_to_map, self._header(run))
            response.stages = stage_timings(run)

    @answered
    @in_turn
    def render_view(self, request: RenderView.Request, response: RenderView.Response) -> None:
        """Draw a viewpoint."""
        session, settings = self.workspace.session, self.workspace.settings
        with self.workspace.run("render_view") as run:
            self.workspace.number(run)
            result = session.segmentation(refinement(request, settings), run.watch)
            result = _at_level(session, result, run, settings.granularity)
            camera = viewpoint(request, settings, self._lookup())
            header = Header(stamp=run.stamp, frame_id=request.viewpoint_camera.header.frame_id)
            selection = Selection(session, result, sorted(result.class_names), 0.0, settings.scene_to_map)
            with run.watch.stage("render"):
                drawing = draw(selection, camera, header, with_overlay=request.with_overlay)
            response.revision, response.stages = run.revision, stage_timings(run)
            response.label_image, response.overlay_image = drawing.labels, drawing.overlay
            if request.with_confidence:
                response.confidence_image = drawing.confidence

    @answered
    def load_scene(self, request: LoadScene.Request, response: LoadScene.Response) -> None:
        """Load another scene, in another place if that is asked for, and drop what was known of the earlier one."""
        workspace, started = self.workspace, time.perf_counter()
        within: Path | None = None
        if request.path:
            path, within = workspace.existing(request.path), workspace.root
        elif workspace.settings.scene_path:
            path, within = workspace.parameter_path("scene_path")
        else:
            raise InvalidRequestError("path and the parameter scene_path are both empty; expected a scene in either")
        wanted = placed(request)
        with workspace.slot.take("load_scene") as job, workspace.run("load_scene") as run:

            @contextmanager
            def place() -> Iterator[None]:
                """Last of all, before any view is fused there."""
                workspace.require_active()
                job.check()
                with placed_by(self.node, wanted):
                    yield

            if request.keep_votes:
                changed = workspace.grow_scene(path, within, request.tolerance, place())
                response.num_carried, response.num_views_lifted = changed.num_carried, changed.num_views_lifted
                response.matched_by = changed.matched_by
            else:
                workspace.load_scene(path, within, place())
            scene = workspace.session.scene
            self.clear(run)
            if request.keep_votes:
                self.show()
            corners = workspace.settings.scene_to_map.points_to_map(scene.means)
        response.path, response.scene_hash, response.num_gaussians = str(scene.path), scene.digest, len(scene)
        response.box_min, response.box_max = (point_message(side(axis=0)) for side in (corners.min, corners.max))
        response.seconds = time.perf_counter() - started

    @answered
    @in_turn
    def save_state(self, request: SaveState.Request, response: SaveState.Response) -> None:
        """Save votes, views and class probabilities."""
        path, session = self.workspace.path(request.path, STATE_FILE), self.workspace.session
        self.workspace.placement.finish()  # Where they are in a state, views stay.
        with self.workspace.run("save_state"), pinned_folder(path.parent, self.workspace.root) as folder:
            response.num_views = session.save(folder / path.name)
            response.path, response.num_bytes = str(path), (folder / path.name).stat().st_size

    @answered
    def load_state(self, request: LoadState.Request, response: LoadState.Response) -> None:
        """Load a saved state in place of the present one."""
        session, path = self.workspace.session, self.workspace.existing(request.path, STATE_FILE)
        with self.workspace.slot.take("load_state"), self.workspace.run("load_state") as run:
            response.num_views = self.workspace.load_state(path, self.workspace.root)
            self.clear(run)
            response.path, response.class_names = str(path), list(session.class_names.values())

    @answered
    @in_turn
    def export(self, request: Export.Request, response: Export.Response) -> None:
        """Write the files that the command line writes."""
        directory, settings = self.workspace.path(request.directory, EXPORT_FOLDER), self.workspace.settings
        scene_format, collision = request.format or settings.export_format, request.collision or None
        check_format(scene_format)
        check_collision(collision)
        scene = self.workspace.session.scene
        require_own_folder(directory, "segment", scene.path)  # Before the work, and again below.
        self.workspace.placement.finish()  # Nothing exports anew once they have followed.
        with self.workspace.run("export") as run:
            selection, refine = self._select(request, run)
            self.workspace.number(run)
            session = selection.session
            result = selection.result.selected(selection.chosen, selection.min_confidence)
            export = staged_export(directory, self.workspace.root, selection.scene.path)
            with run.watch.stage("write"), export as staged:
                result.save(staged.folder / "segmentation.npz", staged.id)
                meshes = collision_meshes(selection.scene, result.labels, result.confidence, collision)
                classes = staged.folder / "classes"
                files = write_classes(selection.scene, result, classes, staged.id, scene_format, meshes)
                names = {k: str(path.relative_to(staged.folder)) for k, path in files.items()}
                mesh_names = {k: f"classes/{mesh_file_name(k, result.class_names[k])}" for k in meshes}
                report = finish(report_message(run, selection, refine, settings.map_frame), run)
                content = RunReport.of(
                    selection.scene,
                    result,
                    views={"used": report.num_views, "rejected": dict(Counter(session.rejected) + run.dropped)},
                    settings={
                        "learner": report.learner,
                        "device": settings.device,
                        "refine": asdict(refine),
                        "scene_format": scene_format,
                        "collision": collision,
                    },
                    seconds=run.watch.seconds,
                    files=names,
                    meshes=mesh_names,
                    run=staged.id,
                )
                write_json(staged.folder / "report.json", content.as_dict())
        response.report = finish(report, run)
        unique = dict.fromkeys([*names.values(), *mesh_names.values()])  # One file may hold all classes.
        response.directory, response.files = str(directory), ["segmentation.npz", *unique, "report.json"]

    @answered
    def reset(self, request: Reset.Request, response: Reset.Response) -> None:
        """Forget all views and what was learnt, and clear the clouds."""
        workspace = self.workspace
        with workspace.slot.take("reset"), workspace.run("reset") as run:
            response.num_views_dropped = workspace.reset()
            self.clear(run)

    def _select(self, request: Any, run: Run) -> tuple[Selection, RefineSettings]:
        session, refine = self.workspace.session, refinement(request, self.workspace.settings)
        threshold, level = checked_confidence(request), level_of(request, self.workspace.settings)
        if session.has_codes and level < 0:
            # Before the work: a wrong name should not have to wait for it.
            chosen_classes(request, session.class_names)
        with_tree = isinstance(request, Export.Request)
        result = _at_level(session, session.segmentation(refine, run.watch), run, level, with_tree)
        chosen = chosen_classes(request, result.class_names)
        return Selection(session, result, chosen, threshold, self.workspace.settings.scene_to_map), refine

    def clear(self, run: Run) -> None:
        """Replace all that is latched by empty messages."""
        workspace, session = self.workspace, self.workspace.loaded
        workspace.number(run)
        names = {} if session is None else session.class_names
        self.outputs().clear(empty_report(run, session, workspace.settings.map_frame), names)

    def _header(self, run: Run) -> Header:
        return Header(stamp=run.stamp, frame_id=self.workspace.settings.map_frame)


def _at_level(
    session: LiveSession, result: Segmentation, run: Run, level: float, with_tree: bool = False
) -> Segmentation:
    """Cut a session's result at a level, as the parameter granularity has it; objects have a tree only on request."""
    if level < 0 and not with_tree:
        return result
    from gsseg_core.live.per_view_session import PerViewSession  # Others start without SciPy.

    if not isinstance(session, PerViewSession):
        return result
    with run.watch.stage("parts"):
        return session.at_level(result, level if level >= 0 else None)
