"""Ask the node for its objects and print their centroids and boxes as JSON, for a planner.

While `segment_node` runs and masks have come (see examples/README.md):

    python examples/objects_to_boxes.py                                   # every object
    python examples/objects_to_boxes.py mug bowl --min-confidence 0.7     # two, without what is in doubt

One line an object: centroid, centre and size of the axis-aligned box in the map frame, in metres. A single stray
Gaussian would make a box too large, so the outermost `--trim` percent on each side are left out.
"""

from __future__ import annotations

import argparse
import json
import sys

import numpy as np

from gsseg_ros.client import NodeUnavailableError, SegmentationClient, SegmentationError

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("classes", nargs="*", metavar="CLASS", help="names of the classes wanted (default: all)")
parser.add_argument("--min-confidence", type=float, default=0.5, help="0 to 1 (default: %(default)s)")
parser.add_argument("--trim", type=float, default=1.0, help="percent, 0 to 49 (default: %(default)s)")
parser.add_argument("--node", default="gsseg", help="name of the node (default: %(default)s)")
options = parser.parse_args()
if not 0 <= options.trim < 50:
    parser.error(f"--trim is {options.trim:g}; expected 0 to 49 percent")

try:
    with SegmentationClient(options.node) as client:
        result = client.segment(options.classes, min_confidence=options.min_confidence)
except (SegmentationError, NodeUnavailableError) as error:
    sys.exit(f"objects_to_boxes: {error}")

for name, thing in result.objects.items():
    low, high = np.percentile(thing.points, [options.trim, 100 - options.trim], axis=0)
    box = {
        "object": name,
        "frame": result.report.header.frame_id,
        "centroid": thing.centroid.round(4).tolist(),
        "box_center": ((low + high) / 2).round(4).tolist(),
        "box_size": (high - low).round(4).tolist(),
        "confidence": round(float(thing.confidence.mean()), 3),
        "gaussians": len(thing.points),
    }
    print(json.dumps(box))
