"""Replays a dataset as SLAM would see it: the scene arrives in submaps while it drives, and at last a loop closes."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gsseg_core.errors import NoUsableViewsError
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.group_frames import moved_scene
from gsseg_core.scene.scene_delta import GroupMove, SceneDelta
from gsseg_core.scene.similarity import Similarity
from gsseg_ros.conversions import stamp_ns
from gsseg_ros.delta_messages import message_from_delta
from gsseg_ros.replay.sources import FolderSource, Group

SUBMAPS = 5
SCENE_DELTA = "scene_delta"

_DRIFT = 0.01  # by how much a submap lies off, and is turned, per submap since the first: of the scene's size, radians
_GROWTH = 1.005  # and by how much it is too large
_PAUSE = 10.0  # masks that the node gets to fuse what came, before the loop closes and names the views


class GrowingSource(FolderSource):
    """The views of a dataset folder, and between them the scene, submap by submap.

    The node has the whole scene of the folder, `scene.ply`. The first message leaves of it the first submap; the others
    arrive one by one before their share of the views, each, with the poses of its views, a little more off than the one
    before. At the end one message moves every submap to where it belongs, and names its views by their stamps. Raises
    `GssegError`: as `FolderSource` and `GaussianScene.load` do; `NoUsableViewsError`: there are fewer views than
    submaps.
    """

    def __init__(
        self, folder: Path, labels: str, split: str, frame_id: str, map_frame: str, submaps: int = SUBMAPS
    ) -> None:
        super().__init__(folder, labels, split, frame_id, map_frame)
        if len(self._views) < submaps:
            raise NoUsableViewsError(f"{folder}: {len(self._views)} views; expected at least {submaps}, one per submap")
        self._scene = GaussianScene.load(folder / "scene.ply")
        # Submaps are slices along the scene's longest side.
        low, high = np.percentile(self._scene.means, (5, 95), axis=0)
        along = self._scene.means[:, int((high - low).argmax())]
        self._parts = np.array_split(np.argsort(along, kind="stable"), submaps)
        self._drifts = [_drift(i, float((high - low).max())) for i in range(submaps)]
        self.description += f", the scene in {submaps} submaps"

    def __iter__(self) -> Iterator[Group]:
        """Give one submap after the other with its views, and then close the loop."""
        bounds = np.linspace(0, len(self._views), len(self._parts) + 1).round().astype(int)
        chunks = [self._views[first:last] for first, last in itertools.pairwise(bounds)]
        sent: list[list[Any]] = []
        due = 0.0
        for i, (drift, views) in enumerate(zip(self._drifts, chunks, strict=True)):
            yield Group(due, ((SCENE_DELTA, message_from_delta(self._arrival(i))),))
            infos = []
            for view in views:
                messages = tuple(self._messages(replace(view, camera=drift.camera(view.camera))))
                infos += [message for topic, message in messages if topic == "camera_info"]
                yield Group(due, messages)
                due += 1
            sent.append(infos)
        # Stamps were given when the messages went out.
        moves = tuple(
            GroupMove(i, drift.inverse(), tuple(str(stamp_ns(info.header.stamp)) for info in infos))
            for i, (drift, infos) in enumerate(zip(self._drifts, sent, strict=True))
            if i > 0
        )
        closure = SceneDelta(revision=len(self._parts) + 1, moves=moves)
        yield Group(due + _PAUSE, ((SCENE_DELTA, message_from_delta(closure)),))

    def _arrival(self, i: int) -> SceneDelta:
        """Make the change that submap i arrives with."""
        part = np.sort(self._parts[i])
        if i == 0:
            return SceneDelta(revision=1, removed=np.setdiff1d(np.arange(len(self._scene)), part))
        # A group's frame is that of the scene at first: it arrives where SLAM believes it to be.
        added = moved_scene(self._scene.subset(part), self._drifts[i])
        groups = np.full(len(part), i, np.int64)
        return SceneDelta(revision=i + 1, added=added, added_ids=part, added_groups=groups)


def _drift(i: int, size: float) -> Similarity:
    angle = _DRIFT * i
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    return Similarity(_GROWTH**i, turn, size * angle * np.array([0.6, -0.6, 0.5]))
