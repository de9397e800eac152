"""PLY files: every encoding in, exactly the same values out, and broken files refused."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import plyfile
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from gsseg_core.errors import SceneFileError, ScenePropertyError
from gsseg_core.scene.ply import read_vertices, write_vertices

ENCODINGS = {"ascii": (True, "="), "little endian": (False, "<"), "big endian": (False, ">")}
PLY_TYPES = ["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"]


def write_ply(path: Path, vertices: np.ndarray, encoding: str = "little endian") -> Path:
    """Write by the reference library, in any encoding."""
    text, byte_order = ENCODINGS[encoding]
    element = plyfile.PlyElement.describe(vertices, "vertex")
    plyfile.PlyData([element], text=text, byte_order=byte_order).write(str(path))
    return path


def some_vertices(n: int = 5) -> np.ndarray:
    vertices = np.zeros(n, [("x", "f4"), ("weight", "f8"), ("id", "i4")])
    vertices["x"], vertices["weight"], vertices["id"] = np.arange(n) / 3, np.arange(n) / 7, np.arange(n)
    return vertices


@st.composite
def vertices(draw: st.DrawFn) -> np.ndarray:
    types = draw(st.lists(st.sampled_from(PLY_TYPES), min_size=1, max_size=6))
    dtype = np.dtype([(f"p{i}", kind) for i, kind in enumerate(types)])
    finite = {"allow_nan": False, "allow_infinity": False}
    return draw(hnp.arrays(dtype, st.integers(1, 5), elements=hnp.from_dtype(dtype, **finite)))


@pytest.mark.parametrize("encoding", ENCODINGS)
@given(vertices=vertices())
def test_every_encoding_reads_and_writes_back_exactly(
    tmp_path_factory: pytest.TempPathFactory, encoding: str, vertices: np.ndarray
) -> None:
    folder = tmp_path_factory.mktemp("ply")
    read = read_vertices(write_ply(folder / "in.ply", vertices, encoding))
    assert read.dtype == vertices.dtype and read.dtype.isnative
    np.testing.assert_array_equal(read, vertices)
    write_vertices(folder / "out.ply", read)
    again = read_vertices(folder / "out.ply")
    assert again.dtype == vertices.dtype
    np.testing.assert_array_equal(again, vertices)


def test_files_are_written_in_little_endian(tmp_path: Path) -> None:
    write_vertices(tmp_path / "out.ply", some_vertices().astype(some_vertices().dtype.newbyteorder(">")))
    assert (tmp_path / "out.ply").read_bytes().startswith(b"ply\nformat binary_little_endian 1.0\n")
    np.testing.assert_array_equal(read_vertices(tmp_path / "out.ply"), some_vertices())


def test_what_was_read_outlives_the_file(tmp_path: Path) -> None:
    path = write_ply(tmp_path / "scene.ply", some_vertices())
    read = read_vertices(path)
    with open(path, "r+b") as file:
        file.truncate(10)
    np.testing.assert_array_equal(read, some_vertices())


def test_elements_other_than_vertex_are_ignored(tmp_path: Path) -> None:
    camera = plyfile.PlyElement.describe(np.zeros(3, [("fov", "f4")]), "camera")
    vertex = plyfile.PlyElement.describe(some_vertices(), "vertex")
    plyfile.PlyData([camera, vertex], byte_order="<").write(str(tmp_path / "scene.ply"))
    np.testing.assert_array_equal(read_vertices(tmp_path / "scene.ply"), some_vertices())


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_truncated_ply_is_refused_with_one_clear_error(tmp_path: Path, encoding: str) -> None:
    whole = write_ply(tmp_path / "scene.ply", some_vertices(), encoding).read_bytes()
    data = whole.index(b"end_header\n") + len(b"end_header\n")
    last_value = whole.rstrip().rindex(b" ") if encoding == "ascii" else len(whole) - 1
    for end in (0, 3, 30, data - 3, data, (data + len(whole)) // 2, last_value):
        (tmp_path / "scene.ply").write_bytes(whole[:end])
        with pytest.raises(SceneFileError, match=r"scene\.ply: truncated or not a PLY file \(.+\); expected") as caught:
            read_vertices(tmp_path / "scene.ply")
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\x89PNG\r\n\x1a\n",
        b"solid mesh of another format\n",
        b"ply\nformat ascii 1.0\nelement vertex many\nend_header\n",
        b"ply\nformat ascii 1.0\nelement vertex -1\nproperty float x\nend_header\n",
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty half x\nend_header\n1\n",
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\none\n",
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n\xff\n",
        b"ply\nformat binary_little_endian 1.0\nelement vertex " + b"9" * 40 + b"\nproperty float x\nend_header\n",
    ],
)
def test_what_is_no_ply_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "scene.ply").write_bytes(content)
    with pytest.raises(SceneFileError, match=r"scene\.ply: truncated or not a PLY file"):
        read_vertices(tmp_path / "scene.ply")


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(SceneFileError, match=r"nowhere\.ply: cannot be read \(No such file or directory\); expected"):
        read_vertices(tmp_path / "nowhere.ply")


def test_a_folder_is_no_scene(tmp_path: Path) -> None:
    with pytest.raises(SceneFileError, match=r"cannot be read \(is a folder\)"):
        read_vertices(tmp_path)


def test_a_ply_without_vertices_is_refused_and_its_elements_named(tmp_path: Path) -> None:
    element = plyfile.PlyElement.describe(np.zeros(1, [("x", "f4")]), "chunk")
    plyfile.PlyData([element]).write(str(tmp_path / "scene.ply"))
    with pytest.raises(SceneFileError, match=r"no element 'vertex' \(elements found: chunk\)"):
        read_vertices(tmp_path / "scene.ply")


def test_list_properties_are_refused_by_name(tmp_path: Path) -> None:
    vertices = np.empty(2, [("x", "f4"), ("neighbours", "O")])
    vertices["x"], vertices["neighbours"] = 0, [np.array([1], "i4"), np.array([0, 1], "i4")]
    element = plyfile.PlyElement.describe(vertices, "vertex")
    plyfile.PlyData([element]).write(str(tmp_path / "scene.ply"))
    with pytest.raises(ScenePropertyError, match="neighbours are lists; expected one number each"):
        read_vertices(tmp_path / "scene.ply")


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("count", [10**6, 10**12, 2**63])
def test_a_count_beyond_the_file_is_refused_before_memory_is_taken(tmp_path: Path, encoding: str, count: int) -> None:
    path = write_ply(tmp_path / "scene.ply", some_vertices(), encoding)
    path.write_bytes(path.read_bytes().replace(b"vertex 5", b"vertex %d" % count))
    tracemalloc.start()
    try:
        with pytest.raises(SceneFileError, match=rf"'vertex' of {count:,} rows takes .* bytes, and \d+ are left"):
            read_vertices(path)
        assert tracemalloc.get_traced_memory()[1] < 8 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_rows_without_properties_are_not_counted_one_by_one_and_refused_in_text(tmp_path: Path, encoding: str) -> None:
    path = write_ply(tmp_path / "a.ply", some_vertices(), encoding)
    path.write_bytes(path.read_bytes().replace(b"element", b"element empty 1000000000000\nelement", 1))
    if encoding != "ascii":
        np.testing.assert_array_equal(read_vertices(path), some_vertices())
        return
    with pytest.raises(SceneFileError, match="element 'empty' of 1,000,000,000,000 rows has no properties"):
        read_vertices(path)


@pytest.mark.parametrize(
    ("content", "found"),
    [(b"", "is empty"), (b"version https://git-lfs.github.com/spec/v1\n", "begins with b'version https://git-lfs.'")],
)
def test_a_file_that_is_no_ply_is_refused_with_what_it_begins_with(tmp_path: Path, content: bytes, found: str) -> None:
    (tmp_path / "scene.ply").write_bytes(content)
    with pytest.raises(SceneFileError, match=rf"scene\.ply: truncated or not a PLY file \({found}"):
        read_vertices(tmp_path / "scene.ply")


def test_a_file_without_the_end_of_a_header_is_not_read_through(tmp_path: Path) -> None:
    (tmp_path / "scene.ply").write_bytes(b"ply\nformat ascii 1.0\ncomment " + b"x" * (2 << 20))
    with pytest.raises(SceneFileError, match=r"no end of its header in the first 1,048,576 bytes"):
        read_vertices(tmp_path / "scene.ply")


def test_comments_may_hold_letters_that_are_not_ascii(tmp_path: Path) -> None:
    for encoding in ENCODINGS:
        path = write_ply(tmp_path / "scene.ply", some_vertices(), encoding)
        path.write_bytes(path.read_bytes().replace(b"\nelement", "\ncomment by Jérôme\nelement".encode(), 1))
        np.testing.assert_array_equal(read_vertices(path), some_vertices())


def test_a_file_that_is_written_anew_while_it_is_read_is_truncated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, parse = write_ply(tmp_path / "scene.ply", some_vertices(1000)), plyfile.PlyData._parse_header

    def cut_then_parse(stream: object) -> object:
        path.write_bytes(path.read_bytes()[:9000])
        return parse(stream)

    monkeypatch.setattr(plyfile.PlyData, "_parse_header", cut_then_parse)
    with pytest.raises(SceneFileError, match=r"scene\.ply: truncated or not a PLY file \(element 'vertex' "):
        read_vertices(path)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_too_little_memory_is_no_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, encoding: str) -> None:
    path = write_ply(tmp_path / "scene.ply", some_vertices(), encoding)

    def exhausted(*_: object, **__: object) -> None:
        raise MemoryError("Unable to allocate 1.35 GiB")

    monkeypatch.setattr(np, "empty", exhausted)
    monkeypatch.setattr(np, "loadtxt", exhausted)
    with pytest.raises(SceneFileError, match=r"scene\.ply: memory is not enough \(Unable to allocate 1\.35 GiB\)"):
        read_vertices(path)


def test_a_line_too_few_or_an_empty_one_is_refused(tmp_path: Path) -> None:
    path = write_ply(tmp_path / "scene.ply", some_vertices(), "ascii")
    *lines, last = path.read_bytes().splitlines(keepends=True)
    for content in ([*lines, b" " * 40], [*lines, b"\n", last]):
        path.write_bytes(b"".join(content))
        with pytest.raises(SceneFileError, match=r"element 'vertex' ends after 4 of 5 rows"):
            read_vertices(path)
