"""Cuts a scene into nodes that a browser can switch on and off for free, and finds which to send after a change.

A viewer draws the scene as many *nodes*. Switching a node takes a few bytes, while a node whose Gaussians change is
sent again whole, at 32 bytes a Gaussian. So the nodes are cut where the switches are: by class, and by confidence at
the marks of the slider. What is right does not depend on the cut. A node that is shown in part is sent with the rest of
its Gaussians transparent; only how much is sent depends on it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

BANDS = 20
"""Marks of the slider for confidence; nodes are cut there, as far as `MAX_NODES` allows."""

MAX_NODES = 600
"""A node takes three texels of one row of a texture, and WebGL 2 promises no more than 2,048."""

BYTES_PER_GAUSSIAN = 32

Key = tuple[int, int]
"""Label and band of a node."""


class Node(NamedTuple):
    """Some Gaussians of the scene with their colours and visibility.

    Attributes
    ----------
    members : (M,) int64
        Indices in the scene, M at least 1.
    rgba : (M, 4) uint8
        Colours, and opacities: 0 for those that are not shown.
    visible : bool
        Whether any is.
    """

    members: np.ndarray
    rgba: np.ndarray
    visible: bool


class Changes(NamedTuple):
    """Nodes to send, switch and drop to get from one picture to the next.

    Attributes
    ----------
    put : list of Key
        Nodes to be sent, those that are new among them.
    switch : dict of Key to bool
        Nodes that were sent earlier, to be switched on or off.
    drop : list of Key
        Nodes that are no more.
    """

    put: list[Key]
    switch: dict[Key, bool]
    drop: list[Key]


def cut(
    labels: np.ndarray,  # (N,) int32
    confidence: np.ndarray,  # (N,) float32
    max_nodes: int = MAX_NODES,
) -> dict[Key, np.ndarray]:
    """Cut a scene by label and confidence, as finely as the number of nodes allows.

    Returns
    -------
    dict of Key to (M,) int64
        Members, ascending; every Gaussian is in exactly one node. Where there are more labels than nodes, the smallest
        classes share the last one.
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
    order = np.argsort(cell, kind="stable")
    used = np.flatnonzero(sizes)
    parts = np.split(order, np.cumsum(sizes[used])[:-1])
    return {(int(c) // bands - 2, int(c) % bands): part for c, part in zip(used, parts, strict=True)}


def paint(
    parts: Mapping[Key, np.ndarray],
    shown: np.ndarray,  # (N,) bool
    colors: np.ndarray,  # (N, 3) uint8
    opacities: np.ndarray,  # (N,) uint8
) -> dict[Key, Node]:
    """Give each node its colours, opacities and visibility."""
    rgba = np.concatenate([colors, opacities[:, None]], axis=1)
    painted = rgba.copy()
    painted[~shown, 3] = 0
    nodes = {}
    for key, members in parts.items():
        visible = bool(shown[members].any())
        # Of a node that is switched off, what it would look like switched on: that is what the browser keeps.
        nodes[key] = Node(members, painted[members] if visible else rgba[members], visible)
    return nodes


def changes(sent: dict[Key, Node], wanted: dict[Key, Node]) -> Changes:
    """Compare what a browser has with what it should show. A node that is not to be seen is not sent before it is."""
    put, switch = [], {}
    for key, node in wanted.items():
        there = sent.get(key)
        if there is not None and there.visible != node.visible:
            switch[key] = node.visible
        if node.visible and (there is None or not _alike(there, node)):
            put.append(key)
    return Changes(put, switch, [key for key in sent if key not in wanted])


def after(sent: dict[Key, Node], wanted: dict[Key, Node], done: Changes) -> dict[Key, Node]:
    """List the nodes that the browser has once these changes are made."""
    has = {key: node for key, node in sent.items() if key in wanted}
    for key, visible in done.switch.items():
        has[key] = has[key]._replace(visible=visible)
    return {**has, **{key: wanted[key] for key in done.put}}


def _alike(a: Node, b: Node) -> bool:
    return np.array_equal(a.members, b.members) and np.array_equal(a.rgba, b.rgba)
