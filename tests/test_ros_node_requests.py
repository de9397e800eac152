"""Requests to the segmentation node, from another process: what it answers, and every error code that it may give."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ros_helpers import Ros
from ros_robot import (
    CLASSES,
    LATCHED,
    SERVICES,
    Goal,
    Learn,
    Robot,
    assert_same,
    copied,
    core_session,
    private_ros,
    viewpoint,
    write_long_dataset,
)
from small_scenes import NAMES, balls_on_a_table, build, clean_views, ring, write_dataset

from gsseg_core import cli
from gsseg_core.dataset import Dataset, View
from gsseg_core.export import background_image
from gsseg_core.operator import make_operator
from gsseg_core.pictures import overlay, palette
from gsseg_core.scene import GaussianScene
from gsseg_core.segmentation import REMOVED, Segmentation

pytest.importorskip("gsseg_msgs.msg", reason="gsseg_msgs is not installed")

from action_msgs.msg import GoalStatus
from geometry_msgs.msg import Pose, PoseStamped, Quaternion
from gsseg_msgs.msg import SegmentationReport
from sensor_msgs.msg import Image, PointCloud2

from gsseg_ros.conversions import arrays_from_cloud, labels_from_image
from gsseg_ros.errors import PathNotAllowedError
from gsseg_ros.parameters import DECLARATIONS, Settings
from gsseg_ros.workspace import Workspace

TOKENS = ("background", "red_ball", "cup_mug", "box")
INTERFACES = {name: SERVICES[name].Response for name in (
    "segment", "render_view", "load_scene", "save_state", "load_state", "export", "reset",
)} | {"learn": Learn.Result}  # fmt: skip


@dataclass(frozen=True)
class Nodes:
    """Nodes that differ in what they have, each in a namespace of its own."""

    root: Path  # data_root of all
    main: Robot  # scene, class names, and six views fused
    fresh: Robot  # scene, but no view yet
    bare: Robot  # no scene
    unset: Robot  # no parameter set, thus no data_root
    idle: Robot  # not configured


@pytest.fixture(scope="module")
def ros(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Ros]:
    with private_ros(tmp_path_factory.mktemp("ros")) as ros:
        yield ros


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data_root with all sorts of files in it, and one beside it that is out of bounds."""
    top = tmp_path_factory.mktemp("top")
    root = top / "root"
    data = write_dataset(root / "data")
    write_long_dataset(root / "long")
    scene, _ = balls_on_a_table(seed=1)
    scene.save(root / "other.ply")
    scene.save(top / "outside.ply")
    (root / "link").symlink_to(top)
    (root / "loop").symlink_to("loop")
    core_session(scene, clean_views(1)).save(root / "other_state.npz")
    for name in ("broken.ply", "broken.npz"):
        (root / name).write_text("nothing of the kind")
    (root / "taken.npz").mkdir()
    (root / "taken").mkdir()
    (root / "taken" / "classes").write_text("in the way")
    broken = copied(data, root / "broken") / "labels" / "view1.png"
    broken.write_bytes(broken.read_bytes()[:60])
    for mask in (copied(data, root / "unlabelled") / "labels").iterdir():
        mask.unlink()
    return root


@pytest.fixture(scope="module")
def nodes(ros: Ros, root: Path) -> Nodes:
    scene = {"scene_path": root / "data" / "scene.ply"}
    nodes = Nodes(root, Robot(ros), *(Robot(ros, f"/{name}") for name in ("fresh", "bare", "unset", "idle")))
    nodes.main.start({**scene, "data_root": root, "class_names": CLASSES})
    nodes.fresh.start({**scene, "data_root": root})
    nodes.bare.start({"data_root": root})
    nodes.unset.start()
    nodes.idle.start({**scene, "data_root": root, "autostart": False})
    for robot in (nodes.main, nodes.fresh, nodes.bare, nodes.unset):
        robot.wait_active()
    nodes.main.fuse(clean_views(6))
    return nodes


@pytest.fixture
def robot(nodes: Nodes) -> Robot:
    """The main node, its scene loaded anew, with six views fused; a test may do with it what it likes."""
    nodes.main.done("load_scene")
    nodes.main.fuse(clean_views(6))
    return nodes.main


@pytest.fixture(scope="module")
def scene(root: Path) -> GaussianScene:
    return GaussianScene.load(root / "data" / "scene.ply")


# Every error code


@dataclass(frozen=True)
class Case:
    """A request, and the error that it has to give."""

    service: str
    code: str
    on: str
    says: str
    fields: dict[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        return f"{self.service}-{self.code}"


def nowhere(frame: str = "", **changes: Any) -> dict[str, Any]:
    """A viewpoint in another frame, or with a camera that is changed."""
    fields = viewpoint(clean_views(1)[0])
    fields["viewpoint_pose"].header.frame_id = frame
    for name, value in changes.items():
        setattr(fields["viewpoint_camera"], name, value)
    return fields


NOT_BELOW = "is not below data_root; expected one below"
CASES = [
    Case("segment", "NOT_ACTIVE", "idle", "the node is not active"),
    Case("segment", "INVALID_REQUEST", "main", "min_confidence is 1.5; expected 0 to 1", {"min_confidence": 1.5}),
    Case("segment", "NO_SCENE", "bare", "no scene is loaded; expected the parameter scene_path, or a call"),
    Case("segment", "NO_CODES", "fresh", "expected at least one posed mask"),
    Case("segment", "UNKNOWN_CLASS", "main", "class 'sofa' does not exist; expected one of", {"classes": ["sofa"]}),
    Case("segment", "INVALID_VIEWPOINT", "main", "use the rectified topic", nowhere(d=[0.1, 0.0, 0.0, 0.0, 0.0])),
    Case("segment", "NO_TRANSFORM", "main", "frame_id is 'odom'", nowhere("odom")),
    Case("segment", "UNKNOWN", "starved", "unexpected MemoryError"),
    Case("render_view", "NOT_ACTIVE", "idle", "the node is not active"),
    Case("render_view", "NO_SCENE", "bare", "no scene is loaded"),
    Case("render_view", "NO_CODES", "fresh", "expected at least one posed mask"),
    Case("render_view", "INVALID_VIEWPOINT", "main", "viewpoint_", {}),
    Case("render_view", "NO_TRANSFORM", "main", "frame_id is 'odom'", nowhere("odom")),
    Case("render_view", "UNKNOWN", "starved", "unexpected MemoryError", nowhere()),
    Case("load_scene", "NOT_ACTIVE", "idle", "the node is not active"),
    Case("load_scene", "BUSY", "busy", "learn is running"),
    Case("load_scene", "INVALID_REQUEST", "bare", "path and the parameter scene_path are both empty"),
    Case("load_scene", "PATH_NOT_ALLOWED", "main", NOT_BELOW, {"path": "../outside.ply"}),
    Case("load_scene", "FILE_NOT_FOUND", "main", "no.ply: does not exist", {"path": "no.ply"}),
    Case("load_scene", "INVALID_FILE", "main", "broken.ply: truncated or not a PLY", {"path": "broken.ply"}),
    Case("load_scene", "UNKNOWN", "starved", "unexpected MemoryError"),
    Case("save_state", "NOT_ACTIVE", "idle", "the node is not active"),
    Case("save_state", "NO_SCENE", "bare", "no scene is loaded"),
    Case("save_state", "NO_CODES", "fresh", "nothing to save"),
    Case("save_state", "PATH_NOT_ALLOWED", "main", NOT_BELOW, {"path": "../state.npz"}),
    Case("save_state", "WRITE_FAILED", "main", "taken.npz: cannot be written", {"path": "taken.npz"}),
    Case("save_state", "UNKNOWN", "starved", "unexpected MemoryError"),
    Case("load_state", "NOT_ACTIVE", "idle", "the node is not active"),
    Case("load_state", "BUSY", "busy", "learn is running", {"path": "other_state.npz"}),
    Case("load_state", "NO_SCENE", "bare", "no scene is loaded"),
    Case("load_state", "PATH_NOT_ALLOWED", "main", NOT_BELOW, {"path": "../state.npz"}),
    Case("load_state", "FILE_NOT_FOUND", "main", "gsseg_state.npz: does not exist"),
    Case("load_state", "INVALID_FILE", "main", "broken.npz: is not a saved state", {"path": "broken.npz"}),
    Case("load_state", "SCENE_MISMATCH", "main", "belongs to the scene", {"path": "other_state.npz"}),
    Case("load_state", "UNKNOWN", "starved", "unexpected MemoryError", {"path": "narrow_state.npz"}),
    Case("export", "NOT_ACTIVE", "idle", "the node is not active"),
    Case("export", "INVALID_REQUEST", "main", "min_confidence is -0.5", {"min_confidence": -0.5}),
    Case("export", "NO_SCENE", "bare", "no scene is loaded"),
    Case("export", "NO_CODES", "fresh", "expected at least one posed mask"),
    Case("export", "UNKNOWN_CLASS", "main", "class '4' does not exist", {"classes": ["4"]}),
    Case("export", "PATH_NOT_ALLOWED", "main", NOT_BELOW, {"directory": "../out"}),
    Case("export", "WRITE_FAILED", "main", "classes: is a file; expected a folder", {"directory": "taken"}),
    Case("export", "UNKNOWN", "starved", "unexpected MemoryError"),
    Case("reset", "NOT_ACTIVE", "idle", "the node is not active"),
    Case("reset", "BUSY", "busy", "learn is running"),
    Case("reset", "UNKNOWN", "starved", "unexpected MemoryError"),
    Case("learn", "NOT_ACTIVE", "idle", "the node is not active"),
    Case("learn", "BUSY", "busy", "learn is running"),
    Case("learn", "INVALID_REQUEST", "main", "learner is 'magic'; expected one of em, votes", {"learner": "magic"}),
    Case("learn", "NO_SCENE", "bare", "no scene is loaded"),
    Case("learn", "NO_VIEWS", "fresh", "no view to learn from"),
    Case("learn", "PATH_NOT_ALLOWED", "main", NOT_BELOW, {"dataset_path": ".."}),
    Case("learn", "FILE_NOT_FOUND", "main", "nothing: does not exist", {"dataset_path": "nothing"}),
    Case("learn", "INVALID_FILE", "main", "broken/labels/view1.png: broken PNG", {"dataset_path": "broken"}),
    Case("learn", "CANCELED", "busy", "learn was canceled; all is as it was before"),
    Case("learn", "UNKNOWN", "starved", "unexpected MemoryError"),
]  # fmt: skip
MORE_CASES = [
    Case("segment", "INVALID_REQUEST", "main", "min_confidence is nan", {"min_confidence": float("nan")}),
    Case("render_view", "INVALID_VIEWPOINT", "main", "all zeros: was it filled in?", {
        "viewpoint_camera": nowhere()["viewpoint_camera"],
        "viewpoint_pose": PoseStamped(pose=Pose(orientation=Quaternion(w=0.0))),
    }),
    Case("segment", "INVALID_VIEWPOINT", "main", "pixels; expected", nowhere(width=100_000, height=100_000)),
    Case("learn", "NO_VIEWS", "main", "4 no mask", {"dataset_path": "unlabelled"}),
    Case("learn", "INVALID_FILE", "main", "cameras.json", {"dataset_path": "taken"}),
    Case("load_scene", "INVALID_FILE", "main", "taken: ", {"path": "taken"}),
    *(
        Case("save_state", "PATH_NOT_ALLOWED", "main", NOT_BELOW, {"path": path})
        for path in ("link/state.npz", "data/../../state.npz", "/tmp/state.npz", "/", "data/../../root2/state.npz")
    ),
    Case("load_scene", "PATH_NOT_ALLOWED", "main", NOT_BELOW, {"path": "link/outside.ply"}),
    Case("load_scene", "PATH_NOT_ALLOWED", "main", NOT_BELOW, {"path": "/etc/passwd"}),
    Case("export", "PATH_NOT_ALLOWED", "main", NOT_BELOW, {"directory": "link"}),
    *(
        Case(service, "PATH_NOT_ALLOWED", "unset", "data_root is empty, so no path is allowed", fields)
        for service, fields in (
            ("load_scene", {"path": "a.ply"}), ("save_state", {}), ("export", {"directory": "/tmp"}),
        )
    ),
    Case("load_scene", "FILE_NOT_FOUND", "main", "does not exist", {"path": "x" * 5000}),
]  # fmt: skip


@contextmanager
def limited(robot: Robot, what: int, limit: int) -> Iterator[None]:
    """Take a resource away from the node's process, for real, for a while."""
    assert robot.process is not None
    _, hard = before = resource.prlimit(robot.process.pid, what)
    resource.prlimit(robot.process.pid, what, (limit, hard))
    try:
        yield
    finally:
        resource.prlimit(robot.process.pid, what, before)


@pytest.fixture(scope="module")
def starved(ros: Ros, root: Path) -> Robot:
    """A node with so many Gaussians and classes that the votes take 200 MB."""
    rng = np.random.default_rng(0)
    scene = build(np.zeros(250_000, np.int64), rng.uniform(-1, 1, (250_000, 3)), np.full((250_000, 3), 0.004))
    scene.save(root / "large.ply")
    core_session(scene, clean_views(1)).save(root / "narrow_state.npz")
    names = [f"class {k}" for k in range(100)]
    robot = Robot(ros, "/starved")
    robot.started({"scene_path": root / "large.ply", "data_root": root, "class_names": names})
    robot.drive(clean_views(1))
    robot.wait_for_status(lambda status: status["views fused"] == "1", "the view")
    return robot


@contextmanager
def short_of_memory(robot: Robot) -> Iterator[None]:
    """Leave the node too little memory for another set of votes."""
    assert robot.process is not None
    pages = int(Path(f"/proc/{robot.process.pid}/statm").read_text().split()[0])
    with limited(robot, resource.RLIMIT_AS, pages * resource.getpagesize() + (90 << 20)):
        yield


@contextmanager
def busy(robot: Robot) -> Iterator[Goal]:
    """The node learns, and goes on with it."""
    goal = robot.begin(dataset_path="long")
    yield goal
    assert not goal.future.done()
    robot.cancel(goal)


def answer(robot: Robot, case: Case) -> Any:
    if case.service != "learn":
        return robot.ask(case.service, **case.fields)
    status, result = robot.learn(**case.fields)
    assert status == GoalStatus.STATUS_ABORTED
    return result


def provoke(case: Case, nodes: Nodes, request: pytest.FixtureRequest) -> Any:
    if case.code == "CANCELED":
        status, result = nodes.main.cancel(nodes.main.begin(dataset_path="long"))
        assert status == GoalStatus.STATUS_CANCELED
        return result
    if case.on == "busy":
        with busy(nodes.main):
            return answer(nodes.main, case)
    if case.on == "starved":
        robot = request.getfixturevalue("starved")
        with short_of_memory(robot):
            return answer(robot, case)
    return answer(getattr(nodes, case.on), case)


@pytest.mark.parametrize("case", CASES + MORE_CASES, ids=str)
def test_the_error_is_answered_with_its_code_and_one_line_that_says_why(
    nodes: Nodes, case: Case, request: pytest.FixtureRequest
) -> None:
    response = provoke(case, nodes, request)
    assert response.error_code == getattr(type(response), case.code), response.error_msg
    assert case.says in response.error_msg
    assert "\n" not in response.error_msg
    # Nothing half filled in goes out.
    assert response == type(response)(error_code=response.error_code, error_msg=response.error_msg)


def test_every_error_code_of_every_interface_is_among_the_cases() -> None:
    declared = {
        (name, code)
        for name, interface in INTERFACES.items()
        for code in dir(interface)
        if code.isupper() and isinstance(getattr(interface, code), int) and code != "NONE"
    }
    assert {(case.service, case.code) for case in CASES} == declared


def test_links_in_a_circle_are_an_error_of_the_path(nodes: Nodes) -> None:
    response = nodes.main.ask("load_scene", path="loop/scene.ply")
    # Which of the two depends on the version of Python.
    assert response.error_code in (response.PATH_NOT_ALLOWED, response.FILE_NOT_FOUND), response.error_msg


def test_a_path_with_a_nul_is_refused(root: Path) -> None:
    # rclpy cuts a string at a NUL; other clients and other versions may not.
    values = {declaration.name: declaration.default for declaration in DECLARATIONS}
    workspace = Workspace(Settings.of({**values, "data_root": str(root)}), lambda: None)
    for path in ("data\0", "data/\0/../..", "\0"):
        with pytest.raises(PathNotAllowedError, match="expected one below"):
            workspace.path(path)


def test_paths_below_data_root_may_be_absolute_and_may_go_up_and_down(robot: Robot, root: Path) -> None:
    for path in (str(root / "data" / "scene.ply"), "data/../data/./scene.ply", "link/root/data/scene.ply"):
        assert robot.done("load_scene", path=path).path == str(root / "data" / "scene.ply")


def test_after_memory_ran_out_the_node_goes_on(starved: Robot) -> None:
    with short_of_memory(starved):
        assert starved.ask("segment").error_code == SERVICES["segment"].Response.UNKNOWN
    assert starved.done("segment", skip_refinement=True).report.num_views == 1
    assert "Traceback" in starved.process.output, "the log has the details"
    assert starved.done("reset").num_views_dropped == 1


# What is answered


def counts(report: SegmentationReport) -> dict[str, int]:
    return {summary.name: summary.num_gaussians for summary in report.classes}


def refined(scene: GaussianScene) -> Segmentation:
    return core_session(scene, clean_views(6)).segmentation()


def assert_untouched(robot: Robot, before: SegmentationReport, folder: Path) -> None:
    """The node knows what it knew when it gave this report."""
    found = robot.exported(folder)
    expected = Segmentation.load(folder.parent / "before" / "segmentation.npz", GaussianScene.load(before.scene_path))
    np.testing.assert_array_equal(found.probabilities, expected.probabilities)
    after = robot.done("segment").report
    assert counts(after) == counts(before)
    assert (after.scene_hash, after.learner, after.num_views) == (before.scene_hash, before.learner, before.num_views)


def test_a_request_left_at_its_defaults_means_all_classes_refined_without_a_threshold(
    robot: Robot, scene: GaussianScene
) -> None:
    robot.done("segment", skip_refinement=True)  # Else the answer may be there already.
    report, expected = robot.done("segment").report, refined(scene)
    assert counts(report) == dict(zip(NAMES.values(), expected.counts().tolist(), strict=True))
    assert (report.k, report.filtered, report.min_confidence) == (50, True, 0.0)
    assert report.beta == pytest.approx(0.65)
    assert report.num_removed == (expected.labels == REMOVED).sum()
    assert (
        report.num_gaussians
        == len(scene)
        == (report.num_objects + report.num_background + report.num_unobserved + report.num_removed)
    )
    assert (report.job, report.learner, report.num_views, report.num_views_rejected) == ("segment", "votes", 6, 0)
    assert [stage.name for stage in report.stages] == ["codes", "knn", "filter", "publish"]
    assert 0 < sum(stage.seconds for stage in report.stages) <= report.total_seconds
    for summary in report.classes:
        index = expected.labels == summary.class_id
        assert summary.mean_confidence == pytest.approx(expected.confidence[index].mean(), abs=1e-4)
        assert summary.min_confidence == pytest.approx(expected.confidence[index].min(), abs=1e-4)
        found = [[getattr(point, axis) for axis in "xyz"] for point in (summary.centroid, summary.box_min)]
        means = scene.means[index]
        np.testing.assert_allclose(found, [means.mean(axis=0), means.min(axis=0)], atol=1e-5)


def test_refinement_is_left_out_when_asked(robot: Robot, scene: GaussianScene) -> None:
    session = core_session(scene, clean_views(6))
    raw = robot.done("segment", skip_refinement=True).report
    assert (raw.k, raw.filtered, raw.num_removed) == (0, False, 0)
    observed = session.codes().any(axis=1)
    assert raw.num_unobserved == (~observed).sum() > 0
    clustered = robot.done("segment", skip_filter=True).report
    assert (clustered.k, clustered.filtered, clustered.num_removed) == (50, False, 0)


def test_min_confidence_leaves_out_what_is_less_sure(robot: Robot, scene: GaussianScene) -> None:
    expected = refined(scene)
    threshold = float(np.quantile(expected.confidence[expected.labels >= 0], 0.5)) - 1e-3
    report = robot.done("segment", min_confidence=threshold).report
    kept = expected.labels[(expected.labels >= 0) & (expected.confidence >= threshold)]
    assert list(counts(report).values()) == np.bincount(kept, minlength=4).tolist()
    assert report.min_confidence == pytest.approx(threshold)
    assert all(summary.min_confidence >= threshold - 1e-6 for summary in report.classes if summary.num_gaussians)
    exported = robot.exported(robot_folder(robot, "threshold"), min_confidence=threshold)
    assert exported.counts().tolist() == list(counts(report).values())


def robot_folder(robot: Robot, name: str) -> Path:
    return Path(robot.get("data_root")) / "out" / name


@pytest.mark.parametrize(
    ("classes", "expected"),
    [
        (["cup/mug"], ["cup/mug"]),
        (["3"], ["box"]),
        (["box", "1", "red ball"], ["red ball", "box"]),
        (["0", "background"], ["background"]),
        ([], CLASSES),
    ],
)
def test_classes_are_chosen_by_name_and_by_number(nodes: Nodes, classes: list[str], expected: list[str]) -> None:
    everything = counts(nodes.main.done("segment").report)
    report = nodes.main.done("segment", classes=classes).report
    assert counts(report) == {name: everything[name] for name in expected}
    assert [summary.topic for summary in report.classes] == [
        f"/gsseg/classes/{TOKENS[CLASSES.index(name)]}" for name in expected
    ]


def test_clouds_hold_the_centres_colours_labels_and_confidences_of_their_class(
    robot: Robot, scene: GaussianScene
) -> None:
    expected = refined(scene)
    robot.done("segment")
    clouds = latched_clouds(robot)
    colors = palette(4)
    for k, name in enumerate(TOKENS):
        found, index = arrays_from_cloud(clouds[f"classes/{name}"]), expected.labels == k
        np.testing.assert_array_equal(found.points, scene.means[index])
        np.testing.assert_allclose(found.confidence, expected.confidence[index], atol=1e-4)
        assert (found.labels == k).all() and (found.rgb == colors[k]).all()
    objects = arrays_from_cloud(clouds["cloud"])
    assert np.bincount(objects.labels, minlength=4).tolist() == [0, *expected.counts()[1:].tolist()]


def latched_clouds(robot: Robot) -> dict[str, PointCloud2]:
    """What a subscriber that comes late gets, by topic."""
    topics = ["cloud", *(f"classes/{token}" for token in TOKENS)]
    return dict(zip(topics, robot.latched(*((PointCloud2, topic) for topic in topics)), strict=True))


def test_a_late_subscriber_gets_the_clouds_and_the_report_of_the_last_run(robot: Robot) -> None:
    robot.done("segment")
    report = robot.done("segment", min_confidence=0.3).report
    clouds = latched_clouds(robot)
    assert robot.latched((SegmentationReport, "report")) == [report]
    assert {cloud.header.frame_id for cloud in clouds.values()} == {"map"}
    assert all(cloud.header.stamp == report.header.stamp for cloud in clouds.values())
    assert [clouds[f"classes/{token}"].width for token in TOKENS] == list(counts(report).values())


def test_every_output_of_one_run_carries_the_same_stamp_and_later_runs_have_larger_numbers(robot: Robot) -> None:
    heard: dict[str, list[Any]] = {
        topic: robot.ros.collect(kind, f"/gsseg/{topic}", LATCHED)
        for topic, kind in [
            ("report", SegmentationReport), ("overlay", Image), ("cloud", PointCloud2),
            *((f"classes/{token}", PointCloud2) for token in TOKENS),
        ]
    }  # fmt: skip
    runs = []

    def all_have_spoken() -> bool:
        runs.append(robot.done("segment", **viewpoint(clean_views(1)[0])))
        return bool(heard["overlay"])

    robot.ros.wait_until(all_have_spoken, "an overlay, which is drawn for those who listen")
    last = runs[-1]
    robot.ros.wait_until(
        lambda: all(sent and sent[-1].header.stamp == last.report.header.stamp for sent in heard.values()),
        "all outputs of the last run",
    )
    assert last.label_image.header.stamp == last.report.header.stamp
    assert last.label_image.header.frame_id == heard["overlay"][-1].header.frame_id == "camera"
    assert heard["report"][-1] == last.report
    revisions = [run.report.revision for run in runs] + [robot.done("render_view", **nowhere()).revision]
    assert revisions == sorted(set(revisions))
    stamps = [(run.report.header.stamp.sec, run.report.header.stamp.nanosec) for run in runs]
    assert stamps == sorted(set(stamps))


def test_an_empty_cloud_clears_that_of_a_class_that_was_not_asked_for(robot: Robot) -> None:
    robot.done("segment")
    report = robot.done("segment", classes=["box"]).report
    clouds = latched_clouds(robot)
    assert {topic: cloud.width for topic, cloud in clouds.items() if cloud.width} == {
        "cloud": counts(report)["box"], "classes/box": counts(report)["box"],
    }  # fmt: skip
    assert all(cloud.header.stamp == report.header.stamp for cloud in clouds.values())


def test_reset_forgets_views_and_codes_and_clears_the_clouds(robot: Robot) -> None:
    robot.done("segment")
    assert robot.done("reset").num_views_dropped == 6
    assert all(cloud.width == 0 for cloud in latched_clouds(robot).values())
    assert robot.ask("segment").error_code == SERVICES["segment"].Response.NO_CODES
    assert robot.learn()[1].error_code == Learn.Result.NO_VIEWS
    robot.fuse(clean_views(2))
    assert robot.done("reset").num_views_dropped == 2
    assert robot.done("reset").num_views_dropped == 0


def test_the_label_image_of_a_viewpoint_is_that_of_the_exported_segmentation(
    robot: Robot, scene: GaussianScene
) -> None:
    view = clean_views(1, "other", 0.4)[0]
    exported = robot.exported(robot_folder(robot, "viewpoint"))
    expected = exported.render(make_operator(scene, view.camera)).labels
    response = robot.done("segment", **viewpoint(view))
    assert response.label_image.encoding == "mono16"
    np.testing.assert_array_equal(labels_from_image(response.label_image, "label_image"), expected)
    response = robot.done("segment", classes=["box"], **viewpoint(view))
    found = labels_from_image(response.label_image, "label_image")
    np.testing.assert_array_equal(found, np.where(expected == 3, 3, 0))
    assert robot.done("segment").label_image.width == 0


def test_render_view_draws_labels_confidence_and_overlay_and_publishes_nothing(
    robot: Robot, scene: GaussianScene
) -> None:
    view = clean_views(1, "other", 0.4)[0]
    robot.done("segment")
    reports = robot.ros.collect(SegmentationReport, "/gsseg/report", LATCHED)
    robot.ros.wait_until(lambda: reports, "the latched report")
    operator = make_operator(scene, view.camera)
    expected = core_session(scene, clean_views(6)).segmentation().render(operator)

    response = robot.done("render_view", **viewpoint(view))
    assert (response.confidence_image.width, response.overlay_image.width) == (0, 0)
    np.testing.assert_array_equal(labels_from_image(response.label_image, "label_image"), expected.labels)

    response = robot.done("render_view", **viewpoint(view), with_confidence=True, with_overlay=True)
    labels, confidence, picture = response.label_image, response.confidence_image, response.overlay_image
    assert (confidence.encoding, picture.encoding) == ("32FC1", "rgb8")
    assert labels.header == confidence.header == picture.header
    found = np.frombuffer(confidence.data, "<f4").reshape(48, 64)
    np.testing.assert_allclose(found, np.minimum(expected.confidence, 1), atol=1e-4)
    drawn = overlay(background_image(scene, operator), expected.labels, palette(4)).astype(int)
    assert np.abs(np.frombuffer(picture.data, np.uint8).reshape(48, 64, 3) - drawn).max() <= 1
    assert [stage.name for stage in response.stages][-1] == "render"
    robot.done("segment")
    robot.ros.wait_until(lambda: len(reports) == 2, "the report of the next run")
    assert reports[1].revision == response.revision + 1


# What stays as it was, and what comes back


@pytest.mark.parametrize(
    ("service", "fields"),
    [
        ("load_scene", {"path": "broken.ply"}),
        ("load_scene", {"path": "no.ply"}),
        ("load_scene", {"path": "../outside.ply"}),
        ("load_state", {"path": "broken.npz"}),
        ("load_state", {"path": "other_state.npz"}),
        ("load_state", {"path": "wide_state.npz"}),
        ("save_state", {"path": "taken.npz"}),
        ("export", {"directory": "taken"}),
        ("segment", {"classes": ["sofa"]}),
    ],
)
def test_a_request_that_fails_leaves_everything_as_it_was(
    robot: Robot, root: Path, scene: GaussianScene, tmp_path_factory: pytest.TempPathFactory, service: str,
    fields: dict[str, Any],
) -> None:  # fmt: skip
    folder = robot_folder(robot, tmp_path_factory.mktemp("run").name)
    names = [*CLASSES, "more", "than", "declared"]
    core_session(scene, clean_views(1), names).save(root / "wide_state.npz")
    robot.exported(folder / "before")
    before, clouds = robot.done("segment").report, latched_clouds(robot)
    assert robot.ask(service, **fields).error_code > 0
    assert latched_clouds(robot) == clouds
    assert_untouched(robot, before, folder / "after")


def test_a_full_disk_fails_the_save_and_keeps_the_earlier_file(robot: Robot, root: Path) -> None:
    saved = robot.done("save_state", path="full/state.npz")
    earlier = Path(saved.path).read_bytes()
    assert saved.num_bytes == len(earlier) and saved.num_views == 6
    robot.fuse(View.from_arrays(camera, np.full((48, 64), 2, np.int32)) for camera in ring(6, turn=0.5))
    with limited(robot, resource.RLIMIT_FSIZE, saved.num_bytes // 2):
        response = robot.ask("save_state", path="full/state.npz")
    assert response.error_code == response.WRITE_FAILED, response.error_msg
    assert f"{saved.path}: cannot be written (File too large); what was there before is unchanged" == response.error_msg
    assert [path.name for path in (root / "full").iterdir()] == ["state.npz"]
    assert (root / "full" / "state.npz").read_bytes() == earlier
    assert robot.done("save_state", path="full/state.npz").num_views == 12


def test_a_saved_state_comes_back_with_views_and_codes(robot: Robot, root: Path) -> None:
    status, _ = robot.learn()
    assert status == GoalStatus.STATUS_SUCCEEDED
    saved = robot.done("save_state")
    assert saved.path == str(root / "gsseg_state.npz")
    before = robot.exported(robot_folder(robot, "saved"))
    robot.done("reset")
    loaded = robot.done("load_state")
    (root / "gsseg_state.npz").unlink()
    assert (loaded.path, list(loaded.class_names), loaded.num_views) == (saved.path, CLASSES, 6)
    after = robot.exported(robot_folder(robot, "loaded"))
    np.testing.assert_array_equal(after.probabilities, before.probabilities)
    np.testing.assert_array_equal(after.labels, before.labels)
    assert robot.done("segment").report.learner == "em"
    assert robot.learn()[1].report.num_views == 6, "the views are there too"


def test_another_scene_takes_the_place_of_the_first_with_all_that_was_known(robot: Robot, root: Path) -> None:
    robot.done("segment")
    other = GaussianScene.load(root / "other.ply")
    response = robot.done("load_scene", path="other.ply")
    assert (response.path, response.scene_hash, response.num_gaussians) == (
        str(root / "other.ply"), other.digest, len(other),
    )  # fmt: skip
    box = [[getattr(corner, axis) for axis in "xyz"] for corner in (response.box_min, response.box_max)]
    np.testing.assert_allclose(box, [other.means.min(axis=0), other.means.max(axis=0)], atol=1e-5)
    assert robot.ask("segment").error_code == SERVICES["segment"].Response.NO_CODES
    assert all(cloud.width == 0 for cloud in latched_clouds(robot).values())
    robot.fuse(clean_views(2))
    assert robot.done("segment").report.scene_hash == other.digest


def test_exported_files_are_those_of_the_command_line(
    robot: Robot, root: Path, scene: GaussianScene, capsys: pytest.CaptureFixture[str]
) -> None:
    robot.done("reset")
    assert robot.learn(dataset_path="data")[0] == GoalStatus.STATUS_SUCCEEDED
    response = robot.done("export", directory="out/node")
    assert response.directory == str(root / "out" / "node")
    by_node, by_hand = root / "out" / "node", root / "out" / "command"
    assert cli.main(["segment", str(scene.path), "--data", str(root / "data"), "--out", str(by_hand), "--quiet"]) == 0
    capsys.readouterr()

    found, expected = (Segmentation.load(folder / "segmentation.npz", scene) for folder in (by_node, by_hand))
    assert_same(found, expected)
    written = sorted(str(path.relative_to(by_node)) for path in by_node.rglob("*") if path.is_file())
    assert written == sorted(response.files)
    plys = sorted(path.name for path in (by_hand / "classes").iterdir())
    assert plys == sorted(path.name for path in (by_node / "classes").iterdir()) and len(plys) == 4
    for name in plys:
        assert (by_node / "classes" / name).read_bytes() == (by_hand / "classes" / name).read_bytes()
    assert [summary.num_gaussians for summary in response.report.classes] == expected.counts().tolist()


def test_the_default_export_folder_is_below_data_root_and_holds_only_what_was_asked_for(
    robot: Robot, root: Path
) -> None:
    response = robot.done("export", classes=["red ball", "3"])
    assert response.directory == str(root / "gsseg_export")
    assert list(response.files) == ["segmentation.npz", "classes/1_red_ball.ply", "classes/3_box.ply", "report.json"]
    everything = counts(robot.done("segment").report)
    for name, ply in (("red ball", "1_red_ball.ply"), ("box", "3_box.ply")):
        assert len(GaussianScene.load(root / "gsseg_export" / "classes" / ply)) == everything[name]


def test_requests_are_answered_side_by_side(robot: Robot) -> None:
    futures = [robot.send("segment", skip_filter=bool(i % 2)) for i in range(6)]
    futures += [robot.send("render_view", **viewpoint(clean_views(1)[0])) for _ in range(6)]
    answers = [robot.ros.result(future) for future in futures]
    assert [answer.error_code for answer in answers] == [0] * 12
    revisions = [getattr(answer, "revision", 0) or answer.report.revision for answer in answers]
    assert len(set(revisions)) == 12


def test_the_dataset_that_a_goal_names_may_lie_behind_a_link_inside_data_root(robot: Robot, root: Path) -> None:
    (root / "inner").symlink_to(root / "data")
    status, result = robot.learn(dataset_path="inner")
    assert status == GoalStatus.STATUS_SUCCEEDED
    assert result.report.num_views == len(Dataset(root / "data").views("train"))
