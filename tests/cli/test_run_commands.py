"""What the commands write is one run, whole, and only over what is gsseg's: the real command, on a small scene."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from segmented_place import assert_one_line
from small_scenes import balls_on_a_table, write_dataset

from gsseg_core.cli.main import main
from gsseg_core.files.run_folder import COMMIT_FILE, RUN_FILE
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import Segmentation
from gsseg_core.viewer.learnt_views import LearntFrom


def command(place: Path, name: str = "segment") -> list[str]:
    inputs = [f"{place}/data/scene.ply", "--data", f"{place}/data", "--quiet"]
    if name == "segment":
        return ["segment", *inputs, "--out", f"{place}/out", "--learner", "votes", "--views", "2"]
    return ["render", *inputs, "--out", f"{place}/maps", "--segmentation", f"{place}/out/segmentation.npz"]


@pytest.fixture(scope="module")
def pristine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset, and what `segment` and `render` make of it."""
    place = tmp_path_factory.mktemp("pristine")
    write_dataset(place / "data")
    assert main(command(place)) == 0 and main(command(place, "render")) == 0
    return place


@pytest.fixture
def place(pristine: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    shutil.copytree(pristine, tmp_path / "place")
    return tmp_path / "place"


def run_id(path: Path) -> str:
    """Id of the run that a file says that it belongs to."""
    if path.suffix == ".npz":
        with np.load(path) as file:
            return str(json.loads(str(file["header"]))["run"])
    if path.suffix == ".png":
        with Image.open(path) as image:
            return str(image.info["gsseg_run"])
    if path.suffix == ".json":
        return str(json.loads(path.read_text())["run"])
    pattern = rb"\ncomment gsseg_run (.+)\n" if path.suffix == ".ply" else rb'<meta name="gsseg-run" content="(.+)">'
    found = re.search(pattern, path.read_bytes())
    assert found is not None, path
    return found[1].decode()


def results(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file() and path.name != RUN_FILE)


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def in_a_process(program: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    start = "import os, signal, resource, sys\nfrom gsseg_core.cli.main import main"
    program = f"{start}\n{program}\nsys.exit(main(sys.argv[1:]))"
    return subprocess.run([sys.executable, "-c", program, *arguments], capture_output=True, text=True, check=False)


@pytest.mark.parametrize("name", ["out", "maps"])
def test_every_file_of_a_run_carries_its_id(pristine: Path, name: str) -> None:
    files = results(pristine / name)
    manifest = json.loads((pristine / name / RUN_FILE).read_text())
    (run,) = manifest["runs"].values()
    assert {run_id(path) for path in files} == {run["run"]}
    assert [path.relative_to(pristine / name).as_posix() for path in files] == sorted(run["files"], key=Path)


def test_a_ply_of_a_class_opens_in_viewers_that_count_the_lines_of_its_header(pristine: Path) -> None:
    header = (pristine / "out/classes/1_red_ball.ply").read_bytes().split(b"\n", 3)
    assert header[:2] == [b"ply", b"format binary_little_endian 1.0"] and header[2].startswith(b"element vertex ")


def test_a_run_that_is_killed_while_it_is_moved_is_finished_by_whoever_reads_it(place: Path) -> None:
    before = {run_id(path) for path in results(place / "out")}
    (place / "out/classes/1_mine.ply").write_text("mine")
    program = (
        "replace = os.replace\n"
        "def killed(source, target):\n"
        "    if '/new/pictures' in str(source) and '/new/' not in str(target): os.kill(os.getpid(), signal.SIGKILL)\n"
        "    replace(source, target)\n"
        "os.replace = killed"
    )
    assert in_a_process(program, *command(place)).returncode == -signal.SIGKILL
    assert (place / "out" / COMMIT_FILE).exists()
    Segmentation.load(place / "out/segmentation.npz", GaussianScene.load(place / "data/scene.ply"))
    files = set(results(place / "out")) - {place / "out/classes/1_mine.ply"}
    after = {run_id(path) for path in files}
    assert len(after) == 1 and after != before
    assert sorted(path.name for path in (place / "out").rglob(".gsseg-*")) == [RUN_FILE]
    assert (place / "out/classes/1_mine.ply").read_text() == "mine"


def test_a_disk_that_fills_up_is_one_clear_line_and_the_earlier_run_stays_whole(place: Path) -> None:
    before = contents(place / "out")
    limit = 70_000  # bytes: more than the probe, and less than report.html
    ended = in_a_process(f"resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}))", *command(place))
    assert ended.returncode == 2 and ended.stdout == ""
    assert re.fullmatch(r"gsseg: error: .*/out/\S+: cannot be written \(File too large\); .*unchanged\n", ended.stderr)
    assert contents(place / "out") == before


def read_only(out: Path) -> None:
    shutil.rmtree(out)
    out.symlink_to("/proc/self")  # Nobody can write there, not even root.


def linked_classes(out: Path) -> None:
    (out / "classes").rename(out.parent / "elsewhere")
    (out / "classes").symlink_to(out.parent / "elsewhere")


def own_report(out: Path) -> None:
    (out / RUN_FILE).unlink()
    (out / "report.json").write_text('{"my": "thesis"}')


def a_file(out: Path) -> None:
    shutil.rmtree(out)
    out.write_text("mine")


@pytest.mark.parametrize(
    ("damage", "said"),
    [(read_only, "out: cannot be written"), (linked_classes, "classes: is a link"), (a_file, "out: is not a folder"),
     (own_report, "segmentation.npz: was not written by gsseg")],
)  # fmt: skip
def test_an_out_that_cannot_be_written_or_holds_what_is_not_ours_is_said_before_learning(
    place: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    damage: Callable[[Path], None],
    said: str,
) -> None:
    damage(place / "out")
    before = contents(place)
    monkeypatch.setattr("gsseg_core.pipeline.make_learner", lambda *_, **__: pytest.fail("learns"))
    assert main(command(place)) == 2
    stderr = capsys.readouterr().err
    assert said in stderr and stderr.count("\n") == 1
    assert contents(place) == before


def test_a_damaged_manifest_is_named_before_learning(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (place / "out" / RUN_FILE).write_text("{")
    before = contents(place)
    assert main(command(place)) == 2
    assert_one_line(capsys.readouterr().err, f"out/{RUN_FILE}: is damaged, so nobody knows who wrote ")
    assert contents(place) == before


@pytest.mark.parametrize("kind", ["segment", "render"])
def test_an_empty_path_is_not_taken_for_the_folder_where_the_command_is_typed(
    place: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    monkeypatch.chdir(place)
    before = contents(place)
    for option in ("out", "data"):
        assert main([*command(place, kind), f"--{option}", ""]) == 2
        assert_one_line(capsys.readouterr().err, f"{option} is ''; expected a value")
    assert main(["remove", "s.ply", "--segmentation", "s.npz", "--class", "", "--out", "x.ply"]) == 2
    assert_one_line(capsys.readouterr().err, "classes is ''")
    assert contents(place) == before


@pytest.mark.parametrize("error", [MemoryError, torch.cuda.OutOfMemoryError])
def test_too_little_memory_is_one_clear_line_and_the_results_of_before_stay(
    place: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, error: type[Exception]
) -> None:
    before = contents(place)

    def too_large(*_: object, **__: object) -> None:
        raise error("Unable to allocate 1.50 GiB for an array")

    monkeypatch.setattr("gsseg_core.pipeline.make_learner", too_large)
    assert main(command(place)) == 2
    stderr = capsys.readouterr().err
    assert stderr.startswith("gsseg: error: memory is not enough (Unable to allocate 1.50 GiB")
    assert stderr.count("\n") == 1 and contents(place) == before


def test_segment_never_replaces_the_scene_that_it_reads(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = contents(place)
    scene, (_, _, *others) = place / "out/classes/1_red_ball.ply", command(place)
    (place / "link.ply").symlink_to(scene)
    for path in (scene, place / "link.ply"):
        assert main(["segment", str(path), *others]) == 2
        assert_one_line(capsys.readouterr().err, f"{scene}: is read by gsseg segment, which would replace it with")
    (place / "link.ply").unlink()
    assert contents(place) == before
    assert main(["segment", str(scene), *others[:-6], "--out", f"{place}/ball", *others[-4:]]) == 0


def test_pick_never_replaces_the_scene_that_it_reads(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dataset = ["--data", f"{place}/data", "--out", f"{place}/picked", "--quiet"]
    shows = ["--view", "view0", "--mask", f"{place}/data/labels/view0.png", "--label", "1"]
    assert main(["pick", f"{place}/data/scene.ply", *dataset, *shows]) == 0
    before = contents(place)
    assert main(["pick", f"{place}/picked/object.ply", *dataset, *shows]) == 2
    assert "picked/object.ply: is read by gsseg pick, which would replace it" in capsys.readouterr().err
    assert contents(place) == before


def test_masks_that_were_named_from_elsewhere_are_found_once_their_dataset_has_moved(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (place / "data/labels").rename(place / "data/sam")
    monkeypatch.chdir(place)
    assert main([*command(place), "--labels", "data/sam"]) == 0
    (place / "data").rename(place / "moved")
    learnt = LearntFrom.read(place / "out/report.json")
    assert learnt.labels == "sam" and learnt.views(learnt.dataset(f"{place}/moved"))


def test_render_never_writes_over_the_masks(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = contents(place / "data")
    assert main([*command(place, "render"), "--out", f"{place}/data/labels"]) == 2
    assert "view2.png: was not written by gsseg render" in capsys.readouterr().err
    assert contents(place / "data") == before


@pytest.mark.parametrize(("kind", "folder"), [("segment", "data"), ("segment", "data/labels"), ("render", "data")])
def test_no_run_is_written_between_what_it_reads(
    place: Path, capsys: pytest.CaptureFixture[str], kind: str, folder: str
) -> None:
    before = contents(place)
    (place / "link").symlink_to(place / folder)
    for out in (place / folder, place / "link", place / folder / "." / "new" / ".."):
        assert main([*command(place, kind), "--out", str(out)]) == 2
        assert_one_line(capsys.readouterr().err, f"gsseg {kind} reads from this folder; expected one for results alone")
    (place / "link").unlink()
    assert contents(place) == before
    assert main([*command(place, kind), "--out", f"{place}/data/out"]) == 0


def test_single_files_replace_no_device_and_keep_links(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    remove = ["remove", f"{place}/data/scene.ply", "--segmentation", f"{place}/out/segmentation.npz", "--class", "box"]
    os.mkfifo(place / "fifo")
    for option in (["--out", f"{place}/fifo"], ["--out", f"{place}/data"], ["--out", f"{place}/data/scene.ply/x"]):
        assert main([*remove, *option]) == 2
        assert "cannot be written (" in capsys.readouterr().err
    assert (place / "fifo").is_fifo()
    scores = ["eval", "--pred", f"{place}/maps", "--truth", f"{place}/data/labels", "--json", f"{place}/fifo"]
    assert main(scores) == 2 and capsys.readouterr().out == ""
    (place / "link.ply").symlink_to("rest.ply")
    assert main([*remove, "--out", f"{place}/link.ply"]) == 0
    assert (place / "link.ply").is_symlink() and len(GaussianScene.load(place / "rest.ply")) > 0


def test_remove_shows_how_many_meshes_are_made_and_quiet_hides_it(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    remove = ["remove", f"{place}/data/scene.ply", "--segmentation", f"{place}/out/segmentation.npz", "--class", "1"]
    for quiet in (False, True):
        assert main([*remove, "--out", f"{place}/rest.ply", "--collision", *["--quiet"] * quiet]) == 0
        assert ("mesh: " in capsys.readouterr().err) != quiet


@pytest.mark.parametrize("saved", ["out/report.json", "out/pictures/legend.png", "state.npz"])
def test_remove_replaces_nothing_but_scenes(place: Path, capsys: pytest.CaptureFixture[str], saved: str) -> None:
    shutil.copy(place / "out/segmentation.npz", place / "state.npz")
    before = (place / saved).read_bytes()
    remove = ["remove", f"{place}/data/scene.ply", "--segmentation", f"{place}/out/segmentation.npz", "--class", "1"]
    assert main([*remove, "--out", str(place / saved)]) == 2 and (place / saved).read_bytes() == before
    assert_one_line(capsys.readouterr().err, f"{saved}: is there and is no scene; expected a new file, or a scene")
    (place / "empty").touch()
    for name in ("empty", "empty", "rest.spz", "rest.spz"):  # The second time, over what it has written.
        assert main([*remove, "--out", str(place / name)]) == 0


def test_the_folder_of_a_run_in_the_place_of_its_segmentation_leads_to_the_file(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = [f"{place}/data/scene.ply", "--segmentation", f"{place}/out", "--class", "1", "--out", f"{place}/rest.ply"]
    assert main(["remove", *given]) == 2
    assert_one_line(capsys.readouterr().err, f"out: is a folder; expected a segmentation.npz; type {place}/out/segm")


@pytest.mark.parametrize("read", ["data/scene.ply", "out/segmentation.npz"])
def test_remove_never_writes_over_what_it_reads(place: Path, capsys: pytest.CaptureFixture[str], read: str) -> None:
    before = (place / read).read_bytes()
    (place / "link").symlink_to(place / read)
    given = [f"{place}/data/scene.ply", "--segmentation", f"{place}/out/segmentation.npz", "--class", "1"]
    for out in (read, "link"):
        assert main(["remove", *given, "--out", f"{place}/{out}"]) == 2
        assert_one_line(capsys.readouterr().err, f"{place}/{out}: is the {Path(read).stem} that is read")
    assert (place / read).read_bytes() == before


def test_scores_replace_nothing_but_scores(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data, scores = place / "data", place / "scores.json"
    given = ["eval", "--pred", f"{data}/labels", "--truth", f"{data}/labels", "--json"]
    for other in ("classes.json", "split.json", "cameras.json", "scene.ply"):
        before = (data / other).read_bytes()
        assert main([*given, f"{data}/{other}"]) == 2
        assert_one_line(capsys.readouterr().err, f"{other}: is there and is no file of scores; expected a new file")
        assert (data / other).read_bytes() == before
    scores.touch()  # As mktemp leaves it.
    for _ in range(2):
        assert main([*given, str(scores)]) == 0 and json.loads(scores.read_text())["mean_iou"] == 1


def test_segment_writes_the_classes_in_the_format_asked_for_and_meshes_beside_them(place: Path) -> None:
    assert main([*command(place), "--format", "usd", "--collision"]) == 0
    meshes = ["1_red_ball.obj", "2_cup_mug.obj", "3_box.obj"]
    assert sorted(path.name for path in (place / "out/classes").iterdir()) == [*meshes, "objects.usdc"]
    report = json.loads((place / "out/report.json").read_text())
    assert report["settings"]["scene_format"] == "usd" and report["settings"]["collision"] == "hull"
    assert [one.get("collision") for one in report["classes"]] == [None, *(f"classes/{name}" for name in meshes)]
    assert all(one["ply"] is None and one["file"] == "classes/objects.usdc" for one in report["classes"])
    assert '<a href="classes/objects.usdc">USDC</a>' in (place / "out/report.html").read_text()


def test_a_library_that_is_missing_is_told_before_anything_is_read(
    place: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    before = contents(place)
    monkeypatch.setitem(sys.modules, "gsply", None)
    monkeypatch.delitem(sys.modules, "gsseg_core.scene.writers.spz", raising=False)
    monkeypatch.setattr(GaussianScene, "load", lambda *_: pytest.fail("reads"))
    remove = ["remove", "no.ply", "--segmentation", "no.npz", "--class", "box", "--out", f"{place}/rest.spz"]
    for asked in ([*command(place), "--format", "spz"], remove):
        assert main(asked) == 2
        stderr = capsys.readouterr().err
        assert "format spz: needs gsply, which is not installed; expected: pip install 'gsseg[formats]'" in stderr
    assert contents(place) == before


def test_names_of_views_that_are_too_long_for_a_picture_do_not_end_a_run(place: Path) -> None:
    path = place / "data/cameras.json"
    cameras = json.loads(path.read_text())
    cameras += [{**cameras[0], "img_name": name} for name in ("v" * 240, "a\u202eb")]
    path.write_text(json.dumps(cameras))
    assert main(command(place)) == 0
    report = json.loads((place / "out/report.json").read_text())
    assert all((place / "out" / picture).is_file() for picture in report["pictures"])
    assert sum(picture.startswith("pictures/overlay_") for picture in report["pictures"]) == len(cameras)


def test_the_scene_with_a_comment_is_read_as_without(tmp_path: Path) -> None:
    scene, _ = balls_on_a_table()
    scene.save(tmp_path / "with.ply", "a run")
    scene.save(tmp_path / "without.ply")
    assert (tmp_path / "with.ply").stat().st_size == (tmp_path / "without.ply").stat().st_size + len(
        "comment gsseg_run a run\n"
    )
    np.testing.assert_array_equal(GaussianScene.load(tmp_path / "with.ply").vertices, scene.vertices)
