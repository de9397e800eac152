"""The SROS 2 policy against the node as it runs: what it lists is what the node has, no more and no less."""

from __future__ import annotations

from fnmatch import fnmatch
from pathlib import Path
from xml.etree import ElementTree

from patience import PATIENCE
from rclpy.action import get_action_client_names_and_types_by_node, get_action_server_names_and_types_by_node
from ros_client_cases import says_in_the_end
from ros_helpers import REPOSITORY, Ros, ros_fixture  # noqa: F401
from small_scenes import balls_on_a_table, write_dataset

from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_ros.client import SegmentationClient
from gsseg_ros.client.view_source import RosSource

# Of the kinds of pose source and of transports one is there at a time, a clock only with use_sim_time, images while
# they are shown, depth if it is asked for, and detections only where vision_msgs is installed.
ONE_OF = {
    "/pose", "/odometry", "/tf", "/tf_static", "/clock", "/image", "/image/compressed", "/mask/compressed",
    "/depth", "/gsseg/detections_3d", "/detections", "/label_info", "/gsseg/label_info",
}  # fmt: skip


def listed(kind: str, permission: str, node: str = "gsseg") -> set[str]:
    """Full names that the policy allows a node."""
    (profile,) = ElementTree.parse(REPOSITORY / "sros2/policy.xml").findall(f".//profile[@node='{node}']")
    names = [entry.text or "" for group in profile.findall(f"{kind}s[@{permission}='ALLOW']") for entry in group]
    return {name.replace("~/", f"/{node}/") if name[0] in "~/" else f"/{name}" for name in names}


def uncovered(found: set[str], policy: set[str]) -> set[str]:
    return {name for name in found if not any(fnmatch(name, pattern) for pattern in policy)}


def unused(found: set[str], policy: set[str]) -> set[str]:
    return {pattern for pattern in policy if not any(fnmatch(name, pattern) for name in found)}


def test_the_policy_lists_exactly_what_the_running_node_has(ros: Ros, tmp_path: Path) -> None:
    balls_on_a_table()[0].save(tmp_path / "scene.ply")
    node = ros.start("segment_node", {"scene_path": tmp_path / "scene.ply", "class_names": ["background", "ball"]})
    node.wait_for("active: listening")
    graph = ros.node

    def names(ask) -> set[str]:  # type: ignore[no-untyped-def]
        return {name for name, _ in ask("gsseg", "/") if "/_action/" not in name}

    wanted = ((graph.get_publisher_names_and_types_by_node, "topic", "publish"),
              (graph.get_subscriber_names_and_types_by_node, "topic", "subscribe"),
              (graph.get_service_names_and_types_by_node, "service", "reply"))  # fmt: skip
    ros.wait_until(lambda: "gsseg" in graph.get_node_names(), "the node")
    for ask, kind, permission in wanted:
        policy = listed(kind, permission)
        ros.wait_until(lambda a=ask, p=policy: unused(names(a), p) <= ONE_OF, f"what the policy allows to {permission}")
        assert not uncovered(names(ask), policy), f"{permission}: the node has more than the policy"

    def actions() -> set[str]:
        return {name for name, _ in get_action_server_names_and_types_by_node(graph, "gsseg", "/")}

    ros.wait_until(lambda: actions() == listed("action", "execute"), "the actions of the node")


def assert_listed(ros: Ros, node: str, unused_allowed: set[str]) -> None:
    """A node of this domain has what the policy lists for it, but for what it may do and does not do now."""
    graph = ros.node
    ros.wait_until(lambda: node in graph.get_node_names(), "the node")
    for ask, kind, permission in (
        (graph.get_publisher_names_and_types_by_node, "topic", "publish"),
        (graph.get_subscriber_names_and_types_by_node, "topic", "subscribe"),
        (graph.get_service_names_and_types_by_node, "service", "reply"),
        (graph.get_client_names_and_types_by_node, "service", "request"),
    ):

        def names(ask=ask) -> set[str]:  # type: ignore[no-untyped-def]
            return {name for name, _ in ask(node, "/") if "/_action/" not in name}

        policy = listed(kind, permission, node)
        ros.wait_until(
            lambda names=names, policy=policy: unused(names(), policy) <= unused_allowed,
            f"what the policy allows {node} to {permission}: {sorted(policy)}, and it has {sorted(names())}",
        )
        assert not uncovered(names(), policy), f"{permission}: {node} has more than the policy"

    def actions() -> set[str]:
        return {name for name, _ in get_action_client_names_and_types_by_node(graph, node, "/")}

    ros.wait_until(lambda: actions() == listed("action", "call", node), f"the actions that {node} calls")


def test_the_policy_lists_exactly_what_replay_client_and_viewer_have(ros: Ros, tmp_path: Path) -> None:
    data = write_dataset(tmp_path / "data")
    ros.start("segment_node", {"scene_path": data / "scene.ply"}).wait_for("active: listening")
    ros.start("replay_node", {"data": data, "rate": 0.1, "loop": 0})
    assert_listed(ros, "replay", {"/clock"})
    with SegmentationClient(domain_id=ros.domain, find_timeout=PATIENCE) as client:
        says_in_the_end(lambda: client.wait_for_views(1000, timeout=1.0), "of 1000 views")
        assert_listed(ros, "gsseg_client", set())
    viewer = RosSource(GaussianScene.load(data / "scene.ply"), domain_id=ros.domain, find_timeout=PATIENCE)
    try:
        assert_listed(ros, "gsseg_view", {"/gsseg/classes/*"})
    finally:
        viewer.close()


def test_only_the_node_itself_has_to_do_with_its_parameters_and_its_state() -> None:
    for node in ("replay", "gsseg_client", "gsseg_view"):
        asked = {name.rsplit("/", 1)[-1] for name in listed("service", "request", node)}
        assert not asked & {"set_parameters", "set_parameters_atomically", "change_state"}
