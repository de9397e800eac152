"""ROS 2 node of gsseg: posed masks in, segmented point clouds out."""

import os

# Before OpenMP is loaded. A robot's cores are busy with more than this: threads that wait for work must not spin.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
