"""The programs that try to break gsseg: they run from end to end, draw the same again, and see what is broken."""

from __future__ import annotations

import json
import random
import shutil
import subprocess
import sys
from pathlib import Path

import mutations
import numpy as np
import pytest
from patience import PATIENCE
from small_scenes import clean_views, write_dataset
from whole_outputs import faults_of, leftovers, listing, read_folder

from gsseg_core import pipeline

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


def ran(program: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Run a program in a process of its own: it forks, which one that has used OpenMP cannot."""
    command = [sys.executable, str(BENCHMARKS / program), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE)


def test_kills_are_counted_and_drawn_again_by_their_number(tmp_path: Path) -> None:
    done = ran("kills.py", "--what", "state", "--count", 2, "--first", 5, "--json", tmp_path / "kills.json")
    assert done.returncode in (0, 1), done.stderr
    assert "| state | 2 |" in done.stdout
    counts = json.loads((tmp_path / "kills.json").read_text())
    assert counts["state"]["kills"] == 2
    assert not counts["state"].get("lost")


def test_broken_files_requests_and_messages_are_judged_and_shown_again(tmp_path: Path) -> None:
    pytest.importorskip("gsseg_msgs.msg", reason="gsseg_msgs is not installed")
    wanted = ("--what", "split.json,state,mask,save_state", "--count", 2, "--patience", PATIENCE)
    done = ran("fuzz.py", *wanted, "--out", tmp_path)
    assert done.returncode in (0, 1), done.stderr
    for what in ("split.json", "state", "mask", "save_state"):
        assert f"| {what} | 2 |" in done.stdout
    again = ran("fuzz.py", "--what", "split.json", "--replay", 1, "--out", tmp_path)
    assert again.stdout.startswith("split.json: ")
    assert (tmp_path / "split.json" / "1" / "finding.json").is_file()


def test_a_robots_day_ends_with_a_table_of_bars(tmp_path: Path) -> None:
    pytest.importorskip("gsseg_msgs.msg", reason="gsseg_msgs is not installed")
    done = ran("robot_day.py", "--minutes", 0.05, "--rate", 150, "--folder", tmp_path)
    assert done.returncode in (0, 1), done.stderr
    for bar in ("memory, from", "labels after learning", "labels after a reset", "masks", "requests", "tracebacks"):
        assert f"| {bar}" in done.stdout


@pytest.fixture(name="results", scope="module")
def results_fixture(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Results of two runs over the same scene, whose masks have other ids."""
    from gsseg_core.data.label_images import write_mask

    data = write_dataset(tmp_path_factory.mktemp("data"))
    for view in clean_views(6):
        write_mask(data / "turned" / f"{view.name}.png", np.array([0, 2, 3, 1])[view.read_labels()], 8)
    outs = []
    for labels in ("labels", "turned"):
        outs.append(tmp_path_factory.mktemp(labels) / "out")
        pipeline.segment(data / "scene.ply", data, outs[-1], labels=labels, learner="votes")
    return outs[0], outs[1]


def test_files_of_two_runs_are_told_from_those_of_one(results: tuple[Path, Path], tmp_path: Path) -> None:
    runs = {name: read_folder(folder) for name, folder in zip(("first", "second"), results, strict=True)}
    assert {kind for kind, _ in faults_of(results[0], runs)} <= {"unmarked"}
    mixed = Path(shutil.copytree(results[0], tmp_path / "mixed"))
    shutil.copy(results[1] / "report.json", mixed)
    (mixed / "segmentation.npz").write_bytes((mixed / "segmentation.npz").read_bytes()[:-50])
    (mixed / "classes" / "1_red_ball.ply").unlink()
    assert {"mixed", "broken", "lost"} <= {kind for kind, _ in faults_of(mixed, runs)}
    clean = listing(results[0])
    (mixed / ".gsseg-0123456789ab.png").touch()
    assert leftovers(results[0], clean) == []
    assert leftovers(mixed, clean) == [("leftover", ".gsseg-*.png (1 in all)")]


@pytest.mark.parametrize("name", ["any_bytes", "json_values", "npz_members", "png_chunks", "ply_header", "words"])
def test_damage_differs_from_draw_to_draw_and_not_from_run_to_run(
    name: str, results: tuple[Path, Path], tmp_path: Path
) -> None:
    folder = write_dataset(tmp_path)
    good = {
        "npz_members": results[0] / "segmentation.npz",
        "png_chunks": folder / "labels" / "view0.png",
        "ply_header": folder / "scene.ply",
    }.get(name, folder / "classes.json").read_bytes()
    mutation: mutations.Mutation = getattr(mutations, name)
    made = [mutation(good, random.Random(i)) for i in range(20)]
    assert made == [mutation(good, random.Random(i)) for i in range(20)]
    assert len(set(made)) > 10
