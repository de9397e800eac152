"""The 3D preview of the report page: some of the Gaussians in few bytes, and places to look at them from."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import UNOBSERVED, Segmentation

MOST_GAUSSIANS = 60_000
"""In the preview; 20 bytes each, a third more as text."""
FEWEST_OF_CLASS = 200
"""Gaussians of a class that the preview keeps before it thins the class out."""
CORE = 0.01
"""Share of the Gaussians at either end of each axis that does not count for where the scene lies."""

RECORD = np.dtype(
    [
        ("position", "<u2", 3), ("label", "<u2"), ("quat", "i1", 4), ("scale", "u1", 3), ("opacity", "u1"),
        ("color", "u1", 3), ("confidence", "u1"),
    ]
)  # fmt: skip
"""A Gaussian as report_page.js reads it; 0 to the largest number of each type stands for the range in the header."""


@dataclass(frozen=True, eq=False)
class Preview:
    """Gaussians to look at.

    Attributes
    ----------
    records : (M,) RECORD
        Positions within `low` to `high`, scales as logarithms within `log_scales`, quaternions w, x, y, z; labels as
        in the segmentation, `first` where unobserved, and where removed `first` + 1 more than the most probable class.
    low, high : (3,) float64
        The box that holds them, in scene units.
    log_scales : (2,) float64
        Natural logarithms of the smallest and the largest scale.
    left_out : int
        Gaussians of the scene that are not among them.
    """

    records: np.ndarray
    low: np.ndarray
    high: np.ndarray
    log_scales: np.ndarray
    left_out: int

    def header(self) -> dict[str, Any]:
        """Give what is needed to read the records, for JSON."""
        return {
            "count": len(self.records),
            "low": self.low.tolist(),
            "high": self.high.tolist(),
            "logScales": self.log_scales.tolist(),
        }

    def as_text(self) -> str:
        """Encode the records in base64."""
        return base64.b64encode(self.records.tobytes()).decode("ascii")


def make_preview(
    scene: GaussianScene, segmentation: Segmentation, most: int = MOST_GAUSSIANS, first: int | None = None
) -> Preview:
    """Choose the Gaussians that show most of the scene, and quantise them; `first` is the number of classes by default.

    Those that lie far from all others are left out. Of the others, `most` are drawn at random, large and opaque ones
    rather than small and faint ones, always the same; they are made larger so that surfaces stay closed. A class keeps
    `FEWEST_OF_CLASS` of its own.
    """
    outer = np.quantile(scene.means[:: max(len(scene) // 50_000, 1)], [CORE, 1 - CORE], axis=0).astype(np.float64)
    margin = 0.15 * (outer[1] - outer[0]).max()
    near = np.flatnonzero(((scene.means >= outer[0] - margin) & (scene.means <= outer[1] + margin)).all(axis=1))
    area = np.prod(np.sort(scene.scales[near], axis=1)[:, 1:], axis=1, dtype=np.float64)
    labels = segmentation.labels[near]
    chosen = _draw(np.sqrt(area) * scene.opacities[near], labels, most)
    growth = float(np.sqrt(area.sum() / max(area[chosen].sum(), np.finfo(float).tiny)))
    picked = near[chosen]
    means = scene.means[picked].astype(np.float64)
    low, high = (means.min(axis=0), means.max(axis=0)) if len(means) else outer
    extent = max(float((high - low).max()), 1e-9)
    # Gaussians thinner than a thousandth of a pixel of any screen look like those that are not.
    logs = np.log(np.clip(scene.scales[picked] * min(growth, 3.0), 1e-5 * extent, extent))
    log_scales = np.array([logs.min(), logs.max()] if len(logs) else [0.0, 1.0], np.float64)
    covered = 1 + segmentation.class_ids[segmentation.probabilities[picked].argmax(axis=1)]
    others = (segmentation.num_classes if first is None else first) + np.where(labels[chosen] == UNOBSERVED, 0, covered)
    records = np.zeros(len(picked), RECORD)
    records["position"] = _quantised(means, low, high, 65535)
    records["label"] = np.where(labels[chosen] < 0, others, labels[chosen])
    records["quat"] = np.rint(127 * scene.quats[picked])
    records["scale"] = _quantised(logs, log_scales[0], log_scales[1], 255)
    records["opacity"] = np.rint(255 * scene.opacities[picked])
    records["color"] = np.rint(255 * np.clip(scene.colors()[picked], 0, 1))
    records["confidence"] = np.rint(255 * np.clip(segmentation.confidence[picked], 0, 1))
    return Preview(records, low, high, log_scales, len(scene) - len(picked))


def look_from(cameras: Iterable[Camera], preview: Preview) -> list[dict[str, Any]]:
    """Describe cameras for the preview: where they are, what they look at, and how wide.

    Returns
    -------
    list of dict
        `name`; `eye` and `target` (3,), in scene units; `fov`, vertical, in radians.
    """
    low, high = preview.low, preview.high
    # A distance is a quantile of depths: one in eight of many says it as well.
    some = preview.records[:: 8 if len(preview.records) > MOST_GAUSSIANS // 8 else 1]
    means = low + some["position"] * ((high - low) / 65535)
    places = []
    for camera in cameras:
        (uv, depth), size = camera.project(means), (camera.width, camera.height)
        # Around the middle of the image; what is nearest there may be a floater.
        central = (depth > 0) & (np.abs(np.nan_to_num(uv, nan=np.inf) / size - 0.5) < 0.2).all(axis=1)
        distance = float(np.quantile(depth[central], 0.25)) if central.any() else float(np.linalg.norm(high - low)) / 2
        places.append(
            {
                "name": camera.name,
                "eye": camera.center.tolist(),
                "target": (camera.center + distance * camera.world_to_camera[2, :3]).tolist(),
                "fov": 2 * float(np.arctan2(camera.height / 2, camera.fy)),
            }
        )
    return places


def up_of(cameras: Iterable[Camera]) -> list[float]:
    """Guess which way is up, (3,) of length 1: people hold cameras upright."""
    up = -np.sum([camera.world_to_camera[1, :3] for camera in cameras] or [np.zeros(3)], axis=0)
    length = float(np.linalg.norm(up))
    return (up / length).tolist() if length > 1e-6 else [0.0, -1.0, 0.0]


def _draw(weights: np.ndarray, labels: np.ndarray, most: int) -> np.ndarray:
    """Draw `most` of M without replacement, by weights (M,), the first few of each label (M,) before all; ascending.

    By Efraimidis and Spirakis (2006): the largest of u^(1 / w).
    """
    if len(weights) <= most:
        return np.arange(len(weights))
    keys = np.random.default_rng(0).exponential(size=len(weights)) / np.maximum(weights, np.finfo(float).tiny)
    wanted = np.zeros(len(weights), bool)
    for label in np.flatnonzero(np.bincount(labels - labels.min())) + labels.min():
        own = np.flatnonzero(labels == label)
        wanted[own[_smallest(keys[own], FEWEST_OF_CLASS)]] = True
    first = np.flatnonzero(wanted)
    if len(first) > most:
        return np.sort(first[_smallest(keys[first], most)])
    others = np.flatnonzero(~wanted)
    return np.sort(np.concatenate([first, others[_smallest(keys[others], most - len(first))]]))


def _smallest(keys: np.ndarray, count: int) -> np.ndarray:
    """Find the places of so many of the smallest keys, in any order; of all, if there are no more."""
    return np.argpartition(keys, count)[:count] if count < len(keys) else np.arange(len(keys))


def _quantised(values: np.ndarray, low: Any, high: Any, largest: int) -> np.ndarray:
    spans = np.maximum(np.asarray(high) - low, 1e-12)
    steps: np.ndarray = np.rint((values - low) / spans * largest)
    return steps
