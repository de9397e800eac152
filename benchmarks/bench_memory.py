"""Tell the peak memory of learning and segmenting at one size, after each stage.

python benchmarks/bench_memory.py         # 5 million Gaussians, 200 classes: 14 GB, a minute
"""

from __future__ import annotations

import argparse

import numpy as np
from machine import describe, peak_memory
from workloads import RoomSize, make_room

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.view import View
from gsseg_core.learn.em.em_learner import EMLearner
from gsseg_core.learn.prepared_views import MEMORY_BUDGET
from gsseg_core.raster.backends import make_operator
from gsseg_core.segmentation import Segmentation


def main() -> None:
    """Go through the stages."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gaussians", type=int, default=5_000_000)
    parser.add_argument("--classes", type=int, default=200)
    parser.add_argument("--views", type=int, default=6, help="of 640 x 480")
    parser.add_argument("--budget", type=int, default=MEMORY_BUDGET >> 20, metavar="MIB", help="for prepared views")
    options = parser.parse_args()
    print(describe())
    room, many = make_room(RoomSize(options.gaussians, options.views, options.classes, 640, 480)), options.classes
    truth = CSRRows(np.arange(len(room.truth) + 1), room.truth.astype(np.uint32), np.ones(len(room.truth), np.float32))
    views = [
        View.from_arrays(c, make_operator(room.scene, c).blend_rows(truth, many).image.argmax(axis=2).astype(np.int32))
        for c in room.cameras
    ]
    tell("scene and masks made")
    learner = EMLearner(room.scene, many, memory_budget=options.budget << 20)
    learner.observe_all(views)
    tell("views observed")
    codes = learner.fit().codes_
    tell(f"{len(learner.history_)} steps of EM")
    del learner
    result = Segmentation.from_codes(room.scene, codes, {})
    del codes
    tell("refined")
    result.render(make_operator(room.scene, room.cameras[0]))
    tell("a label map rendered")


def tell(stage: str) -> None:
    """Print the most memory that the process has had so far."""
    print(f"{stage}: {peak_memory():.2f} GiB", flush=True)


if __name__ == "__main__":
    main()
