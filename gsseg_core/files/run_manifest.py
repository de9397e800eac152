"""What a folder of results says of itself: which files gsseg wrote there, in which run, and what they held."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

FORMAT = "gsseg-run-1"


class FileRecord(NamedTuple):
    """Size, time and digest of a file as it was written.

    Attributes
    ----------
    size : int
        Bytes.
    mtime_ns : int
        Time of its last change.
    sha256 : str
        Hex digest of its content; empty where only size and time count.
    """

    size: int
    mtime_ns: int
    sha256: str

    @classmethod
    def of(cls, path: Path, digest: str | None = None) -> FileRecord:
        """Record a file as it is; raises `OSError`."""
        status = path.lstat()
        return cls(status.st_size, status.st_mtime_ns, _sha256(path) if digest is None else digest)

    def fits(self, path: Path) -> bool:
        """Whether a file is still the same. A copy has another time, and the same content; raises `OSError`."""
        status = path.lstat()
        if status.st_size != self.size:
            return False
        return status.st_mtime_ns == self.mtime_ns or (self.sha256 != "" and _sha256(path) == self.sha256)


@dataclass(frozen=True)
class RunRecord:
    """Id of a run, and its files by their paths in the folder."""

    id: str
    files: dict[str, FileRecord]


@dataclass(frozen=True)
class Manifest:
    """Runs of a folder of results, and what it takes to finish the newest; empty where there is no manifest.

    Attributes
    ----------
    runs : dict of str to RunRecord
        The last run of each kind.
    staging : str
        Folder in which the newest of them was written; empty if there is none.
    replaced : dict of str to FileRecord
        Files of the run before that one, as they were when it came to its end: they may be replaced or removed.
    edited : tuple of str
        Others of the run before, which somebody has changed or removed since.
    """

    runs: dict[str, RunRecord] = field(default_factory=dict)
    staging: str = ""
    replaced: dict[str, FileRecord] = field(default_factory=dict)
    edited: tuple[str, ...] = ()

    @classmethod
    def read(cls, path: Path) -> Manifest:
        """Read a manifest; one that is missing or broken says nothing. Raises `OSError` if it cannot be read."""
        try:
            content: Any = json.loads(path.read_bytes())
            if content["format"] != FORMAT:
                return cls()
            runs = {
                str(kind): RunRecord(str(run["run"]), _files(run["files"])) for kind, run in content["runs"].items()
            }
            edited = tuple(place for place in content["edited"] if is_inside(place))
            return cls(runs, str(content["staging"]), _files(content["replaced"]), edited)
        except FileNotFoundError:
            return cls()
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
            return cls()

    def with_run(self, kind: str, run_id: str, files: Mapping[str, FileRecord]) -> Manifest:
        """Put a run in the place of the last one of its kind."""
        return replace(self, runs={**self.runs, kind: RunRecord(run_id, dict(files))})

    def write(self, path: Path, staging: str, replaced: Mapping[str, FileRecord], edited: Iterable[str]) -> None:
        """Write it with what it takes to move the newest run into its places; raises `OSError`."""
        content = {
            "format": FORMAT,
            "runs": {kind: {"run": run.id, "files": _plain(run.files)} for kind, run in self.runs.items()},
            "staging": staging,
            "replaced": _plain(replaced),
            "edited": list(edited),
        }
        with open(path, "w", encoding="utf-8") as file:
            json.dump(content, file, indent=1)
            file.flush()
            os.fsync(file.fileno())


def is_inside(place: object) -> bool:
    """Whether a path, as a file says it, is relative and leads nowhere but into the folder."""
    if not isinstance(place, str) or not place or "\0" in place:
        return False
    path = PurePosixPath(place)
    return not path.is_absolute() and ".." not in path.parts and path != PurePosixPath(".")


def _files(content: Mapping[str, Mapping[str, Any]]) -> dict[str, FileRecord]:
    return {
        place: FileRecord(int(entry["size"]), int(entry["mtime_ns"]), str(entry["sha256"]))
        for place, entry in content.items()
        if is_inside(place)
    }


def _plain(files: Mapping[str, FileRecord]) -> dict[str, dict[str, Any]]:
    return {place: record._asdict() for place, record in files.items()}


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()
