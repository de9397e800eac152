"""Several cameras in one node, poses by TF or topic, and depth that keeps out what stands before the scene."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import Transform
from nav_msgs.msg import Odometry
from pairing_events import expire
from ros_fixtures import parameters_fixture, root_fixture, scene_fixture, shared_fixture  # noqa: F401
from ros_helpers import Ros, wait_until
from ros_node_here import NodeHere, node_here
from ros_robot import core_session, messages
from sensor_msgs.msg import Image
from small_scenes import clean_views

from gsseg_core.data.view import View
from gsseg_core.errors import SettingsError
from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.depth import surface
from gsseg_core.raster.depth_gating import gate_view
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_ros.conversions import confidence_image, pose_from_matrix
from gsseg_ros.errors import DepthImageError
from gsseg_ros.node import diagnostics
from gsseg_ros.node.depth_images import depth_from_image, gate_by_image
from gsseg_ros.node.parameters import Settings


def wait_for(here: NodeHere, count: int) -> None:
    wait_until(lambda: here.inputs.accepted == count, f"{count} views to be fused")


def assert_fused(here: NodeHere, scene: GaussianScene, views: list[View]) -> None:
    """The node knows what a session knows that has fused these views."""
    names = [replace(view, camera=replace(view.camera, name=str(i))) for i, view in enumerate(views)]
    np.testing.assert_allclose(here.node.workspace.session.codes(), core_session(scene, names).codes(), atol=1e-4)


def values(here: NodeHere) -> dict[str, str]:
    """What `/diagnostics` says now."""
    (status,) = diagnostics.diagnostic_array("gsseg", here.node.workspace, here.inputs, Image().header.stamp).status
    return {pair.key: pair.value for pair in status.values}


def depth_image(scene: GaussianScene, view: View, header: Any) -> Image:
    """The depth of the scene as a camera measures it, in metres: 0 where there is nothing."""
    seen = surface(scene, make_operator(scene, view.camera))
    return confidence_image(np.where(np.isfinite(seen.depth), seen.depth, 0), header)


@contextmanager
def transforms(known: dict[tuple[str, str], np.ndarray]) -> Iterator[None]:
    """tf2_ros, as far as it is needed, which knows some transforms (parent, child) at all times."""

    class NotKnown(Exception):
        pass

    class Buffer:
        def lookup_transform(self, target: str, source: str, stamp: Any) -> Any:
            if (target, source) not in known:
                raise NotKnown(f'"{source}" passed to lookupTransform does not exist')
            pose = pose_from_matrix(known[target, source])
            return SimpleNamespace(
                transform=Transform(
                    rotation=pose.orientation,
                    translation=type(Transform().translation)(x=pose.position.x, y=pose.position.y, z=pose.position.z),
                )
            )

        def clear(self) -> None:
            pass

    class TransformListener:
        def __init__(self, buffer: Buffer, node: Any) -> None:
            pass

        def unregister(self) -> None:
            pass

    module: Any = ModuleType("tf2_ros")
    module.Buffer, module.TransformListener, module.TransformException = Buffer, TransformListener, NotKnown
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "tf2_ros", module)
        yield


def test_masks_of_one_stamp_from_two_cameras_are_two_views_and_topics_carry_the_names(
    shared: Ros, parameters: dict[str, Any], scene: GaussianScene
) -> None:
    views = clean_views(4)
    with node_here(shared, {**parameters, "cameras": ["front", "left"]}) as here:
        # The mask last: a publisher that has found it has found the others.
        assert list(here.inputs.arrivals) == [
            f"/{camera}/{topic}" for camera in ("front", "left") for topic in ("camera_info", "pose", "mask")
        ]
        for i in (0, 2):
            for view, camera in zip(views[i : i + 2], ("front", "left"), strict=True):  # Not even their frames differ.
                here.hand(messages(view, here.stamp + i), camera)
        wait_for(here, 4)
        assert_fused(here, scene, views)
        said = values(here)
        assert (said["views accepted of front"], said["views accepted of left"]) == ("2", "2")
        here.inputs.started -= 10
        for topic in here.inputs.arrivals:
            here.inputs.arrivals[topic] = (0, here.inputs.started)
        missing = diagnostics.missing_inputs(here.inputs)
        assert "/front/mask" in missing["mask"] and "/left/mask" in missing["mask"]


def test_each_camera_has_an_overlay_of_its_own(shared: Ros, parameters: dict[str, Any]) -> None:
    with node_here(shared, {**parameters, "cameras": ["front", "left"]}) as here:
        seen: list[Image] = []
        subscription = shared.node.create_subscription(Image, "/gsseg/overlay/left", seen.append, 1)
        wait_until(lambda: here.outputs.wants_overlay("left"), "the node to know who looks")
        assert not here.outputs.wants_overlay("front") and not here.outputs.wants_overlay()
        here.inputs._expire()
        names = {s.topic_name for s in here.node.subscriptions}
        assert "/left/image" in names and "/front/image" not in names
        for camera, view in zip(("front", "left"), clean_views(2), strict=True):
            here.hand(messages(view, here.stamp), camera)
        wait_until(lambda: len(seen) == 1, "the overlay of the camera that somebody looks at")
        shared.node.destroy_subscription(subscription)


@pytest.mark.parametrize("bad", [["front", "front"], ["a/b"], [""], ["1"], ["front "], ["a__b"]])
def test_names_that_no_topic_can_have_are_refused(bad: list[str]) -> None:
    from gsseg_ros.node.declarations import DECLARATIONS

    defaults = {declaration.name: declaration.default for declaration in DECLARATIONS}
    assert Settings.of({**defaults, "cameras": ["front", "left_2"]}).cameras == ("front", "left_2")
    with pytest.raises(SettingsError, match=r"parameter cameras: .*expected distinct names"):
        Settings.of({**defaults, "cameras": bad})


def test_automatic_poses_come_from_tf_or_else_from_the_topic(
    shared: Ros, parameters: dict[str, Any], scene: GaussianScene
) -> None:
    views = clean_views(2)
    known = {("map", "left"): np.linalg.inv(views[0].camera.world_to_camera)}
    with transforms(known), node_here(shared, {**parameters, "pose_source": "auto"}) as here:
        for view, frame in zip(views, ("left", "camera"), strict=True):
            sent = messages(view, here.stamp)
            here.stamp += 1
            for topic in ("mask", "camera_info"):
                sent[topic].header.frame_id = frame
            if frame == "left":
                del sent["pose"]
            here.hand(sent)
        wait_for(here, 2)
        assert_fused(here, scene, views)
        assert set(here.inputs.roles.values()) == {"mask", "camera_info"}, "a silent pose topic is nothing to warn of"


def test_an_odometry_in_odom_is_taken_to_the_map_and_to_the_camera_by_tf(
    shared: Ros, parameters: dict[str, Any], scene: GaussianScene
) -> None:
    views = clean_views(2)
    odom_in_map, camera_in_base = np.eye(4), np.eye(4)
    odom_in_map[:3, 3], camera_in_base[:3, 3] = (5, -3, 1), (0.2, 0, 0.4)
    camera_in_base[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    known = {("map", "odom"): odom_in_map, ("base_link", "camera"): camera_in_base}
    with transforms(known), node_here(shared, {**parameters, "pose_source": "odometry"}) as here:
        for view in views:
            sent = messages(view, here.stamp)
            here.stamp += 1
            odometry = Odometry(header=sent.pop("pose").header, child_frame_id="base_link")
            odometry.header.frame_id = "odom"
            camera = np.linalg.inv(view.camera.world_to_camera)
            base = np.linalg.inv(odom_in_map) @ camera @ np.linalg.inv(camera_in_base)
            odometry.pose.pose = pose_from_matrix(base)
            here.hand({"odometry": odometry, **sent})
        wait_for(here, 2)
        assert_fused(here, scene, views)


def test_pixels_where_somebody_stands_in_front_do_not_vote_and_are_counted(
    shared: Ros, parameters: dict[str, Any], scene: GaussianScene
) -> None:
    views, expected, hidden = clean_views(3), [], 0
    settings = {**parameters, "depth_gating": True, "scene_to_map.scale": 2.0}
    with node_here(shared, settings) as here:
        similarity = here.node.workspace.settings.scene_to_map
        for i, view in enumerate(views):
            sent = messages(view, here.stamp + i, similarity)
            image = depth_image(scene, view, sent["mask"].header)
            depth = 2.0 * np.frombuffer(image.data, "<f4").reshape(48, 64)
            depth[10:30, 20:40] = np.where(depth[10:30, 20:40] > 0, 0.5, 0)
            if i == 1:  # In millimetres.
                image.encoding, image.step = "16UC1", 128
                image.data = (depth * 1000).astype("<u2").tobytes()
            else:
                image.data = depth.astype("<f4").tobytes()
            here.hand({"mask": sent["mask"], "camera_info": sent["camera_info"], "pose": sent["pose"]})
            assert here.inputs.accepted == i, "without its depth a mask has to wait"
            here.hand({"depth": image})
            wait_for(here, i + 1)
            gated = gate_view(scene, view, depth_from_image(image, "depth"), scale=2.0)
            expected.append(gated.view)
            hidden += int(gated.contradicted.sum())
        assert_fused(here, scene, expected)
        said = values(here)
        assert said["views gated by depth"] == "3"
        assert abs(int(said["pixels unknown by depth"]) - hidden) <= 3 < hidden
        here.hand(messages(views[0], here.stamp + 10, similarity))
        expire(here.inputs.cameras[""].pairing)
        assert here.inputs.dropped == {"no_depth": 1}
        assert "no depth image with their stamp" in diagnostics.why_dropped(here.inputs, "no_depth")


def test_depth_of_another_camera_or_encoding_or_shape_is_refused(
    shared: Ros, parameters: dict[str, Any], scene: GaussianScene
) -> None:
    view = clean_views(1)[0]
    with node_here(shared, {**parameters, "depth_gating": True}) as here:
        for spoil, why in (
            ({"frame_id": "depth_optical"}, "expected depth registered to the camera of the masks"),
            ({"encoding": "mono8"}, "expected depth as one of 16UC1, 32FC1"),
            ({"height": 30}, "expected 64 x 48, as masks are, or a size of the same proportions"),
            ({"width": 0}, "expected at least 1 x 1"),
        ):
            sent = messages(view, here.stamp)
            here.stamp += 1
            image = depth_image(scene, view, replace_header(sent["mask"].header))
            for name, value in spoil.items():
                setattr(image.header if name == "frame_id" else image, name, value)
            before = here.inputs.rejected["bad_depth"]
            here.hand({"depth": image, **sent})
            wait_until(lambda before=before: here.inputs.rejected["bad_depth"] > before, "the refusal")  # type: ignore[misc]
            assert why in here.inputs.explained["bad_depth"]


def replace_header(header: Any) -> Any:
    return type(header)(stamp=header.stamp, frame_id=header.frame_id)


def test_depth_of_half_the_size_is_taken_by_nearest_pixels(scene: GaussianScene) -> None:
    view = clean_views(1)[0]
    header = messages(view, 1)["mask"].header
    depth = np.frombuffer(depth_image(scene, view, header).data, "<f4").reshape(48, 64)
    defaults: Any = SimpleNamespace(max_pixels=1 << 20, scene_to_map=SimpleNamespace(scale=1.0), depth_tolerance=None)
    session: Any = SimpleNamespace(scene=scene, device="cpu")
    half = confidence_image(depth[1::2, 1::2], header)
    gated = gate_by_image(session, view, half, "depth", "camera", defaults)
    expected = gate_view(scene, view, np.repeat(np.repeat(depth[1::2, 1::2], 2, 0), 2, 1))
    np.testing.assert_array_equal(gated.view.read_labels(), expected.view.read_labels())
    with pytest.raises(DepthImageError, match="parameter max_pixels"):
        defaults.max_pixels = 10
        gate_by_image(session, view, half, "depth", "camera", defaults)
