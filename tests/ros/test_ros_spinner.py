"""The thread that spins for a client or a viewer."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from ros_helpers import PATIENCE, Ros, ros_fixture  # noqa: F401
from ros_robot import RELIABLE
from sensor_msgs.msg import PointCloud2

from gsseg_ros.client.spinner import Spinner


def test_a_message_that_cannot_be_taken_in_is_lost_and_all_who_wait_go_on(
    ros: Ros, capfd: pytest.CaptureFixture[str]
) -> None:
    heard: list[Any] = []
    spinner = Spinner("listener", None, ros.domain)
    try:
        subscription = spinner.run(
            lambda: spinner.node.create_subscription(PointCloud2, "cloud", heard.append, RELIABLE)
        )
        publisher = ros.node.create_publisher(PointCloud2, "cloud", RELIABLE)
        ros.wait_until(publisher.get_subscription_count, "the subscription")
        kind, subscription.msg_type = subscription.msg_type, SimpleNamespace  # As good as one that does not fit.
        publisher.publish(PointCloud2())
        said = ""

        def is_said() -> bool:
            nonlocal said
            said += capfd.readouterr().err
            return "/cloud: what was received cannot be processed, and is lost: " in said

        ros.wait_until(is_said, "the loss")
        subscription.msg_type = kind
        publisher.publish(PointCloud2())
        assert spinner.wait_for(lambda: heard, PATIENCE)
    finally:
        spinner.close()
    assert "Traceback" not in said
