"""ROS 2 node of gsseg: posed masks in, segmented point clouds out."""

import importlib.util
import os

# Before OpenMP is loaded. A robot's cores are busy with more than this: threads that wait for work must not spin.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

if importlib.util.find_spec("gsseg_msgs") is None:
    raise ModuleNotFoundError(
        "gsseg_ros needs gsseg_msgs, the messages, which are missing. In a workspace, colcon does not look below "
        "src/gsseg: run `ln -s gsseg/msg_defs src/gsseg_msgs`, and `colcon build` again. Elsewhere: "
        "`pip install ./msg_defs`.",
        name="gsseg_msgs",
    )
