"""The scene without some of its objects."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from gsseg_core.errors import EmptySceneError, SettingsError
from gsseg_core.scene import GaussianScene
from gsseg_core.segmentation import Segmentation


def without_objects(scene: GaussianScene, segmentation: Segmentation, classes: Collection[int]) -> GaussianScene:
    """Leave the Gaussians of some classes out; the others stay bit for bit, in their order.

    It is the exact complement of `export_classes`: the objects' PLYs and what is left make up the scene. What the
    objects hid was never seen, so there may be holes; nothing is made up to fill them. Gaussians that refinement took
    out of an object (`REMOVED`) stay in the scene.

    Parameters
    ----------
    classes : collection of int
        Ids, at least one.

    Raises
    ------
    SettingsError
        A class has no Gaussians.
    EmptySceneError
        Nothing would be left.
    """
    counts = segmentation.counts()
    empty = [k for k in classes if not 0 <= k < len(counts) or not counts[k]]
    if empty or not classes:
        found = f"class {empty[0]}, which has no Gaussians" if empty else "no class"
        present = ", ".join(f"{k} ({segmentation.class_names[k]})" for k in np.flatnonzero(counts).tolist())
        raise SettingsError(f"{scene.path or 'scene'}: asked to remove {found}; expected some of: {present}")
    kept = ~np.isin(segmentation.labels, list(classes))
    if not kept.any():
        raise EmptySceneError(
            f"{scene.path or 'scene'}: nothing is left without {len(classes)} classes; expected to keep some"
        )
    return scene.subset(kept)


def class_ids(segmentation: Segmentation, names: Collection[str]) -> list[int]:
    """Ids of classes that are given by name or by number.

    Raises
    ------
    SettingsError
        There is no such class.
    """
    ids = []
    for name in names:
        matching = [k for k, known in segmentation.class_names.items() if name in (known, str(k))]
        if not matching:
            known = ", ".join(segmentation.class_names.values())
            raise SettingsError(f"class {name!r} is not in the segmentation; expected one of {known}")
        ids += matching[:1]
    return ids
