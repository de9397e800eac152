"""What the segmentation node makes of names of labels and of detections: classes by name, or objects that it finds."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace as Fields
from typing import Any

import numpy as np
import pytest
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from ros_fixtures import parameters_fixture, root_fixture, scene_fixture, shared_fixture, spun  # noqa: F401
from ros_helpers import Ros, wait_until
from ros_node_here import NodeHere, node_here
from ros_robot import LATCHED, core_session, messages
from sensor_msgs.msg import CameraInfo
from small_scenes import clean_views

from gsseg_core.data.view import View
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_ros.conversions import mask_image
from gsseg_ros.node.masks import label_info
from gsseg_ros.node.masks.detections import Detected
from gsseg_ros.node.masks.detections_input import ADAPTERS

NAMES = {0: "background", 1: "red ball", 2: "cup/mug", 3: "box"}
YOLO, VISION = ADAPTERS.values()


@contextmanager
def node(
    ros: Ros, parameters: dict[str, Any], label_map: dict[str, Any] | None = None, **more: Any
) -> Iterator[NodeHere]:
    """A node of these parameters, without class_names unless they are given; the label map is a file in data_root."""
    values = {**parameters, **more}
    if label_map is not None:
        path = Path(parameters["data_root"]) / "label_map.json"
        path.write_text(json.dumps(label_map))
        values["label_map"] = path
    if "class_names" not in more:
        values.pop("class_names")
    with node_here(ros, values) as here:
        yield here


def tell(here: NodeHere, names: dict[int, str]) -> None:
    """Hand over a label_info."""
    entries = [Fields(class_id=k, class_name=name) for k, name in names.items()]
    here.inputs.on_label_info(here.node.resolve_topic_name("label_info"), Fields(class_map=entries))


class LabelInfo(CameraInfo):
    """Stands in for that of vision_msgs: with its name, and a width that is the number of the class "cup"."""


@pytest.mark.parametrize("latched", [True, False])
def test_label_info_is_heard_latched_from_before_and_otherwise(
    shared: Ros, parameters: dict[str, Any], monkeypatch: pytest.MonkeyPatch, latched: bool
) -> None:
    monkeypatch.setattr(label_info, "label_info_class", lambda: LabelInfo)
    monkeypatch.setattr(label_info, "names_of", lambda message, topic: {message.width: "cup"})
    publisher = shared.node.create_publisher(CameraInfo, "label_info", LATCHED if latched else 1)
    publisher.publish(CameraInfo(width=7))
    with node(shared, parameters) as here, spun(here.node):

        def heard() -> bool:
            if not latched:
                publisher.publish(CameraInfo(width=7))
            return here.node.workspace.label_space.heard == {7: "cup"}

        wait_until(heard, "the names of labels")
    shared.node.destroy_publisher(publisher)


def fuse(here: NodeHere, view: View, mask: Any = None) -> None:
    """Hand over a view with another message for its mask, and wait until it is fused or rejected."""
    sent = messages(view, here.stamp)
    here.stamp += 10**8
    before = here.inputs.accepted, here.inputs.rejected.total()
    found = sent["mask"] if mask is None else mask(sent["mask"])
    here.hand({"camera_info": sent["camera_info"], "pose": sent["pose"], "mask": found})
    wait_until(lambda: (here.inputs.accepted, here.inputs.rejected.total()) != before, "the mask to be fused or not")


def numbered(view: View, ids: list[int]) -> View:
    """The same view, its labels being other ones."""
    return View.from_arrays(view.camera, np.array(ids, np.int32)[view.read_labels()])


def assert_votes(here: NodeHere, scene: GaussianScene, views: list[View], names: list[str]) -> None:
    session, expected = here.node.workspace.session, core_session(scene, views, names)
    assert list(session.class_names.values()) == names
    np.testing.assert_allclose(session.codes(), expected.codes(), atol=1e-4)


def test_another_segmenter_with_other_numbers_votes_for_the_classes_of_the_same_names(
    shared: Ros, parameters: dict[str, Any], scene: GaussianScene
) -> None:
    one, two = clean_views(2)
    with node(shared, parameters) as here:
        tell(here, NAMES)
        fuse(here, one)
        tell(here, {0: "box", 4: "background", 5: "red ball", 7: "cup/mug"})
        fuse(here, numbered(two, [4, 5, 7, 0]))
        assert_votes(here, scene, [one, two], list(NAMES.values()))
        tell(here, {1: "box", 2: ""})  # Unusable, and so the last one holds.
        fuse(here, numbered(two, [4, 5, 7, 0]))
        fuse(here, numbered(two, [4, 5, 6, 0]))
        assert here.inputs.rejected == {"unknown_label": 1}
        assert "mask holds the labels [6]" in here.inputs.explained["unknown_label"]


def test_declared_classes_are_found_by_name_and_people_are_left_out(
    shared: Ros, parameters: dict[str, Any], scene: GaussianScene
) -> None:
    view = clean_views(1)[0]
    with node(shared, parameters, {"red ball": None, "cup/mug": "cup"}, class_names=["background", "box"]) as here:
        tell(here, NAMES)
        fuse(here, view)
        assert_votes(here, scene, [numbered(view, [0, -1, 2, 1])], ["background", "box", "cup"])
        assert here.node.workspace.label_space.classes == {0: "background", 1: "box", 2: "cup"}


def test_a_label_map_that_names_what_there_is_not_is_explained(shared: Ros, parameters: dict[str, Any]) -> None:
    with node(shared, parameters, {"sofa": None}, class_names=list(NAMES.values())) as here:
        fuse(here, clean_views(1)[0])
        assert here.inputs.rejected == {"unknown_label": 1}
        assert "label_map.json: names 'sofa', which the masks do not have" in here.inputs.explained["unknown_label"]


def test_a_label_map_must_be_whole_and_lie_where_it_may(shared: Ros, parameters: dict[str, Any], root: Path) -> None:
    with node(shared, parameters) as here:
        here.node.trigger_deactivate()
        here.node.trigger_cleanup()
        outside = root.parent / "map.json"
        outside.write_text("{}")
        for path in (outside, "/etc/passwd"):
            (result,) = here.node.set_parameters([Parameter("label_map", value=str(path))])
            assert not result.successful and "parameter label_map, set after the start: path" in result.reason
        for content in ("{", "[]", '{"a": 3}'):
            (root / "broken_map.json").write_text(content)
            (result,) = here.node.set_parameters([Parameter("label_map", value=str(root / "broken_map.json"))])
            assert result.successful
            assert here.node.trigger_configure() == TransitionCallbackReturn.FAILURE
        (result,) = here.node.set_parameters([Parameter("ids", value="per-view")])
        assert not result.successful and "with ids 'per-view' masks have no classes" in result.reason


def outline(inside: np.ndarray) -> list[Any]:
    """A polygon around the bounding box of some pixels."""
    rows, columns = np.nonzero(inside)
    corners = [(columns.min(), rows.min()), (columns.max() + 1, rows.min()), (columns.max() + 1, rows.max() + 1),
               (columns.min(), rows.max() + 1)]  # fmt: skip
    return [Fields(x=float(x), y=float(y)) for x, y in corners]


def boxes(view: View) -> View:
    """The view with every object drawn as its bounding box, those of larger labels on top."""
    labels, drawn = view.read_labels(), np.zeros((48, 64), np.int32)
    for k in np.unique(labels[labels > 0]):
        rows, columns = np.nonzero(labels == k)
        drawn[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1] = k
    return View.from_arrays(view.camera, drawn)


def yolo(view: View, header: Any, shuffle: bool = False) -> Detected:
    """What yolo_ros says of a view."""
    labels = view.read_labels()
    found = [
        Fields(
            class_id=40 + int(k), class_name=NAMES[int(k)], score=0.5 + 0.1 * float(k), id="",
            mask=Fields(width=64, height=48, data=outline(labels == k)),
        )
        for k in np.unique(labels[labels > 0])
    ]  # fmt: skip
    return Detected(header, YOLO, Fields(detections=found[::-1] if shuffle else found))


def test_detections_are_objects_of_their_view_by_default_and_some_classes_are_left_out(
    shared: Ros, parameters: dict[str, Any]
) -> None:
    views = clean_views(6)
    with node(shared, parameters, {"red ball": None}, detections_topic="yolo/detections") as here:
        assert here.inputs.roles["/yolo/detections"] == "detections" and "/mask" not in here.inputs.arrivals
        for i, view in enumerate(views):
            fuse(here, view, lambda sent, view=view, i=i: yolo(view, sent.header, shuffle=i % 2 == 1))
        assert not here.inputs.rejected
        names = [thing.name for thing in here.done("segment").objects]
        assert names == ["object_001", "object_002"]  # Not the red ball.
        fuse(here, views[0], lambda sent: Detected(sent.header, YOLO, Fields(detections=[])))  # Nothing in sight.
        assert here.inputs.accepted == 7


def test_detections_are_classes_by_name_where_that_is_wanted(
    shared: Ros, parameters: dict[str, Any], scene: GaussianScene
) -> None:
    views = clean_views(2)
    with node(shared, parameters, detections_topic="detections", ids="given") as here:
        for i, view in enumerate(views):
            fuse(here, view, lambda sent, view=view, i=i: yolo(view, sent.header, shuffle=i % 2 == 1))
        assert_votes(here, scene, [boxes(view) for view in views], list(NAMES.values()))


def test_detections_of_vision_msgs_name_what_is_in_their_mask(
    shared: Ros, parameters: dict[str, Any], scene: GaussianScene
) -> None:
    one, two = clean_views(2)
    named = [Fields(id="", results=[Fields(hypothesis=Fields(class_id=n, score=1.0))]) for n in ("box", "7", "cup/mug")]
    by_id = [Fields(id=str(20 - i), results=thing.results) for i, thing in enumerate(named)]

    def detected(view: View, things: list[Any], ids: list[int]) -> Any:
        def of(sent: Any) -> Detected:
            mask = mask_image(numbered(view, ids).read_labels(), sent.header, 16)
            return Detected(sent.header, VISION, Fields(detections=things), ("mask", mask))

        return of

    with node(shared, parameters, detections_topic="detections", class_names=list(NAMES.values())) as here:
        tell(here, {7: "red ball"})
        fuse(here, one, detected(one, named, [0, 2, 3, 1]))
        fuse(here, two, detected(two, by_id, [0, 19, 18, 20]))
        assert not here.inputs.explained
        assert_votes(here, scene, [one, two], list(NAMES.values()))
        fuse(here, two, detected(two, by_id, [0, 19, 18, 17]))
        assert "its mask holds the labels [17], but there are 3 detections" in here.inputs.explained["unknown_label"]


def test_detections_belong_to_a_camera(shared: Ros, parameters: dict[str, Any]) -> None:
    with node(shared, parameters, detections_topic="detections", cameras=["front", "left"]) as here:
        assert {"/front/detections", "/left/detections"} <= here.inputs.arrivals.keys()
        here.inputs._expire()  # Nobody publishes, and nothing is amiss.
        assert [found.adapter for found in here.inputs.detections] == [None, None]
