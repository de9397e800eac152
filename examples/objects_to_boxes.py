"""Ask the node for its objects and print their boxes as JSON, and how a gripper would take them.

While `segment_node` runs and masks have come (see examples/README.md):

    python examples/objects_to_boxes.py                                   # every object
    python examples/objects_to_boxes.py mug bowl --min-confidence 0.7     # two, without what is in doubt
    python examples/objects_to_boxes.py --opening 0.08                    # what a hand of 8 cm can close around

One line an object, in metres of the map frame: the middle of its box, the directions and lengths of the box's sides,
the longest first, its mean and covariance, and, where a side is shorter than the hand opens, the direction along which
to close: the shortest such side. Boxes lie as the objects do, and stray Gaussians do not blow them up. A planner that
is a ROS node itself gets the same from the topic ~/objects.
"""

from __future__ import annotations

import argparse
import json
import sys

from gsseg_ros.client import NodeUnavailableError, SegmentationClient, SegmentationError

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("classes", nargs="*", metavar="CLASS", help="names of the classes wanted (default: all)")
parser.add_argument("--min-confidence", type=float, default=0.5, help="0 to 1 (default: %(default)s)")
parser.add_argument("--opening", type=float, default=0.1, help="of the hand, in metres (default: %(default)s)")
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
