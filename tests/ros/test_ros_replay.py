"""The replay node, from its own process to a subscriber: folders, bags, bad input, and its end."""

from __future__ import annotations

import json
import re
import shutil
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_folders import transforms, write_json
from PIL import Image as Picture
from ros_helpers import Process, Ros, ros_fixture  # noqa: F401
from small_scenes import NAMES, balls_on_a_table, many_classes, ring, write_dataset

from gsseg_core.data.dataset import Dataset
from gsseg_core.data.label_images import UNKNOWN, write_mask
from gsseg_core.errors import GssegError

pytest.importorskip("rosbags", reason="rosbags is not installed")

from geometry_msgs.msg import PoseStamped
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header

from gsseg_ros.camera_infos import camera_from_messages
from gsseg_ros.conversions import (
    camera_info,
    labels_from_image,
    mask_image,
    matrix_from_pose,
    pose_from_matrix,
    stamp_message,
    stamp_ns,
)
from gsseg_ros.frames import Similarity
from gsseg_ros.replay.replay_node import _PARAMETERS, _with_parameters, make_source
from gsseg_ros.replay.sources import BagSource, FolderSource, PhotoFileError

KINDS = {"mask": Image, "camera_info": CameraInfo, "pose": PoseStamped, "image": Image}
STORAGES = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}
FIRST, STEP = 1_700_000_000_000_000_123, 50_000_000
"""Stamps in the bags, ns."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six views, four of them for training; unknown pixels in one of these, and a photo of another."""
    scene, truth = balls_on_a_table()
    folder = write_dataset(tmp_path_factory.mktemp("data") / "table", scene, truth, names=NAMES)
    labels = Dataset(folder).views("train")[1].read_labels()
    labels[:5] = UNKNOWN
    write_mask(folder / "labels" / "view1.png", labels, 8)
    (folder / "images").mkdir()
    Picture.fromarray(photo()).save(folder / "images" / "view3.png")
    return folder


def photo() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8)


def listen(ros: Ros) -> dict[str, list[Any]]:
    # The mask last: it is found last, and the replay begins once it is.
    return {topic: ros.collect(kind, topic) for topic, kind in reversed(KINDS.items())}


def stamps(messages: list[Any]) -> list[int]:
    return [stamp_ns(message.header.stamp) for message in messages]


def write_bag(
    path: Path,
    folder: Path,
    storage: str = "mcap",
    topics: tuple[tuple[str, str], ...] = (
        ("/seg/mask", "mask"),
        ("/cam/camera_info", "camera_info"),
        ("/pose", "pose"),
    ),
    count: int = 4,
) -> list[tuple[str, bytes]]:
    """A bag of the first views of a folder; returns what was recorded, by topic's role."""
    store, recorded = get_typestore(Stores.ROS2_JAZZY), []
    with Writer(path, version=9, storage_plugin=STORAGES[storage]) as writer:
        connections = [
            (writer.add_connection(name, KINDS[role].__module__.split(".")[0] + "/msg/" + KINDS[role].__name__,
                                   typestore=store), role)
            for name, role in topics
        ]  # fmt: skip
        for i, view in enumerate(Dataset(folder).views()[:count]):
            header = Header(stamp=stamp_message(FIRST + i * STEP), frame_id="optical")
            messages = {
                "mask": mask_image(view.read_labels(), header, 8),
                "camera_info": camera_info(view.camera, header),
                "pose": PoseStamped(header=header, pose=pose_from_matrix(np.linalg.inv(view.camera.world_to_camera))),
            }
            messages["image"] = messages["mask"]
            for connection, role in connections:
                data = bytes(serialize_message(messages[role]))
                # The camera speaks at once, the segmenter needs a while.
                writer.write(connection, FIRST + i * STEP + (STEP // 3 if role == "mask" else 0), data)
                recorded.append((role, data))
    return recorded


def refusal(ros: Ros, parameters: dict[str, Any], *arguments: str) -> str:
    """The one line with which bad input is refused."""
    process = ros.start("replay_node", {"wait_for_subscribers": 0.0, **parameters}, *arguments)
    assert process.wait() == 2, process.output
    lines = process.output.splitlines()
    assert len(lines) == 1 and "[ERROR]" in lines[0], process.output
    return lines[0]


def refused(**parameters: Any) -> str:
    """The error with which a folder or bag is refused, here; `refusal` tells what a node makes of such an error."""
    defaults = {name: default for name, default, *_ in _PARAMETERS}
    with pytest.raises(GssegError) as raised:
        make_source({**defaults, **{name: str(value) for name, value in parameters.items()}})
    assert "\n" not in str(raised.value)
    return str(raised.value)


def finished(process: Process) -> str:
    assert process.wait() == 0, process.output
    return process.output


def test_a_folder_gives_the_views_of_the_split_in_order_with_equal_stamps(ros: Ros, folder: Path) -> None:
    heard, begun = listen(ros), time.time_ns()
    output = finished(ros.start("replay_node", {"data": folder, "rate": 40.0, "map_frame": "world"}))
    views = Dataset(folder).views("train")
    ros.wait_until(lambda: len(heard["mask"]) == len(views) and len(heard["pose"]) == len(views), "all views")
    assert stamps(heard["mask"]) == stamps(heard["camera_info"]) == stamps(heard["pose"])
    assert stamps(heard["mask"]) == sorted(set(stamps(heard["mask"])))
    assert begun < stamps(heard["mask"])[0] < time.time_ns()
    for view, mask, info, pose in zip(views, heard["mask"], heard["camera_info"], heard["pose"], strict=True):
        assert mask.encoding == "mono8" and mask.header.frame_id == info.header.frame_id == "camera"
        np.testing.assert_array_equal(labels_from_image(mask, "mask"), view.read_labels())
        camera = camera_from_messages("view", info, np.eye(4), Similarity(), "camera_info")
        assert (camera.width, camera.height) == (view.camera.width, view.camera.height)
        np.testing.assert_array_equal(camera.K, view.camera.K)
        camera_in_map = matrix_from_pose(pose.pose, "pose")
        assert pose.header.frame_id == "world"
        np.testing.assert_allclose(camera_in_map @ view.camera.world_to_camera, np.eye(4), atol=1e-9)
    assert "done: published 4 mask, 4 camera_info, 4 pose, 1 image in " in output


def test_photos_go_out_with_the_stamp_of_their_view(ros: Ros, folder: Path) -> None:
    heard = listen(ros)
    finished(ros.start("replay_node", {"data": folder, "rate": 40.0, "split": "all"}))
    ros.wait_until(lambda: len(heard["mask"]) == 6 and heard["image"], "6 masks and the photo")
    (image,) = heard["image"]
    assert stamps([image])[0] == stamps(heard["mask"])[3]
    assert (image.encoding, image.width, image.height) == ("rgb8", 64, 48)
    assert bytes(image.data) == photo().tobytes()


def test_labels_of_sixteen_bits_arrive_bit_for_bit(ros: Ros, tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / "many", *many_classes(), cameras=ring(2), bits=16)
    labels = np.random.default_rng(0).integers(-1, 65535, (48, 64))
    write_mask(folder / "labels" / "view0.png", labels, 16)
    heard = listen(ros)
    finished(ros.start("replay_node", {"data": folder, "rate": 40.0}))
    ros.wait_until(lambda: len(heard["mask"]) == 2, "2 masks")
    assert heard["mask"][0].encoding == "mono16"
    np.testing.assert_array_equal(labels_from_image(heard["mask"][0], "mask"), labels)


def test_ids_that_are_none_of_the_classes_are_replayed_as_they_are(tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / "parts", names=NAMES)
    ids = np.arange(64 * 48, dtype=np.int32).reshape(48, 64) % 40
    write_mask(folder / "labels" / "view0.png", ids, 8)
    (_, first), *_ = FolderSource(folder, "labels", "train", "camera", "map")
    np.testing.assert_array_equal(labels_from_image(dict(first)["mask"], "mask"), ids)


def test_a_loop_starts_again_with_later_stamps_and_no_mask_early(ros: Ros, folder: Path) -> None:
    heard = listen(ros)
    output = finished(ros.start("replay_node", {"data": folder, "rate": 20.0, "loop": 3}))
    ros.wait_until(lambda: len(heard["mask"]) == 12, "12 masks")
    times = stamps(heard["mask"])
    assert times == sorted(set(times))
    np.testing.assert_array_equal(heard["mask"][0].data, heard["mask"][8].data)
    # Masks that are late on a busy machine follow each other faster; none is early.
    done = re.search(r"published 12 mask, .* in ([\d.]+) s", output)
    assert done and float(done[1]) >= 12 / 20


def test_views_without_a_mask_are_left_out_with_a_warning(ros: Ros, folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder, tmp_path / "copy")
    (tmp_path / "copy" / "labels" / "view1.png").unlink()
    heard = listen(ros)
    output = finished(ros.start("replay_node", {"data": tmp_path / "copy", "rate": 40.0}))
    assert "1 views have no label image and are left out, the first 'view1'" in output
    ros.wait_until(lambda: len(heard["mask"]) == 3, "3 masks")


def test_without_a_subscriber_it_warns_and_goes_on(ros: Ros, folder: Path) -> None:
    parameters = {"data": folder, "rate": 100.0, "wait_for_subscribers": 0.2}
    output = finished(ros.start("replay_node", parameters, "-r", "mask:=/other"))
    assert "[WARN]" in output and "nobody listens to '/other' after 0.2 s" in output
    assert "published 4 mask" in output


def test_a_parameter_that_it_does_not_have_is_named(ros: Ros, folder: Path) -> None:
    process = ros.start("replay_node", {"data": folder, "rate": 1000.0, "wait_for_subscriber": 0.0, "split": "test"})
    process.wait_for("are ignored: wait_for_subscriber (did you mean wait_for_subscribers?)")


def test_it_waits_for_a_subscriber_that_comes_late(ros: Ros, folder: Path) -> None:
    process = ros.start("replay_node", {"data": folder, "rate": 40.0})
    ros.wait_until(lambda: ros.node.count_publishers("mask") == 1, "the node")
    heard = listen(ros)
    finished(process)
    ros.wait_until(lambda: len(heard["mask"]) == 4 and len(heard["pose"]) == 4, "all views")


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_bag_comes_back_as_it_was_recorded(ros: Ros, folder: Path, tmp_path: Path, storage: str) -> None:
    recorded = write_bag(tmp_path / "bag", folder, storage)
    heard = listen(ros)
    output = finished(ros.start("replay_node", {"bag": tmp_path / "bag", "rate": 40.0}))
    ros.wait_until(lambda: all(len(heard[role]) == 4 for role in ("mask", "camera_info", "pose")), "4 of each")
    for role in ("mask", "camera_info", "pose"):
        assert stamps(heard[role]) == [FIRST + i * STEP for i in range(4)]
        assert heard[role] == [deserialize_message(data, KINDS[role]) for r, data in recorded if r == role]
    assert "done: published 4 mask, 4 camera_info, 4 pose, 0 image" in output


def test_what_was_recorded_between_two_masks_is_due_between_them(folder: Path, tmp_path: Path) -> None:
    write_bag(tmp_path / "bag", folder)
    dues: dict[str, list[float]] = {}
    for group in BagSource(tmp_path / "bag", {}):
        for role, _ in group.messages:
            dues.setdefault(role, []).append(group.due)
    # One unit of time for what comes before the first mask, and two thirds of a unit from a mask to the next pose.
    assert dues["mask"] == [1, 2, 3, 4]
    assert dues["pose"] == dues["camera_info"] == pytest.approx([0, 1 + 2 / 3, 2 + 2 / 3, 3 + 2 / 3], abs=1e-6)


def test_a_bag_is_found_by_its_file_too_and_loops(ros: Ros, folder: Path, tmp_path: Path) -> None:
    write_bag(tmp_path / "bag", folder)
    (file,) = (tmp_path / "bag").glob("*.mcap")
    heard = listen(ros)
    finished(ros.start("replay_node", {"bag": file, "rate": 40.0, "loop": 2}))
    ros.wait_until(lambda: len(heard["mask"]) == 8, "8 masks")
    assert stamps(heard["mask"]) == 2 * [FIRST + i * STEP for i in range(4)]


def test_topics_of_a_bag_are_chosen_by_name_where_the_type_is_not_enough(
    ros: Ros,
    folder: Path,
    tmp_path: Path,
) -> None:
    topics = (("/a/mask", "mask"), ("/b/mask", "mask"), ("/odd", "camera_info"), ("/pose", "pose"), ("/image", "image"))
    write_bag(tmp_path / "bag", folder, topics=topics)
    heard = listen(ros)
    parameters = {"bag": tmp_path / "bag", "rate": 40.0, "mask_topic": "/b/mask", "camera_info_topic": "odd"}
    output = finished(ros.start("replay_node", parameters))
    ros.wait_until(lambda: len(heard["mask"]) == 4 and len(heard["image"]) == 4, "4 of each")
    assert "(/b/mask, /odd, /pose, /image)" in output


def test_a_missing_or_ambiguous_topic_is_one_error_that_lists_the_topics(folder: Path, tmp_path: Path) -> None:
    topics = (("/a/mask", "mask"), ("/b/mask", "mask"), ("/camera_info", "camera_info"))
    write_bag(tmp_path / "bag", folder, topics=topics)
    listing = (
        "topics in the bag: /a/mask (sensor_msgs/msg/Image, 4 messages), /b/mask (sensor_msgs/msg/Image, 4 messages), "
        "/camera_info (sensor_msgs/msg/CameraInfo, 4 messages)"
    )
    line = refused(bag=tmp_path / "bag")
    assert "2 topics (/a/mask, /b/mask) of type sensor_msgs/msg/Image" in line and listing in line
    line = refused(bag=tmp_path / "bag", mask_topic="/a/mask")
    assert "no topic of type geometry_msgs/msg/PoseStamped with a name that ends in 'pose'" in line and listing in line
    line = refused(bag=tmp_path / "bag", mask_topic="/camera_info")
    assert "no topic '/camera_info' of type sensor_msgs/msg/Image (mask_topic)" in line and listing in line


def test_a_bag_that_is_missing_broken_or_empty_is_one_error(ros: Ros, folder: Path, tmp_path: Path) -> None:
    assert f"{tmp_path}/no_bag: does not exist" in refused(bag=tmp_path / "no_bag")
    (tmp_path / "bag.mcap").write_bytes(b"\x89MCAP0\r\nno more")
    assert f"{tmp_path}/bag.mcap: not a readable bag" in refused(bag=tmp_path / "bag.mcap")
    write_bag(tmp_path / "empty", folder, count=0)
    process = ros.start("replay_node", {"bag": tmp_path / "empty", "wait_for_subscribers": 0.0, "loop": 0})
    assert process.wait() == 2 and "no message on '/seg/mask'" in process.output


@pytest.mark.parametrize(
    ("parameters", "expected"),
    [
        ({}, "neither 'data' nor 'bag' is set; expected exactly one of 'data'"),
        ({"data": "no/folder"}, "no/folder: is not a folder; looked for cameras.json"),
        ({"data": "", "rate": 0.0}, "expected a number with a decimal point from 0.001 to 1000"),
        ({"data": "", "rate": float("nan")}, "parameter 'rate'"),
        ({"data": "", "rate": 10}, "parameter 'rate': Trying to set parameter 'rate' to '10' of type 'INTEGER'"),
        ({"data": "", "rate": []}, "parameter 'rate': The parameter 'rate' is not initialized"),
        ({"data": "", "loop": -1}, "expected a whole number from 0 to "),
    ],
)
def test_bad_parameters_are_one_error_that_says_what_was_expected(
    ros: Ros,
    folder: Path,
    parameters: dict[str, Any],
    expected: str,
) -> None:
    if parameters.get("data") == "":
        parameters = {**parameters, "data": folder}
    assert expected in refusal(ros, parameters)


@pytest.mark.parametrize(
    ("parameters", "expected"),
    [
        ({"bag": "b"}, "and bag is 'b'; expected exactly one of 'data'"),
        ({"split": "half"}, "split is 'half'; expected 'train', 'test' or 'all'"),
        ({"labels": "none"}, "none: no label image for any of the 4 views of split 'train'"),
    ],
)
def test_what_the_folder_does_not_go_with_is_one_error(folder: Path, parameters: dict[str, str], expected: str) -> None:
    assert expected in refused(data=folder, **parameters)


def test_the_option_grow_is_the_parameter() -> None:
    remapped = ["replay_node", "--ros-args", "-p", "data:=--grow"]
    assert _with_parameters(remapped) == remapped
    assert _with_parameters([*remapped[:1], "--grow", *remapped[1:]]) == [*remapped, "--ros-args", "-p", "grow:=true"]


@pytest.mark.parametrize("parameter", ["rate", "use_sim_time:=5"])
def test_arguments_that_ros_cannot_take_are_refused_without_a_traceback(ros: Ros, parameter: str) -> None:
    process = ros.start("replay_node", None, "-p", parameter)
    assert process.wait() == 2 and "Traceback" not in process.output, process.output


def test_a_split_without_views_is_one_error(ros: Ros, folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder, tmp_path / "copy")
    (tmp_path / "copy" / "split.json").write_text(json.dumps({"train": ["view0"], "test": []}))
    line = refusal(ros, {"data": tmp_path / "copy", "split": "test"})
    assert "split 'test' has no view; expected at least one (train has 1, test has 0)" in line


def test_a_broken_mask_ends_the_replay_with_an_error_that_names_it(ros: Ros, folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder, tmp_path / "copy")
    mask = tmp_path / "copy" / "labels" / "view1.png"
    mask.write_bytes(mask.read_bytes()[:60])
    process = ros.start("replay_node", {"data": tmp_path / "copy", "rate": 40.0, "wait_for_subscribers": 0.0})
    assert process.wait() == 2
    assert f"{mask}: broken PNG" in process.output and "Traceback" not in process.output


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_stops_it_and_it_says_what_it_published(
    ros: Ros,
    folder: Path,
    number: signal.Signals,
) -> None:
    heard = listen(ros)
    process = ros.start("replay_node", {"data": folder, "rate": 0.001, "loop": 0})
    ros.wait_until(lambda: heard["mask"], "a mask")
    process.send(number)
    assert process.wait() == 0, process.output  # Long before the next mask, which is due after 1000 s.
    assert "stopped: published 1 mask, 1 camera_info, 1 pose, 0 image in " in process.output
    assert "Traceback" not in process.output


def test_a_signal_stops_it_while_it_waits_for_a_subscriber(ros: Ros, folder: Path) -> None:
    process = ros.start("replay_node", {"data": folder, "wait_for_subscribers": 600.0}, "-r", "mask:=/other")
    ros.wait_until(lambda: ros.node.count_publishers("/other") == 1, "the node")
    assert process.stop() == 0, process.output
    assert "stopped: published 0 mask" in process.output


def test_a_folder_of_bent_images_is_replayed_as_what_a_pinhole_sees(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    Picture.fromarray(photo()).save(tmp_path / "images" / "0001.png")
    write_mask(tmp_path / "labels" / "0001.png", np.ones((48, 64), np.int32), 8)
    content = transforms(camera_model="OPENCV", k1=-0.2, fl_x=40.0, fl_y=40.0, cx=32.0, cy=24.0)
    write_json(tmp_path / "transforms.json", content)
    ((_, sent),) = FolderSource(tmp_path, "labels", "train", "camera", "map")
    messages = dict(sent)
    sizes = {(messages[role].width, messages[role].height) for role in ("mask", "image", "camera_info")}
    assert len(sizes) == 1 and (64, 48) not in sizes
    camera = camera_from_messages("view", messages["camera_info"], np.eye(4), Similarity(), "camera_info")
    assert (camera.fx, camera.fy) == (40, 40)
    Picture.fromarray(photo()[1:]).save(tmp_path / "images" / "0001.png")
    with pytest.raises(PhotoFileError, match=r"0001\.png: image is 64 x 47 pixels; expected 64 x 48"):
        list(FolderSource(tmp_path, "labels", "train", "camera", "map"))
