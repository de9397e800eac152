"""What changes in a scene while it is in use: Gaussians removed and added, and groups of them moved."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gsseg_core.errors import GssegError, SceneDeltaError
from gsseg_core.files.input_files import UnfitError
from gsseg_core.files.json_files import whole_number
from gsseg_core.files.limits import LIMITS
from gsseg_core.files.npz_files import NpzArrays, open_npz, write_npz
from gsseg_core.scene.gaussian_scene import ACTIVATED, GaussianScene
from gsseg_core.scene.similarity import Similarity
from gsseg_core.text import clipped, quoted

FORMAT = "gsseg-delta-1"
MAX_ID = 2**63 - 1

_ORTHONORMAL = 1e-6  # Rotations that were once float32 are off by less.
_ARRAYS = (*ACTIVATED, "sh")


def _no_ids() -> npt.NDArray[np.int64]:
    return np.empty(0, np.int64)


@dataclass(frozen=True, eq=False)
class GroupMove:
    """A motion of all Gaussians of a group, and of the views that move along.

    Attributes
    ----------
    group : int
        Whose Gaussians move; views that belong to the group move with them.
    motion : Similarity
        From where they are in the scene to where they will be.
    views : tuple of str
        Names of views that belong to the group from now on, and move along. Names that nobody knows are no error: a
        session keeps only the last views.
    """

    group: int
    motion: Similarity
    views: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class SceneDelta:
    """A change of a scene: what is removed goes first, then comes what is added, and at last groups move, in turn.

    An id that is both removed and added is a Gaussian that is replaced.

    Attributes
    ----------
    revision : int or None
        Number of the scene that it makes, one above that of the scene that it is meant for; None for the next one.
    removed : (R,) int64
        Ids of Gaussians.
    added : GaussianScene or None
        M Gaussians, in the frames of their groups.
    added_ids : (M,) int64
        Their ids, from 0.
    added_groups : (M,) int64
        Their groups, from 0. A new group's frame is that of the scene, until it is moved.
    moves : tuple of GroupMove
        Motions of groups.

    Raises
    ------
    SceneDeltaError
        Ids or groups are no int64, negative, doubled, or not as many as Gaussians are added, or a motion is no
        similarity.
    """

    revision: int | None = None
    removed: npt.NDArray[np.int64] = field(default_factory=_no_ids)
    added: GaussianScene | None = None
    added_ids: npt.NDArray[np.int64] = field(default_factory=_no_ids)
    added_groups: npt.NDArray[np.int64] = field(default_factory=_no_ids)
    moves: tuple[GroupMove, ...] = ()

    def __post_init__(self) -> None:
        """Validate."""
        count = 0 if self.added is None else len(self.added)
        for name in ("added_ids", "added_groups"):
            if len(getattr(self, name)) != count:
                raise SceneDeltaError(f"scene delta: {name} are {len(getattr(self, name))}; expected {count}, one "
                                      "for each Gaussian that is added")  # fmt: skip
        for name in ("removed", "added_ids", "added_groups"):
            numbers = getattr(self, name)
            if numbers.dtype != np.int64 or numbers.ndim != 1 or numbers.min(initial=0) < 0:
                raise SceneDeltaError(
                    f"scene delta: {name} hold {clipped(numbers.tolist())}, {numbers.dtype} {numbers.shape}; expected "
                    "whole numbers from 0, int64 (M,)"
                )
            ordered = np.sort(numbers)
            if name != "added_groups" and len(doubled := ordered[1:][ordered[1:] == ordered[:-1]]):
                raise SceneDeltaError(f"scene delta: {name} hold {doubled[0]} twice; expected every id once")
        if not isinstance(self.revision, int | np.integer | None):
            raise SceneDeltaError(f"scene delta: revision is {clipped(self.revision)}; expected a whole number")
        for move in self.moves:
            if not 0 <= move.group <= MAX_ID:
                raise SceneDeltaError(f"scene delta: moves group {move.group}; expected a number from 0")
            check_similarity(move.motion, f"scene delta: the motion of group {move.group}")

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write it as one npz, atomically; raises `WriteError`."""
        moves = [
            {"group": move.group, **similarity_entry(move.motion), "views": list(move.views)} for move in self.moves
        ]
        arrays: dict[str, npt.ArrayLike] = {"removed": self.removed}
        if self.added is not None:
            arrays |= {"added_ids": self.added_ids, "added_groups": self.added_groups}
            arrays |= {name: getattr(self.added, name) for name in _ARRAYS}
        write_npz(path, {"format": FORMAT, "revision": self.revision, "moves": moves}, **arrays)

    @classmethod
    def load(cls, path: str | os.PathLike[str], within: Path | None = None) -> SceneDelta:
        """Read what `save` wrote, below `within` if given, links followed; all of it is checked.

        Raises
        ------
        SceneDeltaError
            The file is missing or damaged, or holds what is no delta.
        PathNotAllowedError
            The file lies outside `within`.
        """
        with open_npz(Path(path), "a scene delta", (FORMAT,), None, within, SceneDeltaError) as (file, header):
            try:
                return cls._read(file, header)
            except GssegError as error:  # of what is in it
                raise UnfitError(str(error)) from error

    @classmethod
    def _read(cls, file: NpzArrays, header: dict[str, Any]) -> SceneDelta:
        revision = header.get("revision")
        if revision is not None:
            whole_number(revision, "revision", 0, MAX_ID)
        removed = file.expect("removed", np.int64, (None,))
        moves = tuple(_read_move(entry) for entry in header["moves"])
        if "added_ids" not in file.names:
            return cls(revision, removed, moves=moves)
        ids = file.expect("added_ids", np.int64, (None,))
        groups = file.expect("added_groups", np.int64, (len(ids),))
        shapes = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh": (None, 3)}
        arrays = [file.expect(name, np.float32, (len(ids), *shape)) for name, shape in shapes.items()]
        return cls(revision, removed, GaussianScene.from_arrays(*arrays), ids, groups, moves)


def check_similarity(motion: Similarity, who: str) -> None:
    """Raise `SceneDeltaError` unless a motion is a similarity: finite, of positive scale, its rotation orthonormal."""
    if motion.rotation.shape != (3, 3) or motion.translation.shape != (3,):
        raise SceneDeltaError(
            f"{who} has a rotation of shape {motion.rotation.shape} and a translation of shape "
            f"{motion.translation.shape}; expected (3, 3) and (3,)"
        )
    numbers = np.concatenate([motion.rotation.ravel(), motion.translation, [motion.scale]])
    if not (np.abs(numbers) <= LIMITS.max_value).all() or motion.scale <= 0:
        raise SceneDeltaError(
            f"{who} holds NaN, too large numbers or a scale of {motion.scale:g}; expected a scale above 0, and numbers "
            f"of at most {LIMITS.max_value:g} (limit max_value)"
        )
    off = _off(motion.rotation)
    if off > _ORTHONORMAL or np.linalg.det(motion.rotation) < 0:
        raise SceneDeltaError(
            f"{who} is no rotation (off by {off:.3g}); expected an orthonormal matrix of determinant 1"
        )


def straightened(frame: Similarity) -> Similarity:
    """Give a frame the nearest rotation, before roundings of many motions add up to what no file may hold."""
    if _off(frame.rotation) <= _ORTHONORMAL / 2:
        return frame
    left, _, right = np.linalg.svd(frame.rotation)
    return replace(frame, rotation=left @ right)


def _off(rotation: npt.NDArray[np.float64]) -> float:  # (3, 3)
    """By how much a matrix is no rotation."""
    return float(np.abs(rotation @ rotation.T - np.eye(3)).max())


def similarity_entry(frame: Similarity) -> dict[str, Any]:
    """Write a similarity as JSON."""
    return {"scale": frame.scale, "rotation": frame.rotation.tolist(), "translation": frame.translation.tolist()}


def read_similarity(entry: dict[str, Any]) -> Similarity:
    """Read what `similarity_entry` wrote; `SceneDeltaError` if it is no similarity."""
    frame = Similarity(
        float(entry["scale"]), np.array(entry["rotation"], np.float64), np.array(entry["translation"], np.float64)
    )
    check_similarity(frame, "a similarity")
    return frame


def _read_move(entry: dict[str, Any]) -> GroupMove:
    names = entry["views"]
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise UnfitError(f"views of a move are {quoted(names)}; expected a list of names")
    return GroupMove(whole_number(entry["group"], "group of a move", 0, MAX_ID), read_similarity(entry), tuple(names))
