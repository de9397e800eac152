"""Levels of a tree of parts, objects and wholes, as labellings to look at."""

from __future__ import annotations

import numpy as np

from gsseg_core.data.object_tree import ObjectTree
from gsseg_core.viewer.model import Labelling


def at_level(objects: Labelling, tree: ObjectTree, granularity: float) -> Labelling:
    """Label the nodes of a level without gaps.

    Parameters
    ----------
    objects : Labelling
        Its first classes are those of the tree; others, which were added in the viewer, are on every level.
    tree : ObjectTree
        Of the same scene.
    granularity : float
        Where to cut it; at its own level, the objects come back as they are.
    """
    if granularity == tree.level:
        return objects
    k, added = tree.num_classes, objects.probabilities.shape[1] - tree.num_classes
    shares, nodes = tree.shares_at(granularity, objects.probabilities[:, :k], tree.leaves)
    of_tree, first = objects.labels < k, len(nodes)
    node = tree.labels_at(granularity, np.where(of_tree, objects.labels, 0))
    place = np.where(node >= 0, np.searchsorted(nodes, node), node)
    names = tree.names(objects.class_names)
    return Labelling(
        np.where(of_tree, place, objects.labels - k + first).astype(np.int32),
        np.concatenate([shares, objects.probabilities[:, k:]], axis=1),
        dict(enumerate([*(names[one] for one in nodes), *(objects.class_names[k + i] for i in range(added))])),
        (*nodes, *range(len(tree), len(tree) + added)),
    )
