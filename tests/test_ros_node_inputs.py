"""What the segmentation node makes of what it hears: posed masks are fused, the rest is counted and explained."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ros_helpers import Ros, ros_fixture  # noqa: F401
from ros_robot import (
    CLASSES,
    SECOND,
    STEP,
    Robot,
    assert_same,
    core_session,
    messages,
    private_ros,
    renamed,
)
from small_scenes import NUM_CLASSES, balls_on_a_table, clean_views, look_at, true_labels, write_dataset

from gsseg_core.dataset import Dataset, View
from gsseg_core.refine_settings import RefineSettings
from gsseg_core.scene import GaussianScene
from gsseg_core.segmentation import Segmentation
from gsseg_ros.frames import Similarity

pytest.importorskip("gsseg_msgs.msg", reason="gsseg_msgs is not installed")

from diagnostic_msgs.msg import DiagnosticStatus
from gsseg_msgs.msg import SegmentationReport
from gsseg_msgs.srv import Segment
from lifecycle_msgs.msg import State
from nav_msgs.msg import Odometry
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from gsseg_ros.conversions import arrays_from_cloud, mask_image, pose_from_matrix, stamp_message, stamp_ns

RAW = RefineSettings(cluster=False, filter=False)
Messages = dict[str, Any]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("root") / "data")


@pytest.fixture(scope="module")
def scene(data: Path) -> GaussianScene:
    return GaussianScene.load(data / "scene.ply")


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Ros]:
    with private_ros(tmp_path_factory.mktemp("ros")) as ros:
        yield ros


@pytest.fixture(scope="module")
def parameters(data: Path) -> dict[str, Any]:
    return {"scene_path": data / "scene.ply", "data_root": data.parent, "class_names": CLASSES, "queue_size": 1000}


@pytest.fixture(scope="module")
def silent(tmp_path_factory: pytest.TempPathFactory, parameters: dict[str, Any]) -> Iterator[Robot]:
    """A node that hears nothing; it may complain while other tests run."""
    with private_ros(tmp_path_factory.mktemp("silent")) as ros:
        robot = Robot(ros, "/silent")
        ros.node.destroy_publisher(robot.publishers.pop("mask"))
        ros.node.destroy_publisher(robot.publishers.pop("pose"))
        robot.start(parameters, lossless=False)
        yield robot


@pytest.fixture(scope="module")
def running(shared: Ros, parameters: dict[str, Any], silent: Robot) -> Robot:
    return Robot(shared).started(parameters)


@pytest.fixture
def robot(running: Robot) -> Robot:
    """A node without views, shared by the tests of this file."""
    running.done("reset")
    return running


def learnt(robot: Robot, folder: Path, **fields: Any) -> Segmentation:
    """The codes of the node as they are now."""
    return robot.exported(folder, skip_refinement=True, **fields)


def expected(scene: GaussianScene, views: list[View]) -> Segmentation:
    return core_session(scene, views).segmentation(RAW)


def out(robot: Robot, name: str) -> Path:
    return Path(robot.get("data_root")) / "out" / name


# Masks that are fused


def padded(image: Any, gap: int) -> Any:
    """The same image, with some bytes of nothing at the end of each row."""
    rows = np.frombuffer(image.data, np.uint8).reshape(image.height, image.step)
    image.data = np.pad(rows, ((0, 0), (0, gap)), constant_values=77).tobytes()
    image.step += gap
    return image


def encoded(labels: np.ndarray, header: Header, encoding: str, kind: str) -> Any:
    image = mask_image(labels, header, 16)
    values = np.where(labels < 0, {1: 255, 2: 65535, 4: -1}[np.dtype(kind).itemsize], labels).astype(kind)
    image.encoding, image.step, image.data = encoding, values[0].nbytes, values.tobytes()
    image.is_bigendian = int(kind.startswith(">"))
    return image


@pytest.mark.parametrize("gap", [0, 3])
@pytest.mark.parametrize(
    ("encoding", "kind"),
    [
        ("mono8", "u1"), ("8UC1", "u1"), ("mono16", "<u2"), ("16UC1", "<u2"), ("16UC1", ">u2"), ("32SC1", "<i4"),
        ("32SC1", ">i4"),
    ],
)  # fmt: skip
def test_masks_of_every_encoding_are_fused(
    robot: Robot, scene: GaussianScene, encoding: str, kind: str, gap: int
) -> None:
    view = clean_views(1)[0]
    labels = view.read_labels()
    labels[:, :20] = -1
    stamp = robot.next_stamp()
    sent = messages(view, stamp)
    sent["mask"] = padded(encoded(labels, sent["mask"].header, encoding, kind), gap)
    robot.publish(sent)
    robot.ros.wait_until(lambda: robot.ask("segment").error_code == 0, "the view to be fused")
    found = learnt(robot, out(robot, "encoding"))
    assert_same(found, expected(scene, [View.from_arrays(view.camera, labels)]))


def test_views_of_another_process_are_fused_with_the_default_quality_of_service(
    ros: Ros, data: Path, parameters: dict[str, Any], scene: GaussianScene
) -> None:
    robot = Robot(ros).started(parameters, lossless=False)
    views = Dataset(data).views("train")
    replay = ros.start("replay_node", {"data": data, "rate": 30.0, "loop": 5})
    # Best effort: what is sent before the two have found each other may be lost.
    status = robot.wait_for_status(lambda status: int(status["views accepted"]) >= 4 * len(views), "most views")
    assert replay.wait() == 0, replay.output
    assert (status["message"], status["queue drops"], status["time jumps"]) == ("fusing", "0", "0")
    found, wanted = learnt(robot, out(robot, "replayed")), expected(scene, views)
    assert (found.labels == wanted.labels).mean() > 0.99
    assert np.abs(found.probabilities - wanted.probabilities).max() < 0.2


def test_a_camera_info_of_before_serves_masks_that_have_none_of_their_own(robot: Robot, scene: GaussianScene) -> None:
    views, center = clean_views(3), np.array([0.0, 0.0, 3.0])
    views = [View.from_arrays(views[0].camera, view.read_labels()) for view in views]
    first = robot.next_stamp()
    robot.publish({"camera_info": messages(views[0], first)["camera_info"]})
    for view in views:
        sent = messages(view, robot.next_stamp())
        del sent["camera_info"]
        robot.publish(sent)
    # That of a later stamp tells that none is to come for the others.
    robot.publish({"camera_info": messages(View.from_arrays(look_at("later", center), views[0].read_labels()),
                                           robot.next_stamp())["camera_info"]})  # fmt: skip
    robot.ros.wait_until(lambda: robot.ask("segment").report.num_views == 3, "three views")
    assert_same(learnt(robot, out(robot, "camera_info")), expected(scene, renamed(views)))


def test_views_out_of_order_are_fused_and_counted(robot: Robot, scene: GaussianScene) -> None:
    before = robot.wait_for_status(lambda status: status["views fused"] == "0", "the reset")
    views, start = clean_views(3), robot.next_stamp()
    for view, late in zip(views, (0, 4, 2), strict=True):
        robot.publish(messages(view, start + late * STEP))
    robot.stamp = start + 5 * STEP
    status = robot.wait_for_status(lambda status: status["views fused"] == "3", "three views")
    assert int(status["out of order"]) - int(before["out of order"]) == 1
    assert status["time jumps"] == before["time jumps"]
    assert_same(learnt(robot, out(robot, "order")), expected(scene, views))


def test_a_bag_that_loops_is_fused_again(robot: Robot, scene: GaussianScene) -> None:
    before = robot.wait_for_status(lambda status: status["views fused"] == "0", "the reset")
    views, start = clean_views(4), robot.next_stamp()
    stamps = [start + i * SECOND for i in range(4)]
    for loop in range(2):
        for view, stamp in zip(views, stamps, strict=True):
            robot.publish(messages(view, stamp))
        done = 4 * (loop + 1)
        robot.ros.wait_until(lambda done=done: robot.ask("segment").report.num_views == done, f"{done} views")
    robot.stamp = stamps[-1]
    status = robot.wait_for_status(lambda status: status["views fused"] == "8", "eight views")
    assert int(status["time jumps"]) - int(before["time jumps"]) == 1
    assert status.get("rejected repeated_stamp") == before.get("rejected repeated_stamp")
    assert_same(learnt(robot, out(robot, "loop")), expected(scene, renamed(views + views)))


def turned(angle: float, axis: int = 2, shift: float = 0.0) -> np.ndarray:
    """A rigid motion (4, 4): a turn about an axis, and a shift along x."""
    c, s = np.cos(angle), np.sin(angle)
    matrix, (i, j) = np.eye(4), [k for k in range(3) if k != axis]
    matrix[[i, i, j, j], [i, j, i, j]] = c, -s, s, c
    matrix[0, 3] = shift
    return matrix


def test_an_odometry_is_interpolated_and_carries_the_camera(
    ros: Ros, parameters: dict[str, Any], scene: GaussianScene
) -> None:
    camera_in_base = turned(0.7, 0, 0.3) @ turned(-0.4, 2)
    rotation = pose_from_matrix(camera_in_base).orientation
    robot = Robot(ros).started({
        **parameters, "pose_source": "odometry", "camera_in_base.translation": camera_in_base[:3, 3].tolist(),
        "camera_in_base.rotation": [rotation.x, rotation.y, rotation.z, rotation.w],
    })  # fmt: skip
    views = clean_views(4)
    for view in views:
        stamp = robot.next_stamp()
        sent = messages(view, stamp)
        sent.pop("pose")
        camera = np.linalg.inv(view.camera.world_to_camera)
        # Half way between a pose before and a pose after lies that of the mask.
        for when, part in ((stamp - STEP // 4, -1), (stamp + STEP // 4, 1)):
            odometry = Odometry(header=Header(stamp=stamp_message(when), frame_id="map"), child_frame_id="base")
            odometry.pose.pose = pose_from_matrix(
                camera @ np.linalg.inv(camera_in_base) @ turned(part * 0.2, 1, part * 0.1)
            )
            robot.publish({"odometry": odometry})
        robot.publish(sent)
    robot.ros.wait_until(lambda: robot.ask("segment").report.num_views == 4, "four views")
    assert_same(learnt(robot, out(robot, "odometry")), expected(scene, views))


def test_poses_and_clouds_are_in_the_map_where_the_scene_has_another_frame_and_scale(
    ros: Ros, parameters: dict[str, Any], scene: GaussianScene
) -> None:
    motion = turned(0.8, 1) @ turned(-2.0, 0)
    similarity = Similarity(motion[:3, :3], np.array([4.0, -1.0, 0.5]), 2.5)
    rotation = pose_from_matrix(motion).orientation
    robot = Robot(ros).started({
        **parameters, "scene_to_map.scale": 2.5, "scene_to_map.translation": [4.0, -1.0, 0.5],
        "scene_to_map.rotation": [rotation.x, rotation.y, rotation.z, rotation.w],
    })  # fmt: skip
    views = clean_views(4)
    robot.drive(views, similarity)
    robot.ros.wait_until(lambda: robot.ask("segment").report.num_views == 4, "four views")
    found = learnt(robot, out(robot, "similarity"))
    assert_same(found, expected(scene, views))

    report = robot.done("segment", skip_refinement=True, classes=["box"]).report
    (cloud,) = robot.latched((PointCloud2, "classes/box"))
    in_map = similarity.points_to_map(scene.means[found.labels == 3])
    np.testing.assert_allclose(arrays_from_cloud(cloud).points, in_map, atol=1e-5)
    (box,) = report.classes
    np.testing.assert_allclose([box.centroid.x, box.centroid.y, box.centroid.z], in_map.mean(axis=0), atol=1e-4)
    sent = messages(views[0], 0, similarity)
    image = robot.done("segment", viewpoint_pose=sent["pose"], viewpoint_camera=sent["camera_info"]).label_image
    assert (np.frombuffer(image.data, "<u2").reshape(48, 64) == views[0].read_labels()).mean() > 0.9
    corner = robot.done("load_scene").box_max
    np.testing.assert_allclose(
        [corner.x, corner.y, corner.z], similarity.points_to_map(scene.means).max(axis=0), atol=1e-4
    )


# Views that are rejected


@dataclass(frozen=True)
class Bad:
    """A view that cannot be used."""

    what: str
    reason: str
    log: str
    spoil: Callable[[Messages], Any]

    def __str__(self) -> str:
        return self.what


def set_labels(sent: Messages, labels: np.ndarray) -> None:
    sent["mask"] = mask_image(labels, sent["mask"].header, 8)


def set_fields(name: str, **fields: Any) -> Callable[[Messages], None]:
    def spoil(sent: Messages) -> None:
        for key, value in fields.items():
            setattr(sent[name], key, value)

    return spoil


def turn_away(sent: Messages) -> None:
    """Stand beside the scene, with the back to it."""
    facing = look_at("facing", np.array([50.0, 0, 0]))
    sent["pose"].pose = pose_from_matrix(np.linalg.inv(facing.world_to_camera))
    sent["pose"].pose.position.x = -50.0


def set_stamp(sent: Messages, change: int) -> None:
    header = sent["mask"].header
    header.stamp = stamp_message(stamp_ns(header.stamp) + change)


def set_orientation(sent: Messages, x: float, w: float) -> None:
    orientation = sent["pose"].pose.orientation
    orientation.x, orientation.y, orientation.z, orientation.w = x, 0.0, 0.0, w


BAD = [
    Bad("a mask of another size", "size_mismatch", "mask is 64 x 47 pixels; expected 64 x 48",
        lambda sent: set_labels(sent, np.zeros((47, 64), int))),
    Bad("a picture", "mask_format", "/mask: encoding is 'rgb8'; expected labels as one of mono8",
        set_fields("mask", encoding="rgb8")),
    Bad("a mask cut short", "mask_format", "", set_fields("mask", step=65)),
    Bad("an unknown label", "unknown_label", "mask holds the label 4; expected at most 3",
        lambda sent: set_labels(sent, np.full((48, 64), 4))),
    Bad("a distorted lens", "bad_camera_info", "/camera_info: distortion d is [-0.3, 0.0, 0.0, 0.0, 0.0]; expected "
        "zeros: use the rectified topic", set_fields("camera_info", d=[-0.3, 0.0, 0.0, 0.0, 0.0])),
    Bad("no focal length", "bad_camera_info", "", set_fields("camera_info", k=np.zeros(9))),
    Bad("all unknown", "all_pixels_unknown", "all pixels unknown",
        lambda sent: set_labels(sent, np.full((48, 64), -1))),
    Bad("a view of nothing", "sees_no_Gaussian", "sees no Gaussian", turn_away),
    Bad("no pose at the stamp", "no_pose", "masks were dropped because no pose with their stamp came",
        lambda sent: sent.pop("pose")),
    Bad("a repeated stamp", "repeated_stamp", "", lambda sent: set_stamp(sent, -STEP)),
]  # fmt: skip
BAD_POSES = [
    Bad("nan", "no_pose", "pose: position is (nan,", lambda sent: setattr(sent["pose"].pose.position, "x", np.nan)),
    Bad("zeros", "no_pose", "pose: orientation is all zeros: was it filled in?",
        lambda sent: set_orientation(sent, 0.0, 0.0)),
    Bad("frame", "no_pose", "pose: frame_id is 'odom'; expected 'map', the parameter map_frame",
        set_fields("pose", header=Header(frame_id="odom"))),
]  # fmt: skip


@dataclass(frozen=True)
class Rejected:
    """A node that has fused four views, and then rejected two hundred others."""

    robot: Robot
    before: Segmentation
    after: Segmentation
    status: dict[str, str]
    report: SegmentationReport
    counts: dict[str, int]


@pytest.fixture(scope="module")
def rejected(shared: Ros, parameters: dict[str, Any]) -> Rejected:
    robot = Robot(shared, "/rejecting").started(parameters)
    views = clean_views(5)
    robot.stamp = 1001 * SECOND - STEP
    robot.fuse(views[:4])
    before = learnt(robot, out(robot, "before"))
    counts: dict[str, int] = {}
    for _ in range(200 // len(BAD)):
        for bad in BAD:
            sent = messages(views[4], robot.next_stamp())
            bad.spoil(sent)
            robot.publish(sent)
            counts[bad.reason] = counts.get(bad.reason, 0) + 1

    def total(status: dict[str, str]) -> int:
        return sum(int(value) for key, value in status.items() if key.startswith("rejected "))

    status = robot.wait_for_status(lambda status: total(status) >= 200, "200 rejected views")
    after = learnt(robot, out(robot, "after"))
    return Rejected(robot, before, after, status, robot.done("segment").report, counts)


def test_two_hundred_rejected_views_leave_the_codes_untouched(rejected: Rejected) -> None:
    assert sum(rejected.counts.values()) == 200
    np.testing.assert_array_equal(rejected.after.labels, rejected.before.labels)
    np.testing.assert_array_equal(rejected.after.probabilities, rejected.before.probabilities)
    assert (rejected.status["views fused"], rejected.status["views kept"]) == ("4", "4")
    assert rejected.report.num_views == 4


@pytest.mark.parametrize("bad", BAD, ids=str)
def test_a_view_that_cannot_be_used_is_counted_by_its_reason_and_explained(rejected: Rejected, bad: Bad) -> None:
    assert rejected.status[f"rejected {bad.reason}"] == str(rejected.counts[bad.reason])
    reported = dict(zip(rejected.report.rejection_reasons, rejected.report.rejection_counts, strict=True))
    assert reported[bad.reason] == rejected.counts[bad.reason]
    assert rejected.robot.process is not None
    assert bad.log in rejected.robot.process.output


def test_the_report_counts_all_rejected_views_until_the_reset(rejected: Rejected) -> None:
    assert rejected.report.num_views_rejected == 200
    assert dict(zip(rejected.report.rejection_reasons, rejected.report.rejection_counts, strict=True)) == (
        rejected.counts
    )
    rejected.robot.done("reset")
    rejected.robot.fuse(clean_views(1))
    report = rejected.robot.done("segment").report
    assert (report.num_views_rejected, list(report.rejection_reasons)) == (0, [])


def test_one_thing_is_not_complained_of_more_than_once_in_five_seconds(rejected: Rejected) -> None:
    assert rejected.robot.process is not None
    by_reason: dict[str, list[float]] = {}
    for line in rejected.robot.process.output.splitlines():
        if found := re.search(r"\[(\d+\.\d+)\].*a view was rejected \((\w+)\)", line):
            by_reason.setdefault(found[2], []).append(float(found[1]))
    assert set(by_reason) == set(rejected.counts) - {"no_pose", "repeated_stamp"}
    assert all(np.diff(times).min(initial=5) >= 4.9 for times in by_reason.values())


@pytest.fixture(scope="module")
def misplaced(shared: Ros, parameters: dict[str, Any]) -> dict[str, Robot]:
    """Nodes of which each hears another kind of bad pose."""
    robots = {bad.what: Robot(shared, f"/{bad.what}") for bad in BAD_POSES}
    for robot in robots.values():
        robot.start(parameters)
    for bad, robot in zip(BAD_POSES, robots.values(), strict=True):
        robot.wait_active()
        for view in clean_views(2):
            sent = messages(view, robot.next_stamp())
            stamp = sent["mask"].header.stamp
            bad.spoil(sent)
            sent["pose"].header.stamp = stamp
            robot.publish(sent)
    return robots


@pytest.mark.parametrize("bad", BAD_POSES, ids=str)
def test_a_bad_pose_is_no_pose_and_the_log_says_what_is_wrong_with_it(misplaced: dict[str, Robot], bad: Bad) -> None:
    robot = misplaced[bad.what]
    status = robot.wait_for_status(lambda status: status.get("rejected no_pose") == "2", "two masks without a pose")
    assert (status["views fused"], status[f"/{bad.what}/pose received"]) == ("0", "2")
    assert robot.process is not None
    assert bad.log in robot.process.output
    assert robot.ask("segment").error_code == Segment.Response.NO_CODES


def test_masks_that_come_before_there_is_a_scene_are_counted(ros: Ros, parameters: dict[str, Any], data: Path) -> None:
    robot = Robot(ros).started({"data_root": data.parent, "class_names": CLASSES})
    assert robot.process is not None
    assert "no scene yet: set the parameter scene_path, or call ~/load_scene" in robot.process.output
    robot.drive(clean_views(3))
    status = robot.wait_for_status(lambda status: status.get("rejected no_scene") == "3", "three masks")
    assert (status["scene"], status["message"]) == ("none", "no scene is loaded")
    robot.done("load_scene", path="data/scene.ply")
    robot.fuse(clean_views(2))


def test_of_too_many_masks_at_once_the_oldest_are_dropped_and_counted(
    ros: Ros, parameters: dict[str, Any], tmp_path: Path
) -> None:
    robot = Robot(ros).started({**parameters, "queue_size": 1})
    scene, truth = balls_on_a_table()
    camera = look_at("large", np.array([3.0, 0, 3.0]), 640, 480, 550.0)
    view = View.from_arrays(camera, true_labels(scene, truth, camera))
    sent = 0

    def burst() -> None:
        nonlocal sent
        robot.publish({"camera_info": messages(view, robot.next_stamp())["camera_info"]})
        for _ in range(10):
            made = messages(view, robot.next_stamp())
            robot.publish({"mask": made["mask"], "pose": made["pose"]})
        # Until a later one comes they wait for a camera_info of their own; then all are ready in the same moment.
        robot.publish({"camera_info": messages(view, robot.next_stamp())["camera_info"]})
        sent += 10

    def all_counted(status: dict[str, str]) -> bool:
        # On a busy machine a pose may come too late for its mask.
        rejected = sum(int(count) for key, count in status.items() if key.startswith("rejected "))
        return int(status.get("views accepted", 0)) + rejected == sent

    # Whether a burst comes at once is up to the machine, which may be busy.
    for _ in range(20):
        burst()
        status = robot.wait_for_status(all_counted, "all masks to be fused or dropped")
        if int(status["queue drops"]):
            break
    assert int(status["queue drops"]) >= 1
    assert status["rejected queue_full"] == status["queue drops"]
    report = robot.done("segment").report
    counts = dict(zip(report.rejection_reasons, report.rejection_counts, strict=True))
    assert counts["queue_full"] == int(status["queue drops"])


# What the node says of its inputs


@pytest.mark.parametrize("reliability", [None, "reliable"])
def test_the_quality_of_service_of_an_input_can_be_overridden(
    ros: Ros, parameters: dict[str, Any], reliability: str | None
) -> None:
    robot = Robot(ros)
    override = {} if reliability is None else {"qos_overrides./mask.subscription.reliability": reliability}
    robot.started({**parameters, **override}, lossless=False)
    (found,) = ros.node.get_subscriptions_info_by_topic("/mask")
    wanted = ReliabilityPolicy.BEST_EFFORT if reliability is None else ReliabilityPolicy.RELIABLE
    assert found.qos_profile.reliability == wanted
    assert found.qos_profile.durability == DurabilityPolicy.VOLATILE
    (other,) = ros.node.get_subscriptions_info_by_topic("/pose")
    assert other.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT

    def fused() -> bool:
        robot.drive(clean_views(1))  # One that is sent before the two have found each other may be lost.
        return robot.ask("segment").error_code == 0

    ros.wait_until(fused, "a view")


def test_without_tf2_ros_the_pose_source_tf_is_one_clear_error(ros: Ros, parameters: dict[str, Any]) -> None:
    try:
        import tf2_ros  # noqa: F401
    except ImportError:
        pass
    else:
        pytest.skip("tf2_ros is installed")
    robot = Robot(ros)
    process = robot.start({**parameters, "pose_source": "tf"})
    process.wait_for("cannot be activated")
    errors = [line for line in process.output.splitlines() if "[ERROR]" in line]
    assert len(errors) == 1 and "Traceback" not in process.output
    assert "parameter pose_source is 'tf', but TF cannot be used here" in errors[0]
    assert "expected the apt package ros-jazzy-tf2-ros-py to be installed, or pose_source 'topic'" in errors[0]
    assert robot.ask("get_state").current_state.id == State.PRIMARY_STATE_INACTIVE


def test_diagnostics_tell_what_there_is_once_a_second(robot: Robot, data: Path) -> None:
    robot.fuse(clean_views(3))
    robot.learn(learner="em")
    status = robot.wait_for_status(lambda status: status["codes"] == "em", "the codes")
    assert {
        "active": "True", "scene": f"{data}/scene.ply", "gaussians": "626", "classes": str(NUM_CLASSES),
        "views fused": "3", "views kept": "3", "message": "fusing",
    }.items() <= status.items()  # fmt: skip
    assert status["last job"].startswith("learn done in ")
    assert float(status["/mask age [s]"]) < 5

    def stamps() -> list[float]:
        return [stamp_ns(array.header.stamp) / SECOND for array in robot.received_status
                if array.status[0].name == robot.name]  # fmt: skip

    robot.ros.wait_until(lambda: len(stamps()) >= 5, "five messages")
    assert np.median(np.diff(stamps())) == pytest.approx(1, abs=0.4)
    assert all(len(array.status) == 1 for array in robot.received_status)


def test_the_log_says_which_input_is_missing_and_what_to_check_once_in_five_seconds(silent: Robot) -> None:
    process = silent.process
    assert process is not None

    def complaints() -> dict[str, list[tuple[float, str]]]:
        found: dict[str, list[tuple[float, str]]] = {}
        for line in process.output.splitlines():
            if match := re.search(r"\[WARN\] \[(\d+\.\d+)\].*no data on (\S+) for (\d+) s; (.*)", line):
                found.setdefault(match[2], []).append((float(match[1]), match[4]))
        return found

    topics = ("/silent/mask", "/silent/camera_info", "/silent/pose")
    silent.ros.wait_until(lambda: all(len(complaints().get(topic, ())) >= 2 for topic in topics), "two complaints each")
    started = re.search(r"\[(\d+\.\d+)\].*active: listening", process.output)
    assert started is not None
    for topic, hint in zip(
        topics,
        (
            "nobody publishes it: is the segmenter running, and is its topic remapped to this one (--ros-args -r mask",
            "it has 1 publisher: do their QoS and type match (this side is best effort, volatile; ros2 topic info -v",
            "nobody publishes it: expected geometry_msgs/PoseStamped of the camera's optical frame",
        ),
        strict=True,
    ):
        times, hints = zip(*complaints()[topic], strict=True)
        assert 4.9 < times[0] - float(started[1]) < 21, "about seven seconds on a machine that is not busy"
        assert np.diff(times).min() >= 4.9
        assert all(found.startswith(hint) for found in hints)
    status = silent.status()
    assert status["message"].startswith("no data on /silent/mask for ")
    assert status["/silent/mask age [s]"] == "never"
    assert silent.received_status[-1].status[0].level == DiagnosticStatus.WARN
