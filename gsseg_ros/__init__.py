"""ROS 2 node of gsseg: posed masks in, segmented point clouds out."""
