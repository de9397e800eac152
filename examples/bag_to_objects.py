"""Turn a recorded bag into one PLY per object, without a node and without ROS installed.

    pip install rosbags
    python examples/bag_to_objects.py scene.ply BAG out
    python examples/bag_to_objects.py scene.ply BAG out --mask /front/mask --pose /slam/pose --class-names mug bowl

BAG is a folder with metadata.yaml, a .mcap or a .db3. It holds masks, camera_info and poses as for the node: with equal
stamps per image, and with the pose of the camera's optical frame in the frame of the scene.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from gsseg_core import Camera, EMLearner, GaussianScene, GssegError, Segmentation, View, export_classes

ENCODINGS = {
    "mono8": (np.uint8, 255), "8UC1": (np.uint8, 255),
    "mono16": (np.uint16, 65535), "16UC1": (np.uint16, 65535), "32SC1": (np.int32, -1),
}  # fmt: skip
"""Type of a pixel, and the value that means unknown."""


def labels_of(mask: Any) -> np.ndarray:
    """Turn a sensor_msgs/Image into labels: (H, W) int32, -1 where unknown."""
    if mask.encoding not in ENCODINGS:
        raise GssegError(f"a mask is {mask.encoding}; expected one of {', '.join(ENCODINGS)}")
    kind, unknown = ENCODINGS[mask.encoding]
    pixel = np.dtype(kind).newbyteorder(">" if mask.is_bigendian else "<")
    rows = np.frombuffer(mask.data, np.uint8).reshape(mask.height, mask.step)  # A row may end in padding.
    labels = np.ascontiguousarray(rows[:, : mask.width * pixel.itemsize]).view(pixel).astype(np.int32)
    labels[labels == unknown] = -1
    return labels


def camera_of(name: str, info: Any, pose: Any) -> Camera:
    """Turn a CameraInfo and a PoseStamped into a camera."""
    if np.any(info.d):
        raise GssegError(f"camera_info has distortion {info.d.tolist()}; expected that of a rectified image, all zeros")
    p, q = pose.pose.position, pose.pose.orientation
    quaternion, camera_in_map = [q.x, q.y, q.z, q.w], np.eye(4)
    if not np.linalg.norm(quaternion) > 0:
        raise GssegError("a pose has a quaternion of zeros, or of NaN; expected x, y, z, w that turn the camera")
    camera_in_map[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
    camera_in_map[:3, 3] = p.x, p.y, p.z
    return Camera(name, info.width, info.height, info.k.reshape(3, 3), np.linalg.inv(camera_in_map))


def read_views(bag: Path, topics: dict[str, str], skipped: Counter[str]) -> Iterator[View]:
    """Pair the messages of three topics by their stamps, and count what cannot be paired or used."""
    waiting: dict[int, dict[str, Any]] = {}  # ns, by topic
    with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        roles = {name: role for role, name in topics.items()}
        wanted = [connection for connection in reader.connections if connection.topic in roles]
        missing = set(roles) - {connection.topic for connection in wanted}
        if missing:
            found = ", ".join(sorted(reader.topics)) or "none"
            raise GssegError(f"{bag}: no topic {', '.join(sorted(missing))}; topics in the bag: {found}")
        for connection, _, data in reader.messages(wanted):
            message: Any = reader.deserialize(data, connection.msgtype)
            stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            group = waiting.setdefault(stamp, {})
            group[roles[connection.topic]] = message
            if len(group) < len(topics):
                continue
            del waiting[stamp]
            try:
                camera = camera_of(str(stamp), group["camera_info"], group["pose"])
                yield View.from_arrays(camera, labels_of(group["mask"]))
            except GssegError as error:
                skipped[str(error)] += 1
    skipped["without the other two of its stamp"] += sum("mask" in group for group in waiting.values())


def main() -> None:
    """Learn from all masks of a bag, and write one PLY per object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", metavar="SCENE.ply", help="trained 3DGS scene")
    parser.add_argument("bag", metavar="BAG", type=Path, help="recorded bag, mcap or sqlite3")
    parser.add_argument("out", metavar="OUT", help="folder for the PLYs")
    for role in ("mask", "camera_info", "pose"):
        parser.add_argument(f"--{role}", default=f"/{role}", metavar="TOPIC", help="default: %(default)s")
    parser.add_argument("--class-names", nargs="*", default=[], metavar="NAME", help="names of the labels 1, 2, ...")
    options = parser.parse_args()
    topics = {role: getattr(options, role) for role in ("mask", "camera_info", "pose")}
    skipped: Counter[str] = Counter()
    try:
        scene = GaussianScene.load(options.scene)
        views = list(read_views(options.bag, topics, skipped))
        for why, count in skipped.items():  # Print this first: too few masks may make a later step fail.
            if count:
                print(f"skipped {count} masks: {why}")
        labels = range(1 + max([len(options.class_names), *(view.largest_label for view in views)]))
        names = dict(zip(labels, ["background", *options.class_names], strict=False))
        learner = EMLearner(scene, len(labels))
        learner.observe_all(views)
        names = {label: names.get(label, f"class_{label:02d}") for label in labels}
        learner.fit()
        result = Segmentation.from_codes(scene, learner.codes_, names, evidence=learner.evidence())
        result = result.carved(scene, [view.camera for view in views])  # cut to the silhouettes
        files = export_classes(scene, result, options.out)
    except (GssegError, AnyReaderError) as error:
        sys.exit(f"bag_to_objects: {error}")
    print(f"learnt from {len(views)} masks")
    for label, path in files.items():
        print(f"{path}: {(result.labels == label).sum()} Gaussians")


if __name__ == "__main__":
    main()
