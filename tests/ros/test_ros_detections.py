"""Detections as masks: of plain objects that have the fields of yolo_msgs and vision_msgs."""

from __future__ import annotations

import sys
from types import SimpleNamespace as Fields
from typing import Any

import numpy as np
import pytest
from ros_message_cases import HEADER, refusal
from sensor_msgs.msg import Image

from gsseg_core.errors import MaskFormatError, UnknownLabelError
from gsseg_ros.conversions import stamp_message
from gsseg_ros.errors import TooManyPixelsError
from gsseg_ros.node.masks import detections_input, vision_detections, yolo_detections
from gsseg_ros.node.masks.detections import MOST_DETECTIONS, Beside, Detected
from gsseg_ros.node.masks.detections_input import ADAPTERS, DetectionsInput

TOPIC = "/some/topic"
SIZE = (8, 6)
BESIDE = Beside(SIZE, 100)
SQUARE = [(1, 1), (4, 1), (4, 4), (1, 4)]
"""Around the pixels 1 to 3 of both axes."""


def yolo(name: str, outline: Any = SQUARE, score: float = 0.5, number: int = 3, size: Any = SIZE) -> Any:
    points = [Fields(x=float(x), y=float(y)) for x, y in outline]
    mask = Fields(width=size[0], height=size[1], data=points)
    return Fields(class_id=number, class_name=name, score=score, id="17", mask=mask)


def array_of(*detections: Any) -> Any:
    return Fields(header=HEADER, detections=list(detections))


def shifted(by: int) -> list[tuple[int, int]]:
    return [(x + by, y) for x, y in SQUARE]


def vision(name: str, number: str = "", *others: tuple[str, float]) -> Any:
    results = [Fields(hypothesis=Fields(class_id=n, score=s)) for n, s in ((name, 0.6), *others)]
    return Fields(results=results, id=number)


def test_polygons_are_painted_the_surest_on_top() -> None:
    message = array_of(yolo("cup", score=0.9), yolo("table", shifted(2), 0.4), yolo("", shifted(4), 0.6, 7))
    found = yolo_detections.named_mask(message, TOPIC, BESIDE)
    row = [0, 1, 1, 1, 2, 3, 3, 3]
    assert found.labels.tolist() == [[0] * 8, row, row, row, [0] * 8, [0] * 8]
    assert found.names == {0: "background", 1: "cup", 2: "table", 3: "class_07"}


def test_an_image_without_detections_is_background_of_the_size_of_the_camera() -> None:
    found = yolo_detections.named_mask(array_of(), TOPIC, BESIDE)
    assert found.labels.shape == (6, 8) and not found.labels.any() and found.names == {0: "background"}


def test_a_detection_without_outline_beside_others_has_no_pixels() -> None:
    found = yolo_detections.named_mask(array_of(yolo("cup", []), yolo("table")), TOPIC, BESIDE)
    assert set(np.unique(found.labels)) == {0, 2}


@pytest.mark.parametrize(
    ("detections", "says"),
    [
        ([yolo("cup", [])], "1 detections have boxes but no masks; expected polygons in mask.data"),
        ([yolo("cup"), yolo("cup", size=(9, 6))], "masks are of images of [(8, 6), (9, 6)] pixels; expected one size"),
        ([yolo("cup", size=(0, 6))], "masks are of images of [(0, 6)] pixels"),
        ([yolo("cup", size=(-8, -6))], "masks are of images of [(-8, -6)] pixels"),
        ([yolo("cup", [(0, 0), (np.nan, 1), (1, 1)])], "a polygon has points that are not finite"),
        ([yolo("cup", [(0, 0), (np.inf, 1), (1, 1)])], "a polygon has points that are not finite"),
        ([yolo("a\nb")], "a detection's class has the name"),
        ([yolo("cup")] * (MOST_DETECTIONS + 1), "has 1,001 detections; expected at most 1,000"),
        ([yolo("cup", SQUARE * 20000)], "crosses the rows of the image 120,000 times; expected an outline"),
    ],
)
def test_unusable_polygons_are_refused(detections: list[Any], says: str) -> None:
    assert says in refusal(MaskFormatError, yolo_detections.named_mask, array_of(*detections), TOPIC, BESIDE)


def test_detections_of_images_of_too_many_pixels_are_refused_before_any_is_painted() -> None:
    for message, beside in (
        (array_of(yolo("cup", size=(2**31 - 1, 2**31 - 1))), BESIDE),
        (array_of(), Beside(SIZE, 47)),
    ):
        with pytest.raises(TooManyPixelsError, match=r"expected [0-9]+ pixels at most"):
            yolo_detections.named_mask(message, TOPIC, beside)


LABELS = np.array([[0, 1, 2], [-1, 2, 1]], np.int32)


def test_a_mask_of_numbers_or_ids_of_detections_gets_their_likeliest_names() -> None:
    beside = Beside(SIZE, 100, LABELS, {5: "sofa"})
    numbered = array_of(vision("cup", "", ("table", 0.7)), vision("5", "x"))
    found = vision_detections.named_mask(numbered, TOPIC, beside)
    assert (found.labels is LABELS, found.names) == (True, {0: "background", 1: "table", 2: "sofa"})
    by_id = array_of(vision("cup", "2"), vision("07", "1"), vision("0", "65534"))
    assert vision_detections.named_mask(by_id, TOPIC, beside).names == {
        0: "background", 1: "class_07", 2: "cup", 65534: "background",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "detections", "says"),
    [
        (
            UnknownLabelError,
            [vision("cup")],
            "its mask holds the labels [2], but there are 1 detection; expected their",
        ),
        (UnknownLabelError, [], "holds the labels [1, 2], but there are 0 detections"),
        (MaskFormatError, [vision("cup"), Fields(results=[], id="")], "a detection has no results"),
        (MaskFormatError, [vision("cup"), vision("")], "a detection's class_id is empty"),
        (MaskFormatError, [vision("cup"), vision("\x00")], "a detection's class has the name"),
        (MaskFormatError, [vision("cup")] * (MOST_DETECTIONS + 1), "has 1,001 detections"),
    ],
)
def test_detections_that_do_not_fit_their_mask_are_refused(kind: Any, detections: list[Any], says: str) -> None:
    beside = Beside(SIZE, 100, LABELS)
    assert says in refusal(kind, vision_detections.named_mask, array_of(*detections), TOPIC, beside)


class Graph:
    """Stands in for a node: knows of which types a topic is."""

    def __init__(self, *types: str) -> None:
        self.types, self.gone, self.resolve_topic_name = types, [], str

    def get_publishers_info_by_topic(self, topic: str) -> list[Any]:
        return [Fields(topic_type=name) for name in self.types]

    def subscribed(self, what: str) -> Any:
        return Fields(close=lambda: self.gone.append(f"{what} subscription"))


class Joined:
    """An input of detections, and what becomes of its messages."""

    def __init__(self, graph: Any, monkeypatch: pytest.MonkeyPatch | None = None) -> None:
        self.forwarded: list[tuple[str, Detected]] = []
        self.lost: list[tuple[str, str]] = []
        if monkeypatch is not None:
            for adapter in ADAPTERS.values():
                monkeypatch.setattr(type(adapter), "message_class", property(lambda self: self.name))
        self.input = DetectionsInput(
            graph, TOPIC, lambda kind, take: graph.subscribed(kind), lambda take: graph.subscribed("mask"),
            lambda topic, found: self.forwarded.append((topic, found)),
            lambda reason, message: self.lost.append((reason, message)),
        )  # fmt: skip

    def stamped(self, second: int, frame: str = "") -> Any:
        return Image(header=type(HEADER)(stamp=stamp_message(second * 10**9), frame_id=frame))


def test_the_type_of_detections_is_found_once_somebody_publishes_them(monkeypatch: pytest.MonkeyPatch) -> None:
    graph = Graph()
    joined = Joined(graph, monkeypatch)
    assert joined.input.look() == "" and joined.input.adapter is None
    graph.types = ("std_msgs/msg/String",)
    assert joined.input.look() == (
        "/some/topic: is of type std_msgs/msg/String; expected yolo_msgs/msg/DetectionArray or "
        "vision_msgs/msg/Detection2DArray"
    )
    graph.types = ("yolo_msgs/msg/DetectionArray",)
    assert joined.input.look() == ""
    message = array_of()
    joined.input.add(TOPIC, message)
    ((topic, found),) = joined.forwarded
    assert (topic, found.header, found.message, found.mask) == (TOPIC, HEADER, message, None)
    joined.input.close()
    assert graph.gone == ["DetectionArray subscription"]


def test_without_the_package_of_their_type_it_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "yolo_msgs.msg", None)  # It may be installed here.
    said = Joined(Graph("yolo_msgs/msg/DetectionArray")).input.look()
    assert (
        said == "/some/topic: is of type yolo_msgs/msg/DetectionArray, but yolo_msgs cannot be imported; is it sourced?"
    )


def test_detections_and_masks_of_one_stamp_are_joined_in_any_order(monkeypatch: pytest.MonkeyPatch) -> None:
    graph = Graph("vision_msgs/msg/Detection2DArray")
    joined = Joined(graph, monkeypatch)
    assert joined.input.look() == ""
    joined.input.add_mask("/mask", joined.stamped(1))
    joined.input.add(TOPIC, joined.stamped(2))
    assert not joined.forwarded
    joined.input.add_mask("/mask", joined.stamped(2))
    joined.input.add(TOPIC, joined.stamped(1))
    assert [found.message for _, found in joined.forwarded] == [joined.stamped(2), joined.stamped(1)]
    assert [found.mask for _, found in joined.forwarded] == [("/mask", joined.stamped(2)), ("/mask", joined.stamped(1))]
    joined.input.close()
    assert graph.gone == ["Detection2DArray subscription", "mask subscription"]


def test_detections_of_one_stamp_are_joined_with_the_mask_of_their_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    joined = Joined(Graph("vision_msgs/msg/Detection2DArray"), monkeypatch)
    joined.input.look()
    joined.input.add_mask("/mask", joined.stamped(1, "optical"))
    joined.input.add(TOPIC, joined.stamped(1, "camera"))  # Of the only camera, whatever they call it.
    assert len(joined.forwarded) == 1
    for second, order in ((2, ("left", "right")), (3, ("right", "left"))):
        for frame in ("left", "right"):
            joined.input.add_mask("/mask", joined.stamped(second, frame))
        for frame in order:
            joined.input.add(TOPIC, joined.stamped(second, frame))
    found = [(found.header, found.mask and found.mask[1].header) for _, found in joined.forwarded[1:]]
    assert len(found) == 4 and all(one == other for one, other in found)
    joined.input.add(TOPIC, joined.stamped(4, ""))
    joined.input.add_mask("/mask", joined.stamped(4, "left"))
    assert len(joined.forwarded) == 6 and not joined.lost


def test_what_stays_alone_is_lost_after_thirty_more(monkeypatch: pytest.MonkeyPatch) -> None:
    joined = Joined(Graph("vision_msgs/msg/Detection2DArray"), monkeypatch)
    joined.input.look()
    for second in range(31):
        joined.input.add_mask("/mask", joined.stamped(second))
        joined.input.add(TOPIC, joined.stamped(100 + second))
    assert [reason for reason, _ in joined.lost] == ["no_detections", "no_mask"]
    assert joined.lost[0][1].startswith("/mask: no detections with its stamp came on /some/topic; expected")


def test_masks_that_wait_for_detections_take_no_more_memory_than_others(monkeypatch: pytest.MonkeyPatch) -> None:
    joined = Joined(Graph("vision_msgs/msg/Detection2DArray"), monkeypatch)
    joined.input.look()
    monkeypatch.setattr(detections_input, "MOST_BYTES", 100)
    for second, size in enumerate((40, 40, 40, 200)):
        mask = joined.stamped(second)
        mask.data = bytes(size)
        joined.input.add_mask("/mask", mask)
        assert [reason for reason, _ in joined.lost] == ["no_detections"] * (0, 0, 1, 3)[second]
    joined.input.add(TOPIC, joined.stamped(3))
    assert len(joined.forwarded) == 1


def waiting(monkeypatch: pytest.MonkeyPatch) -> Joined:
    joined = Joined(Graph("vision_msgs/msg/Detection2DArray"), monkeypatch)
    joined.input.look()
    joined.input.add_mask("/mask", joined.stamped(1))
    joined.input.add(TOPIC, joined.stamped(2))
    return joined


def test_what_waited_for_its_other_part_and_was_forgotten_is_not_joined(monkeypatch: pytest.MonkeyPatch) -> None:
    joined = waiting(monkeypatch)
    assert (joined.input.clear(), joined.input.clear()) == (2, 0)
    joined.input.add(TOPIC, joined.stamped(1))
    joined.input.add_mask("/mask", joined.stamped(2))
    assert not joined.forwarded and not joined.lost


@pytest.mark.parametrize(
    ("event", "reason"), [(("_set_back", 9, 0), "time_jump"), (("_forget_waiting",), "scene_changed")]
)
def test_it_is_forgotten_when_time_goes_back_or_the_scene_is_another(
    event: tuple[Any, ...], reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("gsseg_msgs.msg", reason="gsseg_msgs is not installed")
    from gsseg_ros.node.inputs import Inputs

    joined, counted = waiting(monkeypatch), []
    inputs = Fields(
        cameras={}, tf=None, detections=[joined.input], worker=Fields(clear=lambda: 0), _hand_over=lambda: None,
        _count_rejected=lambda *told: counted.append(told),
    )  # fmt: skip
    name, *stamps = event
    getattr(Inputs, name)(inputs, *stamps)
    assert (counted, joined.input.clear()) == ([(reason, 2)], 0)
