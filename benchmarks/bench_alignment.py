"""Whether cameras in another frame are put back: `python benchmarks/bench_alignment.py [SCENE ...]`.

Each real scene is disturbed by each of the 24 rotations that map axes to axes, by inverted poses, by OpenGL's camera
axes, and by similarities with a scale from 0.2 to 5 and any rotation; and by the first of these without photos, by
masks with errors alone. What is found is compared with the truth: poses for conventions, and where points of the scene
land in the views. A row is printed as soon as it is known, with the CPU time that it took.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from machine import parser_of
from scenes import REAL
from scipy.spatial.transform import Rotation

from gsseg_core.align.conventions import AXIS_ROTATIONS, OPENGL, Alignment, Convention
from gsseg_core.align.placing import find_alignment
from gsseg_core.data.dataset import Dataset
from gsseg_core.errors import AlignmentError
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.similarity import Similarity

SCENES = (*REAL, "fern")
SIMILARITIES = 2
POINTS = 2000  # of the scene, whose places in the views are compared


class Row(NamedTuple):
    """What came of one disturbance."""

    disturbance: str
    by: str
    found: bool
    median_px: float
    largest_px: float
    seconds: float

    def __str__(self) -> str:
        found = "found" if self.found else "NOT FOUND"
        return (
            f"{self.disturbance:28} {self.by:7} {found:10} {self.median_px:9.3f} {self.largest_px:8.3f} "
            f"{self.seconds:7.1f}"
        )


def disturbances(seed: int) -> Iterator[tuple[str, Alignment, bool]]:
    """Name the disturbances, and say whether masks alone should do."""
    for number, axes in enumerate(AXIS_ROTATIONS):
        yield f"world axes {number + 1} of 24", Alignment(Convention(world_axes=axes)), True
    yield "inverted poses", Alignment(Convention(inverted=True)), True
    yield "OpenGL's camera axes", Alignment(Convention(camera_axes=OPENGL)), True
    rng = np.random.default_rng(seed)
    for scale in np.exp(rng.uniform(np.log(0.2), np.log(5), SIMILARITIES)):
        turn = Rotation.from_quat(rng.normal(size=4)).as_matrix()
        yield (
            f"similarity, scale {scale:.2f}",
            Alignment(similarity=Similarity(scale, turn, rng.normal(0, 5, 3))),
            False,
        )


def measure(scene: GaussianScene, true: Dataset, name: str, disturbed: Alignment, photos: bool) -> Row:
    """Disturb a dataset, align it, and compare."""
    moved = true.moved(disturbed.camera)
    views = [view if photos else replace(view, image_path=None) for view in moved.views("train")]
    start = time.process_time()
    try:
        alignment = find_alignment(scene, views).alignment
    except AlignmentError:
        return Row(name, "photos" if photos else "masks", False, np.inf, np.inf, time.process_time() - start)
    seconds = time.process_time() - start
    apart = []
    for given, camera in zip(moved.cameras, true.cameras, strict=True):
        points = scene.means[:: max(1, len(scene) // POINTS)]
        pixels, _ = camera.project(points)
        inside = ((pixels >= 0) & (pixels < (camera.width, camera.height))).all(axis=1)
        offsets = np.linalg.norm(pixels[inside] - alignment.camera(given).project(points[inside])[0], axis=1)
        apart.append(float(np.median(np.nan_to_num(offsets, nan=np.inf))))
    median, largest = float(np.median(apart)), float(np.max(apart))
    return Row(name, "photos" if photos else "masks", median < 1, median, largest, seconds)


def main() -> None:
    """Print the table of some scenes, all by default."""
    parser = parser_of(__doc__)
    parser.add_argument("scenes", nargs="*", default=SCENES)
    parser.add_argument("--every", type=int, default=1, help="take only each so many-th disturbance, and the last")
    options = parser.parse_args()
    print(f"{'disturbance':28} {'by':7} {'':10} {'median px':>9} {'worst px':>8} {'CPU s':>7}")
    for number, name in enumerate(options.scenes):
        print(f"\n{name}", flush=True)
        folder = options.data / name
        scene, true = GaussianScene.load(folder / "scene.ply"), Dataset(folder, "labels_noisy")
        rows, tried = [], list(disturbances(number))
        for label, disturbed, by_masks in [*tried[: -1 : options.every], tried[-1]]:
            ways = [True, *([False] if by_masks and true.views("train")[0].has_mask else [])]
            for photos in ways:
                rows.append(measure(scene, true, label, disturbed, photos))
                print(rows[-1], flush=True)
        print(f"{sum(row.found for row in rows)} of {len(rows)} found", flush=True)


if __name__ == "__main__":
    main()
