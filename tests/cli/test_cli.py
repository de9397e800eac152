"""The command line, end to end: what it writes, and what bad input gets."""

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
from PIL import Image
from small_scenes import balls_on_a_table, look_at, many_classes, write_dataset

from gsseg_core.cli.arguments import build_parser
from gsseg_core.cli.main import main
from gsseg_core.data.label_images import read_mask, write_mask
from gsseg_core.files import atomic
from gsseg_core.learn.vote_learner import VoteLearner
from gsseg_core.scene import ply
from gsseg_core.scene.gaussian_scene import GaussianScene


@pytest.fixture(scope="module")
def pristine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset, and what `segment` makes of it."""
    data = write_dataset(tmp_path_factory.mktemp("pristine") / "data")
    assert main(["segment", f"{data}/scene.ply", "--data", str(data), "--out", f"{data.parent}/out", "--quiet"]) == 0
    return data.parent


@pytest.fixture
def place(pristine: Path, tmp_path: Path) -> Path:
    """A copy of it, to be damaged."""
    shutil.copytree(pristine, tmp_path / "place")
    return tmp_path / "place"


def segment(place: Path, *more: str, scene: str = "data/scene.ply") -> list[str]:
    return ["segment", f"{place / scene}", "--data", f"{place}/data", "--out", f"{place}/out", "--quiet", *more]


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def assert_one_line(stderr: str, names: str) -> None:
    assert "Traceback" not in stderr
    lines = stderr.splitlines()
    assert len(lines) == 1 and lines[0].startswith("gsseg: error: "), stderr
    assert names in lines[0], stderr


def test_segment_writes_labels_objects_report_and_pictures(pristine: Path) -> None:
    out, scene = pristine / "out", GaussianScene.load(pristine / "data/scene.ply")
    with np.load(out / "segmentation.npz") as file:
        labels, probabilities, confidence = (file[name] for name in ("labels", "probabilities", "confidence"))
    assert labels.dtype == np.int32 and labels.shape == confidence.shape == (len(scene),)
    assert probabilities.shape == (len(scene), 4) and labels.min() >= -2
    np.testing.assert_array_equal(confidence, probabilities.max(axis=1))
    names = ["0_background.ply", "1_red_ball.ply", "2_cup_mug.ply", "3_box.ply"]
    assert sorted(path.name for path in (out / "classes").iterdir()) == names
    for k, name in enumerate(names):
        np.testing.assert_array_equal(GaussianScene.load(out / "classes" / name).means, scene.means[labels == k])
    report = json.loads((out / "report.json").read_text())
    assert [entry["gaussians"] for entry in report["classes"]] == np.bincount(labels[labels >= 0]).tolist()
    assert report["gaussians"]["removed"] == (labels == -2).sum()
    assert report["settings"]["learner"] == "em" and report["settings"]["refine"]["beta"] == 0.65
    assert set(report["seconds"]) >= {"load", "observe", "learn", "refine", "export"}
    assert report["views"]["used"] == 4 and report["views"]["rejected"] == {}
    assert all((out / picture).is_file() for picture in report["pictures"])
    assert {"pictures/contact_sheet.png", "pictures/legend.png"} <= set(report["pictures"])
    assert [path.relative_to(out) for path in pristine.rglob(".gsseg-*")] == [Path(".gsseg-run.json")]


def test_segment_says_which_masks_the_other_views_contradict(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mask = place / "data/labels/view1.png"
    labels = read_mask(mask).labels
    write_mask(mask, np.where(labels > 0, 4 - labels, 0), 8)  # red ball and box, exchanged
    assert main(segment(place)) == 0
    report = json.loads((place / "out/report.json").read_text())
    views = report["views"]["reliability"]
    assert views[0]["name"] == "view1" and views[0]["reliability"] < min(0.9, *(v["reliability"] for v in views[1:]))
    assert {(c["true"], c["seen"]) for c in views[0]["confusions"]} >= {("red ball", "box"), ("box", "red ball")}
    assert "masks that agree least with the other views: view1" in capsys.readouterr().out
    assert "pictures/worst_views.png" in report["pictures"]


def test_render_and_eval_score_the_views_that_were_not_learnt_from(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    npz, scene = f"{place}/out/segmentation.npz", f"{place}/data/scene.ply"
    render = ["render", scene, "--data", f"{place}/data", "--segmentation", npz, "--out", f"{place}/maps", "--quiet"]
    assert main(render) == 0
    assert sorted(path.name for path in (place / "maps").glob("*.png")) == ["view2.png", "view5.png"]
    assert read_mask(place / "maps/view2.png").bits == 8
    assert sorted(path.name for path in (place / "maps/overlays").glob("view*")) == ["view2.png", "view5.png"]
    scores = ["eval", "--pred", f"{place}/maps", "--truth", f"{place}/data/labels", "--json", f"{place}/scores.json"]
    assert main(scores) == 0
    told = json.loads((place / "scores.json").read_text())
    assert told["views"] == 2 and told["mean_iou"] > 0.9
    assert f"{100 * told['mean_iou']:.1f} %" in capsys.readouterr().out
    assert main([*render, "--split", "all"]) == 0
    assert len(list((place / "maps").glob("*.png"))) == 6


@pytest.mark.parametrize("learner", ["votes", "gradient"])
def test_the_other_learners_and_settings_can_be_chosen(place: Path, learner: str) -> None:
    assert main(segment(place, "--learner", learner, "--views", "2", "--no-filter", "--k", "9", "--beta", "0.5")) == 0
    report = json.loads((place / "out/report.json").read_text())
    assert report["views"]["used"] == 2 and report["gaussians"]["removed"] == 0
    assert report["settings"]["learner"] == learner
    assert report["settings"]["refine"]["k"] == 9 and report["settings"]["refine"]["beta"] == 0.5


def test_views_without_use_are_skipped_and_counted(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (place / "data/labels/view0.png").unlink()
    Image.fromarray(np.full((48, 64), 255, np.uint8)).save(place / "data/labels/view1.png")
    assert main(segment(place)) == 0
    views = json.loads((place / "out/report.json").read_text())["views"]
    assert views["used"] == 2 and views["rejected"] == {"no mask": 1, "all pixels unknown": 1}
    assert "2 views used, rejected: 1 no mask, 1 all pixels unknown" in capsys.readouterr().out
    assert main(segment(place, "--learner", "votes", "--views", "1")) == 2
    (place / "data/split.json").write_text('{"train": ["view3"]}')
    assert main(segment(place, "--learner", "votes")) == 0
    assert "\n1 view used\n" in capsys.readouterr().out


def test_more_than_255_classes_work_with_16_bit_masks_from_end_to_end(tmp_path: Path) -> None:
    scene, truth = many_classes(300)
    cameras = [look_at(f"v{i}", np.array([0.2 * i, 0.1, 3.5]), 320, 240, 330.0) for i in range(3)]
    data = write_dataset(tmp_path / "data", scene, truth, cameras, bits=16)
    inputs = [f"{data}/scene.ply", "--data", str(data), "--quiet"]
    assert main(["segment", *inputs, "--out", f"{tmp_path}/out", "--k", "1"]) == 0
    with np.load(tmp_path / "out/segmentation.npz") as file:
        assert file["probabilities"].shape == (300, 300)
        np.testing.assert_array_equal(file["labels"], truth)
    assert len(list((tmp_path / "out/classes").iterdir())) == 300
    npz = f"{tmp_path}/out/segmentation.npz"
    assert main(["render", *inputs, "--segmentation", npz, "--out", f"{tmp_path}/maps"]) == 0
    mask = read_mask(tmp_path / "maps/v2.png")
    assert mask.bits == 16 and mask.labels.max() == 299
    assert (mask.labels == read_mask(data / "labels/v2.png").labels).mean() > 0.93


def test_one_class_only_works_from_end_to_end(place: Path) -> None:
    (place / "data/classes.json").unlink()
    for path in (place / "data/labels").iterdir():
        Image.fromarray(np.zeros((48, 64), np.uint8)).save(path)
    assert main(segment(place)) == 0
    assert [path.name for path in (place / "out/classes").iterdir()] == ["0_background.ply"]


def edit_scene(place: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    path = place / "data/scene.ply"
    ply.write_vertices(path, change(ply.read_vertices(path).copy()))


def edit_json(path: Path, change: Callable[[list[dict[str, object]]], object]) -> None:
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def put_nan(vertices: np.ndarray) -> np.ndarray:
    vertices["x"][7] = np.nan
    return vertices


def positions_only(vertices: np.ndarray) -> np.ndarray:
    return np.array(vertices[["x", "y", "z"]].tolist(), [(name, "f4") for name in "xyz"])


def zero_quaternions(vertices: np.ndarray) -> np.ndarray:
    for name in ("rot_0", "rot_1", "rot_2", "rot_3"):
        vertices[name][7] = 0
    return vertices


def truncate(place: Path) -> None:
    path = place / "data/scene.ply"
    path.write_bytes(path.read_bytes()[:-100])


def remove_masks(place: Path) -> None:
    shutil.rmtree(place / "data/labels")


def name_image(name: str) -> Callable[[Path], None]:
    return lambda place: edit_json(place / "data/cameras.json", lambda c: c[1].update(img_name=name))


def name_class(name: str) -> Callable[[Path], object]:
    return lambda place: (place / "data/classes.json").write_text(json.dumps({"1": name, "2": "cup", "3": "box"}))


def mask(size: tuple[int, ...], value: int = 0) -> Callable[[Path], None]:
    return lambda place: Image.fromarray(np.full(size, value, np.uint8)).save(place / "data/labels/view1.png")


BAD_INPUT: dict[str, tuple[Callable[[Path], object], str]] = {
    "scene missing": (lambda place: (place / "data/scene.ply").unlink(), "scene.ply"),
    "scene truncated": (truncate, "scene.ply"),
    "scene without properties": (lambda place: edit_scene(place, positions_only), "scene.ply"),
    "scene with NaN": (lambda place: edit_scene(place, put_nan), "scene.ply"),
    "scene with zero quaternions": (lambda place: edit_scene(place, zero_quaternions), "scene.ply"),
    "scene empty": (lambda place: edit_scene(place, lambda v: v[:0]), "scene.ply"),
    "scene is text": (lambda place: (place / "data/scene.ply").write_text("not a PLY"), "scene.ply"),
    "no cameras": (lambda place: (place / "data/cameras.json").unlink(), "data"),
    "cameras.json broken": (lambda place: (place / "data/cameras.json").write_text("[{"), "cameras.json"),
    "classes.json broken": (lambda place: (place / "data/classes.json").write_text("{"), "classes.json"),
    "split.json broken": (lambda place: (place / "data/split.json").write_text("{"), "split.json"),
    "pose NaN": (
        lambda place: edit_json(place / "data/cameras.json", lambda c: c[1].update(position=[0, float("nan"), 0])),
        "cameras.json",
    ),
    "pose not invertible": (
        lambda place: edit_json(place / "data/cameras.json", lambda c: c[1].update(rotation=[[0] * 3] * 3)),
        "cameras.json",
    ),
    "image name of 250 characters": (name_image("x" * 250), "cameras.json: an image has the name 'xxx"),
    "image name with NUL": (name_image("a\0b"), "with the character '\\x00'; expected one line of text"),
    "class name that no file can hold": (name_class("x\ud800"), "classes.json: id 1 has the name 'x\\ud800', with"),
    "class name of a megabyte": (name_class("x" * 2**20), "of 1,048,576 characters; expected at most 200"),
    "class name of two lines": (name_class("a\nb"), "classes.json: id 1 has the name 'a\\nb', with the character"),
    "mask of another size": (mask((24, 64)), "view1.png"),
    "mask RGB": (mask((48, 64, 3)), "view1.png"),
    "mask label unknown": (mask((48, 64), 9), "view1.png"),
    "mask broken": (lambda place: (place / "data/labels/view1.png").write_bytes(b"\x89PNG"), "view1.png"),
    "no mask at all": (remove_masks, "data: no view to learn from (4 no mask)"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_INPUT)
def test_bad_input_is_one_clear_line_with_exit_code_2_and_changes_nothing(
    place: Path, capsys: pytest.CaptureFixture[str], case: str
) -> None:
    damage, names = BAD_INPUT[case]
    damage(place)
    before = contents(place / "out")
    assert main(segment(place)) == 2
    assert_one_line(capsys.readouterr().err, names)
    assert contents(place / "out") == before


@pytest.mark.parametrize(
    ("settings", "names"),
    [(["--scheduler", "tcp://x"], "scheduler is 'tcp://x'"), (["--k", "0"], "k = 0"),
     (["--beta", "2"], "beta"), (["--views", "0"], "views is 0"), (["--views", "-1"], "views is -1")],
)  # fmt: skip
def test_impossible_settings_are_one_clear_line_with_exit_code_2(
    place: Path, capsys: pytest.CaptureFixture[str], settings: list[str], names: str
) -> None:
    before = contents(place / "out")
    assert main(segment(place, *settings)) == 2
    assert_one_line(capsys.readouterr().err, names)
    assert contents(place / "out") == before


@pytest.mark.parametrize(
    ("line", "names"),
    [("segment s.ply --data d --outt o", "unknown option --outt; did you mean --out?"),
     ("segment s.ply --data d -out o", "unknown option -out; did you mean --out?"),
     ("remove s.ply --klass=chair", "unknown option --klass; did you mean --class?"),
     ("--verison", "unknown option --verison; did you mean --version?"), ("doctor --qq", "unknown option --qq\n")],
)  # fmt: skip
def test_a_misspelt_option_is_named_before_those_that_are_missing(
    capsys: pytest.CaptureFixture[str], line: str, names: str
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(line.split())
    assert ended.value.code == 2 and names in capsys.readouterr().err


def test_what_may_look_like_an_option_is_still_taken_for_what_it_is() -> None:
    options = build_parser().parse_args(["pick", "s", "--data", "d", "--view=--a", "--click", "-3", "5", "--ou", "o"])
    assert options.view == "--a" and options.click == [[-3, 5]] and options.out == "o"


def test_render_and_eval_refuse_what_does_not_fit(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    balls_on_a_table(seed=1)[0].save(place / "other.ply")
    rest = ["--data", f"{place}/data", "--out", f"{place}/maps", "--quiet", "--segmentation"]
    npz, scene = f"{place}/out/segmentation.npz", f"{place}/data/scene.ply"
    assert main(["render", f"{place}/other.ply", *rest, npz]) == 2
    assert_one_line(capsys.readouterr().err, "segmentation.npz: belongs to the scene")
    assert main(["render", scene, *rest, f"{place}/missing.npz"]) == 2
    assert_one_line(capsys.readouterr().err, "missing.npz")
    edit_json(place / "data/split.json", lambda split: split.update(test=[]))  # type: ignore[attr-defined]
    assert main(["render", scene, *rest, npz]) == 2
    assert_one_line(capsys.readouterr().err, "data: split 'test' has no views")
    assert main(["eval", "--pred", f"{place}/maps", "--truth", f"{place}/data/labels"]) == 2
    assert_one_line(capsys.readouterr().err, "maps")
    assert not (place / "maps").exists()


def test_an_out_that_cannot_be_written_is_one_clear_line(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (place / "file").write_text("in the way")
    assert main([*segment(place), "--out", f"{place}/file/out"]) == 2
    assert_one_line(capsys.readouterr().err, "file/out")
    assert (place / "file").read_text() == "in the way"


def test_a_full_disk_is_one_clear_line_and_the_earlier_results_stay_whole(
    place: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    before = contents(place / "out")

    sync, calls = os.fsync, []

    def disk_full(file: int) -> None:
        calls.append(file)
        if len(calls) > 1:  # There is space for the probe.
            raise OSError(28, os.strerror(28))
        sync(file)

    monkeypatch.setattr(atomic.os, "fsync", disk_full)
    assert main(segment(place)) == 2
    assert_one_line(capsys.readouterr().err, "segmentation.npz: cannot be written (No space left on device)")
    assert contents(place / "out") == before


def test_an_error_is_on_a_line_of_its_own_below_the_progress_bar(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mask((24, 64))(place)
    assert main([option for option in segment(place) if option != "--quiet"]) == 2
    stderr = capsys.readouterr().err
    assert "observe" in stderr
    assert re.search(r"^gsseg: error: .*view1\.png", stderr, re.MULTILINE)


def test_progress_is_shown_and_quiet_hides_it(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([option for option in segment(place) if option != "--quiet"]) == 0
    loud = capsys.readouterr()
    assert "observe" in loud.err and "em" in loud.err and "Gaussians" in loud.out
    assert main(segment(place)) == 0
    quiet = capsys.readouterr()
    assert quiet.err == "" and "Gaussians" in quiet.out


def test_an_interrupt_while_learning_ends_with_130_and_changes_nothing(
    place: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    before = contents(place / "out")

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(VoteLearner, "fit", interrupted)
    assert main(segment(place, "--learner", "votes")) == 130
    assert capsys.readouterr().err == ""
    assert contents(place / "out") == before


def test_ctrl_c_in_a_real_process_ends_with_130_and_no_traceback(place: Path) -> None:
    before = contents(place / "out")
    # The learner waits, so that the signal meets it at work; the warm-up, which tells nobody, goes on.
    program = (
        "import sys, time\nfrom gsseg_core.cli.main import main\n"
        "from gsseg_core.learn.vote_learner import VoteLearner\n"
        "def fit(self, progress=None):\n"
        "    if progress: progress('learn', 0, 9); print('at work', file=sys.stderr); time.sleep(60)\n"
        "VoteLearner.fit = fit\n"
        "sys.exit(main())"
    )
    arguments = [option for option in segment(place, "--learner", "votes") if option != "--quiet"]
    with subprocess.Popen(
        [sys.executable, "-c", program, *arguments], stderr=subprocess.PIPE, stdout=subprocess.DEVNULL
    ) as process:
        assert process.stderr is not None
        stderr = b""
        while b"at work" not in stderr and process.poll() is None:
            stderr += os.read(process.stderr.fileno(), 4096)
        process.send_signal(signal.SIGINT)
        stderr += process.stderr.read()
    assert process.returncode == 130, stderr
    assert b"Traceback" not in stderr and b"gsseg" not in stderr and stderr.endswith(b"\n")
    assert contents(place / "out") == before


def test_the_command_runs_as_a_process_of_its_own(place: Path) -> None:
    command = [sys.executable, "-W", "error", "-m", "gsseg_core.cli"]
    run = subprocess.run([*command, *segment(place, "--learner", "votes")], capture_output=True, text=True, check=False)
    assert run.returncode == 0 and run.stderr == ""
    run = subprocess.run([*command, *segment(place, scene="no.ply")], capture_output=True, text=True, check=False)
    assert run.returncode == 2 and run.stdout == ""
    assert_one_line(run.stderr, "no.ply")


def test_the_package_and_the_pipeline_load_without_pytorch() -> None:
    program = "import sys, gsseg_core, gsseg_core.cli.main, gsseg_core.pipeline; sys.exit('torch' in sys.modules)"
    subprocess.run([sys.executable, "-c", program], check=True)


def test_the_demo_segments_its_scene_well(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", "--out", f"{tmp_path}/demo", "--quiet"]) == 0
    out = capsys.readouterr().out
    found = re.search(r"mIoU ([0-9.]+) %", out)
    assert found is not None and float(found[1]) > 80
    assert (tmp_path / "demo/segmented/report.json").is_file()
    assert (tmp_path / "demo/segmented/pictures/contact_sheet.png").is_file()


def test_a_real_apartment_is_segmented_from_20_views(real_data: Path, tmp_path: Path) -> None:
    data = real_data / "replica_apartment"
    inputs = [f"{data}/scene.ply", "--data", str(data), "--quiet"]
    assert main(["segment", *inputs, "--out", f"{tmp_path}/out", "--learner", "votes", "--views", "20"]) == 0
    npz = f"{tmp_path}/out/segmentation.npz"
    assert main(["render", *inputs, "--segmentation", npz, "--out", f"{tmp_path}/maps"]) == 0
    scores = f"{tmp_path}/scores.json"
    assert main(["eval", "--pred", f"{tmp_path}/maps", "--truth", f"{data}/labels", "--json", scores]) == 0
    assert json.loads(Path(scores).read_text())["mean_iou"] > 0.6
    report = json.loads((tmp_path / "out/report.json").read_text())
    assert report["views"]["used"] == 20 and sum(entry["gaussians"] > 0 for entry in report["classes"]) > 30
