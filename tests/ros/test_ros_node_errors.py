"""Every error code that a request to the segmentation node may get, from another process."""

from __future__ import annotations

import resource
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion
from patience import PATIENCE
from rclpy.parameter import Parameter
from ros_checks import limited
from ros_fixtures import parameters_fixture, root_fixture, shared_fixture, spun  # noqa: F401
from ros_helpers import Ros, private_ros
from ros_robot import CLASSES, SERVICES, Goal, Learn, Robot, core_session, viewpoint
from small_scenes import build, clean_views

from gsseg_ros.errors import PathNotAllowedError
from gsseg_ros.node import segment_node, services
from gsseg_ros.node.declarations import DECLARATIONS
from gsseg_ros.node.parameters import Settings
from gsseg_ros.node.segment_node import SegmentNode
from gsseg_ros.node.services import AT_WORK, WAITING
from gsseg_ros.node.workspace import Workspace

INTERFACES = {name: SERVICES[name].Response for name in (
    "segment", "pick", "render_view", "load_scene", "save_state", "load_state", "export", "reset",
)} | {"learn": Learn.Result}  # fmt: skip


@dataclass(frozen=True)
class Nodes:
    """Nodes that differ in what they have, each in a namespace of its own."""

    main: Robot  # scene, class names, and six views fused
    fresh: Robot  # scene, but no view yet
    bare: Robot  # no scene
    unset: Robot  # no parameter set, thus no data_root
    idle: Robot  # not configured


@pytest.fixture(scope="module")
def nodes(shared: Ros, root: Path, parameters: dict[str, Any]) -> Nodes:
    scene = {"scene_path": parameters["scene_path"]}
    nodes = Nodes(Robot(shared), *(Robot(shared, f"/{name}") for name in ("fresh", "bare", "unset", "idle")))
    nodes.main.start(parameters)
    nodes.fresh.start({**scene, "data_root": root})
    nodes.bare.start({"data_root": root})
    nodes.unset.start()
    nodes.idle.start({**scene, "data_root": root, "autostart": False})
    for robot in (nodes.main, nodes.fresh, nodes.bare, nodes.unset):
        robot.wait_active()
    nodes.main.fuse(clean_views(6))
    return nodes


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


SKY = nowhere() | {"inside": [Point()]}
"""A click at the edge of a view, beside the table."""

LARGE = nowhere(width=4000, height=4000) | {"inside": [Point()]}

NOT_BELOW = "is not below data_root; expected one below"
CASES = [
    Case("segment", "NOT_ACTIVE", "idle", "the node is not active"),
    Case("segment", "BUSY", "crowded", "too many requests"),
    Case("segment", "INVALID_REQUEST", "main", "min_confidence is 1.5; expected 0 to 1", {"min_confidence": 1.5}),
    Case("segment", "NO_SCENE", "bare", "no scene is loaded; expected the parameter scene_path, or a call"),
    Case("segment", "NO_CODES", "fresh", "expected at least one posed mask"),
    Case("segment", "UNKNOWN_CLASS", "main", "class 'sofa' does not exist; expected one of", {"classes": ["sofa"]}),
    Case("segment", "INVALID_VIEWPOINT", "main", "expected zeros: what is", nowhere(d=[0.1, 0.0, 0.0, 0.0, 0.0])),
    Case("segment", "NO_TRANSFORM", "main", "frame_id is 'odom'", nowhere("odom")),
    Case("segment", "UNKNOWN", "exhausted", "unexpected MemoryError"),
    Case("pick", "NOT_ACTIVE", "idle", "the node is not active"),
    Case("pick", "BUSY", "crowded", "too many requests"),
    Case("pick", "INVALID_REQUEST", "main", "expected a mask, or points inside", nowhere()),
    Case("pick", "NO_SCENE", "bare", "no scene is loaded"),
    Case("pick", "NO_VIEWS", "main", "no Gaussian is seen at row 0, column 0", SKY),
    Case("pick", "INVALID_VIEWPOINT", "main", "viewpoint_", {"inside": [Point()]}),
    Case("pick", "NO_TRANSFORM", "main", "frame_id is 'odom'", nowhere("odom") | {"inside": [Point()]}),
    Case("pick", "UNKNOWN", "starved", "unexpected MemoryError", LARGE),
    Case("render_view", "NOT_ACTIVE", "idle", "the node is not active"),
    Case("render_view", "BUSY", "crowded", "too many requests"),
    Case("render_view", "INVALID_REQUEST", "main", "refine is 'sand'", nowhere() | {"refine": "sand"}),
    Case("segment", "INVALID_REQUEST", "main", "ids 'given' objects have no parts", {"granularity": [0.5]}),
    Case("render_view", "NO_SCENE", "bare", "no scene is loaded"),
    Case("render_view", "NO_CODES", "fresh", "expected at least one posed mask"),
    Case("render_view", "INVALID_VIEWPOINT", "main", "viewpoint_", {}),
    Case("render_view", "NO_TRANSFORM", "main", "frame_id is 'odom'", nowhere("odom")),
    Case("render_view", "UNKNOWN", "exhausted", "unexpected MemoryError", nowhere()),
    Case("load_scene", "NOT_ACTIVE", "idle", "the node is not active"),
    Case("load_scene", "BUSY", "busy", "learn is running"),
    Case("load_scene", "INVALID_REQUEST", "bare", "path and the parameter scene_path are both empty"),
    Case("load_scene", "PATH_NOT_ALLOWED", "main", NOT_BELOW, {"path": "../outside.ply"}),
    Case("load_scene", "FILE_NOT_FOUND", "main", "no.ply: does not exist", {"path": "no.ply"}),
    Case("load_scene", "INVALID_FILE", "main", "broken.ply: truncated or not a PLY", {"path": "broken.ply"}),
    Case("load_scene", "UNKNOWN", "starved", "unexpected MemoryError"),
    Case("save_state", "NOT_ACTIVE", "idle", "the node is not active"),
    Case("save_state", "BUSY", "crowded", "too many requests"),
    Case("save_state", "NO_SCENE", "bare", "no scene is loaded"),
    Case("save_state", "NO_CODES", "fresh", "nothing to save"),
    Case("save_state", "PATH_NOT_ALLOWED", "main", NOT_BELOW, {"path": "../state.npz"}),
    Case("save_state", "WRITE_FAILED", "main", "other.ply: cannot be written", {"path": "other.ply/below.npz"}),
    Case("save_state", "PATH_TAKEN", "main", "scene.ply: is there and is no saved state", {"path": "data/scene.ply"}),
    Case("save_state", "UNKNOWN", "exhausted", "unexpected MemoryError"),
    Case("load_state", "NOT_ACTIVE", "idle", "the node is not active"),
    Case("load_state", "BUSY", "busy", "learn is running", {"path": "other_state.npz"}),
    Case("load_state", "NO_SCENE", "bare", "no scene is loaded"),
    Case("load_state", "PATH_NOT_ALLOWED", "main", NOT_BELOW, {"path": "../state.npz"}),
    Case("load_state", "FILE_NOT_FOUND", "main", "gsseg_state.npz: does not exist"),
    Case("load_state", "INVALID_FILE", "main", "broken.npz: is not a saved state", {"path": "broken.npz"}),
    Case("load_state", "SCENE_MISMATCH", "main", "belongs to the scene", {"path": "other_state.npz"}),
    Case("load_state", "UNKNOWN", "starved", "unexpected MemoryError", {"path": "narrow_state.npz"}),
    Case("export", "NOT_ACTIVE", "idle", "the node is not active"),
    Case("export", "BUSY", "crowded", "too many requests"),
    Case("export", "INVALID_REQUEST", "main", "min_confidence is -0.5", {"min_confidence": -0.5}),
    Case("export", "NO_SCENE", "bare", "no scene is loaded"),
    Case("export", "NO_CODES", "fresh", "expected at least one posed mask"),
    Case("export", "UNKNOWN_CLASS", "main", "class '4' does not exist", {"classes": ["4"]}),
    Case("export", "PATH_NOT_ALLOWED", "main", NOT_BELOW, {"directory": "../out"}),
    Case("export", "WRITE_FAILED", "main", "below: cannot be written", {"directory": "other.ply/below"}),
    Case("export", "PATH_TAKEN", "main", "data: holds 'cameras.json', and no results", {"directory": "data"}),
    Case("export", "UNKNOWN", "exhausted", "unexpected MemoryError"),
    Case("reset", "NOT_ACTIVE", "idle", "the node is not active"),
    Case("reset", "BUSY", "busy", "learn is running"),
    Case("reset", "UNKNOWN", "starved", "unexpected MemoryError"),
    Case("learn", "BUSY", "busy", "learn is running"),
    Case("learn", "INVALID_REQUEST", "main", "learner is 'magic'; expected one of em, votes", {"learner": "magic"}),
    Case("learn", "NO_SCENE", "bare", "no scene is loaded"),
    Case("learn", "NO_VIEWS", "fresh", "no view to learn from"),
    Case("learn", "PATH_NOT_ALLOWED", "main", NOT_BELOW, {"dataset_path": ".."}),
    Case("learn", "FILE_NOT_FOUND", "main", "nothing: does not exist", {"dataset_path": "nothing"}),
    Case("learn", "INVALID_FILE", "main", "broken/labels/view1.png: broken PNG", {"dataset_path": "broken"}),
    Case("learn", "CANCELED", "busy", "learn was canceled; what was known before is kept"),
    Case("learn", "UNKNOWN", "starved", "unexpected MemoryError"),
]  # fmt: skip
MORE_CASES = [
    Case("export", "INVALID_REQUEST", "main", "format is 'obj'; expected one of ply", {"format": "obj"}),
    Case("export", "INVALID_REQUEST", "main", "collision is 'box'; expected one of hull", {"collision": "box"}),
    Case("learn", "INVALID_REQUEST", "main", "expected dataset_path beside them", {"labels": "soft"}),
    Case("learn", "PATH_NOT_ALLOWED", "main", NOT_BELOW, {"dataset_path": "data", "labels": "../../outside.ply"}),
    Case("learn", "FILE_NOT_FOUND", "main", "soft: does not exist", {"dataset_path": "data", "labels": "soft"}),
    Case("learn", "FILE_NOT_FOUND", "main", "map.json: does not ex", {"dataset_path": "data", "label_map": "map.json"}),
    Case("load_state", "FILE_NOT_FOUND", "main", "a\\nb: does not exist", {"path": "a\nb"}),
    Case("load_scene", "FILE_NOT_FOUND", "main", "x: does not exist", {"path": "x" * 5000}),
    Case("export", "WRITE_FAILED", "main", "name too long", {"directory": "x" * 300}),
    Case("segment", "NO_TRANSFORM", "main", "frame_id is '\\x1b[31mred'", nowhere("\x1b[31mred")),
    Case("learn", "INVALID_REQUEST", "main", "learner is '\\u202eabc'", {"learner": "\u202eabc"}),
    Case("learn", "INVALID_REQUEST", "main", "max_steps is 4294967295; expected at most", {"max_steps": 2**32 - 1}),
    Case("segment", "INVALID_REQUEST", "main", "min_confidence is nan", {"min_confidence": float("nan")}),
    Case("render_view", "INVALID_VIEWPOINT", "main", "all zeros: was it filled in?", {
        "viewpoint_camera": nowhere()["viewpoint_camera"],
        "viewpoint_pose": PoseStamped(pose=Pose(orientation=Quaternion(w=0.0))),
    }),
    Case("segment", "INVALID_VIEWPOINT", "main", "expected 16777216 pixels", nowhere(width=100_000, height=100_000)),
    Case("save_state", "PATH_TAKEN", "main", "taken.npz: is there and is no saved state", {"path": "taken.npz"}),
    Case("export", "PATH_TAKEN", "main", "data: holds 'cameras.json', and no results", {"directory": "data"}),
    Case("learn", "PATH_NOT_ALLOWED", "main", "labels/view1.png: leads out of", {"dataset_path": "leaking"}),
    Case("learn", "NO_VIEWS", "main", "no mask: 4 views", {"dataset_path": "unlabelled"}),
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
        Case("export", "PATH_TAKEN", "main", says, {"directory": directory})
        for directory, says in ((".", "root: holds "), ("taken", "holds 'classes'"), ("other.ply", "is not a folder"))
    ),
    *(
        Case(service, "PATH_NOT_ALLOWED", "unset", "data_root is empty, so no path is allowed", fields)
        for service, fields in (
            ("load_scene", {"path": "a.ply"}), ("save_state", {}), ("export", {"directory": "/tmp"}),
        )
    ),
    Case("load_scene", "FILE_NOT_FOUND", "main", "does not exist", {"path": "x" * 5000}),
]  # fmt: skip


@pytest.fixture(scope="module")
def starved(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Robot]:
    """A node with so many Gaussians and classes that a session takes far more than it is left.

    It is in a domain of its own: the other nodes need not hear of a topic for each class.
    """
    rng = np.random.default_rng(0)
    scene = build(np.zeros(1_500_000, np.int64), rng.uniform(-1, 1, (1_500_000, 3)), np.full((1_500_000, 3), 0.004))
    scene.save(root / "large.ply")
    core_session(scene, clean_views(1)).save(root / "narrow_state.npz")
    names = [*CLASSES, *(f"class {k}" for k in range(len(CLASSES), 1500))]
    with private_ros(tmp_path_factory.mktemp("starved")) as ros:
        robot = Robot(ros, "/starved")
        # It finds all neighbours for a first request; of as many as usual, that takes seconds, and nothing asks for it.
        robot.started({"scene_path": root / "large.ply", "data_root": root, "class_names": names, "k": 1})
        robot.drive(clean_views(1))
        robot.wait_for_status(lambda status: status.get("views fused") == "1", "the view")
        yield robot


LEFT, LEFT_TO_LOAD = 60 << 20, 200 << 20  # bytes
"""What a node that is short of memory has: far too little for another session, but for the file of its scene, which is
100 MB, enough; what it keeps of what earlier requests have freed comes on top."""


@contextmanager
def short_of_memory(robot: Robot, left: int = LEFT) -> Iterator[None]:
    """Leave the node too little memory for another session or learner."""
    assert robot.process is not None
    pages = int(Path(f"/proc/{robot.process.pid}/statm").read_text().split()[0])
    with limited(robot, resource.RLIMIT_AS, pages * resource.getpagesize() + left):
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


@contextmanager
def in_this_process(robot: Robot, parameters: dict[str, Any]) -> Iterator[SegmentNode]:
    """Run a node in this process, active and with one view."""
    values = {name: str(value) if isinstance(value, Path) else value for name, value in parameters.items()}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(segment_node, "warm_up", lambda *_: None)
        node = SegmentNode(
            context=robot.ros.context, namespace=robot.namespace, use_global_arguments=False,
            parameter_overrides=[Parameter(name, value=value) for name, value in values.items()],
        )  # fmt: skip
        with spun(node):
            assert robot.brought_to("inactive").change("activate")
            robot.fuse(clean_views(1))
            yield node
        node.close()


@pytest.fixture(scope="module")
def crowded(shared: Ros, parameters: dict[str, Any]) -> Iterator[Robot]:
    """A node that has as many requests as it takes, and does not come to their end."""
    robot, go_on, draw = Robot(shared, "/crowded"), threading.Event(), services.draw
    with pytest.MonkeyPatch.context() as patch, in_this_process(robot, parameters):
        patch.setattr(services, "draw", lambda *a, **k: (go_on.wait(PATIENCE), draw(*a, **k))[1])
        requests = [robot.send("render_view", **nowhere()) for _ in range(AT_WORK + WAITING + 1)]
        shared.wait_until(lambda: any(request.done() for request in requests), "a request that is refused")
        yield robot
        go_on.set()
        codes = sorted(shared.result(request).error_code for request in requests)
        assert codes == [0] * (AT_WORK + WAITING) + [SERVICES["render_view"].Response.BUSY]


@pytest.fixture(scope="module")
def exhausted(shared: Ros, parameters: dict[str, Any]) -> Iterator[Robot]:
    """A node whose session has no memory left, neither to segment nor to save."""

    def without_memory(*_: object, **__: object) -> None:
        raise MemoryError

    robot = Robot(shared, "/exhausted")
    with in_this_process(robot, parameters) as node:
        node.workspace.session.segmentation = node.workspace.session.save = without_memory
        yield robot


def provoke(case: Case, nodes: Nodes, request: pytest.FixtureRequest) -> Any:
    if case.code == "CANCELED":
        status, result = nodes.main.cancel(nodes.main.begin(dataset_path="long"))
        assert status == GoalStatus.STATUS_CANCELED
        return result
    if case.on == "busy":
        with busy(nodes.main):
            return answer(nodes.main, case)
    if case.on in ("crowded", "exhausted"):
        return answer(request.getfixturevalue(case.on), case)
    if case.on == "starved":
        robot = request.getfixturevalue("starved")
        with short_of_memory(robot, LEFT_TO_LOAD if case.service == "load_scene" else LEFT):
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
    } - {("learn", "NOT_ACTIVE")}  # Goals are rejected then, so that only one of this very moment gets it.
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


def test_after_memory_ran_out_the_node_goes_on(starved: Robot) -> None:
    with short_of_memory(starved):
        response = starved.ask("load_state", path="narrow_state.npz")
        assert response.error_code == SERVICES["load_state"].Response.UNKNOWN
    assert starved.done("segment", skip_refinement=True).report.num_views == 1
    starved.process.wait_for("Traceback")  # The log has the details.
    assert starved.done("reset").num_views_dropped == 1
