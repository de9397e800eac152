"""Finds the Gaussian under a click, and the votes of each view for a Gaussian."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from gsseg_core.data.view import View
from gsseg_core.learn.learner import Progress, silent
from gsseg_core.raster.backends import make_operator
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene

_FOCAL = 1000.0
_WINDOW = 3


class Picked(NamedTuple):
    """The Gaussian that a ray hit.

    Attributes
    ----------
    gaussian : int
        The one that contributes most to the ray's colour, as an index in the scene.
    weight : float
        How much: alpha times the transmittance in front, in (0, 0.99].
    """

    gaussian: int
    weight: float


def pick(
    scene: GaussianScene,
    origin: np.ndarray,  # (3,)
    direction: np.ndarray,  # (3,)
    shown: np.ndarray | None = None,  # (N,) bool
    *,
    focal: float = _FOCAL,
    device: str = "cpu",
) -> Picked | None:
    """Follow a ray into the scene, to the Gaussian that makes most of what is seen there.

    The ray is the middle of a camera of a few pixels, so that a Gaussian counts by the weight with which it is drawn,
    and one that is hidden by others does not count.

    Parameters
    ----------
    scene : GaussianScene
        N Gaussians.
    origin, direction : (3,)
        Of the ray, in the world; the direction of any length but zero.
    shown : (N,) bool, optional
        Look through all others.
    focal : float
        Focal length of the image that was clicked, in pixels: Gaussians are widened by a third of such a pixel, as in
        the image.

    Returns
    -------
    Picked or None
        None where the ray meets nothing.
    """
    forward = np.asarray(direction, np.float64) / np.linalg.norm(direction)
    right = np.cross(forward, np.eye(3)[np.argmin(np.abs(forward))])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ np.asarray(origin, np.float64)
    K = np.array([[focal, 0, _WINDOW / 2], [0, focal, _WINDOW / 2], [0, 0, 1]])
    operator = make_operator(scene, Camera("click", _WINDOW, _WINDOW, K, pose), device)
    if shown is not None:
        operator = operator.without(~shown)
    weights = operator.weights(_WINDOW // 2, _WINDOW // 2)
    if not len(weights.weights):
        return None
    best = int(weights.weights.argmax())
    return Picked(int(weights.gaussians[best]), float(weights.weights[best]))


def scene_camera(
    name: str,
    width: int,
    height: int,
    vertical_fov: float,
    camera_to_world: np.ndarray,  # (4, 4)
) -> Camera:
    """Make a camera from what a viewer says of its own; the field of view in radians, OpenCV axes."""
    focal = height / (2 * np.tan(vertical_fov / 2))
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Camera(name, width, height, K, np.linalg.inv(camera_to_world))


class ViewVote(NamedTuple):
    """Vote of one view for one label of one Gaussian.

    Attributes
    ----------
    view : str
        Name of the view.
    label : int
        The label under which it sees the Gaussian.
    weight : float
        Sum of the Gaussian's weights over the pixels of that label, in px.
    """

    view: str
    label: int
    weight: float


class ViewVotes:
    """Votes of every view for the labels of every Gaussian, not added up over the views.

    Takes 12 bytes per (Gaussian, label) pair of a view, and as long to make as a pass of a learner over all views.

    Parameters
    ----------
    scene : GaussianScene
        N Gaussians.
    views : sequence of View
        Those without a mask do not vote.
    progress : callable, optional
        Told of every view.

    Raises
    ------
    MaskFormatError, MaskSizeError, UnknownLabelError
        A mask cannot be used.
    """

    def __init__(
        self, scene: GaussianScene, views: Sequence[View], *, device: str = "cpu", progress: Progress = silent
    ) -> None:
        self._num_gaussians = len(scene)
        # By view: Gaussians in ascending order, labels, weights, each of one length.
        self._votes: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}
        for done, view in enumerate(views):
            progress("collect the votes of each view", done, len(views))
            if view.has_mask:
                observation = make_operator(scene, view.camera, device).observe(view.read_labels())
                ids = observation.ids[observation.rows]
                order = np.argsort(ids, kind="stable")
                labels = observation.classes[observation.labels]
                self._votes[view.name] = ids[order], labels[order], observation.votes()[order]
        progress("collect the votes of each view", len(views), len(views))

    def __len__(self) -> int:
        """Count the views with a mask."""
        return len(self._votes)

    def of(self, gaussian: int) -> list[ViewVote]:
        """List the votes for the labels of one Gaussian, the largest first."""
        found = []
        for name, (ids, labels, votes) in self._votes.items():
            first, last = np.searchsorted(ids, [gaussian, gaussian + 1])
            found += [ViewVote(name, int(labels[i]), float(votes[i])) for i in range(first, last)]
        return sorted(found, key=lambda vote: -vote.weight)

    def mean_reliability(self, reliability: Mapping[str, float]) -> np.ndarray:
        """Mean reliability of the views that saw each Gaussian, weighed by how much of it each saw.

        Parameters
        ----------
        reliability : mapping from the name of a view to float
            In [0, 1]; views that are not in it do not count.

        Returns
        -------
        (N,) float32
            NaN where no such view saw the Gaussian.
        """
        total, weight = np.zeros(self._num_gaussians), np.zeros(self._num_gaussians)
        for name, (ids, _, votes) in self._votes.items():
            if name in reliability:
                seen = np.bincount(ids, weights=votes, minlength=self._num_gaussians)
                total += reliability[name] * seen
                weight += seen
        mean: np.ndarray = np.divide(total, weight, out=np.full(len(total), np.nan), where=weight > 0)
        return mean.astype(np.float32)
