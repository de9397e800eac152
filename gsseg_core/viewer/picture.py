"""Pictures of a scene: Gaussians with colours and visibility, as nodes for a browser or drawn as an image.

A browser draws the scene as many *nodes*. Switching a node takes a few bytes, while a node whose Gaussians change is
sent again whole, at 32 bytes a Gaussian. So the nodes are cut where the switches are: by class, and by confidence at
the marks of the slider. What is right does not depend on the cut: a node that is shown in part is sent with the rest of
its Gaussians transparent. Only how much is sent depends on it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from gsseg_core.raster.view_operator import ViewOperator
from gsseg_core.scene.gaussian_scene import GaussianScene

BANDS = 20  # marks of the slider for confidence; nodes are cut there, as far as `MAX_NODES` allows
MAX_NODES = 600  # a node takes three texels of one row of a texture, and WebGL 2 promises no more than 2,048
Key = tuple[int, int]  # label and band of a node


class Node(NamedTuple):
    """Some Gaussians of the scene with their colours and visibility."""

    members: np.ndarray  # (M,) int64: indices in the scene, M at least 1
    rgba: np.ndarray  # (M, 4) uint8: colours, and opacities: 0 for those that are not shown
    visible: bool  # whether any is


def cut(labels: np.ndarray, confidence: np.ndarray, max_nodes: int = MAX_NODES) -> dict[Key, np.ndarray]:
    """Cut a scene by label (N,) int32 and confidence (N,) float32, as finely as the number of nodes allows.

    Returns the members of each node, (M,) int64 ascending; every Gaussian is in exactly one. Where there are more
    labels than nodes, the smallest classes share the last one.
    """
    count = int(labels.max()) + 3  # labels begin at -2
    for bands in (BANDS, BANDS // 2, BANDS // 4, 1):
        edges = (np.arange(bands) / bands).astype(np.float32)
        band = np.searchsorted(edges, confidence, side="right") - 1
        cell = (labels.astype(np.int64) + 2) * bands + np.maximum(band, 0)
        sizes = np.bincount(cell, minlength=count * bands)
        if np.count_nonzero(sizes) <= max_nodes:
            break
    else:
        small = np.argsort(-sizes, kind="stable")[max_nodes - 1 :]
        cell[np.isin(cell, small)] = small[0]
        sizes = np.bincount(cell, minlength=count * bands)
    used = np.flatnonzero(sizes)
    parts = np.split(np.argsort(cell, kind="stable"), np.cumsum(sizes[used])[:-1])
    return {(int(c) // bands - 2, int(c) % bands): part for c, part in zip(used, parts, strict=True)}


@dataclass(frozen=True, eq=False)
class Picture:
    """A scene with the visibility and the colour of every Gaussian."""

    scene: GaussianScene  # N Gaussians
    parts: Mapping[Key, np.ndarray]  # how the scene is cut into nodes, as `cut` does: (M,) int64 each
    shown: np.ndarray  # (N,) bool: which of them are to be seen
    colors: np.ndarray  # (N, 3) uint8: in which colours

    @cached_property
    def nodes(self) -> dict[Key, Node]:
        """Nodes that a browser draws, by label and band."""
        opacities = np.rint(self.scene.opacities * 255).astype(np.uint8)
        rgba = np.concatenate([self.colors, opacities[:, None]], axis=1)
        painted = rgba.copy()
        painted[~self.shown, 3] = 0
        nodes = {}
        for key, members in self.parts.items():
            visible = bool(self.shown[members].any())
            # Of a node that is switched off, what it would look like switched on: that is what the browser keeps.
            nodes[key] = Node(members, (painted if visible else rgba)[members], visible)
        return nodes

    def draw(self, operator: ViewOperator) -> np.ndarray:
        """Render the picture by an operator of the scene, before a black background: (H, W, 3) uint8."""
        image = operator.without(~self.shown).render(self.colors.astype(np.float32) / 255)
        return (image * 255 + 0.5).clip(0, 255).astype(np.uint8)
