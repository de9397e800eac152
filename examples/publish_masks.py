"""Publish masks as a robot's segmenter does: a complete node, with a dataset folder in place of camera and network.

    python examples/publish_masks.py DATASET --rate 5
    python examples/publish_masks.py DATASET --ros-args -r mask:=/front/mask -r camera_info:=/front/camera_info

The segmentation node expects the following; most failures come from these points:

stamps    mask, camera_info and pose carry the stamp of the image that the mask was made from: the time of the image,
          not the time when the network finished. The node pairs them by it.
frames    the pose is that of the camera's optical frame (x right, y down, z forward) in the map frame.
pixels    the image is rectified: d is all zeros, and k belongs to the rectified image at the size of the mask.
labels    mono8 (255: unknown) or mono16 (65535: unknown), a class number per pixel, 0 for background; never colours,
          never resized with interpolation.
QoS       reliable. The segmentation node accepts any publisher, but a best-effort publisher loses up to half of the
          large masks, and these are not sent again.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np
import rclpy
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.utilities import remove_ros_args
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header

from gsseg_core import Dataset, GssegError, View
from gsseg_ros.frames import quaternion_from_rotation

QOS = QoSProfile(depth=30, reliability=ReliabilityPolicy.RELIABLE)
MAP_FRAME, OPTICAL_FRAME = "map", "camera_optical_frame"


class Segmenter(Node):
    """Publishes one view at each tick; `done` is true once there are no more."""

    def __init__(self, views: list[View], rate: float) -> None:
        super().__init__("segmenter")
        self.masks = self.create_publisher(Image, "mask", QOS)
        self.camera_infos = self.create_publisher(CameraInfo, "camera_info", QOS)
        self.poses = self.create_publisher(PoseStamped, "pose", QOS)
        self.views, self.done = iter(views), False
        self.create_timer(1 / rate, self.tick)

    def tick(self) -> None:
        """Publish the next view, once every topic has a subscriber."""
        if not all(topic.get_subscription_count() for topic in (self.masks, self.camera_infos, self.poses)):
            self.get_logger().info("waiting for subscribers", throttle_duration_sec=5.0)
            return
        view = next(self.views, None)
        if view is None:
            self.done = True
        else:
            self.publish(view)

    def publish(self, view: View) -> None:
        """Publish mask, camera_info and pose of one image."""
        # On a robot: copy image.header.stamp of the camera's image unchanged.
        stamp = self.get_clock().now().to_msg()
        optical = Header(stamp=stamp, frame_id=OPTICAL_FRAME)

        labels = view.read_labels()  # (H, W), -1 where the network is not sure
        height, width = labels.shape
        data = np.where(labels < 0, 65535, labels).astype("<u2").tobytes()
        self.masks.publish(
            Image(
                header=optical, height=height, width=width, encoding="mono16", is_bigendian=0, step=2 * width, data=data
            )
        )

        K = view.camera.K  # (3, 3) pixels
        self.camera_infos.publish(
            CameraInfo(
                header=optical,
                height=height,
                width=width,
                distortion_model="plumb_bob",
                d=[0.0] * 5,
                k=K.ravel(),
                r=np.eye(3).ravel(),
                p=np.c_[K, np.zeros(3)].ravel(),
            )
        )

        # On a robot: take the pose from localisation, or look it up in TF at the stamp.
        camera_in_map = np.linalg.inv(view.camera.world_to_camera)
        x, y, z = camera_in_map[:3, 3].tolist()
        qx, qy, qz, qw = quaternion_from_rotation(camera_in_map[:3, :3])
        pose = Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))
        self.poses.publish(PoseStamped(header=Header(stamp=stamp, frame_id=MAP_FRAME), pose=pose))


def main() -> None:
    """Publish all train views of a dataset."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", metavar="DATASET", help="folder with cameras and labels/<stem>.png")
    parser.add_argument("--rate", type=float, default=5.0, help="masks per second (default: %(default)s)")
    options = parser.parse_args(remove_ros_args(sys.argv)[1:])
    if not options.rate > 0:
        parser.error(f"--rate is {options.rate:g}; expected more than 0 masks per second")
    try:
        views = [view for view in Dataset(options.dataset).views("train") if view.has_mask]
    except GssegError as error:
        sys.exit(f"publish_masks: {error}")

    rclpy.init(args=sys.argv)
    node = Segmenter(views, options.rate)
    try:
        while not node.done:
            rclpy.spin_once(node)
        for topic in (node.masks, node.camera_infos, node.poses):
            topic.wait_for_all_acked(Duration(seconds=30))
        print(f"published {len(views)} masks")
    except (KeyboardInterrupt, ExternalShutdownException):
        print("stopped")
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
