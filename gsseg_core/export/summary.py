"""What `report.json` says of a run."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

import numpy as np

from gsseg_core.objects.oriented_boxes import object_boxes
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import REMOVED, UNOBSERVED, Segmentation


def build_report(
    scene: GaussianScene,
    result: Segmentation,
    *,
    views: Mapping[str, Any],
    settings: Mapping[str, Any],
    seconds: Mapping[str, float],
    plys: Mapping[int, str],
    objective: Sequence[float] = (),
    pictures: Sequence[str] = (),
) -> dict[str, Any]:
    """Put together what a run found, from what, with which settings, and how long it took.

    Parameters
    ----------
    scene : GaussianScene
        What was segmented.
    result : Segmentation
        What came out.
    views : mapping
        How many were used, and why others were not.
    settings : mapping
        All that determined the result.
    seconds : mapping
        Seconds per stage.
    plys : mapping from class id to str
        File of each class that has one.
    objective : sequence of float
        The learner's objective after each step.
    pictures : sequence of str
        Files.
    """
    return {
        "scene": {"path": str(scene.path), "gaussians": len(scene), "digest": scene.digest},
        "views": dict(views),
        "settings": dict(settings),
        "objective": list(objective),
        "gaussians": gaussian_counts(result),
        "classes": _class_table(scene, result, plys),
        "pictures": list(pictures),
        "seconds": {name: round(value, 3) for name, value in seconds.items()},
        "versions": _versions(),
    }


def gaussian_counts(result: Segmentation) -> dict[str, int]:
    """Count the Gaussians by what became of them."""
    return {
        "labelled": int((result.labels >= 0).sum()),
        "unobserved": int((result.labels == UNOBSERVED).sum()),
        "removed": int((result.labels == REMOVED).sum()),
        "from_neighbours": int(result.clustered.sum()),
    }


def _class_table(scene: GaussianScene, result: Segmentation, plys: Mapping[int, str]) -> list[dict[str, Any]]:
    counts, confidence, boxes = result.counts(), result.confidence, object_boxes(scene, result)
    total = np.bincount(
        result.labels[result.labels >= 0], weights=confidence[result.labels >= 0], minlength=result.num_classes
    )
    return [
        {
            "id": k,
            "name": name,
            "gaussians": int(counts[k]),
            "mean_confidence": round(float(total[k] / counts[k]), 4) if counts[k] else None,
            "ply": plys.get(k),
            "box": boxes[k].as_dict() if k in boxes else None,
        }
        for k, name in result.class_names.items()
    ]


def _versions() -> dict[str, str]:
    packages = {name: version(name) for name in ("gsseg", "numpy", "scipy", "numba")}
    return {"python": platform.python_version(), **packages}
