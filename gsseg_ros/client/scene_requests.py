"""Requests of a client that replace or change a node's scene and what it knows, or that write files."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from gsseg_msgs.srv import Export, LoadScene, LoadState, MergeStates, Reset, SaveState, UpdateScene

from gsseg_core.scene.scene_delta import SceneDelta
from gsseg_ros.client.calls import class_names, refinement
from gsseg_ros.client.connection import Connection
from gsseg_ros.client.results import Exported, LoadedScene, LoadedState, MergedStates, SavedState, UpdatedScene
from gsseg_ros.conversions import array_from_point
from gsseg_ros.delta_messages import message_from_delta


class SceneRequests(Connection):
    """Loads, changes, saves and exports what a node has; see `SegmentationClient`."""

    def load_scene(
        self,
        path: str | os.PathLike[str] = "",
        *,
        keep_votes: bool = False,
        tolerance: float = 0.0,
        timeout: float = 120.0,
    ) -> LoadedScene:
        """Load another scene, and forget all views and what was learnt; by default the node's `scene_path` again.

        With `keep_votes` it has grown out of the one that is there, and nothing is forgotten: Gaussians are found by
        ids, or within `tolerance` (scene units) of where they were.
        """
        request = LoadScene.Request(path=os.fspath(path), keep_votes=keep_votes, tolerance=float(tolerance))
        answer = self._call(LoadScene, request, timeout)
        box = array_from_point(answer.box_min), array_from_point(answer.box_max)
        carried = answer.num_carried if keep_votes else None
        return LoadedScene(Path(answer.path), answer.scene_hash, answer.num_gaussians, box, carried, answer.matched_by)

    def update_scene(self, change: SceneDelta | str | os.PathLike[str], *, timeout: float = 60.0) -> UpdatedScene:
        """Change the scene, and keep what was learnt: by a `gsseg_core.scene.scene_delta.SceneDelta`, or a file of one.

        A view that the change names is called by its stamp in nanoseconds, or by its name.
        """
        request = UpdateScene.Request()
        if isinstance(change, SceneDelta):
            request.delta = message_from_delta(change)
        else:
            request.path = os.fspath(change)
        answer = self._call(UpdateScene, request, timeout)
        counts = {name: getattr(answer, name) for name in UpdatedScene.__dataclass_fields__ if name != "digest"}
        return UpdatedScene(digest=answer.scene_hash, **counts)

    def merge_states(
        self, paths: Sequence[str | os.PathLike[str]] | str | os.PathLike[str], *, timeout: float = 120.0
    ) -> MergedStates:
        """Add what other robots have saved of the same scene to what the node knows, exactly."""
        paths = [paths] if isinstance(paths, str | os.PathLike) else paths
        answer = self._call(MergeStates, MergeStates.Request(paths=[os.fspath(path) for path in paths]), timeout)
        return MergedStates(dict(enumerate(answer.class_names)), answer.num_views, answer.num_merged)

    def save_state(self, path: str | os.PathLike[str] = "", *, timeout: float = 60.0) -> SavedState:
        """Save votes, views and class probabilities; by default in gsseg_state.npz in `data_root`."""
        answer = self._call(SaveState, SaveState.Request(path=os.fspath(path)), timeout)
        return SavedState(Path(answer.path), answer.num_bytes, answer.num_views)

    def load_state(self, path: str | os.PathLike[str] = "", *, timeout: float = 60.0) -> LoadedState:
        """Load a saved state in place of the present one."""
        answer = self._call(LoadState, LoadState.Request(path=os.fspath(path)), timeout)
        return LoadedState(Path(answer.path), dict(enumerate(answer.class_names)), answer.num_views)

    def export(
        self,
        directory: str | os.PathLike[str] = "",
        classes: Sequence[str | int] = (),
        min_confidence: float = 0.0,
        refine: bool | str = True,
        filter: bool = True,
        format: str = "",
        collision: str = "",
        *,
        timeout: float = 120.0,
    ) -> Exported:
        """Write segmentation.npz, one PLY per class, and report.json; by default to gsseg_export in `data_root`.

        `format` and `collision` are those of `gsseg segment`; by default as the node's parameter `export_format` says,
        without meshes. Objects are cut to their silhouettes unless `refine` is "paper".
        """
        request = Export.Request(
            directory=os.fspath(directory),
            classes=class_names(classes),
            min_confidence=float(min_confidence),
            format=format,
            collision=collision,
            **refinement(refine, filter),
        )
        answer = self._call(Export, request, timeout)
        folder = Path(answer.directory)
        return Exported(folder, [folder / name for name in answer.files], answer.report)

    def reset(self, *, timeout: float = 30.0) -> int:
        """Forget all views and what was learnt, and clear the clouds; return how many views were forgotten."""
        return int(self._call(Reset, Reset.Request(), timeout).num_views_dropped)
