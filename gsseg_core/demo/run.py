"""The demo: a table-top scene with known truth, segmented from masks that are wrong as real ones are."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from gsseg_core import pipeline
from gsseg_core.demo.table_scene import DemoScene, build_demo
from gsseg_core.learn.learner import Progress, silent
from gsseg_core.learn.registry import check_seed
from gsseg_core.metrics import evaluate_folders, iou
from gsseg_core.progress import Stopwatch
from gsseg_core.segmentation import Segmentation
from gsseg_core.text import counted, percent, seconds_table, table


def run_demo(out: str | os.PathLike[str], *, seed: int = 0, progress: Progress = silent) -> str:
    """Build the scene, run `segment`, `render` and `eval` on it, and say in tables how well it went."""
    check_seed(seed)
    out = Path(out)
    watch = Stopwatch()
    with watch.stage("build the scene"):
        demo = build_demo(out / "scene", seed)
    report = pipeline.segment(demo.root / "scene.ply", demo.root, out / "segmented", seed=seed, progress=progress)
    watch.seconds.update(report["seconds"])
    with watch.stage("render test views"):
        pipeline.render(
            demo.root / "scene.ply", demo.root, out / "segmented/segmentation.npz", out / "rendered", progress=progress
        )
    with watch.stage("score"):
        scores = evaluate_folders(out / "rendered", demo.root / "labels_true").as_dict(demo.class_names)
        ious = gaussian_ious(demo, out / "segmented/segmentation.npz")
    images = {entry["id"]: entry["iou"] for entry in scores["classes"]}
    rows = [
        [entry["name"], f"{entry['gaussians']:,}", percent(ious[entry["id"]]), percent(images.get(entry["id"]))]
        for entry in report["classes"]
    ]
    return "\n\n".join(
        [
            seconds_table(watch.seconds),
            table(["class", "Gaussians", "IoU of Gaussians", "IoU in test views"], rows),
            f"{counted(report['views']['used'], 'view')} with missed, swapped and frayed masks; scored on "
            f"{counted(scores['views'], 'other')} against the truth: mIoU {percent(scores['mean_iou'])}, "
            f"mAcc {percent(scores['mean_accuracy'])}, boundary IoU {percent(scores['mean_boundary_iou'])}",
            f"Look at: {out}/segmented/report.html and {out}/rendered/overlays\n"
            f"Objects: {out}/segmented/classes, PLYs for 3DGS viewers",
        ]
    )


def gaussian_ious(demo: DemoScene, segmentation: Path) -> list[float]:
    """IoU of each class with the truth, over the Gaussians that belong to something."""
    labels, truth = Segmentation.load(segmentation, demo.scene).labels, demo.truth
    real = truth >= 0
    parts = truth[real & (labels == truth)], truth[real], labels[real & (labels >= 0)]
    return iou(*(np.bincount(part, minlength=len(demo.class_names)) for part in parts)).tolist()
