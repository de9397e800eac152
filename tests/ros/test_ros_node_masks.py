"""What the segmentation node makes of masks as segmenters send them: the votes of the plain mask that is meant."""

from __future__ import annotations

import array
import io
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from PIL import Image as Picture
from rclpy.node import Node
from ros_fixtures import parameters_fixture, root_fixture, scene_fixture, shared_fixture  # noqa: F401
from ros_helpers import Ros, ros_fixture, wait_until  # noqa: F401
from ros_node_here import NodeHere, node_here
from ros_robot import core_session, messages
from sensor_msgs.msg import CompressedImage, Image
from small_scenes import clean_views

from gsseg_core.data.view import View
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_ros.conversions import plain_image, rgb_image
from gsseg_ros.node.masks.compressed import compressed_topic

COLORS = ["#000000", "#ff8000", "#0080ff", "#123456"]
RGB = np.array([[0, 0, 0], [255, 128, 0], [0, 128, 255], [0x12, 0x34, 0x56]], np.uint8)


@pytest.fixture(scope="module")
def running(shared: Ros, parameters: dict[str, Any]) -> Iterator[NodeHere]:
    with node_here(shared, {**parameters, "palette": COLORS}) as here:
        yield here


@pytest.fixture
def here(running: NodeHere) -> NodeHere:
    """A node without views, shared by the tests of this file."""
    running.done("reset")
    return running


def png(pixels: np.ndarray, sent: Image, form: str = "png", kind: str = "PNG") -> CompressedImage:
    stream = io.BytesIO()
    Picture.fromarray(pixels).save(stream, format=kind)
    return CompressedImage(header=sent.header, format=form, data=array.array("B", stream.getvalue()))


def fuse(here: NodeHere, view: View, mask: Any) -> None:
    """Hand over a view with another message for its mask, and wait until it is fused or rejected."""
    sent = messages(view, here.stamp)
    here.stamp += 10**8
    before = here.inputs.accepted, here.inputs.rejected.total()
    here.hand({"camera_info": sent["camera_info"], "pose": sent["pose"], "mask": mask(sent["mask"])})
    wait_until(lambda: (here.inputs.accepted, here.inputs.rejected.total()) != before, "the mask to be fused or not")


def assert_votes(here: NodeHere, scene: GaussianScene, views: list[View]) -> None:
    found, expected = here.node.workspace.session.codes(), core_session(scene, views).codes()
    np.testing.assert_allclose(found, expected, atol=1e-4)


def test_what_is_negative_in_16sc1_is_unknown(here: NodeHere, scene: GaussianScene) -> None:
    view = clean_views(1)[0]
    labels = view.read_labels()
    labels[:, :20] = -1
    fuse(here, view, lambda sent: plain_image(np.where(labels < 0, -7, labels).astype("<i2"), "16SC1", sent.header))
    assert_votes(here, scene, [View.from_arrays(view.camera, labels)])


def test_probabilities_are_fused_as_a_soft_mask(here: NodeHere, scene: GaussianScene) -> None:
    view = clean_views(1)[0]
    certain = np.eye(4, dtype=np.float32)[view.read_labels()]  # (H, W, K)
    p = np.float32(0.75) * certain + np.float32(0.0625) * (1 - certain)
    fuse(here, view, lambda sent: plain_image(p.astype("<f4"), "32FC4", sent.header))
    assert_votes(here, scene, [View.from_probabilities(view.camera, np.moveaxis(p, -1, 0))])


def test_colours_of_the_palette_are_fused_and_others_rejected(here: NodeHere, scene: GaussianScene) -> None:
    view, before = clean_views(1)[0], here.inputs.rejected["mask_format"]
    pixels = RGB[view.read_labels()]
    fuse(here, view, lambda sent: rgb_image(pixels, sent.header))
    pixels[3, 4] += 1
    fuse(here, view, lambda sent: rgb_image(pixels, sent.header))
    assert here.inputs.rejected["mask_format"] == before + 1
    assert (
        "mask: 1 pixels have a colour that is not in the palette, first #010101"
        in (here.inputs.explained["mask_format"])
    )
    assert_votes(here, scene, [view])


def test_compressed_masks_are_heard_below_the_topic_of_the_plain_ones(
    ros: Ros, parameters: dict[str, Any], scene: GaussianScene
) -> None:
    view = clean_views(1)[0]
    labels = view.read_labels()
    with node_here(ros, {**parameters, "mask_transport": "compressed", "max_pixels": labels.size}) as here:
        assert "/mask/compressed" in here.inputs.arrivals and "/mask" not in here.inputs.arrivals
        assert here.inputs.roles["/mask/compressed"] == "mask"
        fuse(here, view, lambda sent: png(labels.astype(np.uint8), sent, "mono8; png compressed "))
        fuse(here, view, lambda sent: png(labels.astype(np.uint8), sent, "mono8; jpeg compressed ", "JPEG"))
        fuse(here, view, lambda sent: png(np.zeros((1, labels.size + 1), np.uint8), sent))
        assert here.inputs.rejected == {"mask_format": 1, "too_large": 1}
        assert "is a JPEG" in here.inputs.explained["mask_format"]
        assert "parameter max_pixels" in here.inputs.explained["too_large"]
        assert_votes(here, scene, [view])


def test_the_compressed_topic_follows_the_remapping_of_the_plain_one(ros: Ros) -> None:
    arguments = ["--ros-args", "-r", "mask:=/segmenter/semantic/image_raw"]
    node = Node("somebody", context=ros.context, cli_args=arguments, namespace="/robot")
    try:
        assert compressed_topic(node, "mask") == "/segmenter/semantic/image_raw/compressed"
        assert compressed_topic(node, "image") == "/robot/image/compressed"
    finally:
        node.destroy_node()


def test_an_overlay_is_drawn_on_compressed_pictures(ros: Ros, parameters: dict[str, Any]) -> None:
    view = clean_views(1)[0]
    overlays = ros.collect(Image, "/gsseg/overlay")
    with node_here(ros, {**parameters, "image_transport": "compressed"}) as here:
        wait_until(lambda: here.outputs.wants_overlay, "a subscriber of the overlay")
        here.fuse([view])
        wait_until(lambda: len(overlays) == 1, "the classes alone, since there is no picture yet")
        here.inputs._images[0].tick()
        assert here.inputs._images[0]._subscription.topic_name == "/image/compressed"
        sent = messages(view, here.stamp)
        here.hand({"camera_info": sent["camera_info"], "pose": sent["pose"]})
        white = np.full((48, 64, 3), 255, np.uint8)
        here.inputs._images[0]._arrived(png(white, sent["mask"], "rgb8; jpeg compressed bgr8", "JPEG"))
        wait_until(lambda: len(overlays) == 2, "the picture with the classes on it")
        drawn = [np.frombuffer(overlay.data, np.uint8).reshape(48, 64, 3) for overlay in overlays]
        assert (drawn[1] >= drawn[0]).all() and drawn[1].mean() > drawn[0].mean()
