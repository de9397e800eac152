"""Parts, objects and wholes as a tree of nodes, and the levels at which it can be cut.

Node k below the number of classes K is class k. Nodes from K on are parts, inside one class each, and wholes, made of
several. Every Gaussian lies in a leaf. A node is one thing at each granularity up to its agreement; above, it comes
apart. Agreement grows on the way from the root to a leaf, so levels are nested: each node of one is a union of nodes of
every finer one. The level of the objects is one of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.class_names import class_name
from gsseg_core.errors import SettingsError
from gsseg_core.files.input_files import UnfitError
from gsseg_core.files.npz_files import NpzArrays
from gsseg_core.text import quoted

PART, OBJECT, WHOLE = "part", "object", "whole"
"""What a node can be."""


@dataclass(frozen=True, eq=False)
class ObjectTree:
    """Which parts the objects of a scene have, and which wholes they make."""

    parents: np.ndarray  # (M,) int32: node that each node is a part of; -1 for those that are of none
    agreement: np.ndarray  # (M,) float32: share of the views, weighted, that give all of a node one id; 1 for leaves
    leaves: np.ndarray  # (N,) int32: leaf of each Gaussian; -1 where it is of no class
    num_classes: int  # K; the first nodes are the classes, the background among them
    level: float  # granularity of the classes, in (0, 1)

    def __post_init__(self) -> None:
        """Raise `UnfitError` unless it is a tree with nodes nested as the docstring of the module says."""
        m, k = len(self.parents), self.num_classes
        nodes = np.arange(m)
        has = self.parents >= 0
        if not (1 <= k <= m and len(self.agreement) == m and 0 < self.level < 1):
            raise UnfitError(f"tree has {m} nodes, {k} classes, level {self.level:g}; expected 1 <= classes <= nodes")
        if ((self.parents < -1) | (self.parents >= m) | (self.parents == nodes)).any() or (self._root < 0).any():
            raise UnfitError("parents of the tree are no nodes of it, or go round in a circle")
        if not ((self.agreement >= 0) & (self.agreement <= 1)).all():
            raise UnfitError("agreement of the tree is outside [0, 1]")
        if (self.agreement[self.parents[has]] >= self.agreement[has]).any():
            raise UnfitError("agreement of the tree does not grow from a node to its parts")
        kinds = self._classes
        if (has & (nodes < k) & (kinds[self.parents] >= 0)).any() or (self.agreement[:k] < self._level).any():
            raise UnfitError("a class of the tree is part of another; expected them to be on one level")
        if (self.agreement[kinds < 0] >= self._level).any():
            raise UnfitError("a whole of the tree holds no two objects at its level")
        if ((self.leaves < -1) | (self.leaves >= m)).any() or (kinds[self.leaves[self.leaves >= 0]] < 0).any():
            raise UnfitError("leaves of the tree are no parts or objects of it")

    @classmethod
    def read(cls, file: NpzArrays, header: dict[str, Any], num_gaussians: int, num_classes: int) -> ObjectTree | None:
        """Read the tree of a segmentation from its file, if it has one; `UnfitError` unless it is one."""
        if "tree_parents" not in file.names:
            return None
        parents = file.expect("tree_parents", np.int32, (None,))
        agreement = file.expect("tree_agreement", np.float32, (len(parents),))
        leaves = file.expect("tree_leaves", np.int32, (num_gaussians,))
        level = header.get("granularity")
        if type(level) is not float:
            raise UnfitError(f"granularity is {quoted(level)}; expected a number in (0, 1)")
        return cls(parents, agreement, leaves, num_classes, level)

    def arrays(self) -> dict[str, np.ndarray]:
        """Name its arrays as `read` finds them; the level is `granularity` in the header."""
        return {f"tree_{name}": getattr(self, name) for name in ("parents", "agreement", "leaves")}

    def __len__(self) -> int:
        """Count the nodes, M."""
        return len(self.parents)

    @property
    def _level(self) -> np.float32:
        return np.float32(self.level)

    @cached_property
    def _root(self) -> np.ndarray:  # (M,); -1 for nodes on a circle
        top = _climbed(np.where(self.parents >= 0, self.parents, np.arange(len(self))))
        return np.where(self.parents[top] < 0, top, -1)

    @cached_property
    def _classes(self) -> np.ndarray:
        """Class that each node is, or is inside of, (M,) int32; -1 for wholes."""
        nodes = np.arange(len(self))
        at = _climbed(np.where((nodes >= self.num_classes) & (self.parents >= 0), self.parents, nodes))
        return np.where(at < self.num_classes, at, -1).astype(np.int32)

    def kind(self, node: int) -> str:
        """`PART`, `OBJECT` or `WHOLE`."""
        return OBJECT if node < self.num_classes else PART if self._classes[node] >= 0 else WHOLE

    def parts(self, node: int) -> list[int]:
        """Nodes that a node is made of, in the order of their numbers; none of a leaf."""
        return np.flatnonzero(self.parents == node).tolist()

    def whole(self, node: int) -> int | None:
        """Node that a node is a part of; None if of none."""
        parent = int(self.parents[node])
        return parent if parent >= 0 else None

    @cached_property
    def granularities(self) -> tuple[float, ...]:
        """One granularity for each different cut, ascending: from the wholes over the objects to the parts.

        That of the objects is `level`.
        """
        inner = np.unique(self.agreement[np.unique(self.parents[self.parents >= 0])]).tolist()
        coarse, fine = [h for h in inner if h < self._level], [h for h in inner if self._level <= h < 1]
        return (*coarse, self.level, *((a + b) / 2 for a, b in pairwise([*fine, 1.0])))

    def level_name(self, granularity: float) -> str:
        """Name a level for people: "objects", "parts at 0.45", "wholes at 0.10"."""
        if granularity == self.level:
            return "objects"
        return f"{'parts' if granularity > self.level else 'wholes'} at {granularity:.2f}"

    def opened(self, node: int) -> float:
        """Find the coarsest granularity at which a node that has parts comes apart."""
        return next(g for g in self.granularities if np.float32(g) > self.agreement[node])

    def closed(self, node: int) -> float:
        """Find a granularity at which a node is one thing: that of the objects if it is one, else the finest."""
        if node < self.num_classes:
            return self.level
        return max(g for g in self.granularities if np.float32(g) <= self.agreement[node])

    def cut(self, granularity: float) -> np.ndarray:
        """Find which node stands for each at a granularity, (M,) int32: the largest that holds it and is one there.

        Nodes that come apart there stand for themselves; no Gaussian lies in them alone. Raises `SettingsError` where
        the granularity is not in [0, 1].
        """
        check_granularity(granularity)
        one = (self.parents >= 0) & (self.agreement[self.parents] >= np.float32(granularity))
        return _climbed(np.where(one, self.parents, np.arange(len(self)))).astype(np.int32)

    def labels_at(self, granularity: float, labels: np.ndarray) -> np.ndarray:
        """Node of each Gaussian at a granularity, (N,) int32, by their classes (N,), of which negative ones stay.

        A Gaussian whose class is no longer that of its leaf belongs to the largest leaf of its class.
        """
        table = self.cut(granularity)
        known = np.maximum(labels, 0)
        own = (self.leaves >= 0) & (self._classes[self.leaves] == known)
        leaf = np.where(own, self.leaves, self._largest_leaf[known])
        return np.where(labels >= 0, table[leaf], labels).astype(np.int32)

    @cached_property
    def _largest_leaf(self) -> np.ndarray:
        """Leaf with the most Gaussians of each class, (K,) int32."""
        count = np.bincount(self.leaves[self.leaves >= 0], minlength=len(self))
        count[np.unique(self.parents[self.parents >= 0])] = -1
        order = np.lexsort([-np.arange(len(self)), count])
        order = order[(self._classes[order] >= 0) & (count[order] >= 0)]
        largest = np.zeros(self.num_classes, np.int32)
        largest[self._classes[order]] = order
        return largest

    def shares_at(self, granularity: float, shares: CSRRows, leaves: np.ndarray) -> tuple[CSRRows, list[int]]:
        """Turn class probabilities of Gaussians, n rows, with the leaves (n,) into those of the nodes of a level.

        A Gaussian's probability of its leaf's class goes to its own part, that of any other class to its largest part.
        Returns probabilities (n, K') float32 and the K' nodes of that level, ascending, so that classes come first.
        """
        table = self.cut(granularity)
        nodes = np.unique(np.append(table[np.setdiff1d(np.arange(len(self)), self.parents)], 0))
        column = np.zeros(len(self), np.uint32)
        column[nodes] = np.arange(len(nodes))
        usual, leaf = column[table[self._largest_leaf]], np.repeat(leaves, np.diff(shares.indptr))
        own = (leaf >= 0) & (self._classes[leaf] == shares.indices)
        return shares.in_columns(np.where(own, column[table[leaf]], usual[shares.indices])), nodes.tolist()

    def names(self, class_names: Mapping[int, str]) -> dict[int, str]:
        """Names of all nodes: those of classes, `object_003.2` for their parts, `whole_001` for wholes."""
        names = {k: class_name(class_names, k) for k in range(self.num_classes)}
        wholes = [node for node in range(self.num_classes, len(self)) if self._classes[node] < 0]
        names |= {node: f"whole_{i:03d}" for i, node in enumerate(wholes, start=1)}
        todo = list(range(self.num_classes))
        while todo:
            node = todo.pop()
            parts = self.parts(node)
            names |= {part: f"{names[node]}.{i}" for i, part in enumerate(parts, start=1)}
            todo += parts
        return dict(sorted(names.items()))

    def inside(self, node: int) -> list[int]:
        """All nodes inside a node, each before what is inside of it."""
        return [one for part in self.parts(node) for one in (part, *self.inside(part))]

    def sizes(self, labels: np.ndarray) -> np.ndarray:
        """Count the Gaussians of each node, (M,) int64, for their classes (N,)."""
        count = np.bincount(self.labels_at(1.0, labels)[labels >= 0], minlength=len(self))
        total, at = np.zeros(len(self), np.int64), np.arange(len(self))
        while len(at):
            np.add.at(total, at, count)
            on = self.parents[at] >= 0
            at, count = self.parents[at[on]], count[on]
        return total

    def describe(self, class_names: Mapping[int, str], sizes: np.ndarray) -> list[dict[str, Any]]:
        """List the nodes that are no classes for `report.json`, parts and wholes; `sizes` has the Gaussians of all."""
        names = self.names(class_names)
        return [
            {
                "id": node,
                "name": names[node],
                "kind": self.kind(node),
                "part_of": self.whole(node),
                "made_of": self.parts(node),
                "agreement": round(float(self.agreement[node]), 4),
                "gaussians": int(sizes[node]),
            }
            for node in range(self.num_classes, len(self))
        ]


def check_granularity(granularity: float) -> None:
    """Raise `SettingsError` unless it is in [0, 1]."""
    if not 0 <= granularity <= 1:
        raise SettingsError(f"granularity is {granularity}; expected a share in [0, 1]")


def _climbed(up: np.ndarray) -> np.ndarray:  # (M,)
    """Follow `up` from each node to the end; from a node on a circle, to any other on it."""
    for _ in range(len(up).bit_length()):
        up = up[up]
    return up
