"""Run NVOS, SPIn-NeRF or LERF-Mask on a scene of theirs, and print the scores; docs/evaluation.md says what they are.

Usage: python benchmarks/evaluate_protocol.py nvos      SCENE.ply --data DATASET --masks ROOT --name fern
       python benchmarks/evaluate_protocol.py spin-nerf SCENE.ply --data DATASET --masks FOLDER
       python benchmarks/evaluate_protocol.py lerf-mask SCENE.ply --data FOLDER --segmentation OUT/segmentation.npz

DATASET holds the cameras of the scene. Of LERF-Mask the masks come with the cameras, and what is scored is a
segmentation whose classes are named by the prompts (a classes.json beside the masks that it was learnt from).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from protocols import Scores, Task, lerf_mask, nvos, score_task, spin_nerf
from results import markdown, points

from gsseg_core.data.camera_files import read_cameras
from gsseg_core.errors import GssegError, SettingsError
from gsseg_core.objects.pick import pick_mask
from gsseg_core.raster.backends import make_operator
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import Segmentation


def main(arguments: list[str] | None = None) -> int:
    """Evaluate, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("protocol", choices=("nvos", "spin-nerf", "lerf-mask"))
    parser.add_argument("scene", type=Path)
    parser.add_argument("--data", required=True, type=Path, help="folder with the cameras")
    parser.add_argument("--masks", type=Path, help="folder with the masks (default: that with the cameras)")
    parser.add_argument("--name", help="nvos: name of the scene")
    parser.add_argument("--segmentation", type=Path, help="lerf-mask: what to score")
    options = parser.parse_args(arguments)
    try:
        print(table(evaluate(options)))
    except GssegError as error:
        print(f"evaluate_protocol: error: {error}", file=sys.stderr)
        return 2
    return 0


def evaluate(options: argparse.Namespace) -> dict[str, Scores]:
    """Scores by object."""
    scene, cameras = GaussianScene.load(options.scene), read_cameras(options.data)
    masks = options.masks or options.data
    if options.protocol == "lerf-mask":
        if options.segmentation is None:
            raise SettingsError("lerf-mask: no --segmentation; expected one whose classes are named by the prompts")
        result = Segmentation.load(options.segmentation, scene)
        return {task.name: score_task(task, class_mask(scene, result, task.name)) for task in lerf_mask(masks, cameras)}
    if options.protocol == "nvos" and not options.name:
        raise SettingsError("nvos: no --name; expected a scene such as fern")
    task = nvos(masks, options.name, cameras) if options.protocol == "nvos" else spin_nerf(masks, cameras)
    return {task.name: score_task(task, picked_mask(scene, task))}


def picked_mask(scene: GaussianScene, task: Task) -> Callable[[Camera], np.ndarray]:
    """Pick the object of a task by its reference view."""
    if task.reference is None:
        raise SettingsError(f"{task.name}: shows the object nowhere; expected a reference view")
    picked = pick_mask(scene, task.reference)
    return lambda camera: picked.silhouette(scene, camera)


def class_mask(scene: GaussianScene, result: Segmentation, prompt: str) -> Callable[[Camera], np.ndarray]:
    """Where the class of that name is the strongest."""
    ids = [k for k, name in result.class_names.items() if name == prompt]
    if not ids:
        raise SettingsError(f"prompt {prompt!r}: no class of that name; found {', '.join(result.class_names.values())}")
    return lambda camera: np.isin(result.render(make_operator(scene, camera)).labels, ids)


def table(scores: dict[str, Scores]) -> str:
    """One line an object, and their mean."""
    names = ["IoU", "accuracy", "boundary IoU", "IoU of all views together"]
    rows = [[name, str(score.views), *map(points, score[:4])] for name, score in scores.items()]
    means = np.mean([score[:4] for score in scores.values()], axis=0)
    if len(rows) > 1:
        rows.append(["mean", "", *(points(float(value)) for value in means)])
    return markdown(["object", "views", *names], rows)


if __name__ == "__main__":
    sys.exit(main())
