"""What a folder of results says of itself: which files gsseg wrote there, in which run, and what they held."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

FORMAT = "gsseg-run-1"


@dataclass(frozen=True)
class FileRecord:
    """Size in bytes, time of the last change, and digest (SHA-256, hex) of a file as it was written."""

    size: int
    mtime_ns: int
    sha256: str

    @classmethod
    def of(cls, path: Path) -> FileRecord:
        """Record a file as it is; raises `OSError`."""
        status = path.lstat()
        return cls(status.st_size, status.st_mtime_ns, _sha256(path))

    def fits(self, path: Path) -> bool:
        """Whether a file still has the recorded content, whatever its time; raises `OSError`."""
        status = path.lstat()
        if status.st_size != self.size:
            return False
        return status.st_mtime_ns == self.mtime_ns or _sha256(path) == self.sha256


@dataclass(frozen=True)
class RunRecord:
    """Id of a run, and its files by their paths in the folder."""

    run: str
    files: dict[str, FileRecord]


@dataclass(frozen=True)
class Manifest:
    """Runs of a folder of results, and what it takes to finish the newest; empty where there is no manifest."""

    runs: dict[str, RunRecord] = field(default_factory=dict)  # the last of each kind
    staging: str = ""  # the folder in which the newest of them was written
    # Files of the run that the newest one replaces: those that are still the same are replaced or removed.
    before: dict[str, FileRecord] = field(default_factory=dict)

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
            return cls(runs, str(content["staging"]), _files(content.get("before", {})))
        except (FileNotFoundError, ValueError, TypeError, KeyError, AttributeError, RecursionError, OverflowError):
            return cls()

    def files(self, kind: str) -> dict[str, FileRecord]:
        """Files of the last run of a kind; none if there was no such run."""
        return self.runs[kind].files if kind in self.runs else {}

    def write(self, path: Path) -> None:
        """Write the manifest, and have it on the disk; raises `OSError`."""
        with open(path, "w", encoding="utf-8") as file:
            json.dump({"format": FORMAT, **asdict(self)}, file, indent=1)
            file.flush()
            os.fsync(file.fileno())


def _files(content: Mapping[str, Mapping[str, Any]]) -> dict[str, FileRecord]:
    """Read the records of files whose paths lead nowhere but into the folder."""
    return {
        place: FileRecord(int(entry["size"]), int(entry["mtime_ns"]), str(entry["sha256"]))
        for place, entry in content.items()
        if _is_inside(place)
    }


def _is_inside(place: str) -> bool:
    path = PurePosixPath(place)
    return path.parts != () and not path.is_absolute() and ".." not in path.parts and "\0" not in place


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()
