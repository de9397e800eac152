"""Folders of results: a run is written beside what is there, and becomes the result in one step.

In a folder OUT that gsseg writes, three names are its own besides the results:

| name | what it is |
|---|---|
| `.gsseg-run.json` | the manifest: the last run of each kind (segment, render, ...), its files and their SHA-256 |
| `.gsseg-<id>/` | a run that is being written; the process that writes it holds a lock on it |
| `.gsseg-commit.json` | the manifest to be, of a run that is the result already, but not yet moved into its places |

A process that moves files holds a lock on OUT itself for that time.

A run is written into `.gsseg-<id>/new/`. When all of it is on the disk, one rename makes its manifest
`.gsseg-commit.json`: with that it is the result. Its files are moved into their places, those of the run before that it
lacks are removed, and `.gsseg-commit.json` becomes `.gsseg-run.json`. A move that was cut short is finished by whoever
next writes the folder or reads it with `settle`; each step can be repeated.

Only files that the manifest names are replaced or removed. One of them that was edited since is somebody's work, and
keeps its content as `<name>.edited-<id>`. A place that something else has taken is refused before the work begins.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import secrets
import shutil
import stat
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from gsseg_core.errors import GssegError, PathTakenError, WriteError
from gsseg_core.files.atomic import check_changeable, remove_empty, remove_leftovers, sync_folder, try_lock
from gsseg_core.files.input_files import reason
from gsseg_core.files.run_manifest import FileRecord, Manifest, RunRecord

RUN_FILE, COMMIT_FILE = ".gsseg-run.json", ".gsseg-commit.json"

STAGING = re.compile(r"\.gsseg-[0-9]{8}T[0-9]{6}Z-[0-9a-f]{8}")
"""Names of folders in which runs are staged."""

_PATIENCE = 60.0  # seconds to wait for others who move files
_PROBE = 1 << 16  # bytes that must fit on the disk before work begins


@contextlib.contextmanager
def staged_run(
    out: str | os.PathLike[str], kind: str, *, places: Iterable[str] = (), inputs: Iterable[str | os.PathLike[str]] = ()
) -> Iterator[StagedRun]:  # fmt: skip
    """Yield a run whose files, at the end of the body, become the result of their kind in `out`: all or none.

    The folder is made if it is not there; results of other kinds in it stay. `places`, the files that the run will
    write, as far as they are known, are checked by `StagedRun.claim` at once, and `inputs` by `keep_apart`.

    Raises `PathTakenError` where `out`, or a place in it, is taken by what is not gsseg's, and `WriteError` where
    something cannot be written; what was there before is then unchanged, unless the message says otherwise.
    """
    run = StagedRun(Path(out), kind)
    there = [path for path in inputs if os.path.exists(path)]  # before the run makes one
    try:
        run.begin()
        run.claim(places)
        run.keep_apart(there)
        try:
            yield run
        except GssegError as error:  # Nobody knows the folder in which it was staged.
            raise type(error)(*(str(part).replace(str(run.folder), str(run.out)) for part in error.args)) from error
        run.commit()
    finally:
        run.close()


def settle(folder: str | os.PathLike[str]) -> None:
    """Finish the move of a run that was cut short, before something is read from a folder; `WriteError` if it fails."""
    folder = Path(folder)
    if os.path.lexists(folder / COMMIT_FILE):
        with _locked(folder):
            _finish(folder)


class StagedRun:
    """A run that is being written into `folder`, under the relative paths that its files will have in `out`.

    Its files carry its `id`, time (UTC) and eight random hex digits, so that they can be traced back to it.
    """

    def __init__(self, out: Path, kind: str) -> None:
        self.id = f"{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}-{secrets.token_hex(4)}"
        self.out, self._kind, self._staging = out, kind, out / f".gsseg-{self.id}"
        self.folder = self._staging / "new"
        self._made: list[Path] = []  # folders that were not there, for the staged one and its files, innermost first
        self._lock = -1

    def begin(self) -> None:
        """Make the folder, finish or remove what dead runs left in it, and see that something can be written there."""
        with _writing(self.out):
            if os.path.lexists(self.out) and not self.out.is_dir():
                raise PathTakenError(f"{self.out}: is not a folder; expected one, or nothing")
            self._made = [path for path in (self.out, *self.out.parents) if not path.exists()]
            self.out.mkdir(parents=True, exist_ok=True)
            with _locked(self.out):
                _finish(self.out)
                _remove_dead(self.out)
                self._staging.mkdir()
                self._lock = _open_folder(self._staging)
                try_lock(self._lock)
            self.folder.mkdir()
            with open(self._staging / "probe", "wb") as probe:
                probe.write(bytes(_PROBE))
                probe.flush()
                os.fsync(probe.fileno())  # Some disks say only now that they are full.
            os.unlink(self._staging / "probe")

    def claim(self, places: Iterable[str]) -> None:
        """Raise `PathTakenError` if a place that the run will write is taken by what no run of its kind wrote.

        `WriteError` where that cannot be read, as where `out` is no folder any more, and where this user may not change
        a folder or a file of the last run of its kind.
        """
        manifest = self._before()
        places = list(places)
        for place in places:
            _check_free(self.out, place, manifest, self._kind)
        # What cannot be moved into its place, or out of it, would leave the folder between two runs, for everybody.
        gone = [place for place in manifest.files(self._kind) if _lies_in(self.out, place)]
        for folder in sorted({folder for place in (*places, *gone) for folder in Path(place).parents[:-1]}):
            _check_same_disk(self._staging, self.out / folder)
        with _writing(self.out):
            for place in sorted({RUN_FILE, *places, *gone}):
                check_changeable(self.out / place, self.out / place)

    def keep_apart(self, inputs: Iterable[str | os.PathLike[str]]) -> None:
        """Raise `PathTakenError` if what the run reads is the folder that it writes to, or goes with its last run."""
        gone = {os.path.realpath(self.out / place) for place in self._before().files(self._kind)}
        for path in filter(os.path.exists, inputs):
            if os.path.samefile(self.out, path):
                raise PathTakenError(
                    f"{self.out}: gsseg {self._kind} reads from this folder; expected one for results alone"
                )
            if (file := os.path.realpath(path)) in gone:
                raise PathTakenError(
                    f"{file}: is read by gsseg {self._kind}, which would replace it with all other results in "
                    f"{self.out}; expected another folder for the new ones"
                )

    def _before(self) -> Manifest:
        with _writing(self.out):
            return Manifest.read(self.out / RUN_FILE)

    def commit(self) -> None:
        """Make what was written the result."""
        files = [path for path in self.folder.rglob("*") if not path.is_dir()]
        with _writing(self.out, "what was there before is unchanged"):
            with ThreadPoolExecutor() as threads:  # A digest leaves the other cores to others.
                places = [path.relative_to(self.folder).as_posix() for path in files]
                records = dict(zip(places, threads.map(FileRecord.of, files), strict=True))
            for folder in {path.parent for path in files} | {self.folder, self._staging}:
                sync_folder(folder)
            with _locked(self.out):
                _finish(self.out)
                self.claim(records)
                for folder in sorted({self.out / parent for place in records for parent in Path(place).parents}):
                    if not folder.exists():
                        folder.mkdir()
                        self._made.insert(0, folder)
                before = Manifest.read(self.out / RUN_FILE)
                runs = {**before.runs, self._kind: RunRecord(self.id, records)}
                Manifest(runs, self._staging.name, before.files(self._kind)).write(self._staging / COMMIT_FILE)
                os.rename(self._staging / COMMIT_FILE, self.out / COMMIT_FILE)  # Now it is the result.
                sync_folder(self.out)
                _finish(self.out)

    def close(self) -> None:
        """Leave nothing behind: not what was staged, nor a folder that was made for it and is empty."""
        try:
            commit = self.out / COMMIT_FILE
            if os.path.lexists(commit) and _read_commit(commit).staging == self._staging.name:
                settle(self.out)  # Something raised an error in the middle of the move, Ctrl-C for example.
            else:
                shutil.rmtree(self._staging, ignore_errors=True)
                remove_empty(self._made)
        finally:
            if self._lock >= 0:
                os.close(self._lock)


def _finish(out: Path) -> None:
    """Move the files of the run that `.gsseg-commit.json` names, if it is there, to their places; `out` is locked."""
    if not os.path.lexists(out / COMMIT_FILE):
        return
    manifest = _read_commit(out / COMMIT_FILE)
    if not STAGING.fullmatch(manifest.staging):
        raise WriteError(f"{out / COMMIT_FILE}: is damaged; expected it as gsseg wrote it, or nothing")
    staging, before, run_id = out / manifest.staging, manifest.before, manifest.staging.removeprefix(".gsseg-")
    try:
        places = {place for run in manifest.runs.values() for place in run.files}
        # Others were moved already, or are of another kind. A link in a folder of a stranger may lead anywhere.
        new = sorted(place for place in places if _lies_in(out, f"{manifest.staging}/new/{place}"))
        gone = before.keys() - places
        for folder in sorted({folder for place in new for folder in Path(place).parents[:-1]}):  # the outermost first
            if os.path.lexists(out / folder) and not _is_folder(out / folder):
                _move_aside(out / folder, run_id)
        for place in new:
            (out / place).parent.mkdir(parents=True, exist_ok=True)
        # All that takes time comes before the first move: until the last one, the files are of two runs.
        unchanged = {place for place in (*new, *gone) if _is_unchanged(out, place, before.get(place))}
        for place in new:
            if place not in unchanged and os.path.lexists(out / place):
                _move_aside(out / place, run_id)
        for number, place in enumerate(new):  # To free what a file took is slow, so that is put off, too.
            with contextlib.suppress(OSError):
                os.link(out / place, staging / f"old-{number}")
        for place in new:
            os.replace(staging / "new" / place, out / place)
        for place in gone:
            if place in unchanged:
                (out / place).unlink()
                remove_empty(out / folder for folder in Path(place).parents[:-1])
            elif _lies_in(out, place):
                _move_aside(out / place, run_id)
        for folder in {(out / place).parent for place in places | before.keys()}:
            sync_folder(folder)
        os.replace(out / COMMIT_FILE, out / RUN_FILE)
        sync_folder(out)
    except OSError as error:
        raise WriteError(
            f"{out}: its new results are complete, but not all are in their places ({reason(error)}); the "
            "next command of gsseg that reads or writes this folder moves them"
        ) from error
    shutil.rmtree(staging, ignore_errors=True)


def _read_commit(path: Path) -> Manifest:
    try:
        return Manifest.read(path)
    except OSError as error:
        raise WriteError(
            f"{path}: cannot be read ({reason(error)}), so a run that was cut short is not finished; "
            "expected that who began it runs gsseg on this folder once more"
        ) from error


@contextlib.contextmanager
def _writing(
    out: Path, more: str = "expected a folder that can be made or written to, with free space"
) -> Iterator[None]:
    """Raise `WriteError` in place of what the body raises where a folder cannot be written."""
    try:
        yield
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        raise WriteError(f"{out}: cannot be written ({reason(error)}); {more}") from error


def _move_aside(path: Path, run_id: str) -> None:
    """Rename a file that was edited since gsseg wrote it, or is none of gsseg's, within its folder."""
    number = ""
    while os.path.lexists(aside := path.with_name(f"{path.stem[:60]}.edited-{run_id}{number}{path.suffix[:20]}")):
        number = f"-{secrets.token_hex(2)}"
    os.rename(path, aside)


def _check_free(out: Path, place: str, manifest: Manifest, kind: str) -> None:
    """Raise `PathTakenError` unless nothing is at a place, or a file of the last run of this kind."""
    for folder in reversed(Path(place).parents[:-1]):
        if os.path.lexists(out / folder) and not _is_folder(out / folder):
            raise PathTakenError(f"{out / folder}: is a link or a file; expected a folder, or nothing")
    path = out / place
    if not os.path.lexists(path):
        return
    if not stat.S_ISREG(path.lstat().st_mode):
        raise PathTakenError(f"{path}: is a link, a folder or a device; expected a file of gsseg {kind}, or nothing")
    if place not in manifest.files(kind):
        if not manifest.runs and os.path.lexists(out / RUN_FILE):
            raise PathTakenError(
                f"{out / RUN_FILE}: is damaged, so nobody knows who wrote {path}, which is not replaced; expected the "
                "manifest as gsseg wrote it, or another folder"
            )
        raise PathTakenError(
            f"{path}: was not written by gsseg {kind}, so it is not replaced; expected nothing there, or another folder"
        )


def _check_same_disk(staging: Path, folder: Path) -> None:
    """Raise `PathTakenError` if files of the folder in which a run is staged cannot be renamed into another one."""
    try:
        os.rename(staging / "none", folder / "none")  # Linux looks at the disks before it looks for the file.
    except OSError as error:
        if error.errno == errno.EXDEV:
            raise PathTakenError(
                f"{folder}: has another disk mounted there; expected one on the disk of {staging.parent}, or nothing"
            ) from error


def _is_folder(path: Path) -> bool:
    return os.path.isdir(path) and not os.path.islink(path)


def _lies_in(out: Path, place: str) -> bool:
    """Whether something is at a place, and no folder above it in `out` is a link."""
    return os.path.lexists(out / place) and all(_is_folder(out / folder) for folder in Path(place).parents[:-1])


def _is_unchanged(out: Path, place: str, record: FileRecord | None) -> bool:
    """Whether a file is as its record says; not where there is no record."""
    is_file = _lies_in(out, place) and stat.S_ISREG((out / place).lstat().st_mode)
    return is_file and record is not None and record.fits(out / place)


def _open_folder(folder: Path) -> int:
    return os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Keep other processes from moving files in a folder, if its file system has locks."""
    deadline = time.monotonic() + _PATIENCE
    with _writing(folder):
        lock = _open_folder(folder)
    try:
        while try_lock(lock) is False:
            if time.monotonic() > deadline:
                raise WriteError(f"{folder}: another process of gsseg has moved files there for {_PATIENCE:.0f} s")
            time.sleep(0.02)
        yield
    finally:
        os.close(lock)


def _remove_dead(out: Path) -> None:
    """Remove what was staged, or half written, by processes that have ended; `out` is locked."""
    remove_leftovers(out)
    for path in [path for path in out.iterdir() if STAGING.fullmatch(path.name) and _is_folder(path)]:
        with contextlib.suppress(OSError):
            lock = _open_folder(path)
            if try_lock(lock):
                shutil.rmtree(path, ignore_errors=True)
            os.close(lock)
