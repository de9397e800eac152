"""The viewer's source of live codes against a real node: what it shows is what the node has, Gaussian by Gaussian."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from gsseg_msgs.msg import StageTiming
from labellings import probabilities_of
from patience import PATIENCE
from ros_helpers import Ros, ros_fixture, wait_until  # noqa: F401
from ros_node_here import node_here
from sensor_msgs.msg import PointCloud2
from small_scenes import NAMES, clean_views, many_classes, write_dataset
from std_msgs.msg import Header

from gsseg_core.errors import SettingsError, StateMismatchError
from gsseg_core.refine.settings import PAPER
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import REMOVED, UNOBSERVED, Segmentation
from gsseg_core.viewer.live_source import LiveUpdate, open_source
from gsseg_ros.client import NodeUnavailableError, SegmentationClient
from gsseg_ros.client.view_source import RosSource, _Places
from gsseg_ros.cloud_messages import CloudArrays
from gsseg_ros.errors import SegmentationError
from gsseg_ros.frames import Similarity
from gsseg_ros.node.diagnostics import diagnostic_array

MOVED = {"scene_to_map.scale": 2.0, "scene_to_map.translation": [1.0, -2.0, 0.5]}


PUBLISHED = [StageTiming(name="publish")]


def next_update(source: RosSource) -> LiveUpdate:
    updates: list[LiveUpdate | None] = [None]
    wait_until(lambda: updates.append(source.wait(0.5)) or updates[-1], "codes")  # type: ignore[func-returns-value]
    assert updates[-1] is not None
    return updates[-1]


def test_live_codes_are_those_of_the_node_wherever_the_scene_lies_in_the_map(ros: Ros, tmp_path: Path) -> None:
    write_dataset(tmp_path / "data")
    scene = GaussianScene.load(tmp_path / "data/scene.ply")
    parameters = {"data_root": tmp_path, "scene_path": tmp_path / "data/scene.ply", "class_names": list(NAMES.values())}
    ros.start("segment_node", {**parameters, **MOVED})
    source = RosSource(scene, domain_id=ros.domain, find_timeout=PATIENCE)
    try:
        with SegmentationClient(domain_id=ros.domain, find_timeout=PATIENCE) as client:
            client.wait_until_active(PATIENCE)
            client.learn("data")
            update = next_update(source)
            client.export("out", refine="paper", filter=False)
        truth = Segmentation.load(tmp_path / "out/segmentation.npz", scene)
        labels, names = update.labelling.labels, update.labelling.class_names
        probabilities = probabilities_of(update.labelling)
        assert names == NAMES and update.num_views == 4
        truth = truth.filtered(scene, PAPER)
        assert np.array_equal(labels, np.where(truth.labels == REMOVED, UNOBSERVED, truth.labels))
        known = labels >= 0
        assert np.allclose(probabilities.max(axis=1)[known], truth.confidence[known], atol=1e-6)
        assert not probabilities[~known].any()
        source.wait(3.0)  # What was told before the node had learnt may have been told anew.
        assert source.wait(3.0) is None, "the node is asked again, though nothing has changed but by asking it"
        other, _ = many_classes(30)
        wrong = RosSource(other, domain_id=ros.domain, find_timeout=PATIENCE)
        with pytest.raises(StateMismatchError, match=r"has the scene .*scene.ply, which is not this one"):
            next_update(wrong)
        wrong.close()
    finally:
        source.close()


def test_without_a_node_or_a_source_one_error_says_so(ros: Ros) -> None:
    scene, _ = many_classes(30)
    with pytest.raises(NodeUnavailableError, match=r"/gsseg: service /gsseg/get_parameters was not there within 0.5 s"):
        RosSource(scene, domain_id=ros.domain, find_timeout=0.5)
    with pytest.raises(SettingsError, match=r"live source 'nothing': none is installed"):
        open_source("nothing", scene)


def test_a_cloud_of_before_a_run_is_not_taken_for_its_own_whatever_the_clock_did(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    source = RosSource.__new__(RosSource)
    source._spinner = SimpleNamespace(wait_for=lambda condition, _: condition())
    monkeypatch.setattr("gsseg_ros.client.view_source.arrays_from_cloud", lambda cloud, _: cloud)
    before, later, after = (PointCloud2(header=Header(stamp=Time(sec=sec))) for sec in (50, 51, 50))
    source._clouds = {"/cloud": before, "/new": None}
    for stamp in (10, 50):  # Set back, and standing still.
        with pytest.raises(NodeUnavailableError, match="no cloud of the last run"):
            source._cloud("/cloud", stamp * 10**9, before)
    with pytest.raises(NodeUnavailableError, match="no cloud of the last run"):
        source._cloud("/new", 0, None)
    for cloud in (later, after):
        source._clouds["/cloud"] = cloud
        assert source._cloud("/cloud", 50 * 10**9, before) is cloud


def source_of(scene: GaussianScene, said: str, answer: Any, place: Similarity) -> RosSource:
    """A source of a node that has said something, answers that or raises it, and has the scene in a place."""
    source = RosSource.__new__(RosSource)
    source._scene, source._name, source._said, source._shown = scene, "/gsseg", (said,), None
    source._clouds, source._segment = {}, None
    source._places = _Places(scene.means)
    points = place.points_to_map(scene.means[:2])
    cloud = CloudArrays(points, np.zeros((2, 3), np.uint8), np.ones(2, np.int32), np.ones(2, np.float32))

    def call(*_: object) -> Any:
        if isinstance(answer, Exception):
            raise answer
        return SimpleNamespace(report=answer)

    instead = {"_calls": SimpleNamespace(call=call), "_spinner": SimpleNamespace(wait_for=lambda held, _: held())}
    instead |= {"_listen": lambda topic: None, "_cloud": lambda *_: cloud, "_similarity": lambda: place}
    vars(source).update(instead)
    return source


def test_a_scene_that_the_node_puts_elsewhere_is_found_there() -> None:
    scene, _ = many_classes(30)
    mug = SimpleNamespace(class_id=1, name="mug", topic="")
    report = SimpleNamespace(scene_hash=scene.digest, classes=[mug], num_views=3, header=Header(), stages=PUBLISHED)
    source = source_of(
        scene, "3 views", report, Similarity.from_parameters(2.0, [1.0, -2.0, 0.5], [0.0, 0.0, 0.0, 1.0])
    )
    update = source.wait(0.1)
    assert update is not None and np.flatnonzero(update.labelling.labels == 1).tolist() == [0, 1]
    assert source.wait(0.1) is None


def test_a_node_whose_map_is_another_one_by_now_is_not_asked_again_before_anything_has_changed() -> None:
    scene, _ = many_classes(30)
    report = SimpleNamespace(scene_hash="that of the map as it has grown", scene_path="map.ply")
    source = source_of(scene, "3 views", report, Similarity())
    for said in ("3 views", "4 views"):
        source._said = (said,)
        with pytest.raises(StateMismatchError, match=r"has the scene map\.ply, which is not this one"):
            source.wait(0.1)
        assert source.wait(0.1) is None


def test_a_class_that_turned_up_in_a_run_for_somebody_else_is_shown() -> None:
    scene, _ = many_classes(30)
    report = SimpleNamespace(scene_hash=scene.digest, classes=[], num_views=3, header=Header(), stages=PUBLISHED)
    source = source_of(scene, "3 views", report, Similarity())
    update = source.wait(0.1)
    assert update is not None and probabilities_of(update.labelling).shape == (len(scene), 2)
    assert np.flatnonzero(probabilities_of(update.labelling)[:, 1]).tolist() == [0, 1]
    assert update.labelling.class_names[1] == "class_01"


def test_a_run_that_was_not_published_is_not_waited_for_but_asked_for_again() -> None:
    scene, _ = many_classes(30)
    report = SimpleNamespace(scene_hash=scene.digest, classes=[], num_views=3, header=Header(), stages=[])
    source: Any = source_of(scene, "3 views", report, Similarity())
    waiting, source._cloud = source._cloud, lambda *_: pytest.fail("it waits for a cloud that does not come")
    assert source.wait(0.1) is None
    report.stages, source._cloud = PUBLISHED, waiting
    assert source.wait(0.1) is not None and source.wait(0.1) is None


def test_when_the_node_has_forgotten_all_nothing_is_known_any_more() -> None:
    scene, _ = many_classes(30)
    place = Similarity.from_parameters(1.0, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
    source = source_of(scene, "0 views", SegmentationError(1, "NO_CODES", "nothing is known"), place)
    update = source.wait(0.1)
    assert update is not None and update.num_views == 0 and (update.labelling.labels == UNOBSERVED).all()
    assert source.wait(0.1) is None


def test_a_node_that_was_not_active_is_asked_again_once_it_is(ros: Ros, tmp_path: Path) -> None:
    write_dataset(tmp_path / "data")
    with node_here(ros, {"scene_path": tmp_path / "data/scene.ply"}) as here:
        here.fuse(clean_views(2))
        node, scene = here.node, GaussianScene.load(tmp_path / "data/scene.ply")
        node.trigger_deactivate()
        source = source_of(scene, "", SegmentationError(2, "NOT_ACTIVE", "the node is not active"), Similarity())

        def hear() -> None:
            source._on_diagnostics(diagnostic_array("/gsseg", node.workspace, node.inputs, Time()))

        hear()
        assert source.wait(0.1) is None and source._said == source._shown
        hear()
        assert source._said == source._shown, "it is asked again and again"
        node.trigger_activate()
        hear()
        assert source._said != source._shown
