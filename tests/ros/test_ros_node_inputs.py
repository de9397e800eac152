"""What the segmentation node makes of posed masks as they come: whichever way, they are fused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nav_msgs.msg import Odometry
from ros_fixtures import parameters_fixture, root_fixture, scene_fixture, shared_fixture  # noqa: F401
from ros_helpers import Ros, ros_fixture  # noqa: F401
from ros_robot import SECOND, STEP, Robot, assert_same, core_session, messages, renamed
from sensor_msgs.msg import PointCloud2
from small_scenes import clean_views, look_at
from std_msgs.msg import Header

from gsseg_core.data.dataset import Dataset
from gsseg_core.data.view import View
from gsseg_core.refine.settings import UNREFINED
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import Segmentation
from gsseg_ros.camera_infos import camera_of_image
from gsseg_ros.cloud_messages import arrays_from_cloud
from gsseg_ros.conversions import mask_image, pose_from_matrix, stamp_message
from gsseg_ros.frames import Similarity


@pytest.fixture(scope="module")
def running(shared: Ros, parameters: dict[str, Any]) -> Robot:
    return Robot(shared).started({**parameters, "queue_size": 1000})


@pytest.fixture
def robot(running: Robot) -> Robot:
    """A node without views, shared by the tests of this file."""
    running.done("reset")
    return running


def status_after_reset(robot: Robot) -> dict[str, str]:
    """What the node says once it is active; just before, it has a scene without views, and no inputs to tell of."""
    return robot.wait_for_status(lambda said: said.get("views fused") == "0" and "time jumps" in said, "the reset")


def learnt(robot: Robot, name: str) -> Segmentation:
    """The codes of the node as they are now."""
    return robot.exported(robot.out(name), skip_refinement=True)


def expected(scene: GaussianScene, views: list[View]) -> Segmentation:
    return core_session(scene, views).segmentation(UNREFINED)


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
    found = learnt(robot, "encoding")
    assert_same(found, expected(scene, [View.from_arrays(view.camera, labels)]))


def test_views_of_another_process_are_fused_with_the_default_quality_of_service(
    ros: Ros, root: Path, parameters: dict[str, Any], scene: GaussianScene
) -> None:
    robot = Robot(ros).started({**parameters, "queue_size": 1000}, lossless=False)
    views = Dataset(root / "data").views("train")
    replay = ros.start("replay_node", {"data": root / "data", "rate": 30.0, "loop": 5})
    status = robot.wait_for_status(lambda status: status.get("views accepted") == str(5 * len(views)), "all views")
    assert replay.wait() == 0, replay.output
    assert (status["queue drops"], status["time jumps"]) == ("0", "0")
    assert "fusing" in {said.message for array in robot.received_status for said in array.status}
    assert {key for key in status if key.startswith("rejected")} == set()
    found, wanted = learnt(robot, "replayed"), expected(scene, views)
    assert (found.labels == wanted.labels).mean() > 0.99
    assert np.abs(found.probabilities - wanted.probabilities).max() < 0.2


def test_a_raw_stream_is_undistorted_and_smaller_masks_fit_which_is_said_once(
    robot: Robot, scene: GaussianScene
) -> None:
    view = clean_views(1)[0]
    smaller = view.read_labels()[::2, ::2]
    for _ in range(2):
        sent = messages(view, robot.next_stamp())
        sent["mask"] = mask_image(smaller, sent["mask"].header, 8)
        sent["camera_info"].d = [-0.2, 0.03, 0.001, -0.001, 0.0]
        robot.publish(sent)
    robot.ros.wait_until(lambda: robot.ask("segment").report.num_views == 2, "two views")
    camera = camera_of_image("raw", sent["camera_info"], (32, 24), view.camera.world_to_camera, "", "", rectified=False)
    assert camera.undistortion is not None
    undistorted = View.from_arrays(camera, camera.undistortion.sample(smaller, -1))
    assert_same(learnt(robot, "raw"), expected(scene, renamed([undistorted] * 2)))
    assert robot.process is not None
    for said in ("/camera_info says 64 x 48: its intrinsics are scaled", "(plumb_bob): masks are undistorted; if they"):
        robot.process.wait_for(said)
        assert robot.process.output.count(said) == 1


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
    assert_same(learnt(robot, "camera_info"), expected(scene, renamed(views)))


def test_views_out_of_order_are_fused_and_counted(robot: Robot, scene: GaussianScene) -> None:
    before = status_after_reset(robot)
    views, start = clean_views(3), robot.next_stamp()
    for view, late in zip(views, (0, 4, 2), strict=True):
        robot.publish(messages(view, start + late * STEP))
    robot.stamp = start + 5 * STEP
    status = robot.wait_for_status(lambda status: status.get("views fused") == "3", "three views")
    assert int(status["out of order"]) - int(before["out of order"]) == 1
    assert status["time jumps"] == before["time jumps"]
    assert_same(learnt(robot, "order"), expected(scene, views))


def test_a_bag_that_loops_is_fused_again(robot: Robot, scene: GaussianScene) -> None:
    before = status_after_reset(robot)
    views, start = clean_views(4), robot.next_stamp()
    stamps = [start + i * SECOND for i in range(4)]
    for loop in range(2):
        for view, stamp in zip(views, stamps, strict=True):
            robot.publish(messages(view, stamp))
        done = 4 * (loop + 1)
        robot.ros.wait_until(lambda done=done: robot.ask("segment").report.num_views == done, f"{done} views")
    robot.stamp = stamps[-1]
    status = robot.wait_for_status(lambda status: status.get("views fused") == "8", "eight views")
    assert int(status["time jumps"]) - int(before["time jumps"]) == 1
    assert status.get("rejected repeated_stamp") == before.get("rejected repeated_stamp")
    assert_same(learnt(robot, "loop"), expected(scene, renamed(views + views)))


def test_synchronised_cameras_whose_poses_cannot_be_told_apart_are_refused_and_diagnostics_say_what_to_do(
    robot: Robot,
) -> None:
    before = status_after_reset(robot)
    refused = int(before.get("rejected several_cameras", 0))
    views = clean_views(2)
    for i in range(3):
        stamp = robot.next_stamp()
        for view, frame in zip(views, ("left", "right"), strict=True):
            sent = messages(view, stamp)
            for topic in ("mask", "camera_info"):
                sent[topic].header.frame_id = frame
            # Without a pose the first mask still waits when the second comes.
            robot.publish(sent if i else {topic: sent[topic] for topic in ("mask", "camera_info")})
        refused += 2
        status = robot.wait_for_status(
            lambda status, n=refused: status.get("rejected several_cameras") == str(n), "two refused masks"
        )
    robot.stamp += 11 * SECOND  # Until masks are believed again.
    assert status.get("rejected repeated_stamp") == before.get("rejected repeated_stamp")
    assert status["views fused"] == "0"
    assert robot.process is not None
    robot.process.wait_for("masks of several cameras (frame_id) carry one stamp, and their poses do not say whose")


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
        **parameters, "queue_size": 1000, "pose_source": "odometry",
        "camera_in_base.translation": camera_in_base[:3, 3].tolist(),
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
    assert_same(learnt(robot, "odometry"), expected(scene, views))


def test_poses_and_clouds_are_in_the_map_where_the_scene_has_another_frame_and_scale(
    ros: Ros, parameters: dict[str, Any], scene: GaussianScene
) -> None:
    motion = turned(0.8, 1) @ turned(-2.0, 0)
    similarity = Similarity(2.5, motion[:3, :3], np.array([4.0, -1.0, 0.5]))
    rotation = pose_from_matrix(motion).orientation
    robot = Robot(ros).started({
        **parameters, "queue_size": 1000, "scene_to_map.scale": 2.5, "scene_to_map.translation": [4.0, -1.0, 0.5],
        "scene_to_map.rotation": [rotation.x, rotation.y, rotation.z, rotation.w],
    })  # fmt: skip
    views = clean_views(4)
    robot.drive(views, similarity)
    robot.ros.wait_until(lambda: robot.ask("segment").report.num_views == 4, "four views")
    found = learnt(robot, "similarity")
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
