"""Folders of results: a run is written beside what is there, and becomes the result in one step.

In a folder OUT that gsseg writes, four names are its own besides the results:

| name | what it is |
|---|---|
| `.gsseg-run.json` | the manifest: the last run of each kind (segment, render, ...), its files and their SHA-256 |
| `.gsseg-<id>/` | a run that is being written; the process that writes it holds a lock on `lock` in there |
| `.gsseg-commit.json` | the manifest to be, of a run that is the result already, but not yet moved into its places |
| `.gsseg-lock` | held, for moments, by whoever moves files |

A run is written into `.gsseg-<id>/new/`. When all of it is on the disk, one rename makes its manifest
`.gsseg-commit.json`: with that it is the result. Its files are moved into their places, those of the run before that it
lacks are removed, and `.gsseg-commit.json` becomes `.gsseg-run.json`. A move that was cut short is finished by whoever
next writes the folder or reads it with `settle`; each step can be repeated.

Only files that the manifest names are replaced or removed. One of them that was edited since is somebody's work, and
keeps its content as `<name>.edited-<id>`. A place that something else has taken is refused before the work begins.
"""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import shutil
import stat
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path

from gsseg_core.errors import GssegError, PathTakenError, WriteError
from gsseg_core.files.atomic import sync_folder, try_lock
from gsseg_core.files.run_manifest import FileRecord, Manifest

RUN_FILE, COMMIT_FILE, LOCK_FILE = ".gsseg-run.json", ".gsseg-commit.json", ".gsseg-lock"

_STAGING = re.compile(r"\.gsseg-[0-9]{8}T[0-9]{6}Z-[0-9a-f]{8}")
_EARLIER_STAGING = re.compile(r"\.gsseg-[a-z0-9_]{8}")  # of gsseg before it had manifests, for classes/
_PATIENCE = 60.0  # seconds to wait for others who move files
_PROBE = 1 << 16  # bytes that must fit on the disk before work begins
_NOTHING = FileRecord(-1, 0, "")  # fits no file

Earlier = Callable[[Path], Iterable[str]]


def nothing_earlier(out: Path) -> Iterable[str]:
    """List no files of versions of gsseg that wrote no manifest."""
    return ()


@contextlib.contextmanager
def staged_run(
    out: str | os.PathLike[str],
    kind: str,
    *,
    earlier: Earlier = nothing_earlier,
    places: Iterable[str] = (),
    only_own: bool = False,
) -> Iterator[StagedRun]:
    """Give a run whose files, at the end of the body, become the result of their kind in `out`: all or none.

    Parameters
    ----------
    out : path
        The folder, made if it is not there.
    kind : str
        What kind of results; those of other kinds in the same folder stay.
    earlier : callable
        Says which files of a folder without a manifest are results of this kind, of an earlier gsseg; relative paths.
    places : iterable of str
        Files that the run will write, as far as they are known: they are claimed at once.
    only_own : bool
        Refuse a folder that holds anything but holds no results of this kind.

    Raises
    ------
    PathTakenError
        `out`, or a place in it, is taken by what is not gsseg's.
    WriteError
        Something cannot be written. What was there before is whole and unchanged, unless the message says otherwise.
    """
    run = StagedRun(Path(out), kind, earlier)
    try:
        run.begin(only_own)
        run.claim(places)
        try:
            yield run
        except GssegError as error:
            # Nobody knows the folder in which it was staged.
            if str(run.folder) in str(error):
                raise type(error)(str(error).replace(str(run.folder), str(run.out))) from error
            raise
        run.commit()
    finally:
        run.close()


def settle(folder: str | os.PathLike[str]) -> None:
    """Finish the move of a run that was cut short, before something is read from a folder.

    Raises
    ------
    WriteError
        There is one, and it cannot be finished.
    """
    folder = Path(folder)
    if not os.path.lexists(folder / COMMIT_FILE):
        return
    try:
        with _locked(folder):
            _finish(folder)
    except OSError as error:
        raise _unfinished(folder, error) from error


def require_own_folder(out: Path, kind: str, earlier: Earlier) -> None:
    """Refuse a folder that holds anything but holds no results of this kind.

    Raises
    ------
    PathTakenError, WriteError
        It is such a folder, or cannot be looked into.
    """
    try:
        _refuse_no_folder(out)
        if not out.is_dir():
            return
        there = [path.name for path in out.iterdir() if path.name not in (RUN_FILE, LOCK_FILE)]
    except OSError as error:  # Also where a name is too long.
        raise _unwritable(out, error) from error
    foreign = sorted(name for name in there if not _STAGING.fullmatch(name))
    if foreign and not _own(out, kind, earlier):
        raise PathTakenError(
            f"{out}: holds {foreign[0][:60]!r}, and no results of gsseg {kind}; expected a folder that is new, "
            "empty, or holds such results"
        )


class StagedRun:
    """A run that is being written; made by `staged_run`.

    Attributes
    ----------
    id : str
        Time (UTC) and eight random hex digits; every file of the run carries it, for whoever finds it elsewhere.
    out : pathlib.Path
        Where its files will be.
    folder : pathlib.Path
        Where they are to be written, under the same relative paths.
    """

    def __init__(self, out: Path, kind: str, earlier: Earlier) -> None:
        self.id = f"{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}-{secrets.token_hex(4)}"
        self.out, self._kind, self._earlier = out, kind, earlier
        self._staging = out / f".gsseg-{self.id}"
        self.folder = self._staging / "new"
        self._made: list[Path] = []  # folders above the staged one that were not there, the innermost first
        self._lock = -1

    def begin(self, only_own: bool) -> None:
        """Make the folder, finish or remove what dead runs left in it, and see that something can be written there."""
        try:
            _refuse_no_folder(self.out)
            self._made = [path for path in (self.out, *self.out.parents) if not path.exists()]
            self.out.mkdir(parents=True, exist_ok=True)
            with _locked(self.out):
                _finish(self.out)
                _remove_dead(self.out)
                if only_own:
                    require_own_folder(self.out, self._kind, self._earlier)
                self._staging.mkdir()
                self._lock = os.open(self._staging / "lock", os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o666)
                try_lock(self._lock)
            self.folder.mkdir()
            with open(self._staging / "probe", "wb") as probe:
                probe.write(bytes(_PROBE))
                probe.flush()
                os.fsync(probe.fileno())
            os.unlink(self._staging / "probe")
        except OSError as error:
            raise _unwritable(self.out, error) from error

    def claim(self, places: Iterable[str]) -> None:
        """Refuse, by name, a place that the run will write and that is taken by what is not of an earlier one.

        Raises
        ------
        PathTakenError
            There is one.
        """
        own = _own(self.out, self._kind, self._earlier)
        for place in places:
            _refuse_stranger(self.out, place, own, self._kind)

    def commit(self) -> None:
        """Make what was written the result."""
        files = sorted(path for path in self.folder.rglob("*") if not path.is_dir())
        try:
            records = {path.relative_to(self.folder).as_posix(): FileRecord.of(path) for path in files}
            for folder in {path.parent for path in files} | {self.folder, self._staging}:
                sync_folder(folder)
            with _locked(self.out):
                _finish(self.out)
                before = Manifest.read(self.out / RUN_FILE)
                own = _own(self.out, self._kind, self._earlier)
                for place in records:
                    _refuse_stranger(self.out, place, own, self._kind)
                replaced = {
                    place: FileRecord.of(self.out / place, digest="")
                    for place, record in own.items()
                    if _is_unchanged(self.out, place, record)
                }
                self._keep_blocks(replaced)
                for place in records:
                    (self.out / place).parent.mkdir(parents=True, exist_ok=True)
                after = before.with_run(self._kind, self.id, records)
                after.write(self._staging / COMMIT_FILE, self._staging.name, replaced, sorted(own.keys() - replaced))
                os.rename(self._staging / COMMIT_FILE, self.out / COMMIT_FILE)  # Now it is the result.
                sync_folder(self.out)
                _finish(self.out)
        except OSError as error:
            if self._is_committed():
                raise _unfinished(self.out, error) from error
            raise WriteError(
                f"{self.out}: cannot be written ({error.strerror or error}); what was there before is unchanged"
            ) from error

    def close(self) -> None:
        """Leave nothing behind: not what was staged, nor a folder that was made for it and is empty."""
        try:
            if self._is_committed():
                settle(self.out)  # Something raised an error in the middle of the move, Ctrl-C for example.
            else:
                shutil.rmtree(self._staging, ignore_errors=True)
                with contextlib.suppress(OSError):
                    for folder in self._made:
                        folder.rmdir()
        finally:
            if self._lock >= 0:
                os.close(self._lock)

    def _is_committed(self) -> bool:
        try:
            return Manifest.read(self.out / COMMIT_FILE).staging == self._staging.name
        except OSError:
            return False

    def _keep_blocks(self, places: Iterable[str]) -> None:
        """Link what will be replaced into the staged folder: to free the blocks of large files takes long."""
        (self._staging / "old").mkdir(exist_ok=True)
        for i, place in enumerate(places):
            with contextlib.suppress(OSError):
                os.link(self.out / place, self._staging / "old" / str(i))


def _refuse_no_folder(out: Path) -> None:
    if os.path.lexists(out) and not out.is_dir():
        raise PathTakenError(f"{out}: is not a folder; expected one, or nothing")


def _own(out: Path, kind: str, earlier: Earlier) -> dict[str, FileRecord | None]:
    """Files in a folder that are results of a kind; None where what they should hold is not known."""
    runs = Manifest.read(out / RUN_FILE).runs
    return dict(runs[kind].files) if kind in runs else dict.fromkeys(earlier(out))


def _finish(out: Path) -> None:
    """Move the files of the run that is the result into their places, if that is not done yet; `out` is locked."""
    manifest = Manifest.read(out / COMMIT_FILE)
    if not manifest.staging:
        if os.path.lexists(out / COMMIT_FILE):
            raise WriteError(f"{out / COMMIT_FILE}: is damaged; expected it as gsseg wrote it, or nothing")
        return
    if not _STAGING.fullmatch(manifest.staging):
        raise WriteError(f"{out / COMMIT_FILE}: is damaged; it names {manifest.staging[:60]!r}")
    staging, run_id = out / manifest.staging, manifest.staging.removeprefix(".gsseg-")
    try:
        places = {place for run in manifest.runs.values() for place in run.files}
        for place in sorted(places):
            if not os.path.lexists(staging / "new" / place):
                continue  # It was moved already, or is of another kind.
            for folder in reversed(Path(place).parents[:-1]):
                if os.path.lexists(out / folder) and not _is_folder(out / folder):
                    _move_aside(out / folder, run_id)
            (out / place).parent.mkdir(parents=True, exist_ok=True)
            if os.path.lexists(out / place) and not _is_unchanged(out, place, manifest.replaced.get(place, _NOTHING)):
                _move_aside(out / place, run_id)
            os.replace(staging / "new" / place, out / place)
        for place in manifest.replaced.keys() - places:
            if _is_unchanged(out, place, manifest.replaced[place]):
                (out / place).unlink()
                with contextlib.suppress(OSError):
                    for folder in Path(place).parents[:-1]:
                        (out / folder).rmdir()
        for place in set(manifest.edited) - places:
            if _lies_in(out, place):
                _move_aside(out / place, run_id)
        for folder in {(out / place).parent for place in places | manifest.replaced.keys()}:
            sync_folder(folder)
        os.replace(out / COMMIT_FILE, out / RUN_FILE)
        sync_folder(out)
    except OSError as error:
        raise _unfinished(out, error) from error
    shutil.rmtree(staging, ignore_errors=True)


def _unwritable(out: Path, error: OSError) -> WriteError:
    expected = "a folder that can be made or written to, with free space"
    return WriteError(f"{out}: cannot be written ({error.strerror or error}); expected {expected}")


def _unfinished(out: Path, error: OSError) -> WriteError:
    return WriteError(
        f"{out}: its new results are complete, but not all are in their places ({error.strerror or error}); the next "
        "command of gsseg that reads or writes this folder moves them"
    )


def _move_aside(path: Path, run_id: str) -> None:
    """Give what somebody made or edited another name in the same folder."""
    number = ""
    while os.path.lexists(aside := path.with_name(f"{path.stem[:60]}.edited-{run_id}{number}{path.suffix[:20]}")):
        number = f"-{secrets.token_hex(2)}"
    os.rename(path, aside)


def _refuse_stranger(out: Path, place: str, own: Mapping[str, FileRecord | None], kind: str) -> None:
    for folder in reversed(Path(place).parents[:-1]):
        if os.path.lexists(out / folder) and not _is_folder(out / folder):
            raise PathTakenError(f"{out / folder}: is a link or a file; expected a folder, or nothing")
    path = out / place
    if not os.path.lexists(path):
        return
    if not stat.S_ISREG(path.lstat().st_mode):
        raise PathTakenError(f"{path}: is a link, a folder or a device; expected a file of gsseg {kind}, or nothing")
    if place not in own:
        raise PathTakenError(
            f"{path}: was not written by gsseg {kind}, so it is not replaced; expected nothing there, or another folder"
        )


def _is_folder(path: Path) -> bool:
    return os.path.isdir(path) and not os.path.islink(path)


def _lies_in(out: Path, place: str) -> bool:
    """Whether something is there, in the folder itself, not behind a link."""
    return os.path.lexists(out / place) and all(_is_folder(out / folder) for folder in Path(place).parents[:-1])


def _is_unchanged(out: Path, place: str, record: FileRecord | None) -> bool:
    """Whether a file is there as a manifest says; any content will do where that is not known."""
    if not _lies_in(out, place) or not stat.S_ISREG((out / place).lstat().st_mode):
        return False
    return record is None or record.fits(out / place)


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Keep others from moving files in a folder; raises `OSError` where no lock can be made there."""
    path, deadline = folder / LOCK_FILE, time.monotonic() + _PATIENCE
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o666)
        # Whoever had it before has removed the file.
        if try_lock(file) is not False and _is_named(file, path):
            break
        os.close(file)
        if time.monotonic() > deadline:
            raise WriteError(f"{folder}: another process of gsseg has moved files there for {_PATIENCE:.0f} s")
        time.sleep(0.02)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            path.unlink()
        os.close(file)


def _is_named(file: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file), path.lstat())
    except FileNotFoundError:
        return False


def _remove_dead(out: Path) -> None:
    """Remove what was staged by runs whose processes have ended; `out` is locked."""
    for path in list(out.iterdir()):
        if _STAGING.fullmatch(path.name) and _is_folder(path):
            try:
                file = os.open(path / "lock", os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o666)
            except OSError:
                continue
            dead = try_lock(file)
            os.close(file)
            if dead:
                shutil.rmtree(path, ignore_errors=True)
        elif _EARLIER_STAGING.fullmatch(path.name) and _is_folder(path):
            classes = (out / "classes").exists()
            if {child.name for child in path.iterdir()} <= ({"new", "old"} if classes else {"new"}):
                shutil.rmtree(path, ignore_errors=True)  # else "old" is the only copy of classes/
