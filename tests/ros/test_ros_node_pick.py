"""One object by a mask of one view or by points in it, from the node as from the command line."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import Point
from gsseg_msgs.msg import Object
from ros_fixtures import parameters_fixture, root_fixture, scene_fixture, shared_fixture  # noqa: F401
from ros_helpers import Ros
from ros_node_here import NodeHere, node_here
from ros_robot import SERVICES, messages, viewpoint
from small_scenes import clean_views
from std_msgs.msg import Header

from gsseg_core.data.view import View
from gsseg_core.objects.oriented_boxes import class_box
from gsseg_core.objects.pick import Pick, pick_clicks, pick_mask
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_ros.camera_infos import camera_of_image
from gsseg_ros.cloud_messages import arrays_from_cloud
from gsseg_ros.conversions import mask_image
from gsseg_ros.frames import Similarity
from gsseg_ros.node import segment_node
from gsseg_ros.object_messages import box_from_object

RESPONSE = SERVICES["pick"].Response
BALL = 1


@pytest.fixture(scope="module")
def here(shared: Ros, parameters: dict[str, Any]) -> Iterator[NodeHere]:
    """A node that has the scene, and has seen no mask."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(segment_node, "warm_up", lambda *_: None)
        with node_here(shared, {"scene_path": parameters["scene_path"]}) as here:
            yield here


def mask_of(view: View, labels: np.ndarray) -> dict[str, Any]:
    return viewpoint(view) | {"mask": mask_image(labels, Header(), 8)}


def middle_of(view: View, label: int) -> tuple[int, int]:
    """Row and column of a pixel in the middle of a label."""
    rows, columns = np.nonzero(view.read_labels() == label)
    return int(np.median(rows)), int(np.median(columns))


def assert_answers(response: Any, picked: Pick, scene: GaussianScene) -> None:
    index = picked.ids
    np.testing.assert_array_equal(response.indices, index)
    cloud, box = arrays_from_cloud(response.cloud), class_box(scene, index, picked.membership[index])
    np.testing.assert_array_equal(cloud.points, scene.means[index])
    np.testing.assert_allclose(cloud.confidence, picked.membership[index], atol=1e-4)
    assert (cloud.labels == response.object.id).all() and response.cloud.header.frame_id == "map"
    assert response.object.num_gaussians == len(index) > 0
    assert response.object.confidence == pytest.approx(cloud.confidence.mean(), abs=1e-4)
    np.testing.assert_allclose(box_from_object(response.object).center, box.center, atol=1e-3)
    np.testing.assert_allclose(box_from_object(response.object).size, box.size, atol=1e-3)
    assert [stage.name for stage in response.stages] == ["pick", "boxes"]


def test_a_mask_of_one_view_gives_the_object_that_the_core_picks(here: NodeHere, scene: GaussianScene) -> None:
    view = clean_views(1)[0]
    response = here.done("pick", **mask_of(view, view.read_labels()), label=BALL, name="ball")
    shown = View.from_arrays(view.camera, (view.read_labels() == BALL).astype(np.int32))
    assert_answers(response, pick_mask(scene, shown), scene)
    assert response.object.name == "ball"
    everything = here.done("pick", **mask_of(view, view.read_labels()))
    assert everything.object.name == "object" and set(response.indices) < set(everything.indices)


def test_in_a_mask_of_black_and_white_white_is_the_object(here: NodeHere) -> None:
    view = clean_views(1)[0]
    labels = (view.read_labels() == BALL).astype(np.int32)
    assert here.done("pick", **mask_of(view, -labels)).indices == here.done("pick", **mask_of(view, labels)).indices


def test_a_soft_mask_is_what_it_names_in_each_pixel(here: NodeHere) -> None:
    view = clean_views(1)[0]
    labels = (view.read_labels() == BALL).astype(np.int32)
    soft = mask_of(view, labels)
    values = np.stack([0.2 + 0.6 * (1 - labels), 0.2 + 0.6 * labels], axis=-1).astype("<f4")
    soft["mask"].encoding, soft["mask"].step, soft["mask"].data = "32FC2", values[0].nbytes, values.tobytes()
    assert here.done("pick", **soft).indices == here.done("pick", **mask_of(view, labels)).indices


def test_points_give_what_clicks_in_the_same_pixels_give(here: NodeHere, scene: GaussianScene) -> None:
    view = clean_views(1)[0]
    inside, outside = middle_of(view, BALL), (40, 5)
    points = [Point(x=column + 0.7, y=row + 0.2, z=9.0) for row, column in (inside, outside)]
    response = here.done("pick", **viewpoint(view), inside=points[:1], outside=points[1:])
    assert_answers(response, pick_clicks(scene, view.camera, [inside], [outside]), scene)


def test_a_mask_of_a_raw_image_is_undistorted_and_may_be_smaller(here: NodeHere, scene: GaussianScene) -> None:
    view = clean_views(1)[0]
    smaller = (view.read_labels()[::2, ::2] == BALL).astype(np.int32)
    fields = mask_of(view, smaller)
    fields["viewpoint_camera"].d = [-0.2, 0.03, 0.001, -0.001, 0.0]
    camera = camera_of_image(
        "raw", fields["viewpoint_camera"], (32, 24), view.camera.world_to_camera, "", "", rectified=False
    )
    assert camera.undistortion is not None
    undistorted = View.from_arrays(camera, camera.undistortion.sample(smaller, -1))
    assert_answers(here.done("pick", **fields), pick_mask(scene, undistorted), scene)
    refused = here.ask("pick", **viewpoint(view) | {"viewpoint_camera": fields["viewpoint_camera"]}, inside=[Point()])
    assert (refused.error_code, "expected points in a rectified image" in refused.error_msg) == (
        RESPONSE.INVALID_VIEWPOINT,
        True,
    )


def test_where_the_scene_lies_elsewhere_in_the_map_so_does_the_object(
    here: NodeHere, shared: Ros, parameters: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(segment_node, "warm_up", lambda *_: None)
    place = Similarity(2.5, translation=np.array([4.0, -1.0, 0.5]))
    moved = {"scene_to_map.scale": 2.5, "scene_to_map.translation": [4.0, -1.0, 0.5]}
    view = clean_views(1)[0]
    labels, sent = view.read_labels(), messages(view, 1, place)
    with node_here(shared, {"scene_path": parameters["scene_path"], **moved}) as elsewhere:
        fields = mask_of(view, labels) | {"viewpoint_pose": sent["pose"]}
        found = elsewhere.done("pick", **fields, label=BALL)
    wanted = here.done("pick", **mask_of(view, labels), label=BALL)
    assert found.indices == wanted.indices
    box = place.box_to_map(box_from_object(wanted.object))
    np.testing.assert_allclose(box_from_object(found.object).center, box.center, atol=1e-3)
    np.testing.assert_allclose(box_from_object(found.object).size, box.size, atol=1e-3)


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({}, "found both or neither"),
        ({"label": 7}, "mask: holds the labels 0, 1, 2, 3; expected pixels with the label 7"),
        ({"inside": [Point()]}, "found both or neither"),
        ({"inside": [Point(x=float("nan"))]}, "inside: found 1 points; expected 1000 at most, all finite"),
        ({"inside": [Point()] * 1001}, "inside: found 1001 points"),
        ({"inside": [Point(x=64.0)]}, "pixel is (row 0, column 64); expected"),
        ({"inside": [Point(x=-0.5)]}, "pixel is (row 0, column -1); expected"),
        ({"outside": [Point()]}, "0 inside"),
        ({"inside": [Point()], "outside": [Point()]}, "expected at least one inside, and none that is both"),
    ],
)
def test_what_shows_no_object_is_refused(here: NodeHere, fields: dict[str, Any], says: str) -> None:
    view = clean_views(1)[0]
    with_mask = "label" in fields or ("both or neither" in says and fields)
    response = here.ask("pick", **(mask_of(view, view.read_labels()) if with_mask else viewpoint(view)), **fields)
    assert response.error_code == RESPONSE.INVALID_REQUEST
    assert says in response.error_msg


def test_masks_that_cannot_be_read_or_do_not_fit_the_camera_are_refused(here: NodeHere) -> None:
    view = clean_views(1)[0]
    colors = mask_of(view, view.read_labels())
    colors["mask"].encoding = "rgb8"
    response = here.ask("pick", **colors)
    assert response.error_code == RESPONSE.INVALID_REQUEST and "encoding is 'rgb8'" in response.error_msg
    response = here.ask("pick", **mask_of(view, view.read_labels()[:20]))
    assert response.error_code == RESPONSE.INVALID_VIEWPOINT and "expected 64 x 48" in response.error_msg
    empty = mask_of(view, np.ones((48, 64), np.int32))
    response = here.ask("pick", **empty)
    assert response.error_code == RESPONSE.NO_VIEWS and "(not the object)" in response.error_msg


def test_picking_changes_and_publishes_nothing(here: NodeHere) -> None:
    view = clean_views(1)[0]
    version, revision = here.node.workspace.session.version, here.outputs._revision
    here.done("pick", **mask_of(view, view.read_labels()))
    assert (here.node.workspace.session.version, here.outputs._revision) == (version, revision)
    assert here.outputs.objects_count == 0 and not here.node.workspace.session.has_codes
    assert RESPONSE().object == Object() and Path(here.node.workspace.settings.scene_path).is_file()
