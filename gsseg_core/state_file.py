"""What has been learnt of one scene, on disk: views with their masks, votes and codes, in one compressed npz."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gsseg_core.atomic import write_atomically
from gsseg_core.cameras import Camera
from gsseg_core.dataset import View
from gsseg_core.errors import PathTakenError, StateFileError
from gsseg_core.meaning import Meaning
from gsseg_core.npz_files import npz_format, open_npz
from gsseg_core.soft_masks import SeenLabels

FORMAT = "gsseg-state-1"


@dataclass(frozen=True, eq=False)
class Learnt:
    """Codes that a learner came to.

    Attributes
    ----------
    learner : str
        Its name.
    codes : (N, K) float32
        Class probabilities; a row of zeros where no labelled pixel saw the Gaussian.
    num_views : int
        Views that it learnt from.
    temperature : float
        At which the codes are probabilities, see `gsseg_core.held_out`.
    """

    learner: str
    codes: np.ndarray
    num_views: int
    temperature: float = 1.0


@dataclass(frozen=True, eq=False)
class State:
    """What is saved.

    Attributes
    ----------
    votes : (N, K) int64
        Votes of all views so far, in units of `VOTE_UNIT`.
    views : list of View
        Those that were kept, in the order in which they came.
    num_fused : int
        Views in the votes, at least as many as were kept.
    class_names : dict of int to str
        Names by id, as far as they are known.
    learnt : Learnt or None
        The best codes.
    """

    votes: np.ndarray
    views: list[View]
    num_fused: int
    class_names: dict[int, str] = field(default_factory=dict)
    learnt: Learnt | None = None

    def save(self, path: str | os.PathLike[str], digest: str) -> None:
        """Write the state of the scene with this digest, atomically. The scene itself is not in the file.

        Raises
        ------
        PathTakenError
            Something is there that is no saved state; it is unchanged.
        WriteError
            The file cannot be written; an earlier one is unchanged.
        """
        path = Path(path)
        _require_replaceable(path)
        seen = np.flatnonzero(self.votes.any(axis=1))
        header: dict[str, Any] = {
            "format": FORMAT,
            "scene": digest,
            "shape": list(self.votes.shape),
            "views": [{"name": view.name, "size": [view.camera.width, view.camera.height]} for view in self.views],
            "num_fused": self.num_fused,
            "class_names": self.class_names,
        }
        arrays = {"seen": seen.astype(np.int64), "votes": self.votes[seen]}
        if self.learnt is not None:
            header["learnt"] = {
                "learner": self.learnt.learner,
                "num_views": self.learnt.num_views,
                "temperature": self.learnt.temperature,
            }
            arrays["codes"] = self.learnt.codes
        for i, view in enumerate(self.views):
            arrays[f"labels_{i}"], meaning = view.read_seen()
            if meaning is not None and meaning.mass is not None:
                arrays[f"classes_{i}"], arrays[f"mass_{i}"] = meaning.classes, meaning.mass
                if meaning.supervised is not None:
                    arrays[f"supervised_{i}"] = meaning.supervised
            arrays[f"pose_{i}"] = np.stack([np.pad(view.camera.K, (0, 1)), view.camera.world_to_camera])
        with write_atomically(path, suffix=".npz") as temporary, open(temporary, "wb") as file:
            np.savez_compressed(file, allow_pickle=False, header=np.array(json.dumps(header)), **arrays)
            _require_replaceable(path)  # To save takes long.

    @classmethod
    def load(cls, path: str | os.PathLike[str], digest: str, num_gaussians: int, within: Path | None = None) -> State:
        """Read what was saved for the same scene; with `within`, from below that folder, links followed.

        Raises
        ------
        StateFileError
            The file is missing or damaged.
        StateMismatchError
            It belongs to another scene.
        PathNotAllowedError
            The file lies outside `within`.
        """
        path = Path(path)
        with open_npz(path, "a saved state", FORMAT, digest, within) as (file, header):
            n, k = (int(size) for size in header["shape"])
            if n != num_gaussians:
                raise StateFileError(f"{path}: holds {n} Gaussians; expected {num_gaussians}, as the scene has")
            votes = np.zeros((n, k), np.int64)
            votes[file["seen"]] = file["votes"]
            learnt = None
            if "learnt" in header:
                entry = header["learnt"]
                temperature = float(entry.get("temperature", 1.0))  # earlier files have none
                learnt = Learnt(str(entry["learner"]), file["codes"], int(entry["num_views"]), temperature)
                if learnt.codes.ndim != 2 or len(learnt.codes) != n:
                    raise StateFileError(f"{path}: codes have shape {learnt.codes.shape}; expected ({n}, K)")
            return cls(
                votes,
                [_read_view(file, i, entry) for i, entry in enumerate(header["views"])],
                int(header["num_fused"]),
                {int(k): str(name) for k, name in header["class_names"].items()},
                learnt,
            )


def _require_replaceable(path: Path) -> None:
    if os.path.lexists(path) and npz_format(path) != FORMAT:
        raise PathTakenError(f"{path}: is there and is no saved state; expected a new file, or a state to replace")


def _read_view(file: np.lib.npyio.NpzFile, i: int, entry: dict[str, Any]) -> View:
    width, height = (int(side) for side in entry["size"])
    pose = file[f"pose_{i}"]
    camera = Camera(str(entry["name"]), width, height, pose[0, :3, :3], pose[1])
    labels = file[f"labels_{i}"]
    if f"mass_{i}" not in file.files:
        return View.from_arrays(camera, labels)
    supervised = file[f"supervised_{i}"] if f"supervised_{i}" in file.files else None
    meaning = Meaning(file[f"classes_{i}"], file[f"mass_{i}"], supervised)
    if meaning.mass is None or meaning.mass.shape != (labels.max() + 1, len(meaning.classes)):
        raise StateFileError(f"view '{camera.name}': mask and what it means do not fit; expected one row per label")
    return View.from_seen(camera, SeenLabels(labels, meaning))
