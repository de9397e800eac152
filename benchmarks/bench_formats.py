"""What a format costs: seconds to load a million Gaussians from it, and points of mIoU when real scenes come in it.

Usage: python benchmarks/bench_formats.py [--data FOLDER] [--scenes NAME ...] [--learner em] [--count 1000000]

Loading: the real scene `fern` of SH degree 3, repeated side by side, written by gsseg, by gaussforge (.ksplat) and by
torch.save, and loaded by `GaussianScene.load`; medians of 5, in seconds of the processor and of the clock.
Segmentation: each scene is written, read again, learnt from its noisy masks and scored on its test views, as
`benchmarks/results.py` does; differences from its PLY in points.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import gaussforge
import numpy as np
import torch
from machine import parser_of, processor
from results import markdown, score, segmented

from gsseg_core.data.dataset import Dataset
from gsseg_core.learn.registry import make_learner
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.scene_writers import write_scene

Write = Callable[[GaussianScene, Path], None]
RUNS = 5
# Format, how it is written, points of mIoU that it may cost, and seconds that a million may take.
FLOATS, BYTES = 0.3, 1.0


def write_ksplat(scene: GaussianScene, path: Path) -> None:
    """Write floats (level 0) by gaussforge."""
    ply = path.with_suffix(".ply")
    scene.save(ply)
    path.write_bytes(gaussforge.GaussForge().convert(ply.read_bytes(), "ply", "ksplat")["data"])
    ply.unlink()


def write_checkpoint(scene: GaussianScene, path: Path) -> None:
    """Write what gsplat's trainer saves."""
    logits = np.log(scene.opacities / (1 - scene.opacities))
    splats = {
        "means": scene.means, "quats": scene.quats, "scales": np.log(scene.scales), "opacities": logits,
        "sh0": scene.sh[:, :1].copy(), "shN": scene.sh[:, 1:].copy(),
    }  # fmt: skip
    torch.save({"step": 0, "splats": {name: torch.from_numpy(array) for name, array in splats.items()}}, path)


FORMATS: dict[str, tuple[str, Write, float, float | None]] = {
    "3DGS PLY": ("scene.ply", write_scene, FLOATS, None),
    "compressed PLY": ("scene.compressed.ply", write_scene, BYTES, 1.0),
    "SPZ 3": ("scene.spz", write_scene, BYTES, 1.0),
    "splat": ("scene.splat", write_scene, BYTES, None),
    "ksplat, level 0": ("scene.ksplat", write_ksplat, BYTES, 3.0),
    "GLB": ("scene.glb", write_scene, FLOATS, None),
    "gsplat checkpoint": ("scene.pt", write_checkpoint, FLOATS, None),
    "SOG": ("scene.sog", write_scene, BYTES, 3.0),
}


def main() -> None:
    """Measure and print both tables."""
    parser = parser_of(__doc__)
    parser.add_argument("--scenes", nargs="*", default=["shelf", "kitchen_table", "workbench", "replica_apartment"])
    parser.add_argument("--learner", default="em")
    parser.add_argument("--count", default=1_000_000, type=int)
    options = parser.parse_args()
    print(processor(), flush=True)
    if options.count:
        print(loading(repeated(GaussianScene.load(options.data / "fern" / "scene.ply"), options.count)), flush=True)
    if options.scenes:
        print(segmenting([options.data / name for name in options.scenes], options.learner))


def repeated(scene: GaussianScene, count: int) -> GaussianScene:
    """Lay copies of a scene side by side until there are `count` Gaussians."""
    vertices = np.resize(scene.vertices, count)
    vertices["x"] += np.arange(count) // len(scene) * np.float32(np.ptp(scene.means[:, 0]))
    return GaussianScene.from_vertices(vertices, None)


def loading(scene: GaussianScene) -> str:
    """Time the loading of a scene from every format."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name, (file, write, _, bar) in FORMATS.items():
            path = Path(folder) / file
            write(scene, path)
            seconds = [timed(path) for _ in range(RUNS)]
            cpu, clock = (statistics.median(column) for column in zip(*seconds, strict=True))
            size = path.stat().st_size / 1e6
            print(f"{name}: {cpu:.2f} s of the processor, {clock:.2f} s", flush=True)
            rows.append([name, f"{size:.0f}", f"{cpu:.2f}", f"{clock:.2f}", "" if bar is None else f"{bar:g}"])
            path.unlink()
    return markdown([f"loading {len(scene):,}", "MB", "s of the processor", "s of the clock", "bar"], rows)


def timed(path: Path) -> tuple[float, float]:
    cpu, clock = time.process_time(), time.perf_counter()
    GaussianScene.load(path)
    return time.process_time() - cpu, time.perf_counter() - clock


def segmenting(folders: list[Path], learner: str) -> str:
    """Score the segmentation of every scene out of every format."""
    columns = []
    for folder in folders:
        scene, found = GaussianScene.load(folder / "scene.ply"), []
        with tempfile.TemporaryDirectory() as out:
            for name, (file, write, _, _) in FORMATS.items():
                path = Path(out) / file
                write(scene, path)
                found.append(mean_iou(GaussianScene.load(path), folder, learner))
                print(f"{folder.name}, {name}: {found[-1]:.4f}", flush=True)
        columns.append(found)
    rows = []
    for i, (name, (_, _, bar, _)) in enumerate(FORMATS.items()):
        cells = [f"{100 * found[i]:.1f}" if i == 0 else f"{100 * (found[i] - found[0]):+.2f}" for found in columns]
        rows.append([name, *cells, f"{bar:g}"])
    return markdown([f"mIoU, {learner}", *(folder.name for folder in folders), "bar"], rows)


def mean_iou(scene: GaussianScene, folder: Path, name: str) -> float:
    data = Dataset(folder, "labels_noisy")
    learner = make_learner(name, scene, data.num_classes)
    learner.observe_all(data.views("train"))
    return score(segmented(learner.fit(), data.class_names), scene, Dataset(folder).views("test")).mean_iou


if __name__ == "__main__":
    main()
