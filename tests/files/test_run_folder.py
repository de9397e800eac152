"""A folder of results holds one run, whole, after any end of the process that writes it; and files of others stay."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from clean_process import in_clean_process
from nobody import become_nobody
from patience import PATIENCE
from test_atomic import small_files_only

from gsseg_core.errors import PathTakenError, SettingsError, WriteError
from gsseg_core.files import run_folder
from gsseg_core.files.atomic import write_atomically
from gsseg_core.files.json_files import write_json
from gsseg_core.files.run_folder import COMMIT_FILE, RUN_FILE, settle, staged_run
from gsseg_core.files.run_manifest import FileRecord, Manifest

FIRST = ["a.npz", "classes/1_cup.ply", "classes/2_box.ply", "old/gone.png", "report.json"]
SECOND = ["a.npz", "classes/1_cup.ply", "classes/3_ball.ply", "new/here.png", "report.json"]


def write(out: Path, files: list[str], kind: str = "segment", **more: object) -> str:
    with staged_run(out, kind, **more) as run:  # type: ignore[arg-type]
        for name in files:
            (run.folder / name).parent.mkdir(parents=True, exist_ok=True)
            (run.folder / name).write_text(run.id)
    return run.id


def contents(out: Path) -> dict[str, str]:
    """All files but those that gsseg keeps for itself."""
    files = {path.relative_to(out).as_posix(): path for path in out.rglob("*") if path.is_file()}
    return {name: path.read_text() for name, path in files.items() if not name.startswith(".gsseg-")}


def hidden(out: Path) -> list[str]:
    return sorted(path.name for path in out.iterdir() if path.name.startswith(".gsseg-"))


def killed_at(count: int, work: Callable[[], object]) -> bool:
    """Say whether some work, in a fork, was killed: before its `count`-th change of the name of a file."""
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
    calls = 0

    def kill(event: str, _: object) -> None:
        nonlocal calls
        if event in ("os.rename", "os.link", "os.remove", "os.rmdir", "os.mkdir"):
            calls += 1
            if calls == count:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(kill)
    try:
        work()
    finally:
        os._exit(0)


@in_clean_process
def test_after_a_kill_at_any_step_all_files_are_of_one_run_and_the_next_run_cleans_up(tmp_path: Path) -> None:
    os.fsync = lambda _: None  # The machine goes on, and it takes most of the time.
    out, before, after = tmp_path / "out", 0, 0
    write(out, FIRST)
    (out / "classes" / "1_mine.ply").write_text("mine")
    (out / ".mine").write_text("mine")
    shutil.copytree(out, tmp_path / "start")
    mine = {"classes/1_mine.ply": "mine", ".mine": "mine"}
    for step in range(1, 200):
        shutil.rmtree(out)
        shutil.copytree(tmp_path / "start", out)
        was_killed = killed_at(step, lambda: write(out, SECOND))
        settle(out)
        found = contents(out)
        assert {name: found.pop(name) for name in mine} == mine
        (run_id,) = set(found.values())
        manifest = json.loads((out / RUN_FILE).read_text())
        assert manifest["runs"]["segment"]["run"] == run_id and not (out / COMMIT_FILE).exists()
        is_new = "new/here.png" in found
        assert sorted(found) == sorted(SECOND if is_new else FIRST)
        before, after = before + (not is_new), after + is_new
        if not was_killed:
            break
        assert set(contents(out)) == set(found) | set(mine)
        if step % 5 == 0:
            last = write(out, FIRST)
            assert contents(out) == dict.fromkeys(FIRST, last) | mine and hidden(out) == [RUN_FILE]
    assert before > 10 and after > 10 and not was_killed


@in_clean_process
def test_a_run_removes_what_a_killed_save_left_in_its_folder_and_nothing_that_is_being_saved(tmp_path: Path) -> None:
    child = os.fork()
    if not child:
        with write_atomically(tmp_path / "state.npz"):
            os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(child, 0)
    with write_atomically(tmp_path / "nested" / "state.npz") as living:
        living = living.rename(tmp_path / living.name)  # Where a save would have removed what the dead one left.
        assert len(hidden(tmp_path)) == 2
        write(tmp_path, FIRST)
        assert hidden(tmp_path) == sorted([living.name, RUN_FILE])
        living.rename(tmp_path / "nested" / living.name)


@in_clean_process
def test_a_move_that_is_killed_again_while_it_is_finished_is_finished_in_the_end(tmp_path: Path) -> None:
    os.fsync = lambda _: None
    out = tmp_path / "out"
    write(out, FIRST)
    step = 1
    while not (out / COMMIT_FILE).exists():
        assert killed_at(step, lambda: write(out, SECOND))
        step += 1
    step = 1
    while killed_at(step, lambda: settle(out)):
        step += 1
    assert set(contents(out)) == set(SECOND) and len(set(contents(out).values())) == 1 and step > 5


def test_a_run_that_fails_leaves_everything_as_it_was(tmp_path: Path) -> None:
    out = tmp_path / "out"
    write(out, FIRST)
    before = contents(out)
    for error in (KeyboardInterrupt, SettingsError, OSError):
        with pytest.raises(error), staged_run(out, "segment") as run:
            (run.folder / "a.npz").write_text("half")
            raise error
        assert contents(out) == before and hidden(out) == [RUN_FILE]
    with pytest.raises(KeyboardInterrupt), staged_run(tmp_path / "no" / "such", "segment"):
        raise KeyboardInterrupt
    assert not (tmp_path / "no").exists()


def test_messages_name_files_by_their_places_however_their_folder_is_called(tmp_path: Path) -> None:
    out = tmp_path / "two\nlines"
    with pytest.raises(WriteError, match=r"/two\\nlines/a.npz: cannot be"), staged_run(out, "segment") as run:
        (run.folder / "a.npz").mkdir()
        write_json(run.folder / "a.npz", {})


def test_results_under_a_manifest_that_says_nothing_of_the_run_before_are_replaced(tmp_path: Path) -> None:
    write(tmp_path, FIRST)
    manifest = json.loads((tmp_path / RUN_FILE).read_text())
    del manifest["before"]
    (tmp_path / RUN_FILE).write_text(json.dumps({**manifest, "replaced": {}, "edited": []}))
    last = write(tmp_path, SECOND)
    assert contents(tmp_path) == dict.fromkeys(SECOND, last)


def test_an_interrupt_within_the_move_leaves_the_new_run_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out, replace = tmp_path / "out", os.replace
    write(out, FIRST)

    def interrupted(source: Path, target: Path) -> None:
        monkeypatch.setattr(os, "replace", replace)
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write(out, SECOND)
    assert set(contents(out)) == set(SECOND) and len(set(contents(out).values())) == 1 and hidden(out) == [RUN_FILE]


def test_a_full_disk_is_one_clear_error_and_the_earlier_run_stays_whole(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(WriteError, match="with free space"), small_files_only():
        write(out, FIRST)
    assert not out.exists()
    write(out, FIRST)
    before, full = contents(out), os.strerror(errno.ENOSPC)

    def no_space(*_: object) -> None:
        raise OSError(errno.ENOSPC, full)

    for name in ("open", "rename"):  # Of the manifest, and the commit itself.
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(run_folder.Manifest, "write", no_space)
            if name == "rename":
                patch.undo()
                patch.setattr(os, "rename", no_space)
            for folder in (out, tmp_path / "new"):
                with pytest.raises(WriteError, match=f"{full}.*what was there before is unchanged"):
                    write(folder, SECOND)
        assert contents(out) == before and hidden(out) == [RUN_FILE] and os.listdir(tmp_path) == ["out"]


def test_a_file_that_was_edited_since_keeps_its_content_under_another_name(tmp_path: Path) -> None:
    out = tmp_path / "out"
    write(out, FIRST)
    for name in ("report.json", "classes/2_box.ply"):
        (out / name).write_text("edited")
    last = write(out, SECOND)
    assert contents(out) == dict.fromkeys(SECOND, last) | {
        f"report.edited-{last}.json": "edited", f"classes/2_box.edited-{last}.ply": "edited",
    }  # fmt: skip


def test_digests_of_files_are_made_beside_each_other_and_each_is_of_its_own_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    meeting, record = threading.Barrier(2, timeout=PATIENCE), FileRecord.of

    def of(path: Path) -> FileRecord:
        meeting.wait()
        return record(path)

    monkeypatch.setattr(FileRecord, "of", of)
    files = FIRST[:4]
    write(tmp_path, files)
    recorded = Manifest.read(tmp_path / RUN_FILE).files("segment")
    assert recorded == {name: record(tmp_path / name) for name in files}


def test_a_copy_of_a_folder_is_as_much_gssegs_as_the_folder(tmp_path: Path) -> None:
    write(tmp_path / "out", FIRST)
    shutil.copytree(tmp_path / "out", tmp_path / "copy", copy_function=shutil.copyfile)
    last = write(tmp_path / "copy", SECOND)
    assert contents(tmp_path / "copy") == dict.fromkeys(SECOND, last)


def test_results_of_another_kind_in_the_same_folder_stay(tmp_path: Path) -> None:
    first = write(tmp_path, ["a.npz", "both.png"])
    second = write(tmp_path, ["x.png"], "render")
    third = write(tmp_path, ["y.png"], "render")
    assert second != third and contents(tmp_path) == {"a.npz": first, "both.png": first, "y.png": third}
    with pytest.raises(PathTakenError, match=r"both\.png: was not written by gsseg render"):
        write(tmp_path, ["both.png"], "render")


def put_file(path: Path) -> None:
    path.write_text("mine")


def put_link(path: Path) -> None:
    path.symlink_to(path.parent / "elsewhere")


@pytest.mark.parametrize(
    ("place", "put", "said"),
    [("report.json", put_file, "report.json: was not written by gsseg"), ("classes", put_link, "classes: is a link"),
     ("classes", put_file, "classes: is a link or a file"), ("report.json", os.mkfifo, "report.json: is a link, a f"),
     ("report.json", Path.mkdir, "report.json: is a link, a folder"), ("a.npz", put_link, "a.npz: is a link")],
)  # fmt: skip
def test_a_place_that_is_taken_is_refused_by_name_before_the_work(
    tmp_path: Path, place: str, put: Callable[[Path], object], said: str
) -> None:
    (tmp_path / "elsewhere").mkdir()
    put(tmp_path / place)
    for places in (SECOND, []):  # Known before; and only found out in the end.
        with pytest.raises(PathTakenError, match=said), staged_run(tmp_path, "segment", places=places) as run:
            assert not places
            for name in SECOND:
                (run.folder / name).parent.mkdir(parents=True, exist_ok=True)
                (run.folder / name).write_text(run.id)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted({"elsewhere", place})


@in_clean_process
def test_what_another_user_lets_nobody_move_is_refused_before_the_work(tmp_path: Path) -> None:
    is_root = os.geteuid() == 0
    for name in ("shared", "sticky")[: 1 + is_root]:
        write(tmp_path / name, FIRST)
        (tmp_path / name).chmod(0o777 if name == "shared" else 0o1777)
        (tmp_path / name / "classes").chmod(0o555 if name == "shared" else 0o777)
    become_nobody(tmp_path)
    said = {"shared": "shared/classes/1_cup.ply: .*no permission", "sticky": "sticky/.gsseg-run.json: .*another user"}
    for name in ("shared", "sticky")[: 1 + is_root]:
        before = contents(Path(name))
        with pytest.raises(WriteError, match=said[name]), staged_run(name, "segment"):
            raise AssertionError("the work began")
        assert contents(Path(name)) == before and hidden(Path(name)) == [RUN_FILE]


@in_clean_process
def test_a_move_that_another_user_alone_can_read_of_is_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / COMMIT_FILE).touch(0o000)
    become_nobody(tmp_path)
    for work in (lambda: write(Path(), FIRST), lambda: settle(Path())):
        with pytest.raises(WriteError, match=r"^.gsseg-commit.json: cannot be read \(Permission denied\)"):
            work()
    assert os.listdir() == [COMMIT_FILE]


def test_a_folder_that_a_file_replaces_during_the_run_is_one_clear_error(tmp_path: Path) -> None:
    out = tmp_path / "out"
    found = r"out: cannot be written \(Not a directory\)"
    with pytest.raises(WriteError, match=found), staged_run(out, "segment") as run:
        shutil.rmtree(out)
        out.write_text("mine")
        run.claim(["a.npz"])
    assert out.read_text() == "mine"


def test_of_two_runs_at_once_the_last_to_end_wins_whole(tmp_path: Path) -> None:
    ids, errors = [], []

    def run(files: list[str]) -> None:
        try:
            ids.extend(write(tmp_path, files) for _ in range(15))
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=run, args=(files,)) for files in (FIRST, SECOND)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []
    (last,) = set(contents(tmp_path).values())
    assert last in ids and set(contents(tmp_path)) in (set(FIRST), set(SECOND)) and hidden(tmp_path) == [RUN_FILE]


def test_a_manifest_that_names_files_outside_the_folder_is_not_believed(tmp_path: Path) -> None:
    out = tmp_path / "out"
    write(out, FIRST)
    (tmp_path / "mine").write_text("mine")
    manifest = json.loads((out / RUN_FILE).read_text())
    files = manifest["runs"]["segment"]["files"]
    status = (tmp_path / "mine").stat()
    entry = {"size": status.st_size, "mtime_ns": status.st_mtime_ns, "sha256": ""}
    files |= {"../mine": entry, str(tmp_path / "mine"): entry}
    (out / RUN_FILE).write_text(json.dumps(manifest))
    write(out, SECOND)
    assert (tmp_path / "mine").read_text() == "mine"


INFINITE = (
    """{"format": "gsseg-run-1", "staging": "", "runs": {"segment": {"run": "a", "files": {"b": {"size": 1e999}}}}}"""
)


@pytest.mark.parametrize("linked", ["", "new", "new/classes"])
def test_a_strangers_folder_that_claims_a_cut_short_move_takes_no_files_from_elsewhere(
    tmp_path: Path, linked: str
) -> None:
    out, mine, name = tmp_path / "out", tmp_path / "mine", ".gsseg-20260101T000000Z-01234567"
    (mine / "new/classes").mkdir(parents=True)
    (mine / "new/classes/1_cup.ply").write_text("mine")
    link = out / name / linked
    link.parent.mkdir(parents=True)
    link.symlink_to(mine / linked)
    places = json.dumps({"classes/1_cup.ply": {"size": 4, "mtime_ns": 0, "sha256": ""}})
    (out / COMMIT_FILE).write_text(
        f'{{"format": "gsseg-run-1", "staging": "{name}", "runs": {{"segment": {{"run": "r", "files": {places}}}}}}}'
    )
    settle(out)
    assert (mine / "new/classes/1_cup.ply").read_text() == "mine" and not (out / "classes").exists()


@pytest.mark.parametrize("text", ["{", "[]", '{"format": "gsseg-run-1"}', '{"format": "other"}', "\udc80", INFINITE])
def test_a_broken_manifest_makes_the_files_somebody_elses(tmp_path: Path, text: str) -> None:
    write(tmp_path, FIRST)
    (tmp_path / RUN_FILE).write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(PathTakenError, match=r"\.gsseg-run\.json: is damaged, so nobody knows who wrote .*report"):
        write(tmp_path, FIRST)


def test_a_lock_that_is_never_released_is_one_clear_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_folder, "_PATIENCE", 0.1)
    with run_folder._locked(tmp_path), pytest.raises(WriteError, match="another process of gsseg"):
        write(tmp_path, FIRST)


@pytest.mark.parametrize("name", ["nul\0", "lone\ud800", "x" * 300])
def test_a_folder_of_a_name_that_none_can_have_is_refused_as_any_that_cannot_be_made(tmp_path: Path, name: str) -> None:
    with pytest.raises(WriteError, match=r": cannot be written \(.*\); expected a folder that can be made"):
        write(tmp_path / "made" / name, FIRST)
    assert list(tmp_path.iterdir()) == []


def test_a_disk_mounted_in_the_place_of_a_folder_is_refused_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "classes").mkdir()
    write(tmp_path, FIRST[:1])
    before = contents(tmp_path)
    mounted = ["unshare", "-rm", "sh", "-c", 'mount -t tmpfs none "$0" && exec "$@"', str(tmp_path / "classes")]
    if subprocess.run([*mounted, "true"], check=False).returncode:
        pytest.skip("no disk can be mounted here")
    program = f"import sys; sys.path[:] = {sys.path}; from test_run_folder import *\n"
    program += f"write(Path({str(tmp_path)!r}), FIRST, places=FIRST)"
    done = subprocess.run([*mounted, sys.executable, "-c", program], stderr=subprocess.PIPE, text=True, check=False)
    assert f"PathTakenError: {tmp_path}/classes: has another disk mounted there; expected one" in done.stderr
    assert contents(tmp_path) == before and hidden(tmp_path) == [RUN_FILE]
