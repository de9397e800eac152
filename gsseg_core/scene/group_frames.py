"""Frames of groups of Gaussians: how one lies in another, and Gaussians moved from one to the other.

Positions and shapes are computed without products of matrices, so they come out the same, bit for bit, whichever other
Gaussians are moved along.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from gsseg_core.scene import spherical_harmonics
from gsseg_core.scene.gaussian_scene import ACTIVATED, GaussianScene
from gsseg_core.scene.quaternions import turned_quats
from gsseg_core.scene.scene_ids import with_ids
from gsseg_core.scene.similarity import Similarity
from gsseg_core.scene.vertices import MEANS, QUATS, SCALES, chosen, columns, put, rest_of

IDENTITY = Similarity()  # the frame of the scene, and of a group that has not moved


def relation(to: Similarity, frame: Similarity) -> Similarity:
    """How a frame lies in another one; `IDENTITY` itself if they are the same."""
    if to == frame:
        return IDENTITY
    return frame if to == IDENTITY else to.inverse().after(frame)


def moved_geometry(scene: GaussianScene, which: npt.NDArray[np.bool_], frame: Similarity) -> GaussianScene:  # (N,)
    """Move some Gaussians from a frame to the one that it lies in; their vertices, and so colours, are not moved."""
    means, quats, scales = scene.means.copy(), scene.quats.copy(), scene.scales.copy()
    means[which] = _points(means[which], frame)
    quats[which] = turned_quats(quats[which], frame.rotation)
    scales[which] = (scales[which].astype(np.float64) * frame.scale).astype(np.float32)
    return replace(scene, means=means, quats=quats, scales=scales)


def moved_scene(scene: GaussianScene, frame: Similarity) -> GaussianScene:
    """Move a scene from a frame to the one that it lies in, colours and all, as a file would hold it."""
    vertices = scene.vertices.copy()
    logs = columns(vertices, SCALES).astype(np.float64) + np.log(frame.scale)
    put(vertices, MEANS, _points(scene.means, frame))
    put(vertices, QUATS, turned_quats(scene.quats, frame.rotation))
    put(vertices, SCALES, logs)
    if names := rest_of(vertices):
        turned = spherical_harmonics.turned(frame.rotation, scene.sh_degree)[1:, 1:]
        rest = columns(vertices, names).reshape(len(vertices), 3, -1) @ turned.T.astype(np.float32)
        put(vertices, names, rest.reshape(len(vertices), -1))
    return GaussianScene.from_vertices(vertices, scene.path)


def joined(
    scene: GaussianScene,
    stays: npt.NDArray[np.bool_],  # (N,)
    added: GaussianScene | None,
    ids: npt.NDArray[np.int64],  # (N',)
) -> GaussianScene:
    """Append Gaussians to those that stay; from now on, the scene holds ids. Raises what `with_ids` does."""
    kept = chosen(scene.vertices, np.flatnonzero(stays))
    if added is None:
        arrays: dict[str, Any] = {name: getattr(scene, name)[stays] for name in ACTIVATED}
        return replace(scene, **arrays, vertices=with_ids(kept, None, ids))
    arrays = {name: np.concatenate([getattr(scene, name)[stays], getattr(added, name)]) for name in ACTIVATED}
    return replace(scene, **arrays, vertices=with_ids(kept, added.vertices, ids))


def _points(means: npt.NDArray[np.float32], frame: Similarity) -> npt.NDArray[np.float64]:
    x, y, z = means.astype(np.float64).T
    rows = [frame.scale * (r[0] * x + r[1] * y + r[2] * z) for r in frame.rotation]
    return np.stack([row + shift for row, shift in zip(rows, frame.translation, strict=True)], axis=1)
