"""The state of a learner on disk: views, masks and votes of one scene, in one compressed npz."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from gsseg_core.atomic import write_atomically
from gsseg_core.cameras import Camera
from gsseg_core.dataset import View
from gsseg_core.errors import StateMismatchError
from gsseg_core.npz_files import open_npz

FORMAT = "gsseg-views-1"


def save_views(
    path: str | os.PathLike[str],
    digest: str,
    views: Iterable[View],
    votes: np.ndarray,  # (N, K) int64
) -> None:
    """Write views with their masks, the votes, and the digest of the scene that they belong to, atomically."""
    views = list(views)
    seen = np.flatnonzero(votes.any(axis=1))
    header = {
        "format": FORMAT,
        "scene": digest,
        "shape": list(votes.shape),
        "views": [{"name": view.name, "size": [view.camera.width, view.camera.height]} for view in views],
    }
    arrays = {"header": np.array(json.dumps(header)), "seen": seen.astype(np.int64), "votes": votes[seen]}
    for i, view in enumerate(views):
        arrays[f"labels_{i}"] = view.read_labels()
        arrays[f"pose_{i}"] = np.stack([np.pad(view.camera.K, (0, 1)), view.camera.world_to_camera])
    with write_atomically(path, suffix=".npz") as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def load_views(
    path: str | os.PathLike[str],
    digest: str,
    shape: tuple[int, ...],
) -> tuple[list[View], np.ndarray]:
    """Read what `save_views` wrote for the same scene and number of classes: views in memory, and votes (N, K)."""
    path = Path(path)
    with open_npz(path, "a saved state", FORMAT, digest) as (file, header):
        if tuple(header["shape"]) != tuple(shape):
            raise StateMismatchError(
                f"{path}: holds {header['shape'][0]} Gaussians and {header['shape'][1]} classes; "
                f"expected {shape[0]} and {shape[1]}"
            )
        votes = np.zeros(shape, np.int64)
        votes[file["seen"]] = file["votes"]
        views = [_read_view(file, i, entry) for i, entry in enumerate(header["views"])]
    return views, votes


def _read_view(file: np.lib.npyio.NpzFile, i: int, entry: dict[str, object]) -> View:
    width, height = (int(side) for side in entry["size"])  # type: ignore[attr-defined]
    pose = file[f"pose_{i}"]
    camera = Camera(str(entry["name"]), width, height, pose[0, :3, :3], pose[1])
    return View.from_arrays(camera, file[f"labels_{i}"])
