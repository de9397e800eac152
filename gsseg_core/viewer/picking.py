"""Finds the Gaussian under a click, and the votes of each view for a Gaussian."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from gsseg_core.data.view import View
from gsseg_core.progress import Progress, silent, with_progress
from gsseg_core.raster.backends import make_operator
from gsseg_core.scene.camera import Camera, rigid_motion
from gsseg_core.scene.gaussian_scene import GaussianScene

_WINDOW = 65  # px, each way, of the part of a picture whose middle is the ray


class Picked(NamedTuple):
    """The Gaussian that a ray hit, as an index, and its weight in the ray's colour: alpha times transmittance."""

    gaussian: int
    weight: float


def pick(
    scene: GaussianScene,
    camera: Camera,  # of the picture that was clicked; it may have moved since
    origin: np.ndarray,  # (3,): of the ray, in the world
    direction: np.ndarray,  # (3,): of any length but zero
    shown: np.ndarray | None = None,  # (N,) bool: look through all others
    *,
    device: str = "cpu",
) -> Picked | None:
    """Follow a ray of a picture into the scene, to the Gaussian that makes most of what is seen there; None if nothing.

    A Gaussian counts by the weight with which the picture draws it, and one that is hidden by others does not count. So
    what is rendered is a part of that picture and not one that looks along the ray: seen from another angle, Gaussians
    have other depths, and another order.
    """
    rotation = camera.world_to_camera[:3, :3]
    x, y, z = (rotation @ np.asarray(direction, np.float64)).tolist()
    if z <= 0:
        return None
    middle = _WINDOW / 2
    K = np.array([[camera.fx, 0, middle - camera.fx * x / z], [0, camera.fy, middle - camera.fy * y / z], [0, 0, 1]])
    part = Camera("click", _WINDOW, _WINDOW, K, rigid_motion(rotation, -rotation @ np.asarray(origin, np.float64)))
    operator = make_operator(scene, part, device)
    if shown is not None:
        operator = operator.without(~shown)
    weights = operator.weights(_WINDOW // 2, _WINDOW // 2)
    if not len(weights.weights):
        return None
    best = int(weights.weights.argmax())
    return Picked(int(weights.gaussians[best]), float(weights.weights[best]))


class ViewVote(NamedTuple):
    """Vote of the view of a name for a label: the sum of a Gaussian's weights over the pixels of that label, in px."""

    view: str
    label: int
    weight: float


class ViewVotes:
    """Votes of every view for the labels of every Gaussian, not added up over the views.

    Takes 12 bytes per (Gaussian, label) pair of a view, and as long to make as a pass of a learner over all views.
    Views without a mask do not vote; `MaskFormatError`, `MaskSizeError` or `UnknownLabelError` if one cannot be used.
    """

    def __init__(
        self, scene: GaussianScene, views: Sequence[View], *, device: str = "cpu", progress: Progress = silent
    ) -> None:
        self._num_gaussians = len(scene)
        # By view: Gaussians in ascending order, labels, weights, each of one length.
        self._votes: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}
        for view in with_progress(progress, "collect the votes of each view", views):
            if view.has_mask:
                observation = make_operator(scene, view.camera, device).observe(view.read_labels())
                self._votes[view.name] = *observation.places, observation.votes()

    def of(self, gaussian: int) -> list[ViewVote]:
        """List the votes for the labels of one Gaussian, the largest first."""
        found = []
        for name, (ids, labels, votes) in self._votes.items():
            first, last = np.searchsorted(ids, [gaussian, gaussian + 1])
            found += [ViewVote(name, int(labels[i]), float(votes[i])) for i in range(first, last)]
        return sorted(found, key=lambda vote: -vote.weight)

    def mean_reliability(self, reliability: Mapping[str, float]) -> np.ndarray:
        """Average the reliability of the views that saw each Gaussian, by how much of it each saw: (N,) float32.

        `reliability` is in [0, 1], by the name of a view; views that are not in it do not count. NaN where no view that
        counts saw the Gaussian.
        """
        total, weight = np.zeros(self._num_gaussians), np.zeros(self._num_gaussians)
        for name, (ids, _, votes) in self._votes.items():
            if name in reliability:
                seen = np.bincount(ids, weights=votes, minlength=self._num_gaussians)
                total += reliability[name] * seen
                weight += seen
        mean: np.ndarray = np.divide(total, weight, out=np.full(len(total), np.nan), where=weight > 0)
        return mean.astype(np.float32)
