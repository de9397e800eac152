"""The picture that the node draws while views come in: for those who look, of what is newest, after the fusing."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from gsseg_msgs.msg import ObjectArray
from patience import PATIENCE
from ros_fixtures import parameters_fixture, root_fixture, running_fixture, scene_fixture, shared_fixture  # noqa: F401
from ros_helpers import wait_until
from ros_robot import CLASSES, LATCHED, Robot, core_session, messages
from sensor_msgs.msg import Image
from small_scenes import balls_on_a_table, clean_views
from std_msgs.msg import Header

from gsseg_core.data.view import View
from gsseg_core.errors import MaskFormatError
from gsseg_core.export.pictures import overlay, palette
from gsseg_core.live.session import LiveSession
from gsseg_core.raster.backends import make_operator
from gsseg_core.refine.settings import UNREFINED
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_ros.conversions import color_from_image, picture_from_image, rgb_image
from gsseg_ros.frames import Similarity
from gsseg_ros.node import live_outputs
from gsseg_ros.node.live_outputs import LiveOutputs
from gsseg_ros.node.pairing import Paired
from gsseg_ros.node.reports import Selection


@pytest.fixture
def robot(running: Robot) -> Robot:
    """A node of which nobody looks at the overlay, and which has fused six views."""
    running.ros.wait_until(lambda: not running.publishers["image"].get_subscription_count(), "the last one to go")
    running.done("reset")
    running.fuse(clean_views(6))
    return running


class Viewer:
    """Somebody who looks at the overlay, until `close`."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.seen: list[Image] = []
        self._subscription = robot.ros.node.create_subscription(
            Image, f"{robot.name}/overlay", self.seen.append, LATCHED
        )
        listens = robot.publishers["image"].get_subscription_count
        robot.ros.wait_until(lambda: listens() > 0, "the node to listen to images, as somebody looks")

    def close(self) -> None:
        self.robot.ros.node.destroy_subscription(self._subscription)

    def picture_of(self, stamp: Time) -> np.ndarray:
        """The overlay with a stamp."""
        self.robot.ros.wait_until(lambda: any(image.header.stamp == stamp for image in self.seen), "the overlay")
        image = next(image for image in self.seen if image.header.stamp == stamp)
        assert (image.encoding, image.header.frame_id) == ("rgb8", "camera")
        return picture_from_image(image, "overlay")


@pytest.fixture
def viewer(robot: Robot) -> Iterator[Viewer]:
    viewer = Viewer(robot)
    yield viewer
    viewer.close()


def photo_of(sent: dict[str, Any], encoding: str = "rgb8") -> tuple[Image, np.ndarray]:
    """A picture of noise at the stamp of a view, and its colours (48, 64, 3)."""
    pixels = np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8)
    image = rgb_image(pixels if encoding == "rgb8" else np.ascontiguousarray(pixels[..., ::-1]), sent["mask"].header)
    image.encoding = encoding
    return image, pixels


def labels_of(scene: GaussianScene, views: list[View], camera: Camera) -> np.ndarray:
    """What a camera sees once some views are fused."""
    return core_session(scene, views).segmentation(UNREFINED).render(make_operator(scene, camera)).labels


def close_to(found: np.ndarray, expected: np.ndarray) -> bool:
    """The same but for few pixels: a quaternion's last digits may move an outline."""
    assert found.shape == expected.shape
    return (np.abs(found.astype(int) - expected).max(axis=2) <= 2).mean() > 0.97


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8"])
def test_the_prediction_is_drawn_over_the_camera_image(
    robot: Robot, viewer: Viewer, scene: GaussianScene, encoding: str
) -> None:
    view = clean_views(1, "other", 0.4)[0]
    sent = messages(view, robot.next_stamp())
    image, pixels = photo_of(sent, encoding)
    del sent["mask"]  # The camera is faster than the segmenter: there is no mask of this image.
    robot.publish({**sent, "image": image})
    expected = overlay(pixels, labels_of(scene, clean_views(6), view.camera), palette(4))
    assert close_to(viewer.picture_of(image.header.stamp), expected)


def test_without_camera_images_the_classes_alone_are_drawn(robot: Robot, scene: GaussianScene) -> None:
    # A node that has been inactive has seen no image yet, whatever other tests have sent it.
    assert robot.change("deactivate")
    robot.ros.wait_until(lambda: not robot.publishers["mask"].get_subscription_count(), "the node to stop listening")
    assert robot.change("activate")
    robot.wait_active()
    viewer = Viewer(robot)
    view = clean_views(6)[0]  # Again, so that nothing depends on whether its own votes are in the codes yet.
    sent = messages(view, robot.next_stamp())
    robot.publish(sent)
    found = viewer.picture_of(sent["mask"].header.stamp)
    viewer.close()
    assert close_to(found, palette(4)[labels_of(scene, clean_views(6), view.camera)])


def test_it_stops_listening_to_images_when_nobody_looks_any_more(robot: Robot) -> None:
    viewer = Viewer(robot)
    viewer.close()
    robot.ros.wait_until(lambda: not robot.publishers["image"].get_subscription_count(), "the node to stop listening")


def test_an_image_that_cannot_be_used_is_explained_and_the_next_one_is_drawn(robot: Robot, viewer: Viewer) -> None:
    view = clean_views(1)[0]
    assert robot.process is not None
    for spoil, why in (
        ({"encoding": "16UC1"}, "/image: encoding is '16UC1'; expected one of rgb8, rgba8, bgr8, bgra8, mono8"),
        ({"width": 32}, "/image: image is 32 x 48 pixels; expected 64 x 48, as /camera_info says"),
    ):
        sent = messages(view, robot.next_stamp())
        image, _ = photo_of(sent)
        for name, value in spoil.items():
            setattr(image, name, value)
        robot.publish({**sent, "image": image})
        robot.process.wait_for(why)
    sent = messages(view, robot.next_stamp())
    image, _ = photo_of(sent)
    robot.publish({**sent, "image": image})
    viewer.picture_of(image.header.stamp)


@pytest.mark.parametrize(
    ("encoding", "channels"),
    [("rgb8", [0, 1, 2]), ("bgr8", [2, 1, 0]), ("rgba8", [0, 1, 2, 3]), ("bgra8", [2, 1, 0, 3]), ("mono8", [0])],
)
def test_pictures_of_every_usual_encoding_come_out_as_rgb(encoding: str, channels: list[int]) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (5, 7, 4), np.uint8)
    sent = np.ascontiguousarray(pixels[..., channels])
    image = Image(header=Header(), height=5, width=7, encoding=encoding, step=7 * len(channels), data=sent.tobytes())
    found = color_from_image(image, "image")
    np.testing.assert_array_equal(found, pixels[..., [0, 0, 0] if encoding == "mono8" else [0, 1, 2]])


def test_a_picture_of_another_encoding_is_refused() -> None:
    with pytest.raises(MaskFormatError, match="encoding is '32FC1'; expected one of rgb8"):
        color_from_image(Image(encoding="32FC1", width=1, height=1, step=4, data=bytes(4)), "image")


# Without ROS around it: what it does to the thread that fuses.


class Shown:
    """In the place of the outputs: takes its time to show a picture."""

    wants_objects = False
    objects_count = 0

    def __init__(self) -> None:
        self.stamps: list[int] = []
        self.objects: list[ObjectArray] = []
        self.wanted: list[Callable[[], bool]] = []
        self.go_on = threading.Event()

    def wants_overlay(self, camera: str) -> bool:
        return True

    def publish_overlay(self, image: Image, wanted: Callable[[], bool], camera: str) -> None:
        self.wanted.append(wanted)
        self.stamps.append(image.header.stamp.sec)
        self.go_on.wait(PATIENCE)

    def publish_objects(self, objects: ObjectArray, since: int) -> bool:
        self.objects.append(objects)
        return True


@pytest.fixture
def live() -> Iterator[tuple[LiveOutputs, Shown, dict[str, int]]]:
    scene, _ = balls_on_a_table()
    session = LiveSession(scene, dict(enumerate(CLASSES)))
    for view in clean_views(2):
        session.fuse(view)
    similarity = Similarity()
    settings = SimpleNamespace(rectified="auto", scene_to_map=similarity, max_pixels=1 << 24, map_frame="map")
    shown, state = Shown(), {"busy": False, "asked": 0}
    workspace: Any = SimpleNamespace(session=session, settings=settings, era=session.era)
    outputs: Any = shown

    def busy() -> bool:
        state["asked"] += 1
        return bool(state["busy"])

    live = LiveOutputs(workspace, outputs, busy, Time, pytest.fail)
    yield live, shown, state
    shown.go_on.set()
    live.close()


CAMERA = clean_views(1)[0].camera


def paired(second: int) -> Paired:
    view = clean_views(1)[0]
    sent = messages(view, second * 1_000_000_000)
    pose = np.linalg.inv(view.camera.world_to_camera)
    return Paired(str(second), second, ("mask", sent["mask"]), ("camera_info", sent["camera_info"]), pose)


def test_whoever_fuses_never_waits_for_a_picture_and_only_the_newest_is_drawn(
    live: tuple[LiveOutputs, Shown, dict[str, int]],
) -> None:
    outputs, shown, _ = live
    outputs.fused(paired(1), CAMERA)
    wait_until(lambda: shown.stamps, "the first picture, which is then stuck")
    for second in range(2, 50):
        outputs.fused(paired(second), CAMERA)  # Would hang here.
    assert shown.stamps == [1]
    shown.go_on.set()
    wait_until(lambda: len(shown.stamps) == 2, "the next picture")
    assert shown.stamps == [1, 49]


def test_nothing_is_drawn_while_masks_wait(
    live: tuple[LiveOutputs, Shown, dict[str, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_outputs, "POSTPONED_SECONDS", PATIENCE)
    outputs, shown, state = live
    shown.go_on.set()
    state["busy"] = True
    outputs.fused(paired(1), CAMERA)
    outputs.fused(paired(2), CAMERA)
    wait_until(lambda: state["asked"] > 3, "it to look several times whether masks still wait")
    assert shown.stamps == []
    state["busy"] = False
    wait_until(lambda: shown.stamps, "the picture")
    assert shown.stamps == [2]


def test_a_picture_is_drawn_within_a_second_though_masks_never_cease_to_wait(
    live: tuple[LiveOutputs, Shown, dict[str, int]],
) -> None:
    outputs, shown, state = live
    shown.go_on.set()
    state["busy"] = True
    begun = time.monotonic()
    outputs.fused(paired(1), CAMERA)
    wait_until(lambda: shown.stamps, "the picture, in spite of the masks")
    assert time.monotonic() - begun >= 0.9, "the masks go first, for a while"
    outputs.fused(paired(2), CAMERA)
    wait_until(lambda: shown.stamps == [1, 2], "the next one")


def test_a_picture_that_was_begun_before_a_reset_is_not_published_after_it(
    live: tuple[LiveOutputs, Shown, dict[str, int]],
) -> None:
    outputs, shown, _ = live
    shown.go_on.set()
    outputs.fused(paired(1), CAMERA)
    wait_until(lambda: shown.wanted, "a picture")
    assert shown.wanted[0]()
    outputs._workspace.era = object()
    assert not shown.wanted[0]()


def test_objects_are_those_of_the_newest_view_though_a_picture_was_drawn_just_before_it(
    live: tuple[LiveOutputs, Shown, dict[str, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    drawer, shown, _ = live
    monkeypatch.setattr(live_outputs, "CODES_PERIOD", PATIENCE)  # However slow this machine is.
    session = drawer._workspace.session
    shown.go_on.set()
    drawer.fused(paired(1), CAMERA)
    wait_until(lambda: shown.stamps, "a picture")
    (view,) = clean_views(1, "late")
    session.fuse(View.from_arrays(view.camera, np.full_like(view.read_labels(), 1)))
    drawer.fused(paired(2), CAMERA)
    drawer.show_objects()
    wait_until(lambda: shown.objects, "the objects")
    now = session.unrefined()
    selection = Selection(session, now, sorted(now.class_names), 0.0, drawer._workspace.settings.scene_to_map)
    assert shown.objects == [selection.objects(Header(frame_id="map"), revision=0)]
