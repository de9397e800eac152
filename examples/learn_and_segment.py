"""Learn from the masks that the node has received, get all objects, and save one of them as an array.

Run it while `segment_node` runs and has received masks (see examples/README.md):

    python examples/learn_and_segment.py                   # print every object
    python examples/learn_and_segment.py --save mug        # also write mug.npy, (M, 3) metres in the map frame
"""

from __future__ import annotations

import argparse
import contextlib
import sys

import numpy as np

from gsseg_ros.client import NodeUnavailableError, SegmentationClient, SegmentationError

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--node", default="gsseg", help="name of the node (default: %(default)s)")
parser.add_argument("--save", metavar="CLASS", help="write the points of this class to CLASS.npy")
options = parser.parse_args()

try:
    with SegmentationClient(options.node) as client:
        client.wait_until_active()
        with contextlib.suppress(NodeUnavailableError):  # learn() raises a clear error if there are no views.
            client.wait_for_views(1, timeout=10)  # masks may still be on their way
        learnt = client.learn(on_feedback=lambda stage, done, total, loss: print(f"{stage} {done}/{total}"))
        result = client.segment()
except (SegmentationError, NodeUnavailableError) as error:
    sys.exit(f"learn_and_segment: {error}")

print(f"learnt from {learnt.report.num_views} views in {learnt.report.total_seconds:.2f} s")
for name, thing in result.objects.items():
    print(f"{name}: {len(thing.points)} Gaussians, {thing.confidence.mean():.0%} sure, at {thing.centroid.round(3)} m")
if options.save:
    if options.save not in result.objects:
        sys.exit(f"learn_and_segment: no object '{options.save}'; there are {', '.join(result.objects) or 'none'}")
    np.save(f"{options.save}.npy", result.objects[options.save].points)
