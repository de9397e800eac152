"""One object from one view: from a mask, from scribbles, or from a single click.

A mask says of one view what is the object (1), what is not (0), and where nothing is said (-1). The view's operator
carries that to the Gaussians, W^T onehot(y): what lies behind the object is hidden there, so that the mask says nothing
of it, however many of its pixels it would cover. What the view does not show takes its neighbours' answer along the
graph of the scene (`gsseg_core.graph`): the back of a chair hangs together with its front, and the wall behind it with
the wall beside it.

A click knows a single pixel, and nothing that is *not* the object. From the Gaussian that made most of the pixel a
region grows along the graph. A step from i to j costs

    |c_i - c_j|^2 / s^2 + |c_0 - c_j|^2 / (2 s)^2 + 1 - |n_i . n_j|

with colours c, c_0 that of the first, s their typical difference between neighbours, and n the shortest axis of a
Gaussian. The region is what can be reached for less than `reach`. It stops at edges in colour and shape, leaks where an
object has none, and is no substitute for a mask: docs/few_views.md has figures of both.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import dijkstra
from scipy.spatial.transform import Rotation

from gsseg_core.atomic import write_atomically
from gsseg_core.cameras import Camera
from gsseg_core.dataset import View
from gsseg_core.errors import MaskFormatError, NoUsableViewsError, SettingsError
from gsseg_core.graph import Graph, GraphSettings, graph_of, propagate
from gsseg_core.masks import UNKNOWN, read_mask
from gsseg_core.operator import make_operator
from gsseg_core.scene import GaussianScene

FORMAT = "gsseg-pick-1"

REACH = 48.0
"""Cost at which a region that grows from a click ends, unless asked otherwise."""

GRAPH = GraphSettings(k=24, strength=4.0)
"""How a mask's word spreads: one view says little of each Gaussian, and nothing of most, so neighbours say more."""


@dataclass(frozen=True, eq=False)
class Pick:
    """An object of a scene.

    Attributes
    ----------
    membership : (N,) float32
        How sure it is that each Gaussian belongs to the object, in [0, 1]; 0 where nothing is known.
    scene_digest : str
        Which scene it belongs to.
    """

    membership: np.ndarray
    scene_digest: str

    @property
    def ids(self) -> np.ndarray:
        """Gaussians of the object, those with a membership of at least one half, (M,) int64."""
        return np.flatnonzero(self.membership >= 0.5)

    def silhouette(self, scene: GaussianScene, camera: Camera, *, device: str = "cpu") -> np.ndarray:
        """Where a camera sees the object, not what hides it: its blended membership is at least one half, (H, W) bool.

        What a ray has left over is not the object.
        """
        operator = make_operator(scene, camera, device)
        seen: np.ndarray = operator.render(self.membership[:, None])[..., 0] >= 0.5
        return seen

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write `ids`, `membership` and the digest of the scene as one npz, atomically.

        Raises
        ------
        WriteError
            The file cannot be written; an earlier one is unchanged.
        """
        header = json.dumps({"format": FORMAT, "scene": self.scene_digest})
        with write_atomically(path, suffix=".npz") as temporary, open(temporary, "wb") as file:
            np.savez_compressed(
                file, allow_pickle=False, ids=self.ids, membership=self.membership, header=np.array(header)
            )


def pick_mask(
    scene: GaussianScene,
    view: View,
    settings: GraphSettings = GRAPH,
    *,
    device: str = "cpu",
) -> Pick:
    """Pick the object that a mask of one view shows.

    Parameters
    ----------
    scene : GaussianScene
        N Gaussians.
    view : View
        Its labels are 1 for the object, 0 for what is not it, -1 where nothing is said; so scribbles will do, of both
        kinds. Make one by `View.from_arrays(camera, labels)`.
    settings : GraphSettings
        How what was seen spreads to what was not.

    Raises
    ------
    NoUsableViewsError
        No Gaussian is seen in a pixel of the object, or none in one that is not it: then nothing says where it ends.
    SettingsError
        There are other labels.
    """
    labels = view.read_labels()
    if labels.max() > 1:
        raise SettingsError(f"view '{view.name}': labels up to {labels.max()}; expected 1 (object), 0 (not it), -1")
    observation = make_operator(scene, view.camera, device).observe(labels)
    votes = np.zeros((len(scene), 2), np.float32)
    votes[observation.ids[:, None], observation.classes] = observation.dense(observation.votes())
    for k, what in enumerate(("not the object", "the object")):
        if not votes[:, k].any():
            raise NoUsableViewsError(
                f"view '{view.name}': no Gaussian is seen in a pixel with the label {k} ({what}); expected pixels of "
                "both kinds, or a click"
            )
    evidence = votes.sum(axis=1)
    codes = np.divide(votes, evidence[:, None], out=np.zeros_like(votes), where=evidence[:, None] > 0)
    return Pick(propagate(graph_of(scene, settings.k), codes, evidence, settings)[:, 1].copy(), scene.digest)


def pick_click(
    scene: GaussianScene,
    camera: Camera,
    row: int,
    column: int,
    reach: float = REACH,
    *,
    device: str = "cpu",
) -> Pick:
    """Pick what a click hits, and what looks like it around.

    Parameters
    ----------
    scene : GaussianScene
        N Gaussians.
    camera : Camera
        Where the click was made.
    row, column : int
        The pixel.
    reach : float
        How far the region grows, 0 or more: typical differences between neighbours, squared, that may add up.

    Returns
    -------
    Pick
        The membership is 1 where the click hit, one half where the cost is `reach`.

    Raises
    ------
    SettingsError
        There is no such pixel, or `reach` is negative.
    NoUsableViewsError
        The pixel shows no Gaussian.
    """
    if not 0 <= reach < float("inf"):
        raise SettingsError(f"reach is {reach}; expected 0 or more, finite")
    hit = make_operator(scene, camera, device).weights(row, column)
    if not len(hit.gaussians):
        raise NoUsableViewsError(
            f"view '{camera.name}': no Gaussian is seen at row {row}, column {column}; expected a click on something"
        )
    seed = int(hit.gaussians[hit.weights.argmax()])
    cost = _costs(scene, graph_of(scene, GRAPH.k), seed, 2 * reach)
    membership = np.exp2(-cost / reach) if reach > 0 else (cost == 0)
    return Pick(membership.astype(np.float32), scene.digest)


def read_object_mask(path: str | os.PathLike[str], label: int | None = None) -> np.ndarray:
    """Read a drawn mask, or one label of a label image, as labels for `pick_mask`.

    Parameters
    ----------
    path : path
        A label image as `read_mask` takes it. In one of black and white only, 255 is the object and not unknown.
    label : int, optional
        The object's; by default all but 0.

    Returns
    -------
    (H, W) int32
        1 object, 0 not, -1 unknown.

    Raises
    ------
    MaskFormatError
        The file is no label image, or nothing in it is the object.
    """
    labels = read_mask(path).labels
    if label is None and not (labels > 0).any():
        labels = np.where(labels == UNKNOWN, 1, labels)
    mine = labels > 0 if label is None else labels == label
    if not mine.any():
        there = np.unique(labels[labels != UNKNOWN]).tolist()
        wanted = "a label above 0" if label is None else f"the label {label}"
        raise MaskFormatError(f"{Path(path)}: holds the labels {str(there)[1:-1][:60]}; expected pixels with {wanted}")
    return np.where(mine, 1, np.where(labels == UNKNOWN, UNKNOWN, 0)).astype(np.int32)


def _costs(scene: GaussianScene, graph: Graph, seed: int, limit: float) -> np.ndarray:
    """Cost of the cheapest way from a Gaussian to each other one, infinite beyond the limit: (N,) float64."""
    order, of = graph.order, np.repeat(np.arange(len(graph.order)), np.diff(graph.start))
    colors = scene.colors()[order]
    normals = _shortest_axes(scene)[order]
    contrast = ((colors[of] - colors[graph.places]) ** 2).sum(axis=1)
    typical = float(np.median(contrast)) or float(contrast.mean()) or 1.0
    strange = ((colors - scene.colors()[seed]) ** 2).sum(axis=1)
    turned = 1 - np.abs((normals[of] * normals[graph.places]).sum(axis=1))
    # Zeros would be no edges at all.
    steps = (contrast + strange[graph.places] / 4) / typical + np.maximum(turned, 1e-6)
    matrix = sparse.csr_array((steps, graph.places, graph.start), shape=(len(order), len(order)))
    out = np.empty(len(order))
    out[order] = dijkstra(matrix, indices=int(np.flatnonzero(order == seed)[0]), limit=limit)
    return out


def _shortest_axes(scene: GaussianScene) -> np.ndarray:
    """Directions of the shortest axes, (N, 3)."""
    turns = Rotation.from_quat(scene.quats[:, [1, 2, 3, 0]]).as_matrix()
    axes: np.ndarray = turns[np.arange(len(scene)), :, scene.scales.argmin(axis=1)]
    return axes
