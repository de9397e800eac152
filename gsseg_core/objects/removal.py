"""Removal of objects from a scene."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from gsseg_core.data.class_names import listed
from gsseg_core.errors import EmptySceneError, SettingsError
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import Segmentation
from gsseg_core.text import clipped, counted


def without_objects(scene: GaussianScene, segmentation: Segmentation, classes: Collection[int]) -> GaussianScene:
    """Leave the Gaussians of some classes out; the others stay bit for bit, in their order.

    It is the exact complement of `export_classes`: the objects' PLYs and what is left make up the scene. What the
    objects hid was never seen, so there may be holes; nothing is made up to fill them. Gaussians that refinement took
    out of an object (`REMOVED`) stay in the scene. The classes are ids, at least one, also of parts and wholes.

    Raises `SettingsError` where a class has no Gaussians, `EmptySceneError` where nothing would be left,
    `StateMismatchError` where the segmentation belongs to another scene.
    """
    return scene.subset(left_without(scene, segmentation, classes))


def left_without(scene: GaussianScene, segmentation: Segmentation, classes: Collection[int]) -> np.ndarray:
    """Mark the Gaussians of a scene that `without_objects` leaves, (N,) bool; raises the same errors."""
    segmentation.require(scene)
    gone = {k: segmentation.members(k) for k in classes}
    empty = [k for k, members in gone.items() if not members.any()]
    if empty or not classes:
        found = f"class {empty[0]}, which has no Gaussians" if empty else "no class"
        present = np.flatnonzero(segmentation.counts()).tolist()
        names = listed(f"{k} ({clipped(segmentation.class_names[k])})" for k in present)
        raise SettingsError(f"{scene.path or 'scene'}: asked to remove {found}; expected some of: {names}")
    kept: np.ndarray = ~np.logical_or.reduce(list(gone.values()))
    if not kept.any():
        without = counted(len(classes), "class", "classes")
        raise EmptySceneError(f"{scene.path or 'scene'}: nothing is left without {without}; expected to keep some")
    return kept
