"""The SROS 2 policy against the node as it runs: what it lists is what the node has, no more and no less."""

from __future__ import annotations

from fnmatch import fnmatch
from pathlib import Path
from xml.etree import ElementTree

import pytest
from ros_helpers import REPOSITORY, Ros, ros_fixture  # noqa: F401
from small_scenes import balls_on_a_table

pytest.importorskip("gsseg_msgs.msg", reason="gsseg_msgs is not installed")

from rclpy.action import get_action_server_names_and_types_by_node

# Of the kinds of pose source one is there at a time, a clock only with use_sim_time, and images while they are shown.
ONE_OF = {"/pose", "/odometry", "/tf", "/tf_static", "/clock", "/image"}


def listed(kind: str, permission: str) -> set[str]:
    """Full names that the policy allows."""
    profile = ElementTree.parse(REPOSITORY / "sros2/policy.xml").find("enclaves/enclave/profiles/profile")
    assert profile is not None
    names = [entry.text or "" for group in profile.findall(f"{kind}s[@{permission}='ALLOW']") for entry in group]
    return {name.replace("~/", "/gsseg/") if name[0] in "~/" else f"/{name}" for name in names}


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
    actions = {name for name, _ in get_action_server_names_and_types_by_node(graph, "gsseg", "/")}
    assert actions == listed("action", "execute")
