"""Messages for the tests of the pairing, whose content tells from which stamp they come."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from gsseg_core.scene.camera import rigid_motion
from gsseg_ros.node.pairing import Pairing
from gsseg_ros.node.pose_sources import GivenPose

MS = 1_000_000
S = 1000 * MS

Event = tuple[str, int]
"""Kind of a message, "mask", "info" or "pose", and its stamp in ns."""


def pose(x: float) -> np.ndarray:
    return rigid_motion(np.eye(3), [x, 0, 0])


def send(pairing: Pairing, events: Iterable[Event]) -> None:
    """Send messages whose content tells where they come from: a pose's x is its stamp in seconds."""
    for kind, stamp in events:
        if kind == "mask":
            pairing.add_mask(stamp, f"mask {stamp}")
        elif kind == "info":
            pairing.add_camera_info(stamp, f"info {stamp}")
        else:
            pairing.add_pose(stamp, GivenPose(pose(stamp / S)))


def at_all(stamps: Iterable[int]) -> list[Event]:
    return [(kind, stamp) for stamp in stamps for kind in ("info", "pose", "mask")]


def wait(pairing: Pairing, seconds: float) -> None:
    """Let time pass in which nothing comes."""
    for tick in range(round(seconds * 10) + 1):
        pairing.expire(tick / 10)


def expire(pairing: Pairing) -> None:
    """Let all waiting time pass."""
    wait(pairing, 12)
