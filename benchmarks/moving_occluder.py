"""Views in which somebody stands before the scene, elsewhere in each, with the depth that a camera beside measures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from gsseg_core.data.view import View
from gsseg_core.demo.furniture import Part, furnish
from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.depth import surface
from gsseg_core.raster.depth_gating import gate_view
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene

NOISE, MISSING = 0.01, 0.03
"""Standard deviation of a measured depth, as a share of it, and share of the pixels that have none."""

DepthOf = Callable[[Camera], np.ndarray]
"""True depth (H, W) of a view in scene units, infinite where there is nothing."""


@dataclass(frozen=True, eq=False)
class Occluded:
    """A view with somebody in it."""

    view: View  # its mask shows the person
    depth: np.ndarray  # (H, W), as measured, 0 where nothing was
    person: np.ndarray  # (H, W) bool


def occlude(views: Sequence[View], label: int | None, depth_of: DepthOf, seed: int) -> list[Occluded]:
    """Put a person, an upright ellipsoid, between the camera and the nearest of each view, and a little aside.

    Parameters
    ----------
    views : sequence of View
        With true masks.
    label : int or None
        What the segmenter calls the person; None: what fills most of the view.
    depth_of : DepthOf
        Of the scene without the person.
    seed : int
        Of where the person stands, and of the noise of the depth.
    """
    rng, occluded = np.random.default_rng(seed), []
    for view in views:
        labels, depth = view.read_labels(), depth_of(view.camera)
        away = 0.6 * float(np.quantile(depth[np.isfinite(depth)], 0.05))
        across = rng.uniform(-0.3, 0.3) * view.camera.width / view.camera.fx
        front = _ellipsoid(view.camera, away * np.array([across, 0.1, 1.0]), away * np.array([0.12, 0.4, 0.12]))
        person = front < depth
        called = int(np.bincount(labels[labels >= 0]).argmax()) if label is None else label
        measured = np.where(person, front, depth) * (1 + NOISE * rng.standard_normal(labels.shape))
        measured[~np.isfinite(measured) | (rng.random(labels.shape) < MISSING)] = 0
        changed = View.from_arrays(view.camera, np.where(person, called, labels))
        occluded.append(Occluded(replace(changed, image_path=view.image_path), measured, person))
    return occluded


def gated(scene: GaussianScene, occluded: Sequence[Occluded]) -> tuple[list[View], float, float]:
    """Gate the views by their depth; also return the share of the person, and of all else, that is unknown then."""
    views, hidden, lost = [], [], []
    for one in occluded:
        result = gate_view(scene, one.view, one.depth)
        views.append(result.view)
        hidden.append(result.contradicted[one.person].mean() if one.person.any() else 1.0)
        lost.append(result.contradicted[~one.person].mean())
    return views, float(np.mean(hidden)), float(np.mean(lost))


def depth_of_demo(camera: Camera) -> np.ndarray:
    """Cast the rays of a view onto the solids of the demo scene: what a perfect depth camera sees."""
    depth = np.full((camera.height, camera.width), np.inf)
    directions = _rays(camera) @ camera.world_to_camera[:3, :3]
    for part in _parts():
        depth = np.minimum(depth, part.hit(camera.center, directions))
    return depth


def depth_of_scene(scene: GaussianScene) -> DepthOf:
    """Return what renders the depth of a scene of which there is no other truth."""
    return lambda camera: surface(scene, make_operator(scene, camera)).depth.astype(np.float64)


@lru_cache(maxsize=1)
def _parts() -> list[Part]:
    return furnish()


def _rays(camera: Camera) -> np.ndarray:
    """Directions (H, W, 3) through the centres of pixels, of depth 1, in the camera's axes."""
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    return np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones_like(rows)], axis=-1)


def _ellipsoid(camera: Camera, center: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """Depth (H, W) at which rays enter an ellipsoid along the camera's axes; infinite for those that miss."""
    d, o = _rays(camera) / radii, -center / radii
    a, b, c = (d * d).sum(axis=-1), d @ o, o @ o - 1
    root = b * b - a * c
    return np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)
