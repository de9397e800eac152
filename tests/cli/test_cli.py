"""The command line, end to end: what it reads and writes."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import weakref
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageFilter
from segmented_place import assert_one_line, segment
from small_scenes import look_at, many_classes, write_dataset

from gsseg_core import pipeline
from gsseg_core.cli.arguments import build_parser
from gsseg_core.cli.main import main
from gsseg_core.data.label_images import read_mask, write_mask
from gsseg_core.export.summary import RunReport
from gsseg_core.refine.label_propagation import UNKNOWN_SHARE
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import Segmentation


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


def test_of_one_view_nobody_says_how_far_others_agree_with_it(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(segment(place, "--views", "1", "--learner", "gradient")) == 0
    told = capsys.readouterr().out
    assert "1 view used" in told and "other views" not in told


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


def test_pictures_of_all_views_are_kept_no_larger_than_they_are_shown_together(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cameras = json.loads((place / "data/cameras.json").read_text())
    large = [{**one, **{name: 10 * one[name] for name in ("width", "height", "fx", "fy")}} for one in cameras]
    (place / "data/cameras.json").write_text(json.dumps(large))
    kept, write = list[int](), pipeline.write_overview

    def look(result: Segmentation, images: list[np.ndarray], *others: Any) -> list[Path]:
        kept.extend(max(image.shape) for image in images)
        return write(result, images, *others)

    monkeypatch.setattr(pipeline, "write_overview", look)
    npz, scene = f"{place}/out/segmentation.npz", f"{place}/data/scene.ply"
    render = ["render", scene, "--data", f"{place}/data", "--segmentation", npz, "--out", f"{place}/maps", "--quiet"]
    assert main(render) == 0 and kept == [480, 480]
    assert read_mask(place / "maps/view2.png").labels.shape[1] == large[2]["width"]


def test_eval_says_that_ids_are_others_than_the_true_ones(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(place / "data/labels", place / "found")
    scores = ["eval", "--pred", f"{place}/found", "--truth", f"{place}/data/labels"]
    assert main(scores) == 0 and capsys.readouterr().err == ""
    for path in (place / "found").iterdir():
        labels = read_mask(path).labels
        write_mask(path, np.where(labels > 0, labels % 3 + 1, labels), 8)
    assert main(scores) == 0
    told = capsys.readouterr()
    assert "(true 1 is 2, 2 is 3, 3 is 1): ids are compared as they are" in told.err and "mean" in told.out
    (place / "data/labels/view0.png").unlink()
    assert main(scores) == 2 and "name them as test in split.json" in capsys.readouterr().err


def test_scores_are_the_same_from_within_the_folder_of_the_truth(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    labels = place / "data/labels"
    assert main(["eval", "--pred", f"{labels}", "--truth", f"{labels}"]) == 0
    told = capsys.readouterr().out
    monkeypatch.chdir(labels)
    assert main(["eval", "--pred", f"{labels}", "--truth", "."]) == 0 and capsys.readouterr().out == told
    (labels / "below").mkdir()
    monkeypatch.chdir("below")
    assert main(["eval", "--pred", f"{labels}", "--truth", ".."]) == 0 and capsys.readouterr().out == told


def test_a_view_called_like_the_legend_keeps_its_overlay(place: Path) -> None:
    cameras = place / "data/cameras.json"
    for view, name in (("view2", "legend"), ("view3", "overlay_legend")):
        cameras.write_text(cameras.read_text().replace(view, name))
        (place / f"data/labels/{view}.png").rename(place / f"data/labels/{name}.png")
    (place / "data/split.json").unlink()
    render = ["render", f"{place}/data/scene.ply", "--data", f"{place}/data", "--out", f"{place}/maps", "--quiet"]
    assert main([*render, "--segmentation", f"{place}/out/segmentation.npz", "--split", "all"]) == 0
    overlays = sorted(path.name for path in (place / "maps/overlays").iterdir())
    assert len(overlays) == 6 + 2 and {"contact_sheet.png", "legend.png", "overlay_legend.png"} <= {*overlays}


def test_render_needs_no_mask_that_can_be_read(place: Path) -> None:
    for path in (place / "data/labels").iterdir():
        path.write_text("damaged")
    inputs = [f"{place}/data/scene.ply", "--data", f"{place}/data", "--quiet", "--out", f"{place}/maps"]
    assert main(["render", *inputs, "--segmentation", f"{place}/out/segmentation.npz"]) == 0
    assert read_mask(place / "maps/view2.png").bits == 8


@pytest.mark.parametrize("learner", ["votes", "gradient"])
def test_the_other_learners_and_settings_can_be_chosen(place: Path, learner: str) -> None:
    assert main(segment(place, "--learner", learner, "--views", "2", "--no-filter", "--k", "9", "--beta", "0.5")) == 0
    report = json.loads((place / "out/report.json").read_text())
    assert report["views"]["used"] == 2 and report["gaussians"]["removed"] == 0
    assert report["settings"]["learner"] == learner
    assert report["settings"]["refine"]["k"] == 9 and report["settings"]["refine"]["beta"] == 0.5


@pytest.mark.parametrize("learner", ["votes", "em"])
def test_codes_are_spread_where_views_leave_much_of_each_other_unknown(place: Path, learner: str) -> None:
    def run(*options: str) -> tuple[float, bool]:
        assert main(segment(place, "--learner", learner, *options)) == 0
        report = json.loads((place / "out/report.json").read_text())
        return report["calibration"]["unknown"], report["settings"]["graph"] is not None

    for options, expected in ((["--views", "1"], True), (["--views", "1", "--no-graph"], False), ([], False)):
        unknown, spread = run(*options)
        assert (unknown > 0.5) if options else (unknown < UNKNOWN_SHARE)
        assert spread is expected


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
    scene, truth = many_classes(260)
    cameras = [look_at(f"v{i}", np.array([0.2 * i, 0.1, 3.5]), 240, 180, 250.0) for i in range(3)]
    data = write_dataset(tmp_path / "data", scene, truth, cameras, bits=16)
    inputs = [f"{data}/scene.ply", "--data", str(data), "--quiet"]
    assert main(["segment", *inputs, "--out", f"{tmp_path}/out", "--k", "1"]) == 0
    with np.load(tmp_path / "out/segmentation.npz") as file:
        assert file["probabilities"].shape == (260, 260)
        np.testing.assert_array_equal(file["labels"], truth)
    assert len(list((tmp_path / "out/classes").iterdir())) == 260
    npz = f"{tmp_path}/out/segmentation.npz"
    assert main(["render", *inputs, "--segmentation", npz, "--out", f"{tmp_path}/maps"]) == 0
    mask = read_mask(tmp_path / "maps/v2.png")
    assert mask.bits == 16 and mask.labels.max() == 259
    assert (mask.labels == read_mask(data / "labels/v2.png").labels).mean() > 0.93


@pytest.mark.parametrize("drawn", [0, 255])
def test_masks_without_an_object_work_from_end_to_end_and_that_is_said(
    place: Path, capsys: pytest.CaptureFixture[str], drawn: int
) -> None:
    (place / "data/classes.json").unlink()
    for path in (place / "data/labels").iterdir():
        Image.fromarray(np.where(np.array(Image.open(path)) > 0, drawn, 0).astype(np.uint8)).save(path)
    assert main(segment(place)) == 0
    assert "no Gaussian is part of an object: the masks name none" in capsys.readouterr().err
    assert "No Gaussian is part of an object: the masks name none" in (place / "out/report.html").read_text()
    assert [path.name for path in (place / "out/classes").iterdir()] == ["0_background.ply"]


def test_masks_of_which_ids_are_shades_of_grey_are_said_to_be(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (place / "data/classes.json").unlink()
    for path in (place / "data/labels").iterdir():
        white = Image.fromarray(np.where(np.array(Image.open(path)) == 1, 255, 0).astype(np.uint8))
        white.filter(ImageFilter.GaussianBlur(2)).save(path)
    assert main(segment(place)) == 0
    assert "are they shades of grey, from masks that were blurred" in capsys.readouterr().err
    assert "are they shades of grey" in (place / "out/report.html").read_text()


def test_a_scene_too_far_from_its_origin_for_float32_is_said_to_be(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, east = place / "data", 5e6
    scene = GaussianScene.load(data / "scene.ply")
    vertices = scene.vertices.copy()
    vertices["x"] += east
    GaussianScene.from_vertices(vertices, None).save(data / "scene.ply")
    cameras = json.loads((data / "cameras.json").read_text())
    for camera in cameras:
        camera["position"][0] += east
    (data / "cameras.json").write_text(json.dumps(cameras))
    assert main(segment(place)) == 0
    said = "he scene is so far from its origin that float32 moves Gaussians by up to"
    assert f"t{said}" in capsys.readouterr().err and f"T{said}" in (place / "out/report.html").read_text()


@pytest.mark.parametrize("line", ["view s", "segment s --data d --out o", "render s --data d --out o --segmentation f"])
def test_every_command_that_renders_takes_the_number_of_a_gpu(line: str) -> None:
    assert build_parser().parse_args([*line.split(), "--device", "cuda:1"]).device == "cuda:1"


def test_what_may_look_like_an_option_is_still_taken_for_what_it_is() -> None:
    options = build_parser().parse_args(["pick", "s", "--data", "d", "--view=--a", "--mask", "-3", "--ou", "o"])
    assert options.views == ["--a"] and options.masks == ["-3"] and options.out == "o"


def test_progress_is_shown_and_quiet_hides_it(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([option for option in segment(place) if option != "--quiet"]) == 0
    loud = capsys.readouterr()
    assert "observe" in loud.err and "em" in loud.err and "Gaussians" in loud.out
    assert main(segment(place)) == 0
    quiet = capsys.readouterr()
    assert quiet.err == "" and "Gaussians" in quiet.out


def test_the_command_runs_as_a_process_of_its_own(place: Path) -> None:
    command = [sys.executable, "-W", "error", "-m", "gsseg_core.cli"]
    run = subprocess.run([*command, *segment(place, "--learner", "votes")], capture_output=True, text=True, check=False)
    assert run.returncode == 0 and run.stderr == ""
    run = subprocess.run([*command, *segment(place, scene="no.ply")], capture_output=True, text=True, check=False)
    assert run.returncode == 2 and run.stdout == ""
    assert_one_line(run.stderr, "no.ply")


def test_what_was_before_carving_takes_no_memory_any_more_when_files_are_written(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, write_run, carved_by = list[weakref.ref[Segmentation]](), pipeline.write_run, Segmentation.carved_by

    def carve(result: Segmentation, *arguments: Any) -> Segmentation:
        before.append(weakref.ref(result))
        return carved_by(result, *arguments)

    def write(*arguments: Any) -> RunReport:
        (one,) = before
        assert one() is None
        return write_run(*arguments)

    monkeypatch.setattr(Segmentation, "carved_by", carve)
    monkeypatch.setattr(pipeline, "write_run", write)
    pipeline.segment(place / "data/scene.ply", place / "data", place / "carved")
    assert before


def test_the_package_and_the_pipeline_load_neither_pytorch_nor_templates() -> None:
    loaded = "'torch' in sys.modules or 'jinja2' in sys.modules"
    program = f"import sys, gsseg_core, gsseg_core.cli.main, gsseg_core.pipeline; sys.exit({loaded})"
    subprocess.run([sys.executable, "-c", program], check=True)


def test_where_ids_hold_in_all_views_nobody_waits_for_scipy(place: Path) -> None:
    loaded = "{'scipy.' + part for part in ('linalg', 'ndimage', 'optimize', 'sparse', 'spatial')} & sys.modules.keys()"
    program = f"import sys; from gsseg_core.cli.main import main; sys.exit(main(sys.argv[1:]) or {loaded} or 0)"
    subprocess.run([sys.executable, "-c", program, *segment(place)], check=True, stdout=subprocess.DEVNULL)


def test_the_demo_segments_its_scene_well(demo_run: Path) -> None:
    found = re.search(r"mIoU ([0-9.]+) %", (demo_run / "said.txt").read_text())
    assert found is not None and float(found[1]) > 80
    assert (demo_run / "segmented/report.json").is_file()
    assert (demo_run / "segmented/pictures/contact_sheet.png").is_file()


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
