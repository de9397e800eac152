"""The benchmark programs: peers compute what the operator does, fits and comparisons are right, a report comes out."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path
from typing import Any

import bench
import calibration
import children
import converged
import growth
import jobs
import lift_rate
import numba as nb
import numpy as np
import peers
import pytest
import torch
from first_rasteriser import first_lift, to_splats
from lift_rate import count_work
from operator_cases import lifting
from plain_torch import PlainTorch
from report import Bar, Report, short
from small_scenes import NAMES, NUM_CLASSES, balls_on_a_table, clean_views, ring
from view_errors import WrongMasks, corrupt_views
from workloads import SIZES, RoomSize, make_room, split

from gsseg_core.learn.gradient_learner import GradientLearner, GradientSettings
from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.constants import T_LIFTED, T_MIN
from gsseg_core.raster.cpu.projection import project
from gsseg_core.raster.cpu.tiling import assign
from gsseg_core.scene.gaussian_scene import GaussianScene

SCENE, TRUTH = balls_on_a_table()
SMALL_ROOM = make_room(RoomSize(3000, 2, 3, 70, 50))


@pytest.mark.parametrize("scene", [SCENE, SMALL_ROOM.scene], ids=["table", "room"])
def test_first_rasteriser_has_the_sums_of_the_operator(scene: GaussianScene) -> None:
    camera = (ring(1) if scene is SCENE else SMALL_ROOM.cameras)[0]
    labels = np.random.default_rng(0).integers(-1, 3, (camera.height, camera.width)).astype(np.int32)
    operator, projected = make_operator(scene, camera), project(scene, camera)
    tiles = assign(projected, camera.width, camera.height)
    first = first_lift(to_splats(projected), tiles, labels, 3)
    seen = operator.observe(labels)
    votes = np.zeros((len(scene), first.shape[1]), first.dtype)
    votes[seen.ids] = seen.dense(seen.votes())
    votes = votes[operator.ids]
    assert first.sum() > 100
    # An alpha that is as good as 1/255 may count for one and not for the other.
    assert np.abs(first - votes).sum() < 1e-4 * votes.sum()


def test_plain_torch_renders_what_the_operator_does() -> None:
    camera = SMALL_ROOM.cameras[0]
    codes = np.random.default_rng(0).dirichlet(np.ones(4), len(SMALL_ROOM.scene)).astype(np.float32)
    image, left_over = make_operator(SMALL_ROOM.scene, camera).blend(codes)
    image[..., 0] += left_over
    rendered = PlainTorch(SMALL_ROOM.scene, 4).render(camera, torch.from_numpy(codes))
    assert np.abs(rendered - image).max() < 5e-3
    assert np.abs(rendered - image).mean() < 1e-5


def test_plain_torch_learns_the_codes_of_the_gradient_learner() -> None:
    views = clean_views(2)
    settings = GradientSettings(epochs=1)
    learner = GradientLearner(SCENE, NUM_CLASSES, settings)
    for view in views:
        learner.observe(view)
    plain = PlainTorch(SCENE, NUM_CLASSES, settings)
    codes = plain.learn([view.camera for view in views], [view.read_labels() for view in views])
    learner.fit()
    np.testing.assert_allclose(codes[learner.observed_], learner.codes_[learner.observed_], atol=2e-3)


def test_work_is_counted_as_the_operator_lists_it() -> None:
    camera = SMALL_ROOM.cameras[0]
    projected = project(SMALL_ROOM.scene, camera)
    tiles = assign(projected, camera.width, camera.height)
    work, whole = (
        count_work(projected, tiles, camera.width, camera.height, least=least) for least in (T_LIFTED, T_MIN)
    )
    operator = make_operator(SMALL_ROOM.scene, camera)
    assert whole.pairs == pytest.approx(len(operator.weights().pixels), rel=1e-4)
    assert work.pairs == pytest.approx((lifting(operator, SMALL_ROOM.scene)[0] > 0).sum(), rel=1e-4)
    assert work.pairs <= 16 * work.records <= 16 * work.evaluations
    assert work.products == work.records  # With one label only.
    assert work.flops > 17 * 16 * work.evaluations


def test_gaussians_that_move_are_told_and_the_work_near_them(capsys: pytest.CaptureFixture[str]) -> None:
    converged.follow("balls", SCENE, clean_views(3), NUM_CLASSES)
    title, *steps = capsys.readouterr().out.splitlines()
    assert title.startswith("balls: steps ") and steps
    for step in steps:
        gaussians, work = map(float, step.split("Gaussians, work ")[1].split(" or ")[0].split(", "))
        assert 0 <= gaussians <= work <= 1


def test_peak_is_that_of_the_fastest_spell(monkeypatch: pytest.MonkeyPatch) -> None:
    spells = iter([0.1, 4.0, 2.0, 3.0])
    monkeypatch.setattr(lift_rate, "CHAINS", (8,))
    monkeypatch.setattr(lift_rate, "once", lambda work: next(spells) if np.isfinite(work()) else np.nan)
    rounds = (1 << 16) * 3  # as many as a spell of 0.3 s needs after one of 0.1 s
    assert lift_rate.fma_peak(0.3, 3) == pytest.approx(nb.get_num_threads() * 8 * rounds / 2, rel=1e-4)


def test_flashsplat_takes_the_largest_vote_and_the_bias_moves_the_background() -> None:
    codes = np.array([[0.4, 0.6, 0], [0.2, 0.3, 0.5], [0, 0, 0]], np.float32)
    assert jobs.hard_votes(codes, 0.0).tolist() == [[0, 1, 0], [0, 0, 1], [0, 0, 0]]
    assert jobs.hard_votes(codes, 0.25).tolist() == [[1, 0, 0], [0, 0, 1], [0, 0, 0]]
    assert jobs.hard_votes(codes, 0.4).tolist() == [[1, 0, 0], [1, 0, 0], [0, 0, 0]]


def test_exponent_is_the_power_of_the_size() -> None:
    sizes = [1, 2, 5, 10]
    assert growth.exponent(sizes, [3 * size**1.5 for size in sizes]) == pytest.approx(1.5)
    assert growth.exponent(sizes, [7, 7, 7, 7]) == pytest.approx(0)
    noisy = [2 * size * factor for size, factor in zip(sizes, (1.05, 0.95, 1.05, 0.95), strict=True)]
    assert growth.exponent(sizes, noisy) == pytest.approx(1, abs=0.1)


def test_test_cameras_are_spread_and_not_learnt_from() -> None:
    cameras = make_room(RoomSize(100, 6, 2, 32, 24, tests=3)).cameras
    train, test = split(cameras, 3)
    assert [camera.name for camera in test] == ["view001", "view004", "view007"]
    assert len(train) == 6
    assert split(cameras, 0) == (cameras, [])


def test_child_answers_and_its_last_words_name_no_path_or_host() -> None:
    assert children.run_child("report.short", value=0.12345) == "0.123"
    with pytest.raises(children.ChildError, match="unexpected keyword argument"):
        children.run_child("report.short", nonsense=1)
    words = children.last_words(
        "first\nHTTPSConnectionPool(host='x.example') https://x.example/y /a/b/c.so: missing.\n"
    )
    assert words == "HTTPSConnectionPool(...) ... c.so: missing"


def report(value: float, sizes: str = "tiny") -> Report:
    made = Report(sizes, "2026-01-02", {"processor": f"P{value:g}", "cores": 2})
    made.add("stages", "bin", "s", [value, 3 * value, 2 * value])
    return made


def test_second_run_is_compared_with_the_first(tmp_path: Path) -> None:
    report(1.0).write(tmp_path, "# Text")
    text = (tmp_path / "BENCHMARK.md").read_text()
    assert '"Last time" is empty: there was no earlier run.' in text
    assert "| bin | 2.00 s | 1.00 to 3.00 | 3 |  |  |" in text
    report(2.0).write(tmp_path, "# Text")
    text = (tmp_path / "BENCHMARK.md").read_text()
    assert '"Last time" is the run of 2026-01-02 on: P1, 2 cores.' in text
    assert "| bin | 4.00 s | 2.00 to 6.00 | 3 | 2.00 | 2.00 |" in text
    kept = Report.load(tmp_path / "BENCHMARK.json")
    assert kept is not None
    assert kept.value("stages", "bin") == 4.0
    report(1.0, "full").write(tmp_path, "# Text")
    assert "the earlier run was of other sizes (tiny)" in (tmp_path / "BENCHMARK.md").read_text()


def test_bars_are_judged_from_the_numbers() -> None:
    bars = [
        Bar("fast", "stages", "bin", 3.0),
        Bar("slow", "stages", "bin", 3.0, at_least=True),
        Bar("absent", "stages", "other", 1.0),
    ]
    text = report(1.0).markdown("", report(2.0), bars)
    assert "| fast | at most 3.00 | 2.00 | met | 4.00 |" in text
    assert "| slow | at least 3.00 | 2.00 | **not met** | 4.00 |" in text
    assert "| absent | at most 1.00 | not measured |  |  |" in text
    assert "| fast | at most 3.00 | 2.00 | met |  |" in report(1.0).markdown("", None, bars)


def test_numbers_have_three_digits_that_count() -> None:
    assert [short(value) for value in (0, 0.0123456, 1.0, 999.6, 123456)] == ["0", "0.0123", "1.00", "1,000", "123,000"]


def test_bars_name_numbers_that_a_run_has(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A tiny run from end to end, its jobs in this process; the bars of the full run all find their number in it."""

    def here(job: str, **arguments: Any) -> Any:
        module, function = job.rsplit(".", 1)
        answer = getattr(importlib.import_module(module), function)(**json.loads(json.dumps(arguments, default=str)))
        return json.loads(json.dumps(answer))

    for module in (bench, growth, peers):
        monkeypatch.setattr(module, "run_child", here)
    monkeypatch.setattr(bench, "seconds_of", lambda command, **environment: 0.1 * len(command[-1]))
    monkeypatch.setattr(bench, "finish", lambda command: "")
    monkeypatch.setattr(jobs, "fma_peak", lambda: 1e9)
    monkeypatch.setattr(jobs, "warm_up", lambda: 0.0)
    absent = tmp_path / "no data"
    monkeypatch.setattr(sys, "argv", ["bench", "--sizes", "tiny", "--out", str(tmp_path), "--data", str(absent)])
    assert bench.main() == 0
    made = Report.load(tmp_path / "BENCHMARK.json")
    assert made is not None
    wanted = bench.bars(SIZES["full"])
    assert [bar.what for bar in wanted if made.value(bar.section, bar.name) is None] == []
    text = (tmp_path / "BENCHMARK.md").read_text()
    assert "Skipped: the scene is not there." in text
    assert "gsplat" in text


def test_true_codes_score_one() -> None:
    codes = np.eye(NUM_CLASSES, dtype=np.float32)[TRUTH]
    assert jobs.score(SCENE, clean_views(2), codes) == 1.0
    assert jobs.score(SCENE, clean_views(2), np.roll(codes, 1, axis=1)) < 0.1


def test_every_learner_is_calibrated_and_every_way_to_do_so_compared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    learners = [calibration.EM, calibration.VOTES, calibration.HARD, calibration.GRADIENT]
    clean, test = clean_views(7), clean_views(2, "test", 0.3)
    train = {calibration.CLEAN: clean, calibration.WRONG: corrupt_views(clean, 0, WrongMasks())}
    balls = calibration.Bench("balls", SCENE, NAMES, train, test, learners)
    monkeypatch.setattr(calibration, "open_benches", lambda folder, real: iter([balls]))
    monkeypatch.setattr(calibration, "warm_up", lambda: None)
    monkeypatch.setattr(sys, "argv", ["calibration.py", "--out", str(tmp_path / "calibration.md")])
    assert calibration.main() == 0
    page = (tmp_path / "calibration.md").read_text(encoding="utf-8")
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in page.splitlines() if "| balls, " in line]
    scores, ways = ([row for row in rows if len(row) == columns] for columns in (11, 7))
    assert [row[1] for row in scores] == [*learners, *learners] and [row[1] for row in ways] == 2 * learners[:3]
    assert all(row[3] == "0" for row in scores), "calibration changes no label"
    for _, _, right, *errors in ways:
        assert 0.5 < float(right) <= 1 and all(0 <= float(error.split()[0]) < 0.5 for error in errors)
        assert "T = 1.00" in errors[0]
    for name in ("calibration.svg", "risk_coverage.svg"):
        assert (tmp_path / "pictures" / name).exists()
