"""A scene that changes while it is in use: Gaussians with ids that stay, in groups that move as one.

Every Gaussian is kept as it was given, in the frame of its group; a move changes the frame alone. So rounding does not
add up over a thousand moves, and what one group's views see of that group alone stays the same bit for bit, wherever
the group goes. See docs/living_map.md.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from gsseg_core.errors import EmptySceneError, GssegError, SceneDeltaError
from gsseg_core.files.input_files import UnfitError
from gsseg_core.files.json_files import whole_number
from gsseg_core.files.npz_files import NpzArrays
from gsseg_core.scene.gaussian_scene import ACTIVATED, GaussianScene
from gsseg_core.scene.group_frames import IDENTITY, joined, moved_geometry, moved_scene, relation
from gsseg_core.scene.scene_delta import MAX_ID, SceneDelta, read_similarity, similarity_entry, straightened
from gsseg_core.scene.scene_ids import with_ids
from gsseg_core.scene.similarity import Similarity
from gsseg_core.scene.vertices import GEOMETRY, columns, pack_vertices

_FRAMES_KEPT = 2  # scenes in the frames of groups; views of one group come one after the other


@dataclass(frozen=True, eq=False)
class LivingScene:
    """N Gaussians with stable ids, in groups, each with a frame; make the first with `of`, the next with `apply`.

    Attributes
    ----------
    scene : GaussianScene
        The Gaussians as they are now, in the frame of the scene; labels are in their order.
    local : GaussianScene
        The same, each in the frame of its group, as it was given.
    ids : (N,) int64
        Ids that stay.
    groups : (N,) int64
        The group of each.
    frames : mapping from group to Similarity
        How the frame of each group lies in that of the scene.
    revision : int or None
        Number of the last change; None if there was none.
    """

    scene: GaussianScene
    local: GaussianScene
    ids: npt.NDArray[np.int64]  # (N,)
    groups: npt.NDArray[np.int64]  # (N,)
    frames: Mapping[int, Similarity]
    revision: int | None = None
    _seen: dict[int, GaussianScene] = field(default_factory=dict, repr=False)
    _seeing: threading.Lock = field(default_factory=threading.Lock, repr=False)

    @classmethod
    def of(cls, scene: GaussianScene) -> LivingScene:
        """Begin with a scene: all of it is group 0. Ids are those of its file, or else count from 0."""
        ids = scene.ids
        ids = np.arange(len(scene)) if ids is None else ids
        return cls(scene, scene, ids, np.zeros(len(scene), np.int64), {0: IDENTITY})

    @classmethod
    def placed(
        cls, local: GaussianScene, ids: npt.NDArray[np.int64], groups: npt.NDArray[np.int64],
        frames: Mapping[int, Similarity],
    ) -> LivingScene:  # fmt: skip
        """Make a scene of N Gaussians, given in the frames of their groups."""
        far = _are_far(groups, frames)
        scene = cls._placed(local, local, groups, frames, far) if far.any() else local
        return cls(scene, local, ids, groups, frames)

    @classmethod
    def numbered(cls, scene: GaussianScene, ids: npt.NDArray[np.int64]) -> LivingScene:  # (N,)
        """Begin with a scene, as `of`, with these ids."""
        return cls.of(replace(scene, vertices=with_ids(scene.vertices, None, ids)))

    @classmethod
    def read(cls, file: NpzArrays, header: dict[str, Any]) -> LivingScene | None:
        """Read a scene, colourless, if the npz of a saved state holds one; `UnfitError` if what is there is none."""
        if "geometry" not in file.names:
            return None
        geometry = file.expect("geometry", np.float32, (None, len(GEOMETRY)))
        ids, groups = (file.expect(name, np.int64, (len(geometry),)) for name in ("ids", "groups"))
        if ids.min(initial=0) < 0 or len(np.unique(ids)) < len(ids):
            raise UnfitError(
                "array ids holds negative numbers, or some twice; expected another from 0 for each Gaussian"
            )
        try:
            frames = {
                whole_number(entry["group"], "group of a frame", 0, MAX_ID): read_similarity(entry)
                for entry in header["frames"]
            }
            if not np.isin(groups, list(frames)).all():
                raise UnfitError(
                    f"array groups holds other groups than the {len(frames)} of its frames; expected those"
                )
            return cls.placed(_colourless(geometry), ids, groups, frames)
        except GssegError as error:
            raise UnfitError(
                f"its scene is unusable ({error}); expected Gaussians, and a similarity per group"
            ) from error

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Arrays that `read` takes, besides the frames: ids, groups, and geometry without colours."""
        return {"ids": self.ids, "groups": self.groups, "geometry": columns(self.local.vertices, GEOMETRY)}

    def frame_entries(self) -> list[dict[str, Any]]:
        """Frames of the groups, as `read` takes them, for a JSON header."""
        return [{"group": group, **similarity_entry(frame)} for group, frame in self.frames.items()]

    def without_colours(self) -> LivingScene:
        """Drop the colours of the scene: its votes stay the same, bit for bit, and it takes a fifth of the memory."""
        local = _colourless(columns(self.local.vertices, GEOMETRY))
        return LivingScene.placed(local, self.ids, self.groups, self.frames)

    def flat(self) -> LivingScene:
        """Make one group of the scene as it is now, whose frame is that of the scene; ids stay."""
        return LivingScene(self.scene, self.scene, self.ids, np.zeros(len(self), np.int64), {0: IDENTITY})

    def __len__(self) -> int:
        """Count the Gaussians."""
        return len(self.ids)

    @cached_property
    def _order(self) -> npt.NDArray[np.intp]:
        return np.argsort(self.ids, kind="stable")

    def places(self, ids: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:  # (M,)
        """Find Gaussians by their ids: their places, (M,) int64; -1 where there is none."""
        order = self._order
        found = order[np.minimum(np.searchsorted(self.ids, ids, sorter=order), len(order) - 1)]
        return np.where(self.ids[found] == ids, found, -1)

    def frame(self, group: int | None) -> Similarity:
        """How the frame of a group lies in that of the scene; of None, which is the scene, the identity."""
        return IDENTITY if group is None else self.frames[group]

    def seen_from(self, group: int | None) -> GaussianScene:
        """All Gaussians in the frame of a group, in which its views are lifted; of None, in that of the scene."""
        if group is None:
            return self.scene
        if all(relation(self.frames[group], frame) is IDENTITY for frame in self.frames.values()):
            return self.local
        with self._seeing:
            if group not in self._seen:
                while len(self._seen) >= _FRAMES_KEPT:
                    del self._seen[next(iter(self._seen))]
                self._seen[group] = self._in_frame(group, np.arange(len(self)))
            return self._seen[group]

    def part_seen_from(self, group: int | None, places: npt.NDArray[np.int64]) -> GaussianScene:  # (M,), M > 0
        """Pick some of the Gaussians of `seen_from`, bit for bit; positions and shapes only."""
        return self.scene.subset(places) if group is None else self._in_frame(group, places)

    def apply(self, delta: SceneDelta) -> tuple[LivingScene, npt.NDArray[np.int64]]:
        """Make the scene after a change.

        Returns
        -------
        after : LivingScene
            N' Gaussians: those that stay, in their order, and behind them those that are added.
        origin : (N',) int64
            Where each was before; -1 for those that are added.

        Raises
        ------
        SceneDeltaError
            It is out of turn, or names Gaussians or groups that are not there, or adds ids that are.
        EmptySceneError
            Nothing would be left.
        """
        revision = self._next_revision(delta)
        stays = self._stays(delta)
        origin = np.concatenate([np.flatnonzero(stays), np.full(len(delta.added_ids), -1)])
        if not len(origin):
            raise EmptySceneError("scene delta: removes the last Gaussian; expected one to be left at least")
        frames = {**{group: IDENTITY for group in np.unique(delta.added_groups).tolist()}, **self.frames}
        for move in delta.moves:
            if move.group not in frames:
                raise SceneDeltaError(f"scene delta: moves group {move.group}, which holds no Gaussian; expected one "
                                      f"of {len(frames)} groups")  # fmt: skip
            frames[move.group] = straightened(move.motion.after(frames[move.group]))
        ids = np.concatenate([self.ids[stays], delta.added_ids])
        groups = np.concatenate([self.groups[stays], delta.added_groups])
        local = joined(self.local, stays, delta.added, ids)
        scene = local if self.scene is self.local else joined(self.scene, stays, delta.added, ids)
        # What is added to a group that was moved before is in its frame, too.
        changed = np.isin(groups, [move.group for move in delta.moves]) | ((origin < 0) & _are_far(groups, frames))
        if changed.any():
            scene = self._placed(scene, local, groups, frames, changed)
        return LivingScene(scene, local, ids, groups, frames, revision), origin

    def _next_revision(self, delta: SceneDelta) -> int | None:
        if delta.revision is None:
            return 1 if self.revision is None else self.revision + 1
        if self.revision is not None and delta.revision != self.revision + 1:
            raise SceneDeltaError(
                f"scene delta: its revision is {delta.revision}; expected {self.revision + 1}, as the scene is at "
                f"{self.revision}: one came twice, too early, or was lost. After one that was lost, load the scene as "
                "it is now and keep the votes (replace_scene, or ~/load_scene with keep_votes); any revision may follow"
            )
        return delta.revision

    def _stays(self, delta: SceneDelta) -> npt.NDArray[np.bool_]:
        """Mark the Gaussians that are not removed, (N,), once all ids of a change are checked."""
        stays, places = np.ones(len(self), bool), self.places(delta.removed)
        if (missing := delta.removed[places < 0]).size:
            raise SceneDeltaError(f"scene delta: removes {missing.size} ids that the scene does not have (first "
                                  f"{missing[0]}); expected ids of its {len(self)} Gaussians")  # fmt: skip
        stays[places] = False
        places = self.places(delta.added_ids)
        taken = delta.added_ids[(places >= 0) & stays[places]]
        if taken.size:
            raise SceneDeltaError(f"scene delta: adds {taken.size} ids that the scene has already (first {taken[0]}); "
                                  "expected new ones, or that it removes them, too")  # fmt: skip
        return stays

    def _in_frame(self, group: int, places: npt.NDArray[np.int64]) -> GaussianScene:
        """Gaussians in the frame of a group: those of groups that have not moved against it, exactly as given."""
        of, local = self.groups[places], self.local
        # Nobody asks for colours here, and vertices are four fifths of a scene.
        arrays = {name: getattr(local, name)[places] for name in ACTIVATED}
        part = replace(local, **arrays, vertices=local.vertices[:0])
        for other in np.unique(of).tolist():
            apart = relation(self.frames[group], self.frames[other])
            if apart is not IDENTITY:
                part = moved_geometry(part, of == other, apart)
        return part

    @staticmethod
    def _placed(
        scene: GaussianScene, local: GaussianScene, groups: npt.NDArray[np.int64],
        frames: Mapping[int, Similarity], changed: npt.NDArray[np.bool_],  # (N,)
    ) -> GaussianScene:  # fmt: skip
        """Move the Gaussians that changed to where the frames of their groups put them; the rest stay as they are."""
        arrays: dict[str, Any] = {name: getattr(scene, name).copy() for name in (*ACTIVATED, "vertices")}
        for group in np.unique(groups[changed]).tolist():
            here = changed & (groups == group)
            part = local.subset(here)
            if frames[group] != IDENTITY:
                part = moved_scene(part, frames[group])
            for name, array in arrays.items():
                array[here] = getattr(part, name)
        return replace(scene, **arrays)


def _are_far(groups: npt.NDArray[np.int64], frames: Mapping[int, Similarity]) -> npt.NDArray[np.bool_]:  # (N,)
    """Mark the Gaussians of groups that are not where they were given, (N,)."""
    return np.isin(groups, [group for group, frame in frames.items() if frame != IDENTITY])


def _colourless(geometry: npt.NDArray[np.float32]) -> GaussianScene:  # (N, 11)
    means, logits, scales, quats = geometry[:, :3], geometry[:, 3], geometry[:, 4:7], geometry[:, 7:]
    black = np.zeros((len(geometry), 3), np.float32)
    return GaussianScene.from_vertices(pack_vertices(means, quats, scales, logits, black), None)
