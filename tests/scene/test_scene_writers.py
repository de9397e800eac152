"""Scenes in other formats: what is written, another program reads."""

from __future__ import annotations

import json
import struct
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from other_readers import ABOUT_X, Read, by_gaussforge, by_gsply, by_pygltflib, by_splat_transform, by_usd
from scene_files import gsply_alone

from gsseg_core.errors import PathTakenError, SceneValueError, SettingsError
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.quaternions import rotations
from gsseg_core.scene.scene_writers import SCENE_WRITERS, check_format, format_of, write_scene
from gsseg_core.scene.writers.axes import HALF_TURN_X, HALF_TURN_Z, turned

EXTENT = 6.0


def some_scene(count: int = 700, degree: int = 3, seed: int = 0) -> GaussianScene:
    """Gaussians in a cube, of sizes, opacities and colours that trained ones have."""
    rng = np.random.default_rng(seed)
    sh = rng.uniform(-0.4, 0.4, (count, (degree + 1) ** 2, 3))
    sh[:, 0] = rng.uniform(-1.7, 1.7, (count, 3))
    scales, opacities = np.exp(rng.uniform(-6, -1, (count, 3))), rng.uniform(0.02, 0.98, count)
    means = rng.uniform(-EXTENT / 2, EXTENT / 2, (count, 3))
    return GaussianScene.from_arrays(means, rng.normal(size=(count, 4)), scales, opacities, sh)


class Kept(NamedTuple):
    """How far values may be off: positions, logarithms of scales, opacities, 1 - cosines of axes, colours.

    Positions are in scene units; `degree` is the largest SH degree that is kept. All keep the order.
    """

    position: float
    log_scale: float
    opacity: float
    rotation: float
    dc: float
    rest: float = 0.0
    degree: int = 3


EXACT = Kept(0, 1e-6, 1e-6, 1e-6, 1e-6, 1e-6)
KEPT = {
    "ply": EXACT,
    "compressed-ply": Kept(EXTENT / 2**10, 5 / 2**10, 1 / 254, 4e-4, 0.02, 1 / 63),
    "spz": Kept(EXTENT / 2**22, 1 / 31, 1 / 254, 4e-4, 0.0135, 1 / 250),
    "sog": Kept(EXTENT / 2**14, 0.03, 1 / 254, 4e-4, 0.02, 0.005),
    "splat": Kept(0, 1e-6, 1 / 254, 8e-3, 0.007, degree=0),
    "glb": EXACT,
    "usd": EXACT,
}
"""What each format keeps; docs/formats.md says the same in words."""


def spz_by_gaussforge(path: Path) -> Read:
    return by_gaussforge(path).turned(ABOUT_X)


def by_gsseg(path: Path) -> Read:
    return Read.of(GaussianScene.load(path))


READERS: list[tuple[str, Callable[[Path], Read]]] = [
    ("ply", by_gsply),
    ("compressed-ply", by_gaussforge),
    ("spz", spz_by_gaussforge),
    ("sog", by_gaussforge),
    ("splat", by_gaussforge),
    ("glb", by_pygltflib),
    ("usd", by_usd),
    *((name, by_gsseg) for name in SCENE_WRITERS if name != "usd"),
]


def assert_kept(found: Read, scene: GaussianScene, kept: Kept) -> None:
    expected = Read.of(scene)
    assert len(found.means) == len(scene)
    terms = (min(round(scene.sh.shape[1] ** 0.5) - 1, kept.degree) + 1) ** 2
    assert found.sh.shape == (len(scene), terms, 3)
    assert np.abs(found.means - expected.means).max() <= kept.position
    assert np.abs(np.log(found.scales / expected.scales)).max() <= kept.log_scale
    assert np.abs(found.opacities - expected.opacities).max() <= kept.opacity
    # The axes of an ellipsoid may point either way.
    cosines = np.einsum("nji,nji->ni", *(rotations(r.quats.astype(np.float64)) for r in (found, expected)))
    assert 1 - np.abs(cosines).min() <= kept.rotation
    assert np.abs(found.sh[:, 0] - expected.sh[:, 0]).max() <= kept.dc
    if terms > 1:
        assert np.abs(found.sh[:, 1:] - expected.sh[:, 1:terms]).max() <= kept.rest


def written(folder: Path, name: str, scene: GaussianScene, run: str | None = None) -> Path:
    path = folder / f"some{SCENE_WRITERS[name].suffixes[0]}"
    with gsply_alone() if name == "compressed-ply" else nullcontext():
        write_scene(scene, path, run=run)
    assert [file.name for file in folder.iterdir()] == [path.name]
    return path


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize(("name", "read"), READERS, ids=lambda case: getattr(case, "__name__", case))
def test_what_is_written_another_program_reads(
    tmp_path: Path, name: str, read: Callable[[Path], Read], degree: int
) -> None:
    scene = some_scene(40, degree) if degree < 3 else some_scene()
    assert_kept(read(written(tmp_path, name, scene)), scene, KEPT[name])


@pytest.mark.processes
@pytest.mark.parametrize("name", ["ply", "compressed-ply", "spz", "sog", "splat"])
def test_what_is_written_the_converter_of_playcanvas_reads(tmp_path: Path, name: str) -> None:
    scene = some_scene()
    assert_kept(by_splat_transform(written(tmp_path, name, scene)), scene, KEPT[name])


@pytest.mark.parametrize("name", SCENE_WRITERS)
@pytest.mark.parametrize("count", [1, 257])
def test_a_scene_of_any_size_is_written_without_a_word(
    tmp_path: Path, name: str, count: int, capfd: pytest.CaptureFixture[str]
) -> None:
    assert written(tmp_path, name, some_scene(count, 1)).stat().st_size > 0
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", ["compressed-ply", "spz", "sog", "splat"])
def test_no_opacity_becomes_infinite_as_a_logit(tmp_path: Path, name: str) -> None:
    scene = some_scene(300, 0)
    opacities = np.resize([0.0, 1.0, 1e-4, 1 - 1e-4], len(scene))
    scene = GaussianScene.from_arrays(scene.means, scene.quats, scene.scales, opacities, scene.sh)
    found = by_gaussforge(written(tmp_path, name, scene)).opacities
    assert (found > 0).all() and (found < 1).all() and np.abs(found - opacities).max() < 1 / 200


def test_what_lies_beyond_the_ranges_of_spz_is_clipped_to_them(tmp_path: Path) -> None:
    scene = some_scene(2)
    sh = np.tile(np.array([[[9.0]], [[-9.0]]]), (1, 16, 3))
    beyond = GaussianScene.from_arrays(scene.means, scene.quats, [[1e4] * 3, [1e-8] * 3], scene.opacities, sh)
    found = GaussianScene.load(written(tmp_path, "spz", beyond))
    np.testing.assert_allclose(np.log(found.scales), [[255 / 16 - 10] * 3, [-10] * 3], rtol=1e-6)
    np.testing.assert_allclose(found.sh[:, 0], [[10 / 3] * 3, [-10 / 3] * 3], rtol=1e-6)
    assert np.abs(found.sh[:, 1:]).max() <= 1


def test_positions_as_far_away_as_spz_goes_are_kept_and_farther_ones_refused(tmp_path: Path) -> None:
    scene = some_scene(100, 0)

    def moved(by: float) -> GaussianScene:
        return GaussianScene.from_arrays(
            scene.means + np.array([0, by, 0]), scene.quats, scene.scales, scene.opacities, scene.sh
        )

    far = moved(3e6)
    found = spz_by_gaussforge(written(tmp_path, "spz", far))
    assert np.abs(found.means - far.means).max() <= 0.5
    with pytest.raises(SceneValueError, match=r"far\.spz: positions reach 5e\+06; expected at most 4,194,303"):
        write_scene(moved(5e6), tmp_path / "far.spz")
    assert not (tmp_path / "far.spz").exists()


@given(st.sampled_from([HALF_TURN_X, HALF_TURN_Z]), st.integers(0, 3), st.integers(0, 99))
def test_half_a_turn_turns_shapes_and_colours_and_two_undo_each_other(
    signs: tuple[int, int, int], degree: int, seed: int
) -> None:
    scene = some_scene(5, degree, seed)
    means, quats, sh = turned(scene, signs)
    expected = Read.of(scene).turned(np.diag(np.array(signs, float)))
    np.testing.assert_allclose(means, expected.means)
    np.testing.assert_allclose(sh, expected.sh, atol=1e-5)
    again, _, sh_again = turned(GaussianScene.from_arrays(means, quats, scene.scales, scene.opacities, sh), signs)
    np.testing.assert_array_equal(again, scene.means)
    np.testing.assert_array_equal(np.abs(sh_again), np.abs(scene.sh))


def test_a_glb_is_as_its_specification_says(tmp_path: Path) -> None:
    data = written(tmp_path, "glb", some_scene(9, 1), run="a run").read_bytes()
    magic, version, length, json_length, kind = struct.unpack("<4sII I4s", data[:20])
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON") and json_length % 4 == 0
    content = json.loads(data[20 : 20 + json_length])
    assert content["asset"]["extras"] == {"gsseg_run": "a run"}
    primitive = content["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 0 and content["extensionsUsed"] == ["KHR_gaussian_splatting"]
    assert primitive["extensions"]["KHR_gaussian_splatting"]["colorSpace"] == "srgb_rec709_display"
    for accessor in content["accessors"]:
        view = content["bufferViews"][accessor["bufferView"]]
        assert accessor["count"] == 9 and view["byteOffset"] % 4 == view["byteLength"] % 4 == 0
    assert content["buffers"][0]["byteLength"] == length - 28 - json_length


def test_the_format_of_a_file_is_what_its_suffix_says() -> None:
    asked = {"a.ply": "ply", "a.COMPRESSED.ply": "compressed-ply", "a.usda": "usd", "a.glb": "glb", "a": "ply"}
    assert {name: format_of(name) for name in asked} == asked
    assert format_of("a.dat", "spz") == "spz"
    for asked_for in (None, "ply"):
        with pytest.raises(SettingsError, match=r"a\.ksplat: has the suffix of ksplat, which gsseg reads and does not"):
            format_of("a.ksplat", asked_for)
        with pytest.raises(SettingsError, match=r"a\.USDZ: has the suffix of a format of others; expected \.ply, "):
            format_of("a.USDZ", asked_for)
    with pytest.raises(SettingsError, match=r"a\.spz: has the suffix of the format spz, but glb is asked for"):
        format_of("a.spz", "glb")
    with pytest.raises(SettingsError, match="suffix of the format compressed-ply, but ply"):
        format_of("a.compressed.ply", "ply")
    with pytest.raises(SettingsError, match="format is 'obj'; expected one of ply, compressed-ply, spz, sog"):
        format_of("a.ply", "obj")


def test_a_format_that_is_not_there_is_refused_by_one_message(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SettingsError, match="format is 'obj'; expected one of ply, compressed-ply, spz, sog"):
        check_format("obj")
    for name, module, extra in (("spz", "gsply", "formats"), ("usd", "pxr", "usd")):
        with monkeypatch.context() as missing:
            missing.setitem(sys.modules, module, None)
            missing.delitem(sys.modules, SCENE_WRITERS[name].write.split(":")[0], raising=False)
            with pytest.raises(SettingsError, match=rf"format {name}: needs {module}.*pip install 'gsseg\[{extra}\]'"):
                check_format(name)


@pytest.mark.parametrize("name", SCENE_WRITERS)
def test_a_write_that_fails_leaves_the_earlier_file_whole(tmp_path: Path, name: str) -> None:
    folder = tmp_path / f"taken{SCENE_WRITERS[name].suffixes[0]}"
    folder.mkdir()
    with pytest.raises(PathTakenError, match="it is a folder"):
        write_scene(some_scene(5, 0), folder)
    assert list(tmp_path.rglob("*")) == [folder]


FULL_DISK = """
import resource, signal, sys
from gsseg_core import GaussianScene, GssegError, write_scene
from gsseg_core.scene.quaternions import rotations
from gsseg_core.scene.scene_writers import SCENE_WRITERS, check_format

scene = GaussianScene.load(sys.argv[1])
for name in SCENE_WRITERS:
    check_format(name)  # Compiled kernels are files, too.
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (4000, 4000))
for name, writer in SCENE_WRITERS.items():
    try:
        write_scene(scene, f"{sys.argv[2]}/some{writer.suffixes[0]}")
    except GssegError as error:
        print(name, type(error).__name__, "cannot be written (" in str(error))
"""


def test_a_full_disk_is_one_error_and_the_earlier_file_stays_whole(tmp_path: Path) -> None:
    some_scene().save(tmp_path / "scene.ply")
    (tmp_path / "out").mkdir()
    before = {tmp_path / "out" / f"some{writer.suffixes[0]}" for writer in SCENE_WRITERS.values()}
    for path in before:
        path.write_text("as it was")
    command = [sys.executable, "-c", FULL_DISK, str(tmp_path / "scene.ply"), str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == [f"{name} WriteError True" for name in SCENE_WRITERS]
    assert set((tmp_path / "out").iterdir()) == before
    assert all(path.read_text() == "as it was" for path in before)


@pytest.mark.parametrize("name", SCENE_WRITERS)
def test_a_machine_whose_clock_begins_in_1970_writes_every_format(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    then = time.gmtime(100)
    monkeypatch.setattr(time, "localtime", lambda *_: then)
    path = tmp_path / f"scene{SCENE_WRITERS[name].suffixes[0]}"
    write_scene(some_scene(30), path)
    assert path.stat().st_size > 0


def test_a_palette_of_harmonics_stands_for_more_gaussians_than_it_has_entries(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from gsseg_core.scene.writers import sog

    # Sixteen looks, each with a little noise: a palette a tenth as large as the scene has room for all.
    rng, scene = np.random.default_rng(0), some_scene(3000)
    looks = rng.uniform(-0.4, 0.4, (16, 15, 3))
    rest = looks[rng.integers(0, 16, len(scene))] + rng.normal(0, 0.003, (len(scene), 15, 3))
    sh = np.concatenate([scene.sh[:, :1], rest], axis=1)
    scene = GaussianScene.from_arrays(scene.means, scene.quats, scene.scales, scene.opacities, sh)
    monkeypatch.setattr(sog, "LARGEST_PALETTE", 300)
    monkeypatch.setattr(sog, "_COARSE", 8)
    found = by_gaussforge(written(tmp_path, "sog", scene))
    assert np.sqrt(((found.sh[:, 1:] - scene.sh[:, 1:]) ** 2).mean()) < 0.01


def test_harmonics_that_many_gaussians_share_take_one_entry_of_the_palette(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from gsseg_core.scene.writers import sog

    # As after a conversion: no view-dependent colour, or one of three.
    rng, scene = np.random.default_rng(0), some_scene(3000)
    looks = np.concatenate([np.zeros((1, 15, 3)), rng.uniform(-0.4, 0.4, (3, 15, 3))])
    sh = np.concatenate([scene.sh[:, :1], looks[rng.integers(0, 4, len(scene))]], axis=1)
    scene = GaussianScene.from_arrays(scene.means, scene.quats, scene.scales, scene.opacities, sh)
    monkeypatch.setattr(sog, "LARGEST_PALETTE", 300)
    monkeypatch.setattr(sog, "_COARSE", 8)
    path = written(tmp_path, "sog", scene)
    with zipfile.ZipFile(path) as archive:
        assert json.loads(archive.read("meta.json"))["shN"]["count"] == 4
    np.testing.assert_allclose(by_gaussforge(path).sh[:, 1:], scene.sh[:, 1:], atol=KEPT["sog"].rest)


def test_code_books_of_a_sog_are_made_for_all_axes_and_colours_of_a_large_scene(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from gsseg_core.scene.writers import sog

    # Flat Gaussians: the scales of one axis say nothing of the others. A third of all numbers make the code books.
    rng, scene = np.random.default_rng(0), some_scene(3000, 0)
    scales = np.exp(rng.normal((0, -5, 3), 0.1, (3000, 3)))
    scene = GaussianScene.from_arrays(scene.means, scene.quats, scales, scene.opacities, scene.sh)
    monkeypatch.setattr(sog, "_SAMPLE", 3000)
    found = by_gaussforge(written(tmp_path, "sog", scene))
    off = np.abs(np.log(found.scales / scene.scales)).mean(axis=0)
    assert off.max() < 2 * off.min()


def test_a_scene_that_no_glb_can_hold_is_refused_and_the_earlier_file_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from gsseg_core.scene.writers import glb

    monkeypatch.setattr(glb, "_LARGEST", 10_000)  # bytes, in place of 2^32
    write_scene(some_scene(10, 3), tmp_path / "a.glb")
    before = (tmp_path / "a.glb").read_bytes()
    assert len(before) < 10_000
    message = r"a\.glb: 100 Gaussians of SH degree 3 take 2\d,\d+ bytes; expected at most 10,000, which is as large"
    with pytest.raises(SceneValueError, match=message):
        write_scene(some_scene(100, 3), tmp_path / "a.glb")
    assert (tmp_path / "a.glb").read_bytes() == before


KILLED = """
import os, signal, sys
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.scene_writers import SCENE_WRITERS, write_scene, writer_of

scene = GaussianScene.load("scene.ply")
for name, writer in SCENE_WRITERS.items():
    writer_of(name)
    for path in ("new" + writer.suffixes[0], "old" + writer.suffixes[0]):
        if path.startswith("old"):
            open(path, "w").write("as it was")
        if not (child := os.fork()):
            os.fsync = lambda file: os.kill(os.getpid(), signal.SIGKILL)
            write_scene(scene, path, name)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL, path
        assert not path.startswith("new") or not os.path.exists(path), path
        assert not path.startswith("old") or open(path).read() == "as it was", path
assert [name for name in os.listdir() if name.startswith(".gsseg-")]
write_scene(scene, "last.ply")
assert not [name for name in os.listdir() if name.startswith(".gsseg-")], os.listdir()
"""


def test_a_conversion_that_is_killed_leaves_nothing_half_written(tmp_path: Path) -> None:
    some_scene(20, 1).save(tmp_path / "scene.ply")
    done = subprocess.run([sys.executable, "-c", KILLED], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
