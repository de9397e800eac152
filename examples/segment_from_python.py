"""Segment a scene in one process, without ROS: learn from a dataset folder and write one PLY per object.

    python examples/segment_from_python.py scene.ply DATASET out

The README describes the DATASET folder. `make demo-local` makes one, demo_out/scene, with scene.ply in it.
"""

from __future__ import annotations

import argparse
import sys

from gsseg_core import Dataset, EMLearner, GaussianScene, GssegError, Segmentation, export_classes
from gsseg_core.learn.calibrate import calibrate

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("scene", metavar="SCENE.ply", help="trained 3DGS scene")
parser.add_argument("dataset", metavar="DATASET", help="folder with cameras and labels/<stem>.png")
parser.add_argument("out", metavar="OUT", help="folder for the PLYs")
options = parser.parse_args()

try:
    scene = GaussianScene.load(options.scene)
    data = Dataset(options.dataset)
    learner = EMLearner(scene, data.num_classes)
    for view in data.views("train"):
        learner.observe(view)
    learner.fit()
    result = Segmentation.from_codes(scene, learner.codes_, data.class_names, evidence=learner.evidence())
    result = result.carved(scene, [view.camera for view in data.views("train")])  # cut to the silhouettes
    result = result.calibrated(calibrate(learner).temperature)  # 80 % confident: 80 % right
    files = export_classes(scene, result, options.out)
except GssegError as error:
    sys.exit(f"segment_from_python: {error}")

for label, path in files.items():
    chosen = result.labels == label
    print(f"{path}: {chosen.sum()} Gaussians, {result.confidence[chosen].mean():.0%} sure")
