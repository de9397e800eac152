"""Measure what docs/results.md shows, and write it: every learner and the whole command, on every scene.

Usage: python benchmarks/results.py [--data FOLDER] [--out docs/results.md]

FOLDER holds the scenes (default: the environment variable GSSEG_DATA, else ../shared/data); those that are absent are
left out. Nothing of it is copied.
"""

from __future__ import annotations

import os
import platform
import statistics
import sys
import tempfile
import time
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from children import finish, seconds_of
from jobs import hard_votes
from machine import REPOSITORY, parser_of, processor
from report import markdown
from scenes import REAL

from gsseg_core.data.dataset import Dataset
from gsseg_core.data.view import View
from gsseg_core.files.atomic import write_atomically
from gsseg_core.learn.em.em_learner import EMLearner, EMSettings
from gsseg_core.learn.learner import Learner
from gsseg_core.learn.registry import make_learner
from gsseg_core.metrics import Evaluation, evaluate_folders
from gsseg_core.raster.backends import make_operator
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import Segmentation

MASKS = {"labels": "true masks", "labels_noisy": "wrong masks"}
RUNS = 3


def main() -> int:
    """Measure and write."""
    parser = parser_of(__doc__)
    parser.add_argument("--out", default=REPOSITORY / "docs/results.md", type=Path)
    options = parser.parse_args()
    learners: list[list[str]] = []
    commands: list[list[str]] = []
    for name in REAL:
        folder = options.data / name
        if folder.is_dir():
            learners += learn_all(folder)
            commands += command(folder)
        else:
            print(f"{folder}: not there, and so not measured")
    if not learners:
        return 1
    columns = ["mIoU", "mAcc", "boundary IoU", "s"]
    header = ["scene", "learner", *(f"{kind}: {column}" for kind in MASKS.values() for column in columns)]
    sections = [
        HEADER.format(machine=machine()),
        LEARNERS.format(table=markdown(header, learners)),
        COMMAND.format(table=markdown(COMMAND_COLUMNS, commands)),
    ]
    write_page(options.out, "\n".join(sections))
    return 0


def learn_all(folder: Path) -> list[list[str]]:
    """Learn a scene with every learner from both mask sets, and score rendered label maps of the test views: rows."""
    scene, truth = GaussianScene.load(folder / "scene.ply"), Dataset(folder).views("test")
    rows = []
    for name in ("votes", "votes made hard", "gradient", "em without error model", "em"):
        row = [folder.name, name]
        for masks, kind in MASKS.items():
            data = Dataset(folder, masks)
            start = time.perf_counter()
            codes = learn(name, scene, data)
            seconds = time.perf_counter() - start
            scores = score(Segmentation.from_codes(scene, codes, data.class_names), scene, truth)
            print(f"{folder.name}, {name}, {kind}: mIoU {scores.mean_iou:.4f}, {seconds:.1f} s", flush=True)
            row += map(points, (scores.mean_iou, scores.mean_accuracy, scores.mean_boundary_iou))
            row.append(f"{seconds:.1f}")
        rows.append(row)
    return rows


def learn(name: str, scene: GaussianScene, data: Dataset) -> np.ndarray:
    """Codes by one learner from all train views."""
    learner: Learner
    if name == "em without error model":
        learner = EMLearner(scene, data.num_classes, EMSettings(errors=False))
    else:
        learner = make_learner(name.split()[0], scene, data.num_classes)
    for view in data.views("train"):
        learner.observe(view)
    codes: np.ndarray = learner.fit().codes_
    if name == "votes made hard":
        return hard_votes(codes, bias=0.0)
    return codes


def segmented(learner: Learner, class_names: Mapping[int, str]) -> Segmentation:
    """Refine what a learner has learnt, and label all Gaussians."""
    return Segmentation.from_codes(learner.scene, learner.codes_, class_names, evidence=learner.evidence())


def score(result: Segmentation, scene: GaussianScene, truth: Iterable[View]) -> Evaluation:
    """Score rendered label maps against the true labels of views."""
    evaluation = Evaluation()
    for view in truth:
        evaluation.add(view.read_labels(), result.render(make_operator(scene, view.camera)).labels, view.name)
    return evaluation


def command(folder: Path) -> list[list[str]]:
    """Time the whole command in processes of its own, and score what it wrote: a row for each kind of masks."""
    rows = []
    for masks in MASKS:
        with tempfile.TemporaryDirectory() as out:
            gsseg, on = [sys.executable, "-m", "gsseg_core.cli"], [str(folder / "scene.ply"), "--data", str(folder)]
            segment = [*gsseg, "segment", *on, "--labels", masks, "--out", f"{out}/out", "--quiet"]
            seconds = [seconds_of(segment) for _ in range(RUNS)]
            segmentation = ["--segmentation", f"{out}/out/segmentation.npz"]
            finish([*gsseg, "render", *on, *segmentation, "--out", f"{out}/test", "--quiet"])
            scores = evaluate_folders(f"{out}/test", folder / "labels")
        values = (scores.mean_iou, scores.mean_accuracy, scores.mean_boundary_iou)
        rows.append([folder.name, MASKS[masks], f"{statistics.median(seconds):.1f}", *map(points, values)])
        print(*rows[-1], sep=", ", flush=True)
    return rows


def points(value: float) -> str:
    """Write a ratio with three decimals."""
    return f"{value:.3f}"


def write_page(path: Path, text: str) -> None:
    """Write what was measured, whole or not at all, and say where it is."""
    with write_atomically(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    print(path)


def machine() -> str:
    """Name the processor, its cores and the versions."""
    return f"{processor()}, {os.cpu_count()} cores, Python {platform.python_version()}, NumPy {np.__version__}"


HEADER = """# Results

`make results` (`python benchmarks/results.py`) measures everything on this page again and writes it.
Machine: {machine}.

`replica_apartment` is one floor of a real scanned apartment (Replica `apartment_0`): 126,507 Gaussians trained by
OpenSplat, 40 objects, 105 views of 320 x 320 to learn from and 14 to score on. The other three scenes were composed
from freely available splats of objects that touch, stand on and hide each other, and trained anew from renderings of
that: 33,000 to 95,000 Gaussians, 12 to 16 objects, 66 views to learn from and 12 to score on. In the wrong masks, every
view misses 15 % of the objects, has 10 % under another id, and has edges off by up to 3 px. All scores compare the test
views with their true masks; no learner saw either.

The settings of `em` were chosen on held-out train views of all development scenes together, or compared there with
other values ([em_settings.md](em_settings.md)); none was chosen on test views.

Other tables: [regret.md](regret.md) shows which step of `em` helps where, [clean_objects.md](clean_objects.md) compares
refinements of cut-out objects, and [ids.md](ids.md) covers masks without common ids.
"""

LEARNERS = """## Learners

Scores are those of rendered label maps, without refinement. "Votes made hard" is FlashSplat's rule without its
background bias. Seconds cover reading and preparing the views, and learning.

{table}
"""

COMMAND_COLUMNS = ["scene", "masks", f"seconds, median of {RUNS}", "mIoU", "mAcc", "boundary IoU"]
COMMAND = """## The whole command

```bash
gsseg segment replica_apartment/scene.ply --data replica_apartment --out out
```

The command runs in its own process with kernels already compiled, and includes refinement, export, pictures and report.
`gsseg render` and `gsseg eval` then score it on the test views.

{table}

## What is measured

Scores are per class, over all test views together. IoU is intersection / union of pixels. Accuracy is the share of the
class's true pixels that were found. Boundary IoU is the IoU of bands along the inside of the outlines, as wide as 2 %
of the image diagonal. mIoU averages all ids that occur in the truth or in the prediction, mAcc those in the truth.
"""

if __name__ == "__main__":
    sys.exit(main())
