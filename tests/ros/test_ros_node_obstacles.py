"""Classes chosen by name as obstacles: what the node says again and again, and what Nav2, as configured, makes of it.

Nav2 is not to be had where these tests run. `marked` does with a cloud what its ObstacleLayer and ObservationBuffer do,
by their sources; it takes the parameters that they take, at the defaults that they declare.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import yaml
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy, qos_profile_sensor_data
from ros_fixtures import parameters_fixture, root_fixture, scene_fixture, shared_fixture  # noqa: F401
from ros_helpers import REPOSITORY, Node, Ros, private_context
from ros_node_here import NodeHere, node_here
from ros_robot import core_session
from sensor_msgs.msg import PointCloud2
from small_scenes import clean_views

from gsseg_core.objects.occupied_cells import occupied_cells
from gsseg_core.refine.settings import PAPER
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.quaternions import rotations
from gsseg_ros.node import declarations, segment_node
from gsseg_ros.node import obstacles as obstacles_module
from gsseg_ros.node.parameters import Settings

FILE = REPOSITORY / "config/nav2_obstacles.yaml"
CONFIG = yaml.safe_load(FILE.read_text())
BOX = 3
LAYER = {"min_obstacle_height": 0.0, "max_obstacle_height": 2.0}
SOURCE = {
    "min_obstacle_height": 0.0, "max_obstacle_height": 0.0, "obstacle_min_range": 0.0, "obstacle_max_range": 2.5,
}  # fmt: skip


def points_of(cloud: PointCloud2) -> np.ndarray:
    """Read x, y and z as ROS readers do, by the fields' names and offsets."""
    offsets = {field.name: field.offset for field in cloud.fields}
    point = np.dtype({"names": list("xyz"), "formats": ["<f4"] * 3, "offsets": [offsets[a] for a in "xyz"],
                      "itemsize": cloud.point_step})  # fmt: skip
    records = np.frombuffer(cloud.data, point, cloud.width * cloud.height)
    return np.stack([records[axis] for axis in "xyz"], axis=1)


def marked(points: np.ndarray, robot: np.ndarray, layer: dict[str, Any], source: dict[str, Any]) -> np.ndarray:
    """Points (M, 3) of a cloud that become lethal cells, the robot's sensor_frame being at a place (3,)."""
    layer, source = LAYER | layer, SOURCE | source
    for rule in (source, layer):
        points = points[(points[:, 2] >= rule["min_obstacle_height"]) & (points[:, 2] <= rule["max_obstacle_height"])]
    far = np.linalg.norm(points - robot, axis=1)
    return points[(far < source["obstacle_max_range"]) & (far >= source["obstacle_min_range"])]


@pytest.fixture(scope="module")
def running(shared: Ros, parameters: dict[str, Any]) -> Iterator[NodeHere]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(segment_node, "warm_up", lambda *_: None)
        with node_here(shared, {**parameters, "obstacle_classes": ["box"]}) as here:
            here.fuse(clean_views(6))
            yield here


Hear = Callable[[], PointCloud2]


@pytest.fixture
def hear(running: NodeHere, shared: Ros, monkeypatch: pytest.MonkeyPatch) -> Iterator[Hear]:
    """Subscribe as an obstacle layer does, and hand over what comes of the next tick."""
    monkeypatch.setattr(obstacles_module, "RENEWAL_SECONDS", 0.0)
    layer = CONFIG["local_costmap"]["local_costmap"]["ros__parameters"]["gsseg_layer"]
    heard: list[PointCloud2] = []
    subscription = shared.node.create_subscription(
        PointCloud2, layer["gsseg"]["topic"], heard.append, qos_profile_sensor_data
    )
    shared.wait_until(lambda: running.obstacles._publisher.get_subscription_count(), "the subscriber")

    def next_one() -> PointCloud2:
        count = len(heard)
        running.obstacles.tick()
        shared.wait_until(lambda: len(heard) > count, "obstacles")
        return heard[-1]

    yield next_one
    running.node.set_parameters(
        [Parameter("obstacle_classes", value=["box"]), Parameter("obstacle_max_height", value=2.0)]
    )
    shared.node.destroy_subscription(subscription)


def expected(scene: GaussianScene, label: int, low: float = 0.05, high: float = 2.0) -> np.ndarray:
    labels = core_session(scene, clean_views(6)).segmentation(PAPER).labels
    index = labels == label
    axes = rotations(scene.quats[index]) * scene.scales[index, None, :]
    return occupied_cells(scene.means[index], axes, 0.05, low, high)


def test_cells_of_the_chosen_classes_come_best_effort_in_the_map_frame(
    running: NodeHere, shared: Ros, scene: GaussianScene, hear: Hear
) -> None:
    cloud = hear()
    assert cloud.header.frame_id == "map" and (cloud.header.stamp.sec, cloud.height, cloud.is_dense) > (0, 0, False)
    np.testing.assert_allclose(points_of(cloud), expected(scene, BOX), atol=1e-5)
    (info,) = shared.node.get_publishers_info_by_topic("/gsseg/obstacles")
    assert (info.qos_profile.reliability, info.qos_profile.durability) == (
        ReliabilityPolicy.BEST_EFFORT, DurabilityPolicy.VOLATILE,
    )  # fmt: skip
    again = hear()
    assert again.data == cloud.data and again.header.stamp != cloud.header.stamp, (
        "a costmap that rolls has forgotten it"
    )


def test_classes_and_heights_can_be_chosen_while_the_robot_drives(
    running: NodeHere, scene: GaussianScene, hear: Hear
) -> None:
    (result, _) = running.node.set_parameters(
        [Parameter("obstacle_classes", value=["1", "box"]), Parameter("obstacle_max_height", value=0.4)]
    )
    assert result.successful, result.reason
    cells = {tuple(cell) for cell in points_of(hear())[:, :2].round(3).tolist()}
    wanted = np.concatenate([expected(scene, k, high=0.4) for k in (1, BOX)])[:, :2]
    assert cells == {tuple(cell) for cell in wanted.round(3).tolist()}
    running.node.set_parameters([Parameter("obstacle_classes", value=["background"])])
    assert len(points_of(hear())) == 0, "the table lies below the least height"


@pytest.mark.parametrize(
    ("name", "value", "why"),
    [
        ("obstacle_classes", ["sofa"], "parameter obstacle_classes: class 'sofa' does not exist; expected one of 0"),
        ("obstacle_min_height", 2.5, "parameter obstacle_min_height is 2.5; expected at most 2, the parameter"),
        ("obstacle_rate", 5.0, "can change only while the node is unconfigured"),
    ],
)  # fmt: skip
def test_what_makes_no_sense_is_refused(running: NodeHere, name: str, value: Any, why: str) -> None:
    (result,) = running.node.set_parameters([Parameter(name, value=value)])
    assert not result.successful and why in result.reason


def test_as_views_come_and_go_so_do_obstacles(running: NodeHere, scene: GaussianScene, hear: Hear) -> None:
    running.done("reset")
    assert len(points_of(hear())) == 0
    running.fuse(clean_views(6))
    np.testing.assert_allclose(points_of(hear()), expected(scene, BOX), atol=1e-5)


def test_nobody_listening_or_nothing_chosen_costs_nothing(
    running: NodeHere, shared: Ros, monkeypatch: pytest.MonkeyPatch
) -> None:
    publisher = running.obstacles._publisher
    shared.wait_until(lambda: not publisher.get_subscription_count(), "the last test's subscription to go")
    monkeypatch.setattr(running.obstacles, "_cells", lambda _: pytest.fail("looked for cells"))
    running.obstacles.tick()


def test_a_class_that_does_not_exist_yet_is_complained_of_and_the_others_are_said(
    running: NodeHere, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    monkeypatch.setattr(
        running.obstacles, "_complaints", type("", (), {"add": lambda _, kind, text: said.append(text)})()
    )
    assert running.obstacles._chosen(["sofa", "box"], {0: "background", 3: "box"}) == [3]
    assert said == ["parameter obstacle_classes: class 'sofa' does not exist; expected one of 0 (background), 3 (box)"]


@pytest.mark.parametrize("costmap", ["local_costmap", "global_costmap"])
def test_nav2_as_configured_marks_every_cell_in_reach_and_as_it_comes_none(costmap: str, hear: Hear) -> None:
    own = CONFIG[costmap][costmap]["ros__parameters"]
    layer, plugins = own["gsseg_layer"], own["plugins"]
    source = layer[layer["observation_sources"]]
    assert plugins.index("gsseg_layer") < plugins.index("inflation_layer")
    assert (layer["plugin"], source["data_type"]) == ("nav2_costmap_2d::ObstacleLayer", "PointCloud2")
    assert source["marking"] and not source["clearing"] and source["observation_persistence"] == 0.0
    assert source["sensor_frame"] == "base_link", "the frame of the cloud is the map's, whose origin is not the robot"
    points = points_of(hear())
    robot = np.array([-2.0, 3.0, 0.0])
    assert len(points) > 10
    np.testing.assert_array_equal(marked(points, robot, layer, source), points)
    assert len(marked(points, robot, {}, {})) == 0
    out_of_reach = robot + np.array([source["obstacle_max_range"] + 10, 0, 0])
    assert len(marked(points, out_of_reach, layer, source)) == 0


def test_the_part_of_the_node_is_one_that_it_takes_and_the_manager_has_no_bond_with_it() -> None:
    with private_context("--ros-args", "--params-file", str(FILE)) as context:
        node = Node("gsseg", context=context)
        declarations.declare(node)
        settings = Settings.read(node)
        node.destroy_node()
    given = CONFIG["/**/gsseg"]["ros__parameters"]
    assert given.keys() <= {declaration.name for declaration in declarations.DECLARATIONS}
    assert settings.obstacle_classes == tuple(given["obstacle_classes"]) and settings.autostart is False
    manager = CONFIG["lifecycle_manager_gsseg"]["ros__parameters"]
    assert (manager["node_names"], manager["bond_timeout"], manager["autostart"]) == (["gsseg"], 0.0, True)
