"""Watches simulated time: whether /clock comes at all, goes on, or is set back."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from builtin_interfaces.msg import Time
from rclpy.callback_groups import CallbackGroup
from rclpy.clock import Clock, ClockType, JumpHandle, JumpThreshold, TimeJump
from rclpy.duration import Duration

from gsseg_core.text import counted

STANDSTILL_SECONDS = 5.0
"""How long /clock may stand still, of a clock that does not."""

_BACK = JumpThreshold(min_forward=None, min_backward=Duration(seconds=-1), on_clock_change=False)


class SimTime:
    """Watches the clock of a node that goes by /clock, as its parameter use_sim_time says; ask it once a second."""

    def __init__(self, node: Any, now: Callable[[], float] = time.monotonic) -> None:
        self._node, self._now = node, now
        self._last, self._since = -1, now()

    def problem(self) -> str:
        """Say what is wrong with the clock, and what to check; empty if nothing is."""
        clock = self._node.get_clock()
        stamp, now = clock.now().nanoseconds, self._now()
        if stamp != self._last or not clock.ros_time_is_active:
            # A clock that has not come yet stands at zero from the start.
            self._last, self._since = stamp, self._since if stamp == 0 else now
        silence = now - self._since
        if silence < STANDSTILL_SECONDS or not clock.ros_time_is_active:
            return ""
        publishers = self._node.count_publishers("/clock")
        if stamp == 0:
            found = f"no /clock has come for {silence:.0f} s"
        else:
            found = f"/clock has stood still at {stamp / 1e9:.3f} s for {silence:.0f} s"
        hint = f"it has {counted(publishers, 'publisher')} (is it paused?)" if publishers else "nobody publishes it"
        return (
            f"use_sim_time is true, but {found}, and {hint}; expected a simulator or 'ros2 bag play --clock', or "
            "use_sim_time false"
        )

    def stamp(self) -> Time:
        """Give the time for diagnostics: that of the wall as long as no /clock has come, for zero means "not set"."""
        now = self._node.get_clock().now()
        return (now if now.nanoseconds else Clock(clock_type=ClockType.SYSTEM_TIME).now()).to_msg()


def steady_timer(node: Any, period_s: float, callback: Callable[[], None], group: CallbackGroup) -> Any:
    """Make a timer that goes on whatever /clock does, which may stand still."""
    steady = Clock(clock_type=ClockType.STEADY_TIME)
    return node.create_timer(period_s, callback, callback_group=group, clock=steady)


def on_set_back(node: Any, heard: Callable[[int, int], None]) -> JumpHandle:
    """Have `heard` called with the times before and after (ns) whenever the clock is set back by a second or more.

    Returns what is to be kept, and unregistered at the end.
    """
    clock: Clock = node.get_clock()

    def jumped(jump: TimeJump) -> None:
        now = clock.now().nanoseconds
        heard(now - jump.delta.nanoseconds, now)

    return clock.create_jump_callback(_BACK, post_callback=jumped)
