"""Ask the node for its objects, and print their boxes and gripper directions as JSON.

Run it while `segment_node` runs and has received masks (see examples/README.md):

    python examples/objects_to_boxes.py                                   # every object
    python examples/objects_to_boxes.py mug bowl --min-confidence 0.7     # two, without uncertain Gaussians
    python examples/objects_to_boxes.py --opening 0.08                    # for a gripper that opens 8 cm

It prints one line per object, in metres in the map frame: the centre of its box, the directions and lengths of the
box's sides (longest first), its mean and its covariance. If a side is shorter than the gripper's opening, `close_along`
is the direction of the shortest side. Boxes are oriented along the objects, and stray Gaussians do not enlarge them. A
planner that is a ROS node gets the same from the topic ~/objects.
"""

from __future__ import annotations

import argparse
import json
import sys

from gsseg_ros.client import NodeUnavailableError, SegmentationClient, SegmentationError

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("classes", nargs="*", metavar="CLASS", help="names of the classes wanted (default: all)")
parser.add_argument("--min-confidence", type=float, default=0.5, help="0 to 1 (default: %(default)s)")
parser.add_argument("--opening", type=float, default=0.1, help="of the gripper, in metres (default: %(default)s)")
parser.add_argument("--node", default="gsseg", help="name of the node (default: %(default)s)")
options = parser.parse_args()
if not options.opening > 0:
    parser.error(f"--opening is {options.opening:g}; expected more than 0 m")

try:
    with SegmentationClient(options.node) as client:
        client.wait_until_active()
        result = client.segment(options.classes, min_confidence=options.min_confidence)
except (SegmentationError, NodeUnavailableError) as error:
    sys.exit(f"objects_to_boxes: {error}")

for name, thing in result.objects.items():
    box = thing.oriented_box
    line = {
        "object": name,
        "frame": result.report.header.frame_id,
        "confidence": round(float(thing.confidence.mean()), 3),
        "gaussians": len(thing.points),
        **box.as_dict(),
        "close_along": box.axes[:, 2].round(4).tolist() if box.size[2] < options.opening else None,
    }
    print(json.dumps(line))
