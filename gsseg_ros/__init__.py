"""ROS 2 node of gsseg: posed masks in, segmented point clouds out."""

import importlib.util

if importlib.util.find_spec("gsseg_msgs") is None:
    raise ModuleNotFoundError(
        "gsseg_ros needs gsseg_msgs, the messages, which are missing. In a workspace, colcon does not look below "
        "src/gsseg: run `ln -s gsseg/msg_defs src/gsseg_msgs`, and `colcon build` again. Elsewhere: "
        "`pip install ./msg_defs`.",
        name="gsseg_msgs",
    )
