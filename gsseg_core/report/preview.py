"""The 3D preview of the report page: some of the Gaussians in few bytes, and places to look at them from."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from gsseg_core.csr_rows import CSRRows, largest
from gsseg_core.data.object_tree import ObjectTree
from gsseg_core.learn.temperature import tempered_rows
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import UNOBSERVED, Segmentation
from gsseg_core.spatial.row_order import rows_by_label

MOST_GAUSSIANS = 60_000  # of the preview; 20 bytes each, a third more as text
FEWEST_OF_CLASS = 200  # Gaussians of a class that are kept before the class is thinned out
CORE = 0.01  # share of the Gaussians at either end of each axis that do not count for where the scene lies
LARGEST_GROWTH = 3.0  # factor by which a Gaussian that stands for others becomes larger, at most
RECORD = np.dtype(
    [
        ("position", "<u2", 3), ("label", "<u2"), ("quat", "i1", 4), ("scale", "u1", 3), ("opacity", "u1"),
        ("color", "u1", 3), ("confidence", "u1"),
    ]
)  # fmt: skip
"""A Gaussian as `page.js` reads it; 0 to the largest number of each type stands for the range in the header."""


@dataclass(frozen=True, eq=False)
class Preview:
    """Gaussians to look at.

    Positions are within `low` to `high`, scales as logarithms within `log_scales`, quaternions w, x, y, z. The label of
    a record is a place in `labels`. These are as in the segmentation, or nodes of its tree; the number of all of these
    where unobserved; and where removed, that number + 1 more than the most probable one.
    """

    records: np.ndarray  # (M,) RECORD
    labels: np.ndarray  # (L,) int64: those that occur, ascending; of all, there may be more than a record can number
    low: np.ndarray  # (3,) float64: the box that holds them, in scene units
    high: np.ndarray  # (3,) float64
    core: np.ndarray  # (2, 3) float64: corners of the box that holds all but those around the scene, to be looked at
    log_scales: np.ndarray  # (2,) float64: natural logarithms of the smallest and the largest scale
    left_out: int  # Gaussians of the scene that are not among them

    def header(self) -> dict[str, Any]:
        """Give what is needed to read the records, for JSON."""
        return {
            "count": len(self.records),
            "labels": self.labels.tolist(),
            "low": self.low.tolist(),
            "high": self.high.tolist(),
            "core": self.core.tolist(),
            "logScales": self.log_scales.tolist(),
        }

    def as_text(self) -> str:
        """Encode the records in base64."""
        return base64.b64encode(self.records.tobytes()).decode("ascii")


def make_preview(
    scene: GaussianScene, segmentation: Segmentation, most: int = MOST_GAUSSIANS, parts: bool = False
) -> Preview:
    """Choose the Gaussians that show most of the scene, and quantise them, labelled by class, or by part if asked for.

    `most` are drawn at random, large and opaque ones rather than small and faint ones, always the same. The less likely
    one was to be drawn, the more others it stands for, and the larger it is made, so that surfaces stay closed. A class
    keeps `FEWEST_OF_CLASS` of its own. Those far from all others, walls and sky behind what was captured, come as near
    and become as small as leaves them where and as large as cameras see them.
    """
    core = _core(scene.means)
    a, b, c = scene.scales.T.astype(np.float64)
    area = np.maximum(np.maximum(a * b, b * c), a * c)
    tree, labels, first = segmentation.tree if parts else None, segmentation.labels, segmentation.num_classes
    if tree is not None:
        labels, first = tree.labels_at(1.0, labels), len(tree)
    picked, chance = _draw(np.sqrt(area) * scene.opacities, labels, most)
    labels, shares, nodes = labels[picked], segmentation.shares.take(picked), segmentation.class_ids
    if tree is not None:
        shares, nodes = _of_parts(shares, segmentation.temperature, tree, picked)
    confidence, column = largest(shares)
    means, nearer = _contracted(scene.means[picked].astype(np.float64), core)
    low, high = (means.min(axis=0), means.max(axis=0)) if len(means) else core
    sizes = scene.scales[picked] * (nearer * np.minimum(chance**-0.5, LARGEST_GROWTH))[:, None]
    # One Gaussian alone extends no farther than it is large.
    extent = max(float((high - low).max()) or float(sizes.max(initial=0)), 1e-9)
    # Gaussians thinner than a thousandth of a pixel of any screen look like those that are not.
    logs = np.log(np.clip(sizes, 1e-5 * extent, extent))
    log_scales = np.array([logs.min(), logs.max()] if len(logs) else [0.0, 1.0], np.float64)
    others = first + np.where(labels == UNOBSERVED, 0, 1 + nodes[np.maximum(column, 0)])
    records = np.zeros(len(picked), RECORD)
    records["position"] = _quantised(means, low, high, 65535)
    used, records["label"] = np.unique(np.where(labels < 0, others, labels), return_inverse=True)
    records["quat"] = np.rint(127 * scene.quats[picked])
    records["scale"] = _quantised(logs, log_scales[0], log_scales[1], 255)
    records["opacity"] = np.rint(255 * scene.opacities[picked])
    records["color"] = np.rint(255 * np.clip(scene.colors(ids=picked), 0, 1))
    records["confidence"] = np.rint(255 * np.clip(confidence, 0, 1))
    return Preview(records, used.astype(np.int64), low, high, core, log_scales, len(scene) - len(picked))


def _of_parts(shares: CSRRows, temperature: float, tree: ObjectTree, ids: np.ndarray) -> tuple[CSRRows, np.ndarray]:
    """Turn probabilities (M, K) of Gaussians (M,) into those of the finest parts, (M, K'), and name their nodes, (K',).

    They are those of `Segmentation.at`, which takes the time for all N.
    """
    of_parts, nodes = tree.shares_at(1.0, tempered_rows(shares, 1 / temperature), tree.leaves[ids])
    return tempered_rows(of_parts, temperature), np.array(nodes)


def look_from(cameras: Iterable[Camera], preview: Preview) -> list[dict[str, Any]]:
    """Describe cameras for the preview: where they are, what they look at, and how wide.

    Each has a `name`; `eye` and `target` (3,), in scene units; and `fov`, vertical, in radians.
    """
    low, high = preview.low, preview.high
    half = float(np.linalg.norm(preview.core[1] - preview.core[0])) / 2
    # A distance is a quantile of depths: one in eight of many says it as well.
    some = preview.records[:: 8 if len(preview.records) > MOST_GAUSSIANS // 8 else 1]
    means = low + some["position"] * ((high - low) / 65535)
    places = []
    for camera in cameras:
        (uv, depth), size = camera.project(means), (camera.width, camera.height)
        # Around the middle of the image; what is nearest there may be a floater.
        central = (depth > 0) & (np.abs(np.nan_to_num(uv, nan=np.inf) / size - 0.5) < 0.2).all(axis=1)
        distance = float(np.quantile(depth[central], 0.25)) if central.any() else half
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


def _core(means: np.ndarray) -> np.ndarray:
    """Find the box, (2, 3), that holds all Gaussians of means (N, 3) but those far from the others."""
    outer = np.quantile(means[:: max(len(means) // 50_000, 1)], [CORE, 1 - CORE], axis=0).astype(np.float64)
    margin = 0.15 * (outer[1] - outer[0]).max()
    low, high = np.transpose([(column.min(), column.max()) for column in means.T])  # in a tenth of the time of axis 0
    return np.array([np.maximum(outer[0] - margin, low), np.minimum(outer[1] + margin, high)])


def _contracted(means: np.ndarray, core: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Move what is far from the core (2, 3) towards its middle: means (M, 3) and, (M,), how much nearer each is.

    By the contraction of mip-NeRF 360 (Barron et al. 2022, eq. 10): within a sphere around the core nothing moves, and
    the infinite comes to twice its radius.
    """
    middle, radius = core.mean(axis=0), max(float(np.linalg.norm(core[1] - core[0])) / 2, np.finfo(float).tiny)
    offsets = means - middle
    ratio = radius / np.maximum(np.linalg.norm(offsets, axis=1), radius)
    nearer = ratio * (2 - ratio)
    return np.where(nearer[:, None] < 1, middle + offsets * nearer[:, None], means), nearer


def _draw(weights: np.ndarray, labels: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Draw `most` of N without replacement, by weights (N,), the first few of each label (N,) before all.

    By Efraimidis and Spirakis (2006): the largest of u^(1 / w). Returns which, (M,) int64, ascending, and how likely
    each was to be drawn, (M,) float64 in (0, 1].
    """
    if len(weights) <= most:
        return np.arange(len(weights)), np.ones(len(weights))
    weights = np.maximum(weights, 1e-300)  # No key is infinite.
    keys = np.random.default_rng(0).exponential(size=len(weights)) / weights
    limits = np.zeros(len(weights))  # Who has a smaller key is drawn.
    for own in rows_by_label(labels).values():
        limits[own] = _limit(keys[own], FEWEST_OF_CLASS)
    first = keys < limits
    if first.sum() > most:
        limits = np.where(first, _limit(np.where(first, keys, np.inf), most), 0.0)
    else:
        limits = np.maximum(limits, _limit(np.where(first, np.inf, keys), most - int(first.sum())))
    picked = np.flatnonzero(keys < limits)
    return picked, -np.expm1(-weights[picked] * limits[picked])


def _limit(keys: np.ndarray, count: int) -> float:
    """Find what so many of the keys are smaller than; infinity, if there are no more."""
    return float(np.partition(keys, count)[count]) if count < len(keys) else np.inf


def _quantised(values: np.ndarray, low: Any, high: Any, largest: int) -> np.ndarray:
    spans = np.maximum(np.asarray(high) - low, 1e-12)
    return np.rint((values - low) / spans * largest)
