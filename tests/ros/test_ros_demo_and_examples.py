"""The demo and the examples as people start them: as programs, with all their child processes."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from patience import PATIENCE
from PIL import Image as Picture
from ros_helpers import REPOSITORY, Process, Ros, ros_fixture, wait_until  # noqa: F401
from small_scenes import NAMES, write_dataset

from gsseg_core.cli.main import main
from gsseg_core.data.label_images import read_mask
from gsseg_core.demo.furniture import CLASS_NAMES
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_ros.child_nodes import ChildError, ChildNodes, claimed_domain
from gsseg_ros.client import SegmentationClient

EXAMPLES = sorted((REPOSITORY / "examples").glob("*.py"))
PYTHONPATH = {"PYTHONPATH": str(REPOSITORY), "PYTHONUNBUFFERED": "1"}

BUILT_BEFORE = """
import pickle
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from gsseg_ros import demo
before = Path(sys.argv.pop(1))
built = pickle.loads((before / "built.pickle").read_bytes())
demo.build_demo = lambda folder, seed: replace(built, root=shutil.copytree(before / "scene", folder))
sys.exit(demo.main())
"""
"""The demo's program, with the scene that `demo_run` has built: that is half the work of one that is ended early."""


def processes_with(text: str) -> list[int]:
    """Process ids whose command line holds a text."""
    found = []
    for folder in Path("/proc").iterdir():
        try:
            if folder.name.isdigit() and text in (folder / "cmdline").read_bytes().decode(errors="replace"):
                found.append(int(folder.name))
        except OSError:  # It has just ended.
            continue
    return found


class Demo:
    """A demo under way, writing to a folder of its own."""

    def __init__(self, out: Path, *arguments: str, built: Path | None = None) -> None:
        self.out = out
        program = ["-m", "gsseg_ros.demo"] if built is None else ["-c", BUILT_BEFORE, str(built)]
        self.process = subprocess.Popen(
            [sys.executable, *program, "--out", str(out), "--quiet", *arguments],
            cwd=REPOSITORY, env={**os.environ, **PYTHONPATH}, text=True, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )  # fmt: skip

    @property
    def children(self) -> list[int]:
        return processes_with(str(self.out / "scene"))

    def wait_for_log(self, module: str, text: str) -> None:
        log = self.out / f"logs/{module}.log"
        wait_until(lambda: log.exists() and text in log.read_text(), f"{text!r} in {log}")

    def end(self) -> tuple[int, str, str]:
        """Exit code and output, once it has ended."""
        output, errors = self.process.communicate(timeout=PATIENCE)
        return self.process.returncode, output, errors


@pytest.fixture
def demo_out(tmp_path: Path) -> Iterator[Path]:
    """A folder for a demo; what a failing test leaves behind of it is killed."""
    yield tmp_path / "demo"
    for number in processes_with(str(tmp_path)):
        os.kill(number, signal.SIGKILL)


def test_the_demo_segments_its_scene_well_and_shows_it(demo_out: Path) -> None:
    demo = Demo(demo_out, "--rate", "100")
    code, output, errors = demo.end()
    assert code == 0, errors
    assert demo.children == []
    for stage in ("fuse masks as they come, 100 per second", "learn", "segment: from request to last cloud", "export"):
        assert re.search(rf"^{re.escape(stage)} +\d+\.\d\d$", output, re.M), output
    for name in CLASS_NAMES:
        row = re.search(rf"^{name} +([\d,]+) +([\d.]+) % +([\d.]+) % +([\d.]+) %$", output, re.M)
        assert row is not None, output
        assert float(row[3]) > 75 and float(row[4]) > 80
        assert len(GaussianScene.load(next((demo_out / "segmented/classes").glob(f"*_{name}.ply")))) == int(
            row[1].replace(",", "")
        )
    score = re.search(r"^30 views .* mIoU ([\d.]+) %", output, re.M | re.S)
    assert score is not None and float(score[1]) > 90
    assert json.loads((demo_out / "segmented/report.json").read_text())["views"]["used"] == 30
    assert len(list((demo_out / "rendered").glob("*.png"))) == 6
    assert set(np.unique(read_mask(demo_out / "rendered/0003.png").labels)) <= set(range(len(CLASS_NAMES)))
    for picture in ("masks_and_result.png", "rendered/overlays/contact_sheet.png", "rendered/overlays/legend.png"):
        assert str(picture) in output or "legend" in picture
        with Picture.open(demo_out / picture) as image:
            assert min(image.size) > 200 and np.asarray(image).std() > 20
    # The demo without ROS goes where this one has been.
    assert main(["demo", "--out", str(demo_out), "--quiet"]) == 0


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 128 + signal.SIGTERM)])
def test_no_node_outlives_a_demo_that_is_ended_early(
    demo_out: Path, demo_run: Path, number: signal.Signals, code: int
) -> None:
    demo = Demo(demo_out, "--rate", "0.1", built=demo_run)
    demo.wait_for_log("replay_node", "replaying 30 views")
    assert len(demo.children) >= 2
    demo.process.send_signal(number)
    found, output, errors = demo.end()
    assert (found, output) == (code, ""), errors
    assert "Traceback" not in errors
    assert demo.children == []


@pytest.mark.parametrize("module", ["segment_node", "replay_node"])
def test_a_node_that_dies_ends_the_demo_with_its_log_named(demo_out: Path, demo_run: Path, module: str) -> None:
    demo = Demo(demo_out, "--rate", "0.1", built=demo_run)
    demo.wait_for_log("replay_node", "replaying 30 views")
    (number,) = [n for n in demo.children if module in Path(f"/proc/{n}/cmdline").read_text()]
    os.kill(number, signal.SIGKILL)
    code, output, errors = demo.end()
    assert (code, output) == (2, "")
    assert errors.startswith(f"demo: error: {module} ended with code -9; the last line of its log {demo_out}/logs/")
    assert errors.count("\n") == 1 and f"{demo_out}/logs/segment_node.log" in errors
    assert demo.children == []


def test_a_folder_that_cannot_be_written_to_is_one_error(demo_out: Path) -> None:
    demo_out.write_text("in the way")
    code, _, errors = Demo(demo_out).end()
    assert code == 2 and errors.startswith("demo: error: ") and errors.count("\n") == 1


def test_an_impossible_rate_is_refused(demo_out: Path) -> None:
    code, _, errors = Demo(demo_out, "--rate", "0").end()
    assert code == 2 and "--rate is 0; expected more than 0" in errors


def test_a_child_that_cannot_start_is_named_with_what_it_said(tmp_path: Path) -> None:
    with ChildNodes(tmp_path / "logs") as nodes:
        child = nodes.start("replay_node", {"data": str(tmp_path / "nowhere")})

        def failed() -> bool:
            try:
                nodes.check()
            except ChildError:
                return True
            return False

        wait_until(failed, "the end of the child")
        with pytest.raises(ChildError, match=r"replay_node ended with code 2; the last line of its log .*nowhere"):
            _ = child.done
        assert nodes.logs == [tmp_path / "logs/replay_node.log"]


def test_two_that_start_children_at_once_never_share_a_domain(tmp_path: Path) -> None:
    with ChildNodes(tmp_path) as first:
        claimed, claim = claimed_domain([first.domain_id, *range(1, 101)])
        claim.close()
        assert claimed != first.domain_id
        with pytest.raises(ChildError, match=r"in each ROS domain .* expected one that is free"):
            claimed_domain([first.domain_id])

    def free() -> bool:
        try:
            claimed_domain([first.domain_id])[1].close()
        except ChildError:
            return False
        return True

    wait_until(free, "the domain, which another test may have taken meanwhile")


# Examples


@pytest.fixture
def robot(ros: Ros, tmp_path: Path) -> Process:
    """A node that waits for masks, with the dataset `data` beside it."""
    write_dataset(tmp_path / "data")
    return ros.start("segment_node", {"scene_path": tmp_path / "data/scene.ply", "class_names": list(NAMES.values())})


def wait_for_views(ros: Ros) -> None:
    """Wait until the masks of the dataset are fused: that they have arrived does not say so."""
    with SegmentationClient(domain_id=ros.domain, find_timeout=PATIENCE) as client:
        assert client.wait_for_views(4, PATIENCE) == 4


def run_example(name: str, *arguments: str, ros: Ros | None = None, folder: Path | None = None) -> tuple[str, str]:
    """Output and errors of an example that does its work."""
    ran = start_example(name, *arguments, ros=ros, folder=folder)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    return ran.stdout, ran.stderr


def start_example(
    name: str, *arguments: str, ros: Ros | None = None, folder: Path | None = None
) -> subprocess.CompletedProcess[str]:
    environment = ros.environment if ros is not None else dict(os.environ)
    return subprocess.run(
        [sys.executable, str(REPOSITORY / "examples" / name), *arguments],
        cwd=folder, env={**environment, **PYTHONPATH}, text=True, capture_output=True, timeout=PATIENCE, check=False,
    )  # fmt: skip


@pytest.mark.parametrize("example", [path.name for path in EXAMPLES])
def test_every_example_says_how_it_is_run(example: str) -> None:
    output, _ = run_example(example, "--help")
    assert f"python examples/{example}" in output
    assert example in (REPOSITORY / "examples/README.md").read_text()


def test_masks_published_by_hand_are_fused_learnt_and_turned_into_boxes(
    ros: Ros, robot: Process, tmp_path: Path
) -> None:
    output, _ = run_example("publish_masks.py", str(tmp_path / "data"), "--rate", "20", ros=ros)
    assert output == "published 4 masks\n"
    wait_for_views(ros)

    output, _ = run_example("learn_and_segment.py", "--save", "box", ros=ros, folder=tmp_path)
    assert "observe 4/4" in output and "learnt from 4 views in " in output
    points = np.load(tmp_path / "box.npy")
    assert f"box: {len(points)} Gaussians, " in output and points.shape[1] == 3

    output, _ = run_example("objects_to_boxes.py", "box", "red ball", "--min-confidence", "0.6", ros=ros)
    boxes = {box["object"]: box for box in map(json.loads, output.splitlines())}
    assert set(boxes) == {"box", "red ball"}
    # Where small_scenes puts it, and its diameter.
    ball = boxes["red ball"]
    np.testing.assert_allclose(ball["mean"], [1, 0, 0.45], atol=0.15)
    np.testing.assert_allclose(ball["center"], [1, 0, 0.45], atol=0.15)
    assert ball["frame"] == "map" and 0.5 < ball["size"][2] <= ball["size"][0] < 1.1
    assert ball["close_along"] is None, "it is wider than the hand"
    np.testing.assert_allclose(np.linalg.norm(ball["axes"], axis=1), 1, atol=1e-3)

    output, _ = run_example("objects_to_boxes.py", "box", "--opening", "2", ros=ros)
    (box,) = map(json.loads, output.splitlines())
    np.testing.assert_allclose(box["close_along"], box["axes"][2], atol=1e-3)
    assert robot.running


def test_topics_of_the_publisher_can_be_remapped(ros: Ros, tmp_path: Path) -> None:
    write_dataset(tmp_path / "data")
    parameters = {"scene_path": tmp_path / "data/scene.ply"}
    robot = ros.start("segment_node", parameters, "-r", "mask:=/front/mask")
    remapped = ("--ros-args", "-r", "mask:=/front/mask")
    run_example("publish_masks.py", str(tmp_path / "data"), "--rate", "50", *remapped, ros=ros)
    wait_for_views(ros)
    run_example("learn_and_segment.py", ros=ros)
    assert robot.running


@pytest.mark.parametrize("example", ["learn_and_segment.py", "objects_to_boxes.py"])
def test_examples_say_in_one_line_that_nothing_was_learnt_yet(ros: Ros, robot: Process, example: str) -> None:
    robot.wait_for("active: listening")
    ran = start_example(example, ros=ros)
    assert ran.returncode == 1
    assert re.fullmatch(rf"{example[:-3]}: NO_(CODES|VIEWS) \(10\d+\): .*\n", ran.stderr)


def test_the_library_alone_segments_a_dataset(tmp_path: Path) -> None:
    write_dataset(tmp_path / "data")
    output, _ = run_example(
        "segment_from_python.py", str(tmp_path / "data/scene.ply"), str(tmp_path / "data"), str(tmp_path / "out")
    )
    files = sorted((tmp_path / "out").glob("*.ply"))
    assert [path.name for path in files] == ["0_background.ply", "1_red_ball.ply", "2_cup_mug.ply", "3_box.ply"]
    for path in files:
        assert f"{path}: {len(GaussianScene.load(path))} Gaussians, " in output


@pytest.mark.parametrize("example", ["segment_from_python.py", "publish_masks.py"])
def test_examples_name_a_folder_that_is_not_there(example: str, tmp_path: Path) -> None:
    missing = str(tmp_path / "nowhere")
    arguments = [missing] if example == "publish_masks.py" else [missing, missing, str(tmp_path / "out")]
    ran = start_example(example, *arguments)
    assert ran.returncode == 1 and "nowhere" in ran.stderr and ran.stderr.count("\n") == 1


def test_masks_at_a_rate_of_none_are_refused_in_one_line(tmp_path: Path) -> None:
    ran = start_example("publish_masks.py", str(tmp_path), "--rate", "0")
    assert ran.returncode == 2 and ran.stderr.endswith("--rate is 0; expected more than 0 masks per second\n")
