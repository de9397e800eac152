"""Tell how much of what wrong outlines cost is chance: learn from the same views drawn wrong once, and several times.

Usage: python benchmarks/more_draws.py [--data FOLDER]

Every draw is of all train views anew, with the edges of all objects off by up to 3 px and no other error. What more
draws take away is chance; what is left however many there are is not. Prints mIoU in the test views of the real scene,
with outlines left where they are and with outlines moved to edges of the scene, and what was lost against true masks,
in points. FOLDER holds `replica_apartment/` (default: the environment variable GSSEG_DATA, else ../shared/data). Four
minutes on two cores.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from machine import parser_of
from results import markdown, points, score, segmented
from view_errors import corrupt_views
from wrong_masks import WrongMasks

from gsseg_core.data.dataset import Dataset
from gsseg_core.data.view import View
from gsseg_core.learn.em.em_learner import EMLearner, EMSettings
from gsseg_core.scene.gaussian_scene import GaussianScene

DRAWS = (1, 3, 6)
EDGES_OFF = WrongMasks(missed=0.0, swapped=0.0, missed_label=None)


def main() -> int:
    """Measure and print."""
    real = parser_of(__doc__).parse_args().data / "replica_apartment"
    if not real.is_dir():
        print(f"{real}: not there; nothing measured")
        return 0
    scene, data = GaussianScene.load(real / "scene.ply"), Dataset(real)
    rows = []
    for edge_px in (0, EMSettings().edge_px):
        clean = learnt(scene, data, data.views("train"), edge_px)
        rows.append([f"{edge_px}", "true masks", points(clean), ""])
        for draws in DRAWS:
            miou = learnt(scene, data, drawn(data.views("train"), draws), edge_px)
            rows.append([f"{edge_px}", f"{draws}", points(miou), f"{100 * (clean - miou):.1f}"])
            print(*rows[-1], flush=True)
    print(markdown(["edge_px", "draws", "mIoU", "points lost"], rows))
    return 0


def drawn(views: Sequence[View], draws: int) -> list[View]:
    """Draw all views wrong several times, under a name of its own each time."""
    wrong = []
    for seed in range(draws):
        for view in corrupt_views(views, seed, EDGES_OFF):
            camera = replace(view.camera, name=f"{view.name}, draw {seed}")
            wrong.append(View.from_arrays(camera, view.read_labels()))
    return wrong


def learnt(scene: GaussianScene, data: Dataset, views: Sequence[View], edge_px: int) -> float:
    """Learn from views, and return mIoU in the test views."""
    learner = EMLearner(scene, data.num_classes, EMSettings(edge_px=edge_px))
    learner.observe_all(views)
    return score(segmented(learner.fit(), data.class_names), scene, data.views("test")).mean_iou


if __name__ == "__main__":
    raise SystemExit(main())
