"""What of ROS 2 and its messages is not installed; nothing of it is imported to know."""

from __future__ import annotations

from importlib.util import find_spec

MISSING = [name for name in ("rclpy", "gsseg_msgs") if find_spec(name) is None]
