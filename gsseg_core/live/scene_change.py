"""Which views a change of the scene can touch, told without rendering any of them.

A view's votes depend on the Gaussians that reach its image, in the frame of its group, and on nothing else. So they
stay what they are, bit for bit, unless one that changed in this frame reaches the image, where it was or where it is.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.view import View
from gsseg_core.raster.cpu.occlusion import nearest_depths
from gsseg_core.scene.group_frames import relation
from gsseg_core.scene.living_scene import LivingScene

_MARGIN = 1 + 1e-5

Rows = TypeVar("Rows", np.ndarray, CSRRows)
"""What Gaussians have, dense or sparse."""


class SceneChange:
    """What differs between a scene of N Gaussians and of N' after a change, seen from the frame of each group.

    `origin` says where each was before, (N',) int64; -1 for those that were not there.
    """

    def __init__(self, before: LivingScene, after: LivingScene, origin: np.ndarray) -> None:
        self.before, self.after, self.origin = before, after, origin
        self._new = (origin < 0) | ~_are_alike(before, after, origin)
        kept = origin[~self._new]
        # Gaussians that are alike in all are blended in their order, which must stay.
        self.keeps_order = bool((np.diff(origin[origin >= 0]) > 0).all())
        self._gone = np.ones(len(before), bool)
        self._gone[kept] = False
        self._parts: dict[int | None, tuple[np.ndarray, np.ndarray]] = {}

    def touches(self, view: View, ends: Callable[[], np.ndarray] | None = None) -> bool:
        """Whether the votes of a view, which keeps its group and pose, may be others than before.

        None of its Gaussians is rendered: those that changed are projected, as lifting would project them. If some
        reach the image, `ends` is asked where the view's rays end, as `raster.cpu.occlusion.ray_ends` tells: behind
        that, they change nothing.
        """
        if not self.keeps_order:
            return True
        depths = [
            nearest_depths(scene.part_seen_from(view.group, part), view.camera)
            for scene, part in zip((self.before, self.after), self._changed(view.group), strict=True)
            if len(part)
        ]
        nearest = np.minimum.reduce(depths) if depths else np.array(np.inf)
        if np.isinf(nearest).all():
            return False
        # Depths are compared with a margin many times what rounding could make of them.
        return ends is None or bool((nearest < np.inf)[nearest <= ends() * _MARGIN].any())

    def carry(self, rows: Rows) -> Rows:  # (N, ...)
        """Take what Gaussians had before along to where they are, (N', ...); zeros for those that were not there."""
        return carried(rows, self.origin)

    def has_flattened(self, group: int) -> bool:
        """Whether Gaussians of a group are given afterwards as they lay in the scene, and not as in the group's frame.

        So it is where the scene was read from a file in between. Where the frame was that of the scene, it is all one.
        """
        found = self.origin >= 0
        found[found] = self.before.groups[self.origin[found]] == group
        if not found.any():
            return False
        now, places = self.after.local.means[found], self.origin[found]
        in_scene, in_group = (
            np.median(np.linalg.norm(now - scene.means[places], axis=1))
            for scene in (self.before.scene, self.before.local)
        )
        return bool(in_scene < in_group)

    def _changed(self, group: int | None) -> tuple[np.ndarray, np.ndarray]:
        """Places of the Gaussians that changed in the frame of a group, before (M,) and after (M',).

        Those of another group did if it lies otherwise in that frame than before.
        """
        if group not in self._parts:
            before, after = self.before, self.after
            apart = [
                other
                for other, frame in before.frames.items()
                if other not in after.frames
                or relation(before.frame(group), frame) != relation(after.frame(group), after.frame(other))
            ]
            gone, new = self._gone, self._new
            self._parts[group] = (
                np.flatnonzero(gone | np.isin(before.groups, apart)),
                np.flatnonzero(new | np.isin(after.groups, apart)),
            )
        return self._parts[group]


def carried(rows: Rows, origin: np.ndarray) -> Rows:  # (N, ...), (N',)
    """Take rows of Gaussians along to where they are, (N', ...); zeros where the origin is -1."""
    if isinstance(rows, CSRRows):
        return CSRRows.empty(len(origin), rows.data.dtype).replaced(origin, rows)
    out = np.zeros((len(origin), *rows.shape[1:]), rows.dtype)
    found = origin >= 0
    out[found] = rows[origin[found]]
    return out


def _are_alike(before: LivingScene, after: LivingScene, origin: np.ndarray) -> np.ndarray:
    """Whether each Gaussian after a change is of the same group and geometry as before, bit for bit, (N',) bool."""
    alike: np.ndarray = before.groups[origin] == after.groups
    for name in ("means", "quats", "scales", "opacities"):
        same = getattr(before.local, name)[origin] == getattr(after.local, name)
        alike &= same if same.ndim == 1 else same.all(axis=1)
    return alike
