"""Which Gaussian of one scene is which of another: by ids, or else by position."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gsseg_core.errors import SettingsError, StateMismatchError
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.living_scene import LivingScene


class Matching(NamedTuple):
    """How a scene goes over into another one."""

    after: LivingScene  # N' Gaussians; those that match keep their ids
    origin: np.ndarray  # (N',) int64: where each was before; -1 for those that match none
    by: str  # "id" or "position"


def match_scenes(before: LivingScene, scene: GaussianScene, tolerance: float = 0.0) -> Matching:
    """Find each Gaussian of a scene in the one before: by id where both have ids, else by position.

    Those found by position have moved no farther than the tolerance, in scene units; `SettingsError` for one that is
    NaN, infinite or negative.
    """
    if not 0 <= tolerance < np.inf:
        raise SettingsError(f"tolerance is {tolerance:g}; expected a distance in scene units, 0 or more")
    if before.scene.ids is not None and scene.ids is not None:
        return Matching(LivingScene.of(scene), before.places(scene.ids), "id")
    origin = _nearest(before.scene.means, scene.means, tolerance)
    after = LivingScene.of(scene)
    if before.scene.ids is not None:
        new = np.flatnonzero(origin < 0)
        ids = before.ids[origin]  # Those of what matches go on.
        ids[new] = _free_ids(before.ids, len(new))
        after = LivingScene.numbered(scene, ids)
    return Matching(after, origin, "position")


def places_in_saved(
    saved: LivingScene,  # what a state was saved of
    first: LivingScene,  # what the session began with, under the numbers of now
    now: LivingScene,  # N' Gaussians
) -> np.ndarray:
    """Find the Gaussians of now in a saved scene, where the session has numbered them itself: (N',) int64, or -1.

    Numbers mean the same there if most Gaussians that the session began with are what has their numbers there. If not,
    the file of one of the two was in another order, and Gaussians are those that lie at exactly the same place. Raises
    `StateMismatchError` where neither finds half of the smaller scene.
    """
    places = saved.places(first.ids)
    found = places >= 0
    alike = (saved.local.means[places] == first.local.means).all(axis=1) & found
    if 2 * alike.sum() > found.sum():
        return saved.places(now.ids)
    origin = _nearest(saved.scene.means, now.scene.means, 0.0)
    count, smaller = int((origin >= 0).sum()), min(len(saved), len(now))
    if 2 * count < smaller:
        raise StateMismatchError(
            f"its Gaussians have ids, which the scene's file has not, and only {count} of {smaller} lie where the "
            "scene has one; expected the scene that it was saved for, or a file of it with ids"
        )
    return origin


def _free_ids(taken: np.ndarray, count: int) -> np.ndarray:  # (N,) int64
    """Find so many ids that are not taken: those behind the largest, or, where int64 ends before, the lowest."""
    if count <= np.iinfo(np.int64).max - taken.max():
        return taken.max() + 1 + np.arange(count)
    return np.setdiff1d(np.arange(len(taken) + count), taken)[:count]


def _nearest(before: np.ndarray, after: np.ndarray, tolerance: float) -> np.ndarray:  # (N, 3), (N', 3)
    """Find the nearest of the points before, each for one point at most, (N',) int64; -1 where none is near enough."""
    from scipy.spatial import cKDTree  # It takes a while to load, and few sessions need it.

    bound = max(tolerance * (1 + 1e-9), 1e-30)  # what is not below it is not looked for, and its square must not be 0
    distances, found = cKDTree(before).query(after, distance_upper_bound=bound)
    found = np.where(distances <= tolerance, found, -1)
    # The nearest one keeps a point that several have found; of equally near ones, the first.
    order = np.argsort(distances, kind="stable")
    order = order[found[order] >= 0]
    _, first = np.unique(found[order], return_index=True)
    origin = np.full(len(after), -1, np.int64)
    origin[order[first]] = found[order[first]]
    return origin
