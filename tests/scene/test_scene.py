"""Scenes: what real trainers write is read exactly, activated, validated and written back."""

from __future__ import annotations

import dataclasses
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_ply import ENCODINGS, write_ply

from gsseg_core.errors import EmptySceneError, SceneFileError, ScenePropertyError, SceneValueError, WriteError
from gsseg_core.scene.gaussian_scene import ACTIVATED, GaussianScene
from gsseg_core.scene.ply import read_vertices
from gsseg_core.scene.spherical_harmonics import C0
from gsseg_core.scene.vertices import BLOCK

GEOMETRY = ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]


def names_3dgs(degree: int, normals: bool = True) -> list[str]:
    rest = [f"f_rest_{i}" for i in range(3 * (degree + 1) ** 2 - 3)]
    return ["x", "y", "z", *["nx", "ny", "nz"][: 3 * normals], "f_dc_0", "f_dc_1", "f_dc_2", *rest, *GEOMETRY]


def random_vertices(
    n: int = 6, degree: int = 1, *, seed: int = 0, normals: bool = True, kind: str = "f4", shuffled: bool = False
) -> np.ndarray:
    """Vertices as a trainer stores them, with two properties of somebody else's."""
    rng = np.random.default_rng(seed)
    fields = [(name, kind) for name in names_3dgs(degree, normals)] + [("label", "i4"), ("time", "f8")]
    if shuffled:
        rng.shuffle(fields)
    vertices = np.empty(n, fields)
    for name, _ in fields:
        vertices[name] = rng.integers(-99, 99, n) if name == "label" else rng.normal(size=n).astype(np.float32)
    return vertices


def stack(vertices: np.ndarray, *names: str) -> np.ndarray:
    return np.stack([vertices[name] for name in names], axis=1).astype(np.float32)


@pytest.mark.parametrize("degree", range(4))
@settings(max_examples=12)
@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(1, 6),
    encoding=st.sampled_from(sorted(ENCODINGS)),
    kind=st.sampled_from(["f4", "f8"]),
    normals=st.booleans(),
    shuffled=st.booleans(),
)
def test_every_form_of_ply_is_read_and_written_back_exactly(
    tmp_path_factory: pytest.TempPathFactory,
    degree: int,
    seed: int,
    n: int,
    encoding: str,
    kind: str,
    normals: bool,
    shuffled: bool,
) -> None:
    folder = tmp_path_factory.mktemp("scene")
    vertices = random_vertices(n, degree, seed=seed, normals=normals, kind=kind, shuffled=shuffled)
    scene = GaussianScene.load(write_ply(folder / "in.ply", vertices, encoding))
    assert len(scene) == n and scene.sh_degree == degree
    np.testing.assert_array_equal(scene.means, stack(vertices, "x", "y", "z"))
    np.testing.assert_allclose(scene.scales, np.exp(stack(vertices, "scale_0", "scale_1", "scale_2")), rtol=1e-6)
    np.testing.assert_allclose(scene.opacities, 1 / (1 + np.exp(-vertices["opacity"])), rtol=1e-6)
    rot = stack(vertices, "rot_0", "rot_1", "rot_2", "rot_3")
    np.testing.assert_allclose(scene.quats, rot / np.linalg.norm(rot, axis=1, keepdims=True), atol=1e-6)
    bands = (degree + 1) ** 2
    assert scene.sh.shape == (n, bands, 3)
    for channel in range(3):
        np.testing.assert_array_equal(scene.sh[:, 0, channel], vertices[f"f_dc_{channel}"])
        for band in range(1, bands):
            name = f"f_rest_{channel * (bands - 1) + band - 1}"
            np.testing.assert_array_equal(scene.sh[:, band, channel], vertices[name])

    scene.save(folder / "out.ply")
    again = read_vertices(folder / "out.ply")
    assert again.dtype == vertices.dtype
    np.testing.assert_array_equal(again, vertices)
    assert GaussianScene.load(folder / "out.ply").digest == scene.digest


@settings(max_examples=15)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(1, 5), degree=st.integers(0, 3))
def test_a_scene_from_arrays_is_what_is_read_back(
    tmp_path_factory: pytest.TempPathFactory, seed: int, n: int, degree: int
) -> None:
    rng = np.random.default_rng(seed)
    arrays = {
        "means": rng.normal(size=(n, 3)),
        "quats": rng.normal(size=(n, 4)),
        "scales": rng.uniform(1e-3, 2, (n, 3)),
        "opacities": rng.uniform(0, 1, n),
        "sh": rng.normal(size=(n, (degree + 1) ** 2, 3)),
    }
    scene = GaussianScene.from_arrays(**arrays)
    path = tmp_path_factory.mktemp("scene") / "scene.ply"
    scene.save(path)
    again = GaussianScene.load(path)
    assert list(again.vertices.dtype.names or ()) == names_3dgs(degree)
    assert not stack(again.vertices, "nx", "ny", "nz").any()
    arrays["quats"] /= np.linalg.norm(arrays["quats"], axis=1, keepdims=True)
    for name, values in arrays.items():
        np.testing.assert_array_equal(getattr(again, name), getattr(scene, name))
        np.testing.assert_allclose(getattr(scene, name), values, rtol=1e-5, atol=1e-6)


def test_opacities_of_zero_and_one_are_kept_just_inside(tmp_path: Path) -> None:
    opacities = GaussianScene.from_arrays(
        np.zeros((2, 3)), np.ones((2, 4)), np.ones((2, 3)), [0, 1], np.zeros((2, 1, 3))
    ).opacities
    assert 0 < opacities[0] < 1e-6 and 1 - 1e-6 < opacities[1] < 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"means": np.zeros((2, 2))}, r"means has shape \(2, 2\); expected \(2, 3\)"),
        ({"means": 0.0}, r"means has shape \(\); expected"),
        ({"quats": np.ones((3, 4))}, r"quats has shape \(3, 4\); expected \(2, 4\)"),
        ({"opacities": np.ones((2, 1))}, r"opacities has shape \(2, 1\); expected \(2,\)"),
        ({"sh": np.zeros((2, 2, 3))}, r"sh has shape \(2, 2, 3\); expected \(2, 1, 3\) or \(2, 4, 3\)"),
        ({"scales": np.zeros((2, 3))}, "scales hold values that are NaN or not positive"),
        ({"scales": np.full((2, 3), np.nan)}, "scales hold values that are NaN or not positive"),
        ({"scales": np.full((2, 3), np.inf)}, "2 of 2 Gaussians have NaN, infinite or too large scales"),
        ({"opacities": np.array([0.5, 1.5])}, r"opacities hold values that are NaN or outside \[0, 1\]"),
        ({"opacities": np.array([0.5, np.nan])}, r"opacities hold values that are NaN or outside \[0, 1\]"),
        ({"means": np.full((2, 3), 1e300)}, "2 of 2 Gaussians have NaN, infinite or too large positions"),
        ({"quats": np.zeros((2, 4))}, "2 of 2 Gaussians have a rotation quaternion of zero"),
    ],
)
def test_arrays_that_make_no_scene_are_refused(change: dict[str, np.ndarray], message: str) -> None:
    arrays = {
        "means": np.zeros((2, 3)),
        "quats": np.ones((2, 4)),
        "scales": np.ones((2, 3)),
        "opacities": np.full(2, 0.5),
        "sh": np.zeros((2, 1, 3)),
    }
    GaussianScene.from_arrays(**arrays)
    with pytest.raises(SceneValueError, match=message):
        GaussianScene.from_arrays(**arrays | change)


def test_a_subset_keeps_every_property_and_is_a_valid_scene(tmp_path: Path) -> None:
    vertices = random_vertices(8, 2)
    scene = GaussianScene.load(write_ply(tmp_path / "in.ply", vertices))
    mask = np.arange(8) % 3 == 0
    for index, expected in ((mask, mask), (np.array([5, 0, -1]), np.array([5, 0, 7]))):
        part = scene.subset(index)
        part.save(tmp_path / "part.ply")
        np.testing.assert_array_equal(read_vertices(tmp_path / "part.ply"), vertices[expected])
        again = GaussianScene.load(tmp_path / "part.ply")
        for name in ("means", "quats", "scales", "opacities", "sh"):
            np.testing.assert_array_equal(getattr(part, name), getattr(scene, name)[expected])
            np.testing.assert_array_equal(getattr(part, name), getattr(again, name))


def test_a_subset_of_nothing_is_refused(tmp_path: Path) -> None:
    scene = GaussianScene.load(write_ply(tmp_path / "in.ply", random_vertices(4)))
    with pytest.raises(EmptySceneError, match=r"in\.ply: none of its 4 Gaussians is in the subset"):
        scene.subset(np.zeros(4, bool))


def test_a_mask_of_another_length_is_refused(tmp_path: Path) -> None:
    scene = GaussianScene.load(write_ply(tmp_path / "in.ply", random_vertices(4)))
    with pytest.raises(IndexError):
        scene.subset(np.ones(5, bool))


def test_the_digest_is_of_the_geometry_alone(tmp_path: Path) -> None:
    vertices = random_vertices(5)
    digest = GaussianScene.load(write_ply(tmp_path / "a.ply", vertices)).digest
    assert len(digest) == 64
    for name in vertices.dtype.names or ():
        other = vertices.copy()
        other[name][3] += 1
        same = GaussianScene.load(write_ply(tmp_path / "b.ply", other)).digest == digest
        assert same == (name not in {"x", "y", "z", *GEOMETRY}), name
    doubles = vertices.astype([(name, "f8") for name in vertices.dtype.names or ()])
    assert GaussianScene.load(write_ply(tmp_path / "c.ply", doubles, "ascii")).digest == digest


def test_colours_depend_on_where_they_are_seen_from() -> None:
    sh = np.zeros((2, 4, 3))
    sh[:, 0] = 0.1 / C0
    sh[0, 2, 0] = 0.2 / 0.4886025119029199  # red grows with z of the direction
    scene = GaussianScene.from_arrays(np.zeros((2, 3)), np.ones((2, 4)), np.ones((2, 3)), [0.5, 0.5], sh)
    np.testing.assert_allclose(scene.colors(), np.full((2, 3), 0.6), atol=1e-6)
    np.testing.assert_allclose(scene.colors((0, 0, -5)), [[0.8, 0.6, 0.6], [0.6, 0.6, 0.6]], atol=1e-6)
    np.testing.assert_allclose(scene.colors((0, 0, 5)), [[0.4, 0.6, 0.6], [0.6, 0.6, 0.6]], atol=1e-6)
    assert np.isfinite(scene.colors((0, 0, 0))).all()


def test_an_empty_scene_is_refused(tmp_path: Path) -> None:
    for encoding in ENCODINGS:
        with pytest.raises(EmptySceneError, match=r"in\.ply: holds no Gaussian \(0 vertices\); expected at least one"):
            GaussianScene.load(write_ply(tmp_path / "in.ply", random_vertices(0), encoding))
    with pytest.raises(EmptySceneError):
        GaussianScene.from_arrays(np.zeros((0, 3)), np.zeros((0, 4)), np.ones((0, 3)), [], np.zeros((0, 1, 3)))


def test_missing_properties_are_listed(tmp_path: Path) -> None:
    vertices = random_vertices(3, 0)
    kept = [name for name in vertices.dtype.names or () if name not in ("opacity", "rot_2", "f_dc_0")]
    path = write_ply(tmp_path / "in.ply", vertices[kept].astype([(name, "f4") for name in kept]))
    with pytest.raises(ScenePropertyError, match=r"in\.ply: .* lacks the vertex properties f_dc_0, opacity, rot_2$"):
        GaussianScene.load(path)


def test_a_point_cloud_is_not_a_scene(tmp_path: Path) -> None:
    path = write_ply(tmp_path / "cloud.ply", np.zeros(3, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("red", "u1")]))
    with pytest.raises(
        ScenePropertyError, match=r"not a 3DGS scene, lacks the vertex properties f_dc_0, .*, rot_3; points"
    ):
        GaussianScene.load(path)


@pytest.mark.parametrize("names", [["f_rest_0", "f_rest_1"], [f"f_rest_{i}" for i in range(1, 10)]])
def test_an_odd_number_of_sh_coefficients_is_refused(tmp_path: Path, names: list[str]) -> None:
    plain = random_vertices(3, 0)
    vertices = np.zeros(3, plain.dtype.descr + [(name, "f4") for name in names])
    for name in plain.dtype.names or ():
        vertices[name] = plain[name]
    with pytest.raises(ScenePropertyError, match=rf"has {len(names)} properties f_rest_\*; expected 0, 9, 24, 45"):
        GaussianScene.load(write_ply(tmp_path / "in.ply", vertices))


def test_opacities_and_scales_of_0_and_1_may_be_infinite_as_logits_and_logarithms(tmp_path: Path) -> None:
    vertices, finite = random_vertices(6), random_vertices(6)
    vertices["opacity"][[2, 4]], finite["opacity"][[2, 4]] = (np.inf, -np.inf), (16, -16)
    vertices["scale_1"][3], finite["scale_1"][3] = -np.inf, -40
    scene = GaussianScene.load(write_ply(tmp_path / "in.ply", vertices))
    expected = GaussianScene.load(write_ply(tmp_path / "finite.ply", finite))
    for name in ACTIVATED:
        np.testing.assert_array_equal(getattr(scene, name), getattr(expected, name))
    scene.save(tmp_path / "out.ply")
    assert read_vertices(tmp_path / "out.ply").tobytes() == vertices.tobytes()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize(
    ("name", "what"),
    [
        ("y", "positions"),
        ("scale_2", "scales"),
        ("opacity", "opacities"),
        ("rot_1", "rotations"),
        ("f_dc_1", "SH coefficients"),
        ("f_rest_8", "SH coefficients"),
    ],
)
@pytest.mark.parametrize("encoding", ["ascii", "little endian"])
def test_nan_and_infinity_are_refused_with_count_and_place(
    tmp_path: Path, name: str, what: str, value: float, encoding: str
) -> None:
    vertices = random_vertices(6)
    if name == "opacity" or (name == "scale_2" and value < 0):
        value = np.nan  # What is infinite is an opacity of 0 or 1, or a scale of 0.
    vertices[name][[2, 4]] = value
    with pytest.raises(SceneValueError) as caught:
        GaussianScene.load(write_ply(tmp_path / "in.ply", vertices, encoding))
    assert str(caught.value).startswith(
        f"{tmp_path / 'in.ply'}: 2 of 6 Gaussians have NaN, infinite or too large {what} (first at index 2); "
        "expected finite numbers, at most "
    )


def test_doubles_beyond_float32_count_as_infinite(tmp_path: Path) -> None:
    vertices = random_vertices(3, kind="f8")
    vertices["z"][1] = 1e200
    for encoding in ENCODINGS:
        with pytest.raises(SceneValueError, match="1 of 3 Gaussians have NaN, infinite or too large"):
            GaussianScene.load(write_ply(tmp_path / "in.ply", vertices, encoding))


def test_nan_in_properties_that_nobody_uses_is_kept(tmp_path: Path) -> None:
    vertices = random_vertices(3)
    vertices["nx"], vertices["time"] = np.nan, np.inf
    scene = GaussianScene.load(write_ply(tmp_path / "in.ply", vertices))
    scene.save(tmp_path / "out.ply")
    assert read_vertices(tmp_path / "out.ply").tobytes() == vertices.tobytes()


def test_zero_quaternions_are_refused_with_count_and_place(tmp_path: Path) -> None:
    vertices = random_vertices(6)
    for name in GEOMETRY[4:]:
        vertices[name][[1, 5]] = 0
    with pytest.raises(SceneValueError, match=r"2 of 6 .* have a rotation quaternion of zero \(first at index 1\)"):
        GaussianScene.load(write_ply(tmp_path / "in.ply", vertices))


def test_a_scene_of_several_blocks_is_that_of_its_parts() -> None:
    vertices = random_vertices(2 * BLOCK + 3, 0)
    whole = GaussianScene.from_vertices(vertices, None)
    for part in (slice(0, 5), slice(BLOCK - 2, BLOCK + 2), slice(2 * BLOCK - 1, None)):
        alone = GaussianScene.from_vertices(vertices[part], None)
        for name in ("means", "quats", "scales", "opacities"):
            np.testing.assert_array_equal(getattr(whole, name)[part], getattr(alone, name))
    for name in GEOMETRY[4:]:
        vertices[name][-1] = 0
    with pytest.raises(SceneValueError, match=rf"1 of {len(vertices)} .* \(first at index {len(vertices) - 1}\)"):
        GaussianScene.from_vertices(vertices, None)


def test_extreme_but_finite_values_are_activated_within_range(tmp_path: Path) -> None:
    vertices = random_vertices(2)
    for sign, i in ((-1, 0), (1, 1)):
        for name in ("opacity", "scale_0", "scale_1", "scale_2"):
            vertices[name][i] = sign * 3e38
        for name in GEOMETRY[4:]:
            vertices[name][i] = 1e-38 if sign < 0 else 3e38
    scene = GaussianScene.load(write_ply(tmp_path / "in.ply", vertices))
    assert (scene.opacities > 0).all() and (scene.opacities < 1).all()
    assert (scene.scales**2 > 0).all() and np.isfinite(scene.scales**2).all()
    np.testing.assert_allclose(scene.quats, 0.5)
    scene.save(tmp_path / "out.ply")
    np.testing.assert_array_equal(read_vertices(tmp_path / "out.ply"), vertices)


def test_a_scene_cannot_be_reassigned(tmp_path: Path) -> None:
    scene = GaussianScene.load(write_ply(tmp_path / "in.ply", random_vertices(2)))
    with pytest.raises(dataclasses.FrozenInstanceError):
        scene.means = scene.means[:1]  # type: ignore[misc]


def test_a_save_that_fails_leaves_the_earlier_file_whole(tmp_path: Path) -> None:
    scene = GaussianScene.load(write_ply(tmp_path / "in.ply", random_vertices(500)))
    (tmp_path / "out.ply").write_text("earlier")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
    try:
        with pytest.raises(WriteError, match=r"out\.ply: cannot be written"):
            scene.save(tmp_path / "out.ply")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert (tmp_path / "out.ply").read_text() == "earlier"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in.ply", "out.ply"]


def test_a_missing_scene_is_named(tmp_path: Path) -> None:
    with pytest.raises(SceneFileError, match=r"nowhere\.ply: cannot be read"):
        GaussianScene.load(tmp_path / "nowhere.ply")


def test_a_scene_can_be_saved_over_itself(tmp_path: Path) -> None:
    vertices = random_vertices(9)
    path = write_ply(tmp_path / "in.ply", vertices)
    GaussianScene.load(path).subset(np.arange(4)).save(path)
    np.testing.assert_array_equal(read_vertices(path), vertices[:4])


def test_colours_of_gaussians_that_are_not_there_are_refused() -> None:
    scene = GaussianScene.from_arrays(
        np.zeros((4, 3)), np.ones((4, 4)), np.ones((4, 3)), np.ones(4), np.zeros((4, 4, 3))
    )
    for ids in (np.array([4]), np.array([-1]), np.array([1.5]), np.ones(4, bool), np.array([[0]])):
        with pytest.raises(SceneValueError, match=r"scene: ids are .* expected integers \(M,\) below 4"):
            scene.colors(ids=ids)
    with pytest.raises(SceneValueError, match=r"center of \(2,\); expected .* \(3,\)"):
        scene.colors(np.zeros(2))


@pytest.mark.parametrize(("name", "count", "degree"), [("replica_apartment", 126_507, 1), ("fern", 65_311, 3)])
def test_real_scenes_load_and_save_exactly(real_data: Path, tmp_path: Path, name: str, count: int, degree: int) -> None:
    path = real_data / name / "scene.ply"
    scene = GaussianScene.load(path)
    assert len(scene) == count and scene.sh_degree == degree and scene.path == path
    np.testing.assert_allclose(np.linalg.norm(scene.quats, axis=1), 1, atol=1e-6)
    rgb = scene.colors(np.zeros(3))
    assert rgb.min() >= 0 and rgb.max() <= 1 and rgb.std() > 0.05
    scene.save(tmp_path / "out.ply")
    np.testing.assert_array_equal(read_vertices(tmp_path / "out.ply"), scene.vertices)


def test_reading_a_scene_loads_no_kernels(tmp_path: Path) -> None:
    path = write_ply(tmp_path / "scene.ply", random_vertices())
    program = f"""
import sys
from gsseg_core.scene.gaussian_scene import GaussianScene
GaussianScene.load({str(path)!r})
sys.exit("numba" in sys.modules or "scipy" in sys.modules)
"""
    subprocess.run([sys.executable, "-c", program], check=True)
