"""Broken and hostile scene files of every format: one clear error, and no more memory than a file deserves."""

from __future__ import annotations

import errno
import gzip
import pickle
import random
import struct
import tracemalloc
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import scene_files
import torch
from scene_files import some_scene
from test_scene_formats import CASES

from gsseg_core.errors import GssegError, PathNotAllowedError, SceneFileError, SceneValueError
from gsseg_core.scene import spz
from gsseg_core.scene.gaussian_scene import GaussianScene


@contextmanager
def little_memory(most: int = 80 << 20) -> Iterator[None]:
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < most
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("name", [f"{'a' * 300}.ply", "a" * 300])
def test_a_scene_that_the_system_does_not_let_one_look_for_is_refused(tmp_path: Path, name: str) -> None:
    refuse(tmp_path / name, "cannot be read .*File name too long")


def test_a_folder_that_cannot_be_listed_is_refused_as_a_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "iterdir", denied)
    refuse(tmp_path, r"is a folder\); expected a PLY file$")


def denied(path: Path) -> Iterator[Path]:
    raise PermissionError(errno.EACCES, "Permission denied", str(path))


def refuse(path: Path, match: str) -> None:
    with little_memory(), pytest.raises(SceneFileError, match=match) as caught:
        GaussianScene.load(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("name", CASES)
def test_a_truncated_file_is_refused_with_one_clear_error(tmp_path: Path, name: str) -> None:
    case = CASES[name]
    path = tmp_path / case.file
    case.write(path, some_scene(200, 2))
    whole = path.read_bytes()
    # Of the `.splat`, which counts nothing, a whole number of records is whole.
    ends = {1, 3, 7, 15, 31, 33, 100, len(whole) // 4, len(whole) // 2, len(whole) - 65, len(whole) - 1}
    for end in sorted(end for end in ends if case.format != "splat" or end % 32):
        path.write_bytes(whole[:end])
        with pytest.raises(GssegError) as caught:
            GaussianScene.load(path)
        assert str(path) in str(caught.value) and "\n" not in str(caught.value), end


@pytest.mark.parametrize("name", CASES)
def test_bytes_changed_at_random_make_a_scene_or_one_error_and_take_little_memory(tmp_path: Path, name: str) -> None:
    case, rng = CASES[name], random.Random(name)
    path = tmp_path / case.file
    case.write(path, some_scene(100, 1))
    whole = path.read_bytes()
    with little_memory():
        for _ in range(40):
            changed = bytearray(whole)
            for _ in range(rng.choice((1, 1, 2, 5))):
                # Headers are where it hurts.
                place = rng.randrange(rng.choice((64, len(changed))))
                changed[place] = rng.choice((0, 1, 127, 128, 255, rng.randrange(256)))
            path.write_bytes(changed)
            try:
                assert len(GaussianScene.load(path))
            except GssegError as error:
                assert "\n" not in str(error)


def test_an_spz_that_claims_more_than_it_can_hold_is_refused_before_memory_is_taken(tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    for count, match in ((2**26, "data|Gaussians: .* bytes are there"), (2**32 - 1, "claims 4,294,967,295 Gaussians")):
        header = struct.pack("<4sIIBBBB", b"NGSP", 3, count, 3, 12, 0, 0)
        path.write_bytes(gzip.compress(header + bytes(1 << 20)))
        refuse(path, match)
        path.write_bytes(struct.pack("<4sIIBBBBI12x", b"NGSP", 4, count, 0, 12, 0, 5, 32) + bytes(80))
        refuse(path, "claims|has streams of")


@pytest.mark.parametrize("version", [3, 4])
def test_an_spz_that_is_packed_as_no_scene_is_is_refused_before_it_is_inflated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, version: int
) -> None:
    path, scene = tmp_path / "a.spz", some_scene(10, 0)
    if version == 3:
        head = struct.pack("<4sIIBBBB", b"NGSP", 3, 40_000_000, 3, 12, 0, 0)
        path.write_bytes(gzip.compress(head + bytes(20 << 20), 9))
    else:
        body = bytearray(scene_files.spz_4(scene_files.spz_body(scene, 4), scene))
        body[8:12] = struct.pack("<I", 40_000_000)
        for place in range(32, 32 + 16 * body[15], 16):
            size = int.from_bytes(body[place + 8 : place + 16], "little")
            body[place + 8 : place + 16] = struct.pack("<Q", size * 4_000_000)
        path.write_bytes(body)
    monkeypatch.setattr(spz, "_rows", lambda *_: pytest.fail("inflated"))
    refuse(path, r"a\.spz: 40,000,000 Gaussians: [\d,]+ bytes are there; expected at least")


def test_an_spz_that_holds_more_than_it_claims_is_not_inflated(tmp_path: Path) -> None:
    body = scene_files.spz_body(some_scene(10, 0), 3)
    (tmp_path / "a.spz").write_bytes(gzip.compress(body + bytes(200 << 20), 1))
    refuse(tmp_path / "a.spz", r"a\.spz: holds more than 10 Gaussians")


@pytest.mark.parametrize(
    ("place", "value", "match"),
    [
        (4, b"\x05", "is SPZ of version 5; expected 1 to 4"),
        (12, b"\x05", "has SH of degree 5"),
        (14, b"\x02", "has extensions under gzip"),
        (0, b"X", "truncated or not an SPZ file"),
    ],
)
def test_an_spz_of_what_nobody_writes_is_refused(tmp_path: Path, place: int, value: bytes, match: str) -> None:
    body = bytearray(scene_files.spz_body(some_scene(10, 0), 3))
    body[place : place + 1] = value
    (tmp_path / "a.spz").write_bytes(gzip.compress(bytes(body)))
    refuse(tmp_path / "a.spz", match)


def test_without_zstandard_version_4_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene_files.write_spz(4)(tmp_path / "a.spz", some_scene(5, 0))
    monkeypatch.setitem(__import__("sys").modules, "zstandard", None)
    refuse(tmp_path / "a.spz", r"takes the package zstandard: pip install 'gsseg\[formats\]'")


def test_a_zip_with_a_scene_in_it_and_usd_are_refused_with_what_to_give_instead(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "scan.zip", "w") as archive:
        archive.writestr("scan/point_cloud.ply", b"ply\n")
    refuse(tmp_path / "scan.zip", r"is a zip of 'scan/point_cloud\.ply', without SOG's meta\.json: unpack it, and give")
    (tmp_path / "objects.usda").write_text("#usda 1.0\n")
    refuse(tmp_path / "objects.usda", "gsseg writes USD, and does not read it: give the scene that it was made from$")


def changed_sog(path: Path, **members: bytes) -> None:
    """SOG with members replaced; `meta` stands for meta.json, other names for WebP images."""
    scene_files.write_sog_1(path, some_scene(100, 1))
    with zipfile.ZipFile(path) as archive:
        content = {name: archive.read(name) for name in archive.namelist()}
    content |= {"meta.json" if name == "meta" else f"{name}.webp": data for name, data in members.items()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in content.items():
            archive.writestr(name, data)


def test_sog_that_inflates_is_refused_before_it_does(tmp_path: Path) -> None:
    path = tmp_path / "a.sog"
    changed_sog(path, meta=b'{"means":' + b" " * (80 << 20))
    refuse(path, r"claims 83,886,\d+ bytes of 'meta.json'; expected at most")
    changed_sog(path, means_l=scene_files.webp(np.zeros((8000, 8000, 3), np.uint8)))
    refuse(path, r"has 64,000,000 pixels in 'means_l.webp'; expected one for each of 100, or few more")
    changed_sog(path, quats=scene_files.webp(np.zeros((2, 2, 4), np.uint8)))
    refuse(path, r"has 4 pixels in 'quats.webp'")


@pytest.mark.parametrize(
    ("before", "after", "match"),
    [
        (b"means_l.webp", b"../../x.webp", "names the image '../../x.webp'; expected the name of a file beside"),
        (b'"shape": [100', b'"shape": [99999999999', "claims 99,999,999,999 Gaussians"),
        (b'"shape": [100', b'"shape": ["a"', "count is 'a'; expected a whole number"),
        (b'"quats"', b'"quat"', "truncated or not a SOG scene .lacks 'quats'"),
        (b"{", b"[{", "not valid JSON"),
        (b"{", b'{"lodLevels": 2, ', "lists SOG scenes in 2 levels of detail; expected one of them"),
    ],
)
def test_sog_whose_words_do_not_fit_is_refused(tmp_path: Path, before: bytes, after: bytes, match: str) -> None:
    scene_files.unzipped(tmp_path / "meta.json", some_scene(100, 1))
    path = tmp_path / "meta.json"
    path.write_bytes(path.read_bytes().replace(before, after, 1))
    refuse(path, match)


def test_sog_with_numbers_too_large_for_floats_is_refused_without_a_warning(tmp_path: Path) -> None:
    scene_files.unzipped(path := tmp_path / "meta.json", some_scene(100, 1))
    path.write_bytes(path.read_bytes().replace(b'"mins": [', b'"mins": [1e300, 1e300, 1e300], "more": [', 1))
    with pytest.raises(SceneValueError, match=r"meta\.json: 100 of 100 Gaussians have NaN, infinite or too large"):
        GaussianScene.load(path)


def test_an_image_of_sog_that_leads_elsewhere_is_refused(tmp_path: Path) -> None:
    inside = tmp_path / "inside"
    inside.mkdir()
    scene_files.unzipped(inside / "meta.json", some_scene(100, 1))
    (inside / "quats.webp").rename(tmp_path / "quats.webp")
    (inside / "quats.webp").symlink_to(tmp_path / "quats.webp")
    assert len(GaussianScene.load(inside / "meta.json")) == 100
    with pytest.raises(PathNotAllowedError):
        GaussianScene.load(inside / "meta.json", inside)


class _Command:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return exec, ("raise SystemExit('executed')",)


def test_a_checkpoint_is_never_executed(tmp_path: Path) -> None:
    torch.save({"splats": _Command()}, tmp_path / "a.pt")
    refuse(tmp_path / "a.pt", r"a\.pt: holds objects that only executing the file would make; expected tensors alone")
    (tmp_path / "b.pt").write_bytes(pickle.dumps(_Command()))
    refuse(tmp_path / "b.pt", r"b\.pt: truncated or not a checkpoint of gsplat")


def test_a_checkpoint_whose_tensors_lie_nowhere_is_refused(tmp_path: Path) -> None:
    torch.save({"splats": torch.zeros(1)}, tmp_path / "a.pt")
    with zipfile.ZipFile(tmp_path / "a.pt") as before, zipfile.ZipFile(tmp_path / "b.pt", "w") as after:
        for name in before.namelist():
            # In place of a dictionary, what is stored outside under the number 1.
            after.writestr(name, b"\x80\x02K\x01Q." if name.endswith("data.pkl") else before.read(name))
    refuse(tmp_path / "b.pt", r"b\.pt: truncated or not a checkpoint of gsplat")


def test_a_checkpoint_that_becomes_larger_than_its_file_is_refused(tmp_path: Path) -> None:
    splats = scene_files.stored(some_scene(4, 0))
    splats["means"] = torch.zeros(1, 3).expand(10**9, 3)
    torch.save({"splats": splats}, tmp_path / "a.pt")
    refuse(tmp_path / "a.pt", r"means is of shape \(1000000000, 3\), more than the file holds")
    with (
        zipfile.ZipFile(tmp_path / "a.pt") as before,
        zipfile.ZipFile(tmp_path / "b.pt", "w", zipfile.ZIP_DEFLATED) as b,
    ):
        for name in before.namelist():
            b.writestr(name, before.read(name))
    refuse(tmp_path / "b.pt", "is compressed, which torch.save never does")


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"means": torch.zeros(10, 2)}, "has means of a shape that does not fit 10 Gaussians"),
        ({"shN": torch.zeros(10, 4, 3)}, "has opacities or SH of a shape"),
        ({"quats": "text"}, "has no tensor of numbers 'quats'"),
    ],
)
def test_a_checkpoint_of_other_tensors_is_refused(tmp_path: Path, change: dict[str, object], match: str) -> None:
    torch.save({"splats": scene_files.stored(some_scene(10, 0)) | change}, tmp_path / "a.pt")
    refuse(tmp_path / "a.pt", match)
    torch.save({"model": 1}, tmp_path / "b.pt")
    refuse(tmp_path / "b.pt", r"holds 'model'; expected 'splats' \(gsplat\) or 'pipeline' \(splatfacto\)")


@pytest.mark.parametrize(
    ("node", "match"),
    [
        ({"scale": [1, 2, 1]}, "scales its axes by several factors"),
        ({"scale": [0, 0, 0]}, "scales its axes by several factors, or by 0"),
        ({"children": [0]}, "below themselves"),
        ({"matrix": [1, 2]}, "truncated or not a glTF file"),
        ({"mesh": 7}, "truncated or not a glTF file"),
        ({"mesh": None}, "truncated or not a glTF file"),
    ],
)
def test_a_gltf_whose_nodes_are_wrong_is_refused(tmp_path: Path, node: dict[str, object], match: str) -> None:
    (tmp_path / "a.glb").write_bytes(scene_files.glb(*scene_files.glb_parts(some_scene(9, 1), **node)))
    refuse(tmp_path / "a.glb", match)


@pytest.mark.parametrize(
    ("part", "change", "match"),
    [
        ("accessors", {"count": 10**9}, "claims 1,000,000,000 Gaussians"),
        ("accessors", {"count": 10**6}, "view: .* bytes are there"),
        ("accessors", {"count": -1}, "claims -1 Gaussians"),
        ("accessors", {"byteOffset": -8}, "has an accessor at -8"),
        ("accessors", {"sparse": {}}, "or a sparse one"),
        ("bufferViews", {"byteLength": 10**9}, "buffer: .* bytes are there"),
        ("bufferViews", {"byteOffset": -4}, "has a view of"),
        ("buffers", {"uri": "../secret.bin"}, "names the buffer '../secret.bin'"),
        ("buffers", {"uri": "gone.bin"}, "gone.bin: cannot be read"),
        ("buffers", {"uri": "data:;base64,AAAA"}, "buffer: 3 bytes are there"),
    ],
)
def test_a_gltf_that_claims_what_is_not_there_is_refused(
    tmp_path: Path, part: str, change: dict[str, object], match: str
) -> None:
    document, buffer = scene_files.glb_parts(some_scene(9, 1))
    document[part][0].update(change)  # type: ignore[index]
    path = tmp_path / "a.glb"
    path.write_bytes(scene_files.glb(document, buffer))
    with little_memory(), pytest.raises(SceneFileError, match=match):
        GaussianScene.load(path)


def test_a_gltf_without_splats_or_with_needs_of_its_own_is_refused(tmp_path: Path) -> None:
    document, buffer = scene_files.glb_parts(some_scene(9, 1))
    document["extensionsRequired"] = ["EXT_meshopt_compression", "KHR_gaussian_splatting"]
    (tmp_path / "a.glb").write_bytes(scene_files.glb(document, buffer))
    refuse(tmp_path / "a.glb", "needs the extension EXT_meshopt_compression; gsseg reads")
    document["extensionsRequired"], document["scenes"] = [], [{"nodes": []}]
    (tmp_path / "a.glb").write_bytes(scene_files.glb(document, buffer))
    refuse(tmp_path / "a.glb", "has no splats in its scene")


@pytest.mark.parametrize(
    ("place", "value", "match"),
    [
        (1, b"\x02", r"is ksplat of version 0\.2, level 1; expected 0\.1"),
        (20, b"\x03", "level 3; expected 0.1, level 0 to 2"),
        (4, b"\xff\xff\xff\xff", "4,294,967,295 headers of sections: .* bytes are there"),
        (16, b"\x01", "claims 1 Gaussians and has 100"),
        (4096, b"\xff", "has a section of 255 in 100"),
        (4096 + 12, b"\xff\xff\xff\x7f", "section of 100 Gaussians: .* bytes are there"),
        (4096 + 32, b"\x07", "has 7 full buckets"),
        (4096 + 20, b"\x0b", "has 1 full buckets|bytes are there"),
    ],
)
def test_a_ksplat_whose_counts_do_not_fit_is_refused(tmp_path: Path, place: int, value: bytes, match: str) -> None:
    scene_files.write_ksplat(1)(tmp_path / "a.ksplat", some_scene(100, 1))
    content = bytearray((tmp_path / "a.ksplat").read_bytes())
    content[place : place + len(value)] = value
    (tmp_path / "a.ksplat").write_bytes(content)
    refuse(tmp_path / "a.ksplat", match)


@pytest.mark.parametrize(
    ("before", "after", "match"),
    [
        (b"element chunk 1", b"element chunk 0", "has 0 chunks for 100 vertices; expected 1"),
        (b"property uint packed_scale", b"property uint packed_skale", "lacks elements or properties"),
        (b"property float min_x", b"property float mix_x", "not a compressed PLY"),
        (b"property uchar f_rest_0\n", b"property char f_rest_0\n", "not a compressed PLY"),
        (b"property uchar f_rest_3\n", b"property uchar f_west_3\n", "not a compressed PLY"),
    ],
)
def test_a_compressed_ply_whose_elements_do_not_fit_is_refused(
    tmp_path: Path, before: bytes, after: bytes, match: str
) -> None:
    path = tmp_path / "a.compressed.ply"
    scene_files.write_compressed_ply(path, some_scene(100, 1))
    assert before in path.read_bytes()
    path.write_bytes(path.read_bytes().replace(before, after, 1))
    refuse(path, match)


def test_a_splat_of_no_whole_number_of_gaussians_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.splat").write_bytes(bytes(33))
    refuse(tmp_path / "a.splat", r"a\.splat: has 33 bytes; expected 32 for each Gaussian")
