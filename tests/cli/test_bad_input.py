"""Bad input, settings and disks: one clear line, exit code 2, and the results of before stay."""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from segmented_place import assert_one_line, contents, segment
from small_scenes import balls_on_a_table

from gsseg_core.cli.main import main
from gsseg_core.files import atomic
from gsseg_core.scene import ply


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


def turn_away(cameras: list[dict[str, object]]) -> None:
    for camera in cameras:  # axes of OpenGL, as nobody says
        camera["rotation"] = (np.array(camera["rotation"]) * (1, -1, -1)).tolist()


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
    "cameras that look elsewhere": (
        lambda place: edit_json(place / "data/cameras.json", turn_away),
        "data: no view to learn from (sees no Gaussian: 4 views); expected posed views with label images; cameras and "
        "scene may be in different frames: try --align",
    ),
    "no mask at all": (remove_masks, "data: no view to learn from (no mask: 4 views)"),
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
     (["--learner", "gradient", "--seed", "-1"], "seed is -1"),
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
     ("segment s.ply --data d --no-carve", "unknown option --no-carve; did you mean --no-"),
     ("remove s.ply --klass=chair", "unknown option --klass; did you mean --class?"),
     ("--verison", "unknown option --verison; did you mean --version?"), ("doctor --qq", "unknown option --qq\n")],
)  # fmt: skip
def test_a_misspelt_option_is_named_before_those_that_are_missing(
    capsys: pytest.CaptureFixture[str], line: str, names: str
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(line.split())
    assert ended.value.code == 2 and names in capsys.readouterr().err


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
    says = "data: split 'test' has no views; expected at least one to render; --split all renders every view"
    assert_one_line(capsys.readouterr().err, says)
    assert main(["eval", "--pred", f"{place}/maps", "--truth", f"{place}/data/labels"]) == 2
    assert_one_line(capsys.readouterr().err, "maps")
    assert not (place / "maps").exists()


def test_a_mask_of_what_no_gaussian_is_part_of_picks_nothing_and_is_named(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def swell(vertices: np.ndarray) -> np.ndarray:
        for axis in range(3):
            vertices[f"scale_{axis}"] = 20
        return vertices

    edit_scene(place, swell)
    data, out = place / "data", place / "picked"
    mask = ["--view", "view0", "--mask", f"{data}/labels/view0.png", "--label", "1"]
    assert main(["pick", f"{data}/scene.ply", "--data", str(data), *mask, "--out", str(out), "--quiet"]) == 2
    assert_one_line(capsys.readouterr().err, "labels/view0.png: no Gaussian lies more in the object than beside it")
    assert not out.exists()


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
    assert_one_line(capsys.readouterr().err, ": cannot be written (No space left on device); what was there before is")
    assert contents(place / "out") == before


def test_an_error_is_on_a_line_of_its_own_below_the_progress_bar(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mask((24, 64))(place)
    assert main([option for option in segment(place) if option != "--quiet"]) == 2
    stderr = capsys.readouterr().err
    assert "observe" in stderr
    assert re.search(r"^gsseg: error: .*view1\.png", stderr, re.MULTILINE)


@pytest.mark.parametrize("found", ["0", "-2", "abc", ""])
def test_a_number_of_threads_that_numba_cannot_take_is_one_clear_line(
    found: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("NUMBA_NUM_THREADS", found)
    assert main(["doctor"]) == 2
    assert_one_line(capsys.readouterr().err, f"variable NUMBA_NUM_THREADS: is '{found}'; expected a number of threads")
