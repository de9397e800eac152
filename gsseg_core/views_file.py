"""The state of a learner on disk: views, masks and votes of one scene, in one compressed npz."""

from __future__ import annotations

import json
import os
import struct
import zipfile
import zlib
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from gsseg_core.atomic import write_atomically
from gsseg_core.cameras import Camera
from gsseg_core.dataset import View
from gsseg_core.errors import GssegError, StateFileError, StateMismatchError

FORMAT = "gsseg-views-1"

# What NumPy, zipfile and zlib raise on damaged bytes; RuntimeError where a flipped bit says "encrypted".
_DAMAGED = (
    OSError, KeyError, IndexError, ValueError, TypeError, AttributeError, EOFError, RuntimeError, MemoryError,
    struct.error, zipfile.BadZipFile, zlib.error,
)  # fmt: skip


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
    try:
        # Opened here, since np.load leaves a file open that it cannot read.
        with open(path, "rb") as opened, np.load(opened, allow_pickle=False) as file:
            header = json.loads(str(file["header"]))
            if header["format"] != FORMAT:
                raise StateFileError(f"{path}: format is {header['format']!r}; expected {FORMAT!r}")
            if header["scene"] != digest:
                raise StateMismatchError(
                    f"{path}: belongs to the scene {header['scene'][:12]}; expected {digest[:12]}, the scene in use"
                )
            if tuple(header["shape"]) != tuple(shape):
                raise StateMismatchError(
                    f"{path}: holds {header['shape'][0]} Gaussians and {header['shape'][1]} classes; "
                    f"expected {shape[0]} and {shape[1]}"
                )
            votes = np.zeros(shape, np.int64)
            votes[file["seen"]] = file["votes"]
            return [_read_view(file, i, entry) for i, entry in enumerate(header["views"])], votes
    except GssegError:
        raise
    except FileNotFoundError as error:
        raise StateFileError(f"{path}: does not exist; expected a saved state") from error
    except _DAMAGED as error:
        raise StateFileError(f"{path}: is not a saved state, or is damaged ({error})") from error


def _read_view(file: np.lib.npyio.NpzFile, i: int, entry: dict[str, object]) -> View:
    width, height = (int(side) for side in entry["size"])  # type: ignore[attr-defined]
    pose = file[f"pose_{i}"]
    camera = Camera(str(entry["name"]), width, height, pose[0, :3, :3], pose[1])
    return View.from_arrays(camera, file[f"labels_{i}"])
