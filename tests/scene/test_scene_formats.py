"""Scenes of every format: read in the order of the file, in the place and with the look that they have as a PLY."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import plyfile
import pytest
import scene_files
import torch
from hypothesis import given
from hypothesis import strategies as st
from scene_files import by_library, half_turned, some_scene, write_ksplat, write_spz
from test_ply import write_ply

from gsseg_core.errors import EmptySceneError, ScenePropertyError, SceneValueError
from gsseg_core.scene import spherical_harmonics
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.moving import move
from gsseg_core.scene.quaternions import covariances
from gsseg_core.scene.scene_formats import SCENE_FORMATS, find_format, read_scene
from gsseg_core.scene.scene_writers import write_scene
from gsseg_core.scene.vertices import log_scales, logits, pack_vertices

Write = Callable[[Path, GaussianScene], None]


class Case(NamedTuple):
    """How a file is written, and how far off values may be: positions, covariances (relative), colours, opacities."""

    file: str
    write: Write
    format: str
    version: str = ""
    place: float = 1e-6
    covariance: float = 1e-4
    color: float = 1e-4
    opacity: float = 1e-5
    degree: int = 3


BYTE = 1 / 255
CASES = {
    "compressed PLY by gsply": Case(
        "a.compressed.ply", scene_files.write_compressed_ply, "PlayCanvas compressed PLY", "", 0.005, 0.1, 0.1, BYTE
    ),
    "SPZ 1": Case("a.spz", write_spz(1), "SPZ", "1", 0.002, 0.5, 0.04, BYTE),
    "SPZ 2": Case("a.spz", write_spz(2), "SPZ", "2", 2e-4, 0.5, 0.04, BYTE),
    "SPZ 3": Case("a.spz", write_spz(3), "SPZ", "3", 2e-4, 0.1, 0.04, BYTE),
    "SPZ 4": Case("a.spz", write_spz(4), "SPZ", "4", 2e-4, 0.1, 0.04, BYTE),
    "SOG 1": Case("a.sog", scene_files.write_sog_1, "SOG", "1", 2e-4, 0.2, 0.04, 0.01),
    "SOG 1, unbundled": Case("meta.json", scene_files.unzipped, "SOG", "1", 2e-4, 0.2, 0.04, 0.01),
    "splat by gaussforge": Case(
        "a.splat", by_library("splat"), "splat", "", 1e-6, 0.1, 0.01, BYTE, degree=0
    ),
    "ksplat 0": Case("a.ksplat", write_ksplat(0), "ksplat", "0.1, level 0", 1e-6, 1e-4, 0.01, BYTE, degree=2),
    "ksplat 1": Case("a.ksplat", write_ksplat(1), "ksplat", "0.1, level 1", 2e-4, 0.01, 0.01, BYTE, degree=2),
    "ksplat 2": Case("a.ksplat", write_ksplat(2), "ksplat", "0.1, level 2", 2e-4, 0.01, 0.04, BYTE, degree=2),
    "GLB": Case("a.glb", scene_files.write_glb, "glTF with KHR_gaussian_splatting", "2.0"),
    "glTF": Case("a.gltf", scene_files.write_gltf, "glTF with KHR_gaussian_splatting", "2.0"),
    "gsplat": Case("a.pt", scene_files.write_gsplat, "gsplat or nerfstudio checkpoint", "gsplat"),
    "splatfacto": Case("a.ckpt", scene_files.write_splatfacto, "gsplat or nerfstudio checkpoint", "splatfacto"),
}  # fmt: skip


def check_same(found: GaussianScene, expected: GaussianScene, case: Case) -> None:
    """Gaussian i of one is Gaussian i of the other: where it is, how it lies, and how it looks from two sides."""
    assert len(found) == len(expected)
    np.testing.assert_allclose(found.means, expected.means, atol=case.place)
    np.testing.assert_allclose(found.opacities, expected.opacities, atol=case.opacity)
    true = covariances(expected.quats.astype(float), expected.scales)
    off = np.linalg.norm(covariances(found.quats.astype(float), found.scales) - true, axis=(1, 2))
    assert (off <= case.covariance * np.linalg.norm(true, axis=(1, 2))).all()
    for center in ([5.0, -3, 1], [-2.0, 1, -6]):
        np.testing.assert_allclose(found.colors(center), expected.colors(center), atol=case.color)


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_label_i_belongs_to_record_i_and_it_lies_and_looks_as_in_the_ply(
    tmp_path: Path, name: str, degree: int
) -> None:
    case, scene = CASES[name], some_scene(degree=degree)
    case.write(tmp_path / case.file, scene)
    found = GaussianScene.load(tmp_path / case.file)
    if (name, degree) == ("splatfacto", 0):
        case = case._replace(color=1)  # Without SH it learns something else, as another test says.
    assert found.sh_degree == min(degree, case.degree)
    check_same(found, without_bands(scene, case.degree), case)


def without_bands(scene: GaussianScene, degree: int) -> GaussianScene:
    sh = scene.sh[:, : (degree + 1) ** 2]
    return GaussianScene.from_arrays(scene.means, scene.quats, scene.scales, scene.opacities, sh)


@pytest.mark.parametrize("name", CASES)
def test_the_format_is_told_by_its_content_or_its_suffix_and_names_its_version(tmp_path: Path, name: str) -> None:
    case = CASES[name]
    path = tmp_path / case.file
    case.write(path, some_scene(70, 1))
    known = find_format(path)
    assert known is not None and known.name == case.format and known.keeps
    assert known.read(path, None).version == case.version
    if known.marks or known.name == "3DGS PLY":
        for wrong in ("scene.ksplat", "scene.splat", "scene.pt"):
            path = path.rename(path.with_name(wrong))
            assert find_format(path) is known and len(read_scene(path).vertices) == 70


@pytest.mark.parametrize(
    ("kind", "options"), [("spz", {"spz_version": 2}), ("spz", {"spz_version": 3}), ("spz", {"spz_version": 4})]
)
def test_spz_of_another_implementation_is_read_record_by_record(
    tmp_path: Path, kind: str, options: dict[str, int]
) -> None:
    scene = some_scene()
    by_library(kind, **options)(tmp_path / "a.spz", scene)  # It stores the axes that it is given: those of no SPZ.
    found = GaussianScene.load(tmp_path / "a.spz")
    turned = GaussianScene.from_arrays(**half_turned(scene, scene_files.FLIP_SPZ))
    check_same(found, turned, CASES["SPZ 2"]._replace(color=0.15))


def test_a_sog_in_coordinates_of_a_map_is_read_as_exactly_as_float32_allows(tmp_path: Path) -> None:
    near = some_scene(200, 0)
    means = near.means + np.array([4.5e5, 4e6, 0])
    scene = GaussianScene.from_arrays(means, near.quats, near.scales, near.opacities, near.sh)
    write_scene(scene, tmp_path / "a.sog")
    assert (np.abs(GaussianScene.load(tmp_path / "a.sog").means - scene.means) <= (0.03125, 0.25, 1e-3)).all()


def test_sog_of_another_implementation_is_read_in_the_order_of_its_images(tmp_path: Path) -> None:
    scene = some_scene(400, 1)
    by_library("sog")(tmp_path / "a.sog", scene)
    found = GaussianScene.load(tmp_path / "a.sog")
    import gaussforge

    read = gaussforge.GaussForge().convert((tmp_path / "a.sog").read_bytes(), "sog", "ply")["data"]
    (tmp_path / "read.ply").write_bytes(read)
    theirs = GaussianScene.load(tmp_path / "read.ply")
    assert not np.allclose(found.means, scene.means, atol=0.1)  # Its writer sorts.
    np.testing.assert_allclose(found.means, theirs.means, atol=1e-4)
    np.testing.assert_allclose(found.sh, theirs.sh, atol=1e-4)


@given(
    turn=st.sampled_from([np.diag(s).astype(float) for s in np.ndindex(2, 2, 2) for s in [2 * np.array(s) - 1]]),
    seed=st.integers(0, 99),
    turned=st.booleans(),
)
def test_what_is_moved_is_seen_from_the_moved_place_as_before(turn: np.ndarray, seed: int, turned: bool) -> None:
    scene, rng = some_scene(20, 3, seed), np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0] if turned else turn
    scale, shift = float(rng.uniform(0.2, 5)), rng.normal(size=3)
    vertices = scene.vertices.copy()
    move(vertices, turn, scale, shift)
    moved = GaussianScene.from_vertices(vertices, None)
    np.testing.assert_allclose(moved.means, scale * scene.means @ turn.T + shift, atol=1e-4)
    there = turn @ covariances(scene.quats.astype(float), scene.scales) @ turn.T * scale**2
    np.testing.assert_allclose(covariances(moved.quats.astype(float), moved.scales), there, atol=1e-4 * scale**2)
    eye = rng.normal(size=3) * 6
    np.testing.assert_allclose(moved.colors(scale * turn @ eye + shift), scene.colors(eye), atol=1e-4)


def test_axes_that_only_change_their_sign_leave_harmonics_exact() -> None:
    for signs in np.ndindex(2, 2, 2):
        matrix = spherical_harmonics.turned(np.diag(2.0 * np.array(signs) - 1), 3)
        assert set(np.abs(matrix).ravel()) == {0, 1} and (matrix == np.diag(np.diag(matrix))).all()


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("degrees", [(1, 2), (2, 0, 1), (0, 0), (1, 1)])
def test_sections_of_a_ksplat_with_fewer_harmonics_keep_those_that_they_have(
    tmp_path: Path, level: int, degrees: tuple[int, ...]
) -> None:
    scenes = [some_scene(70, degree, seed=degree) for degree in degrees]
    scene_files.write_ksplat_sections(tmp_path / "a.ksplat", level, scenes)
    found = GaussianScene.load(tmp_path / "a.ksplat")
    assert found.sh_degree == max(degrees) and len(found) == 70 * len(degrees)
    for i, scene in enumerate(scenes):
        part = found.subset(np.arange(70 * i, 70 * (i + 1)))
        check_same(part, scene, CASES[f"ksplat {level}"])
        assert not part.sh[:, (scene.sh_degree + 1) ** 2 :].any()


def test_spz_says_its_axes_in_an_extension(tmp_path: Path) -> None:
    scene = some_scene(50, 2)
    body = bytearray(scene_files.spz_body(scene, 3, turned=False))
    other = struct.pack("<II4x", 0x12340001, 4)
    rdf = struct.pack("<III", 0xADBE0003, 4, 6)
    (tmp_path / "a.spz").write_bytes(scene_files.spz_4(bytes(body), scene, other + rdf))
    check_same(GaussianScene.load(tmp_path / "a.spz"), scene, CASES["SPZ 4"])
    assert read_scene(tmp_path / "a.spz").remarks == ("axes RDF, as the file says",)


def test_nodes_of_a_gltf_move_their_splats_and_follow_each_other(tmp_path: Path) -> None:
    scene = some_scene(40, 1)
    document, buffer = scene_files.glb_parts(scene, translation=[1, 2, 3], scale=[2, 2, 2], children=[1])
    document["nodes"].append({"mesh": 0, "rotation": [0, 0, np.sqrt(0.5), np.sqrt(0.5)]})  # type: ignore[attr-defined]
    (tmp_path / "a.glb").write_bytes(scene_files.glb(document, buffer))
    found = GaussianScene.load(tmp_path / "a.glb")
    moved = 2 * scene.means + np.array([-1, -2, 3])
    np.testing.assert_allclose(found.means[:40], moved, atol=1e-5)
    quarter = scene.means @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    np.testing.assert_allclose(found.means[40:], 2 * quarter + np.array([-1, -2, 3]), atol=1e-5)
    np.testing.assert_allclose(found.scales, np.tile(2 * scene.scales, (2, 1)), rtol=1e-5)


def mip_vertices(scene: GaussianScene, size: np.ndarray) -> np.ndarray:
    vertices = np.empty(len(scene), [*scene.vertices.dtype.descr, ("filter_3D", "<f4")])
    for name in scene.vertices.dtype.names or ():
        vertices[name] = scene.vertices[name]
    vertices["filter_3D"] = size
    return vertices


@given(seed=st.integers(0, 2**32 - 1))
def test_the_filter_of_mip_splatting_is_fused_as_its_paper_does(
    tmp_path_factory: pytest.TempPathFactory, seed: int
) -> None:
    folder, scene = tmp_path_factory.mktemp("mip"), some_scene(30, 1, seed)
    size = np.random.default_rng(seed).uniform(0, 0.2, 30).astype(np.float32)
    size[0] = 0
    fused = GaussianScene.load(write_ply(folder / "a.ply", mip_vertices(scene, size)))
    squares, grown = scene.scales.astype(float) ** 2, scene.scales.astype(float) ** 2 + size.astype(float)[:, None] ** 2
    np.testing.assert_allclose(fused.scales, np.sqrt(grown), rtol=1e-5)
    ratio = np.sqrt(squares.prod(axis=1) / grown.prod(axis=1))
    np.testing.assert_allclose(fused.opacities, np.maximum(scene.opacities * ratio, 1 / (1 + np.e**16)), rtol=1e-4)
    np.testing.assert_array_equal(fused.sh, scene.sh)
    fused.save(folder / "b.ply")
    assert GaussianScene.load(folder / "b.ply").digest == fused.digest  # Nobody fuses it twice.


def test_a_filter_that_is_no_size_is_refused(tmp_path: Path) -> None:
    path = write_ply(tmp_path / "a.ply", mip_vertices(some_scene(5), np.full(5, np.nan)))
    with pytest.raises(SceneValueError, match=r"a\.ply: filter_3D holds values that are NaN or negative"):
        GaussianScene.load(path)


def test_discs_of_2dgs_become_flat_gaussians_along_their_normal(tmp_path: Path) -> None:
    scene = some_scene(20, 2)
    kept = [name for name in scene.vertices.dtype.names or () if name != "scale_2"]
    vertices = np.empty(20, [(name, "f4") for name in kept])
    for name in kept:
        vertices[name] = scene.vertices[name]
    found = GaussianScene.load(write_ply(tmp_path / "a.ply", vertices))
    np.testing.assert_array_equal(found.scales[:, :2], scene.scales[:, :2])
    np.testing.assert_allclose(found.scales[:, 2], scene.scales[:, :2].min(axis=1) / 1000, rtol=1e-5)
    np.testing.assert_array_equal(found.quats, scene.quats)


def test_colours_as_bytes_stand_for_harmonics_as_nerfstudio_exports_them(tmp_path: Path) -> None:
    scene = some_scene(20, 0)
    kept = [name for name in scene.vertices.dtype.names or () if not name.startswith("f_dc")]
    vertices = np.zeros(20, [*((name, "f4") for name in kept), *((c, "u1") for c in ("red", "green", "blue"))])
    for name in kept:
        vertices[name] = scene.vertices[name]
    for i, name in enumerate(("red", "green", "blue")):
        vertices[name] = np.round(scene.colors()[:, i] * 255)
    found = GaussianScene.load(write_ply(tmp_path / "a.ply", vertices, "ascii"))
    np.testing.assert_allclose(found.colors(), scene.colors(), atol=1 / 500)


def test_splatfacto_without_harmonics_learns_logits_of_colours(tmp_path: Path) -> None:
    scene = some_scene(20, 0)
    scene_files.write_splatfacto(tmp_path / "a.ckpt", scene)
    found = GaussianScene.load(tmp_path / "a.ckpt")
    np.testing.assert_allclose(found.colors(), 1 / (1 + np.exp(-scene.sh[:, 0])), atol=1e-5)


def test_harmonics_above_degree_3_are_left_out_and_it_is_said(tmp_path: Path) -> None:
    scene = some_scene(20, 3)
    splats = scene_files.stored(scene)
    splats["shN"] = torch.cat([splats["shN"], torch.ones(20, 9, 3)], dim=1)
    torch.save({"splats": splats}, tmp_path / "a.pt")
    check_same(GaussianScene.load(tmp_path / "a.pt"), scene, CASES["gsplat"])
    assert read_scene(tmp_path / "a.pt").remarks == ("SH above degree 3 are left out",)


def test_values_that_no_scene_has_are_refused_in_every_format(tmp_path: Path) -> None:
    record = struct.pack("<6f8B", np.nan, 0, 0, 1, 1, 1, 9, 9, 9, 9, 255, 128, 128, 128)
    (tmp_path / "nan.splat").write_bytes(record)
    with pytest.raises(SceneValueError, match=r"nan\.splat: 1 of 1 Gaussians have NaN, infinite or too large pos"):
        GaussianScene.load(tmp_path / "nan.splat")
    (tmp_path / "negative.splat").write_bytes(
        record.replace(struct.pack("<f", np.nan), struct.pack("<f", 0), 1).replace(
            struct.pack("<f", 1), struct.pack("<f", -1), 1
        )
    )
    with pytest.raises(SceneValueError, match=r"NaN, infinite or too large scales"):
        GaussianScene.load(tmp_path / "negative.splat")
    (tmp_path / "empty.splat").write_bytes(b"")
    with pytest.raises(EmptySceneError, match=r"empty\.splat: holds no Gaussian"):
        GaussianScene.load(tmp_path / "empty.splat")


def test_scales_that_were_rounded_to_nothing_are_small_and_no_error(tmp_path: Path) -> None:
    (tmp_path / "a.splat").write_bytes(struct.pack("<6f8B", 0, 0, 0, 0, 1, 1, 9, 9, 9, 255, 255, 128, 128, 128))
    scene = GaussianScene.load(tmp_path / "a.splat")
    assert 0 < scene.scales[0, 0] < 1e-15 and 0.99 < scene.opacities[0] < 1


def test_a_variant_of_ply_that_lacks_properties_is_refused_as_any_other(tmp_path: Path) -> None:
    vertices = np.zeros(3, [("x", "f4"), ("filter_3D", "f4")])
    with pytest.raises(ScenePropertyError, match=r"a\.ply: not a 3DGS scene, lacks the vertex properties scale_0"):
        GaussianScene.load(write_ply(tmp_path / "a.ply", vertices))
    elsewhere = [plyfile.PlyElement.describe(some_scene().vertices, "vertex")]
    elsewhere += [plyfile.PlyElement.describe(np.zeros(1, [("filter_3D", "f4")]), "settings")]
    plyfile.PlyData(elsewhere).write(str(tmp_path / "a.ply"))
    with pytest.raises(ScenePropertyError, match=r"a\.ply: not a 3DGS scene, lacks the vertex properties filter_3D"):
        GaussianScene.load(tmp_path / "a.ply")


def test_of_a_ply_of_sh_degree_4_those_up_to_degree_3_are_read(tmp_path: Path) -> None:
    zeros, sh = np.zeros((5, 3)), np.random.default_rng(1).normal(size=(5, 25, 3)).astype(np.float32)
    vertices = pack_vertices(zeros, np.ones((5, 4)), zeros, np.zeros(5), sh[:, 0], sh[:, 1:])
    with_labels = np.zeros(5, [*vertices.dtype.descr, ("label", "i4")])
    for name in vertices.dtype.names or ():
        with_labels[name] = vertices[name]
    with_labels["label"] = np.arange(5)
    scene = GaussianScene.load(write_ply(tmp_path / "a.ply", with_labels))
    np.testing.assert_array_equal(scene.sh, sh[:, :16])
    assert scene.vertices["label"].tolist() == [0, 1, 2, 3, 4] and (scene.opacities == 0.5).all()
    assert read_scene(tmp_path / "a.ply").remarks == ("SH above degree 3 are left out",)


def test_a_compressed_ply_of_gsplat_without_harmonics_names_them_all_the_same(tmp_path: Path) -> None:
    path = tmp_path / "a.compressed.ply"
    scene_files.write_compressed_ply(path, some_scene(degree=0))
    written, plain = path.read_bytes(), GaussianScene.load(path)
    path.write_bytes(written.replace(b"end_header\n", b"element sh 300\nend_header\n", 1))  # and no property
    found = GaussianScene.load(path)
    assert found.sh_degree == 0
    np.testing.assert_array_equal(found.vertices, plain.vertices)


def test_packed_vertices_are_laid_out_as_trainers_do() -> None:
    zeros = np.zeros((2, 3))
    rest = np.arange(18.0).reshape(2, 3, 3)
    vertices = pack_vertices(zeros, np.ones((2, 4)), zeros, np.zeros(2), zeros, rest)
    assert (vertices.dtype.names or ())[:7] == ("x", "y", "z", "nx", "ny", "nz", "f_dc_0")
    assert [vertices[f"f_rest_{i}"][0] for i in range(9)] == [0, 3, 6, 1, 4, 7, 2, 5, 8]


def test_the_table_names_every_format_once_and_says_what_it_keeps() -> None:
    names = [known.name for known in SCENE_FORMATS]
    assert len(set(names)) == len(names) and all(known.keeps and known.suffixes for known in SCENE_FORMATS)


def test_the_same_scene_as_spz_and_as_compressed_ply_of_other_programs_is_the_same(real_data: Path) -> None:
    folder = real_data / "formats"
    spz, ply = (GaussianScene.load(folder / name) for name in ("biker.spz", "biker.compressed.ply"))
    assert len(spz) == len(ply) == 152_746
    assert np.median(np.abs(spz.means - ply.means).max(axis=1)) < 3e-4
    np.testing.assert_allclose(spz.opacities, ply.opacities, atol=0.01)
    np.testing.assert_allclose(spz.colors(), ply.colors(), atol=0.03)


def test_real_files_of_other_programs_are_read(real_data: Path) -> None:
    folder = real_data / "formats"
    files = (("playbot_sog", 31_000, 2), ("playbot_sog/meta.json", 31_000, 2), ("plant.splat", 113_648, 0))
    for name, count, degree in files:
        scene = GaussianScene.load(folder / name)
        assert len(scene) == count and scene.sh_degree == degree


def test_a_nan_that_is_signalled_when_it_is_converted_is_nan_without_a_warning() -> None:
    signalling = np.array([0x7F800001], np.uint32).view(np.float32)
    assert np.isnan(logits(signalling)).all() and np.isnan(log_scales(signalling)).all()
