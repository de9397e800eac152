"""Starts the installed `segment_node` as `ros2 run` would, and checks that it becomes active and stops when asked to.

The node is looked up through the ament index, so the environment must be set up as for `ros2 run`: a sourced
workspace, or AMENT_PREFIX_PATH set to the prefix of a Python environment.
"""

from __future__ import annotations

import argparse
import importlib
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import rclpy
from ament_index_python import get_package_prefix, get_package_share_directory
from lifecycle_msgs.msg import State
from lifecycle_msgs.srv import GetState

from gsseg_ros.child_nodes import claimed_domain

START_SECONDS = 1200.0  # The first start after installing compiles the kernels of gsseg_core.
STOP_SECONDS = 300.0  # Far more than it takes, since tests run beside this.
SHARED_FILES = ("config/segment_node.yaml", "launch/segment.launch.py", "launch/replay.launch.py", "package.xml")


def main() -> None:
    """Run the checks; exits with a message and status 1 at the first that fails."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--below", type=Path, required=True, help="folder below which both packages must be installed")
    below = parser.parse_args().below.resolve()

    node = find_node(below)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    domain, claim = claimed_domain(random.sample(range(1, 101), 100))  # The tests of any checkout may run beside this.
    os.environ["ROS_DOMAIN_ID"] = str(domain)
    os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"
    process = subprocess.Popen([node])
    try:
        seconds = wait_until_active(process)
        stop(process)
    finally:
        process.kill()
        process.wait()
        claim.close()
    print(f"{node} was active after {seconds:.1f} s and stopped when asked to")


def find_node(below: Path) -> Path:
    """Return the path of segment_node, after checking that everything comes from the installation under test."""
    prefix = Path(get_package_prefix("gsseg_ros")).resolve()
    if below not in (prefix, *prefix.parents):
        sys.exit(f"the ament index has gsseg_ros in {prefix}, expected below {below}")
    for package in ("gsseg_core", "gsseg_ros", "gsseg_msgs"):
        file = Path(importlib.import_module(package).__file__ or "").absolute()
        if below not in file.parents:
            sys.exit(f"{package} is imported from {file}, expected below {below}")
    for name in SHARED_FILES:
        if not (Path(get_package_share_directory("gsseg_ros")) / name).is_file():
            sys.exit(f"{prefix}/share/gsseg_ros has no {name}")
    for name in ("replay_node", "segment_node"):
        if not os.access(prefix / "lib" / "gsseg_ros" / name, os.X_OK):
            sys.exit(f"{prefix}/lib/gsseg_ros has no executable {name}")
    return prefix / "lib" / "gsseg_ros" / "segment_node"


def wait_until_active(process: subprocess.Popen[bytes]) -> float:
    """Return the seconds until the node answered on ~/get_state that it is active."""
    start = time.monotonic()
    rclpy.init()
    try:
        asker = rclpy.create_node("check_installed_node")
        client = asker.create_client(GetState, "/gsseg/get_state")
        state = "not to be reached"
        while time.monotonic() - start < START_SECONDS:
            if process.poll() is not None:
                sys.exit(f"the node ended by itself with status {process.returncode}")
            if not client.wait_for_service(timeout_sec=0.5):
                continue
            answer = client.call_async(GetState.Request())
            rclpy.spin_until_future_complete(asker, answer, timeout_sec=5.0)
            if answer.result() is not None:
                state = answer.result().current_state.label
                if answer.result().current_state.id == State.PRIMARY_STATE_ACTIVE:
                    return time.monotonic() - start
            time.sleep(0.1)
    finally:
        rclpy.shutdown()
    sys.exit(f"after {START_SECONDS:.0f} s the node is {state}, expected active")


def stop(process: subprocess.Popen[bytes]) -> None:
    """Interrupt the node, as Ctrl+C does, and wait until it has ended well."""
    process.send_signal(signal.SIGINT)
    try:
        status = process.wait(STOP_SECONDS)
    except subprocess.TimeoutExpired:
        sys.exit(f"the node did not stop within {STOP_SECONDS:.0f} s of SIGINT")
    if status != 0:
        sys.exit(f"the node ended with status {status} after SIGINT, expected 0")


if __name__ == "__main__":
    main()
