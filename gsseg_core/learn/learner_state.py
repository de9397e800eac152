"""Saves and loads the learning state of one scene: views with their masks, votes and codes, in one compressed npz.

The file has only the non-zero entries of votes and codes, (N, K); docs/conventions.md says how to read it with NumPy.

The state of a scene that changes also has the geometry of the scene, so that its votes can be transferred to the
changed scene.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from gsseg_core.csr_rows import CSRRows, starts
from gsseg_core.data.label_evidence import UNITS, LabelEvidence
from gsseg_core.data.label_images import DIGEST_BYTES, PER_VIEW, UNKNOWN
from gsseg_core.data.soft_masks import TOLERANCE, SeenLabels
from gsseg_core.data.view import View
from gsseg_core.errors import GssegError
from gsseg_core.files.atomic import check_replaceable, write_atomically
from gsseg_core.files.input_files import UnfitError
from gsseg_core.files.json_files import whole_number
from gsseg_core.files.limits import LIMITS, MAX_LABEL
from gsseg_core.files.npz_files import (
    NpzArrays,
    check_evidence,
    check_scene,
    check_shares,
    class_names_of,
    npz_format,
    open_npz,
    sparse_arrays,
    temperature_of,
    write_arrays,
)
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.living_scene import LivingScene
from gsseg_core.scene.scene_delta import MAX_ID
from gsseg_core.text import clipped, quoted

FORMAT, WITH_ZEROS, WHOLE_RAYS = "gsseg-state-3", "gsseg-state-2", "gsseg-state-1"
"""Format names: of this version; of older ones that wrote votes and codes as dense arrays; and of still older ones
whose rays went on behind surfaces."""

_FORMATS = FORMAT, WITH_ZEROS, WHOLE_RAYS

OBJECTS_OF_ONE_SESSION = "holds objects that its own session found and numbered (ids per-view)"
"""Text of errors for a state with `per_view`, where classes must have the same meaning in other sessions."""

_MOST_VIEWS = 2**31 - 1
_MOST_DROPPED = 1 << 20  # most dropped views to list: each takes some 60 bytes of memory
_MOST_VOTES = 2.0**62
_VIEW_VOTES = UNITS * LIMITS.max_pixels  # most votes of one view for one Gaussian, in units of `VOTE_UNIT`


@dataclass(frozen=True, eq=False)
class Learnt:
    """Class probabilities that a learner has found."""

    learner: str  # its name
    codes: CSRRows  # (N, K) float32: class probabilities; rows are empty if no labelled pixel saw the Gaussian
    num_views: int  # number of views that it learnt from
    temperature: float = 1.0  # that calibrates the codes, see `gsseg_core.learn.calibrate`
    evidence: np.ndarray | None = None  # (N,) float32: px from which codes were learnt; None for an older state
    # Mask ids of the same object, see `gsseg_core.learn.renamed_ids`; not saved to disk.
    renamed: Mapping[int, int] = field(default_factory=dict)

    def carried(self, carry: Callable[[Any], Any]) -> Learnt:
        """Return the same for the changed scene; `carry` converts rows, dense or sparse, to its Gaussians."""
        evidence = None if self.evidence is None else carry(self.evidence)
        return replace(self, codes=carry(self.codes), evidence=evidence)


@dataclass(frozen=True, eq=False)
class State:
    """The saved learning state of one scene."""

    votes: CSRRows  # N rows, int64: non-zero votes of all views so far, in units of `VOTE_UNIT`
    num_classes: int  # K, of votes and codes
    views: list[View]  # views that were kept, in the order in which they were added
    num_fused: int  # number of views in the votes, kept or not
    class_names: dict[int, str] = field(default_factory=dict)  # may lack names of some classes
    learnt: Learnt | None = None  # the best codes
    living: LivingScene | None = None  # the scene, if it changes; it is then saved, too
    per_view: bool = False  # whether its session found and numbered the classes, which are objects, itself
    whole_rays: bool = False  # whether the votes are of an older version whose rays went on behind surfaces
    dropped: tuple[bytes, ...] = ()  # `View.digest` of views in the votes that are no longer kept, as far as known

    @property
    def all_known(self) -> bool:
        """Whether all views in the votes are kept or listed in `dropped`, which older versions did not write."""
        return self.num_fused == len(self.views) + len(self.dropped)

    def save(self, path: str | os.PathLike[str], digest: str) -> None:
        """Write the state of the scene with this digest, atomically; the file has no colours.

        Raises `WriteError` if it cannot be written, and `PathTakenError` if the path has anything but a saved state,
        which is then unchanged.
        """
        path = Path(path)
        check_replaceable(path, "saved state", npz_format(path) in _FORMATS)
        header: dict[str, Any] = {
            "format": FORMAT,
            "scene": digest,
            "shape": [self.votes.num_rows, self.num_classes],
            "views": [_entry(view) for view in self.views],
            "num_fused": self.num_fused,
            "class_names": self.class_names,
        }
        if self.per_view:
            header["ids"] = PER_VIEW
        if self.whole_rays:
            header["whole_rays"] = True
        arrays: dict[str, Any] = sparse_arrays("votes", self.votes)
        if self.learnt is not None:
            header["learnt"] = {name: getattr(self.learnt, name) for name in ("learner", "num_views", "temperature")}
            arrays |= sparse_arrays("codes", self.learnt.codes)
            if self.learnt.evidence is not None:
                arrays["evidence"] = self.learnt.evidence
        if self.living is not None:
            header["frames"] = self.living.frame_entries()
            arrays |= self.living.arrays()
        if self.dropped:
            digests = b"".join(self.dropped[-_MOST_DROPPED:])
            arrays["dropped"] = np.frombuffer(digests, np.uint8).reshape(-1, DIGEST_BYTES)
        for i, view in enumerate(self.views):
            arrays[f"labels_{i}"], evidence, _ = view.read_seen()
            if evidence is not None and evidence.mass is not None:
                arrays[f"classes_{i}"], arrays[f"mass_{i}"] = evidence.classes, evidence.mass
                if evidence.supervised is not None:
                    arrays[f"supervised_{i}"] = evidence.supervised
            arrays[f"pose_{i}"] = np.stack([np.pad(view.camera.K, (0, 1)), view.camera.world_to_camera])
        with write_atomically(path) as temporary:
            write_arrays(temporary, header, **arrays)
            check_replaceable(path, "saved state", npz_format(path) in _FORMATS)  # Again, since writing takes long.

    @classmethod
    def load(
        cls, path: str | os.PathLike[str], digest: str, num_gaussians: int, within: Path | None = None,
        first: LivingScene | None = None,
    ) -> State:  # fmt: skip
        """Read a state of the scene with this digest and check all of its content.

        With `first`, the state of any changed scene that has its own geometry, or of the scene `first` itself, is read
        as well; `living` is then the scene of the state. With `within`, the file must lie below that folder after links
        are resolved.

        Raises `StateFileError` if the file is missing, damaged or invalid, `StateMismatchError` if it belongs to
        another scene, `PathNotAllowedError` if it lies outside `within`.
        """
        path = Path(path)
        with open_npz(path, "a saved state", _FORMATS, None if first else digest, within) as (file, header):
            living = LivingScene.read(file, header)
            if first is not None and header.get("scene") == first.scene.digest:
                living = living or first
            if first is not None and living is not None:
                num_gaussians = len(living)
            else:
                check_scene(path, header, digest)
            return cls._read(file, header, living, num_gaussians)

    @classmethod
    def load_alone(cls, path: str | os.PathLike[str]) -> tuple[str, State]:
        """Read a state without its scene: return scene digest and state; raises `StateFileError` as `load` does."""
        with open_npz(Path(path), "a saved state", _FORMATS, None) as (file, header):
            living = LivingScene.read(file, header)
            n = whole_number(header["shape"][0], "a side of the votes", 1, LIMITS.max_gaussians)
            if living is not None and len(living) != n:
                raise UnfitError(f"claims votes of {n:,} Gaussians; expected {len(living):,}, as its scene has")
            return str(header["scene"]), cls._read(file, header, living, n)

    @classmethod
    def _read(cls, file: NpzArrays, header: dict[str, Any], living: LivingScene | None, num_gaussians: int) -> State:
        n, k = header["shape"]
        if n != num_gaussians:
            raise UnfitError(f"holds {clipped(n)} Gaussians; expected {num_gaussians}, as the scene has")
        k = whole_number(k, "number of classes", 1, MAX_LABEL + 1)
        views = [_read_view(file, i, entry, k) for i, entry in enumerate(header["views"])]
        twice = [name for name, count in Counter(view.name for view in views).items() if count > 1]
        known = {0} if living is None else living.frames.keys()
        strange = {view.group for view in views if view.group is not None} - known
        if strange:
            raise UnfitError(f"has views of the groups {clipped(sorted(strange))}; expected groups of its scene only")
        if twice:
            raise UnfitError(f"has two views of the name {quoted(twice[0])}; expected one of each name")
        num_fused = whole_number(header["num_fused"], "num_fused", len(views), _MOST_VIEWS)
        votes = _read_votes(file, (n, k), len(views), num_fused)
        learnt = None
        if "learnt" in header:
            entry = header["learnt"]
            codes = _read_codes(file, (n, k))
            check_shares("codes", codes)
            num_views = whole_number(entry["num_views"], "num_views of what was learnt", 0, _MOST_VIEWS)
            learnt = Learnt(str(entry["learner"]), codes, num_views, temperature_of(entry), _read_evidence(file, n))
        names, per_view = class_names_of(header), header.get("ids") == PER_VIEW
        whole = header["format"] == WHOLE_RAYS or header.get("whole_rays") is True
        dropped = _read_dropped(file, min(num_fused - len(views), _MOST_DROPPED))
        return cls(votes, k, views, num_fused, names, learnt, living, per_view, whole, dropped)


def _entry(view: View) -> dict[str, Any]:
    entry: dict[str, Any] = {"name": view.name, "size": [view.camera.width, view.camera.height]}
    also = {"group": view.group, "former_name": view.former_name}
    return entry | {name: value for name, value in also.items() if value is not None}


def _read_votes(file: NpzArrays, shape: tuple[int, int], num_kept: int, num_fused: int) -> CSRRows:
    """Read votes, N rows of int64, and check that no Gaussian has more votes than the views have pixels."""
    older = "votes" in file.names
    given = _read_votes_with_zeros(file, shape) if older else file.expect_sparse("votes", np.int64, shape)
    # Only partial masks vote against classes; views that were not kept may have had partial masks.
    may_oppose = num_fused > num_kept or any(name.startswith("supervised_") for name in file.names)
    if not may_oppose and given.data.min(initial=0) < 0:
        raise UnfitError(f"array votes holds {given.data.min()}; expected none below 0")
    most = np.bincount(given.rows, np.abs(given.data, dtype=np.float64)).max(initial=0)
    possible = min(num_fused * _VIEW_VOTES * (shape[1] if may_oppose else 1), _MOST_VOTES)
    if most > possible:
        raise UnfitError(
            f"array votes sums to {most:.3g} in a row; expected at most {possible:.3g} of {num_fused} views"
        )
    return given


def _read_votes_with_zeros(file: NpzArrays, shape: tuple[int, int]) -> CSRRows:
    """Read votes of an older version, which wrote dense rows of the Gaussians that have votes."""
    seen = file.expect("seen", np.int64, (None,))
    if np.any(np.diff(seen) <= 0) or np.any((seen < 0) | (seen >= shape[0])):
        raise UnfitError(f"array seen holds no Gaussians; expected ascending numbers from 0 to {shape[0] - 1}")
    given = file.expect_rows("votes", np.int64, (len(seen), shape[1]))
    of_all = np.zeros(shape[0], np.int64)
    of_all[seen] = np.diff(given.indptr)
    return given._replace(indptr=starts(of_all))


def _read_codes(file: NpzArrays, shape: tuple[int, int]) -> CSRRows:
    """Read class probabilities, N rows of float32, or the dense array of an older version."""
    if "codes" not in file.names:
        return file.expect_sparse("codes", np.float32, shape)
    codes = file.expect_rows("codes", np.float32, (shape[0], None))
    if not 1 <= (found := file.header("codes").shape[1]) <= shape[1]:
        raise UnfitError(f"array codes is of {found} classes; expected 1 to {shape[1]}")
    return codes


def _read_evidence(file: NpzArrays, num_gaussians: int) -> np.ndarray | None:
    """Read the evidence of the codes, (N,) float32; None for a state of an older version, which has none."""
    if "evidence" not in file.names:
        return None
    evidence = file.expect("evidence", np.float32, (num_gaussians,))
    check_evidence(evidence)
    return evidence


def _read_dropped(file: NpzArrays, most: int) -> tuple[bytes, ...]:
    if "dropped" not in file.names:
        return ()
    if len(dropped := file.expect("dropped", np.uint8, (None, DIGEST_BYTES))) > most:
        raise UnfitError(f"array dropped is of {len(dropped)} views; expected at most {most}")
    return tuple(row.tobytes() for row in dropped)


def _read_view(file: NpzArrays, i: int, entry: dict[str, Any], num_classes: int) -> View:
    width, height = (whole_number(side, "size of a view", 1, LIMITS.max_pixels) for side in entry["size"])
    pose = file.expect(f"pose_{i}", np.float64, (2, 4, 4))
    try:
        camera = Camera(str(entry["name"]), width, height, pose[0, :3, :3], pose[1])
        labels = file.expect(f"labels_{i}", np.int32, (height, width))
        if f"mass_{i}" in file.names:
            view = View.from_seen(camera, SeenLabels(labels, _read_label_evidence(file, i, labels)))
        else:
            view = View.from_arrays(camera, labels)
        if "group" in entry:
            view = replace(view, group=whole_number(entry["group"], "group of a view", 0, MAX_ID))
        if "former_name" in entry:
            view = replace(view, former_name=str(entry["former_name"]))
    except GssegError as error:
        raise UnfitError(str(error)) from error
    if view.largest_label >= num_classes:
        raise UnfitError(f"view {quoted(view.name)} holds the label {view.largest_label}; expected below {num_classes}")
    return view


def _read_label_evidence(file: NpzArrays, i: int, labels: np.ndarray) -> LabelEvidence:
    classes = file.expect(f"classes_{i}", np.int32, (None,))
    mass = file.expect(f"mass_{i}", np.float32, (int(labels.max()) + 1, len(classes)))
    supervised = file.expect(f"supervised_{i}", np.int32, (None,)) if f"supervised_{i}" in file.names else None
    for name, ids in (("classes", classes), ("supervised", supervised)):
        if ids is not None and (np.any(np.diff(ids) <= 0) or np.any((ids < 0) | (ids > MAX_LABEL))):
            raise UnfitError(f"array {name}_{i} holds {clipped(ids.tolist())}; expected ascending ids of classes")
    if supervised is not None and not np.isin(classes, supervised).all():
        raise UnfitError(f"array classes_{i} holds other ids than supervised_{i}; expected some of those")
    if labels.min() < UNKNOWN:
        raise UnfitError(f"array labels_{i} holds {labels.min()}; expected {UNKNOWN} for unknown pixels, or more")
    if not np.all((mass >= 0) & (mass <= 1)) or not np.all(mass.sum(axis=1) <= 1 + TOLERANCE):
        raise UnfitError(f"array mass_{i} holds no probabilities; expected rows from 0 that sum to 1 at most")
    return LabelEvidence(classes, mass, supervised)
