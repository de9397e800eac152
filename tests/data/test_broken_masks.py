"""Masks of other programs that are cut off, hostile or no masks: one clear error, in little memory."""

from __future__ import annotations

import json
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mask_writers import AMG_HEADER, PER_VIEW_WRITERS, WRITERS, compressed, runs
from PIL import Image
from test_mask_formats import HEIGHT, WIDTH, make_cameras, written

from gsseg_core.data.dataset import Dataset
from gsseg_core.data.mask_formats import shapes
from gsseg_core.data.mask_formats.rle import run_lengths, runs_to_mask
from gsseg_core.data.mask_formats.shapes import Polygons, Shape, paint
from gsseg_core.errors import GssegError, MaskFormatError

MANY = "x" * 5000
SQUARE = [[0, 0], [3, 0], [3, 3], [0, 3]]


def read_all(root: Path, place: Path | str) -> None:
    dataset = Dataset(root, place)
    for view in dataset.views():
        if view.has_mask:
            view.read_labels()


def refused(root: Path, place: Path | str, *said: str, most: int = 2**27) -> None:
    """Check that masks are refused with one line that names a file below the root, in little memory."""
    tracemalloc.start()
    try:
        with pytest.raises(GssegError) as caught:
            read_all(root, place)
        assert tracemalloc.get_traced_memory()[1] < most
    finally:
        tracemalloc.stop()
    message = str(caught.value)
    assert message.startswith(str(root)) and "\n" not in message and len(message) <= 1000 and message.isprintable()
    for words in said:
        assert words in message, message


@pytest.mark.parametrize("name", [*WRITERS, *PER_VIEW_WRITERS])
@pytest.mark.parametrize("share", [0.0, 0.02, 0.3, 0.6, 0.9, 0.99])
def test_a_file_that_is_cut_off_is_read_as_far_as_it_is_whole_or_refused(
    tmp_path: Path, name: str, share: float
) -> None:
    place = written(tmp_path, (WRITERS | PER_VIEW_WRITERS)[name])
    for path in [path for path in (tmp_path / "masks").rglob("*") if path.is_file()]:
        whole = path.read_bytes()
        path.write_bytes(whole[: int(share * len(whole))])
        try:
            read_all(tmp_path, place)
        except GssegError as error:
            assert str(error).startswith(str(tmp_path)) and str(error).isprintable()
        path.write_bytes(whole)


def coco(**changes: object) -> dict[str, object]:
    whole: dict[str, object] = {
        "images": [{"id": 1, "file_name": "frame_001.jpg", "width": WIDTH, "height": HEIGHT}],
        "categories": [{"id": 1, "name": "a"}],
        "annotations": [{"image_id": 1, "category_id": 1, "segmentation": [np.ravel(SQUARE).tolist()]}],
    }
    return whole | changes


def annotated(segmentation: object, category: object = 1) -> dict[str, object]:
    return coco(annotations=[{"image_id": 1, "category_id": category, "segmentation": segmentation}])


def sized(width: object, height: object) -> dict[str, object]:
    return coco(images=[{"id": 1, "file_name": "frame_001.jpg", "width": width, "height": height}])


def named(name: object) -> dict[str, object]:
    return coco(categories=[{"id": 1, "name": name}])


def runs_of(counts: object, size: object = (HEIGHT, WIDTH)) -> dict[str, object]:
    return annotated({"size": size if not isinstance(size, tuple) else list(size), "counts": counts})


@pytest.mark.parametrize(
    ("whole", "said"),
    [
        (runs_of([10**9, 10**9]), "its runs are 2000000000 pixels long; expected 432"),
        (runs_of([2**61, 2**61]), "pixels long; expected 432"),
        (runs_of([1] * 10), "its runs are 10 pixels long"),
        (runs_of([-5, 437]), "a run of -5 pixels"),
        (runs_of([1.5, 430.5]), "expected whole numbers"),
        (runs_of("PPP\x7f"), "which is no compressed RLE of COCO"),
        (runs_of("oooooooooooo0"), "which is no compressed RLE of COCO"),
        (runs_of("\u00fc"), "which is no compressed RLE of COCO"),
        (runs_of(compressed([10**9, 5])), "pixels long; expected 432"),
        (runs_of(None), "'counts' is null"),
        (runs_of("0", (10**9, 10**9)), "its runs are for [1000000000, 1000000000] pixels; expected [18, 24]"),
        (runs_of("0", [MANY]), "expected [18, 24]"),
        (sized(10**9, 10**9), "limit max_pixels"),
        (sized(-3, 4), "'width' is -3; expected a whole number of pixels"),
        (sized("24", 18), "'width' is text"),
        (annotated([[0, 0, float("nan"), 3, 3, 3]]), "a polygon has the point (nan, 3)"),
        (annotated([[0, 0, 1e300, 3, 3, 3]]), "a polygon has the point (1e+300, 3)"),
        (annotated([[0, 0, 10**400, 3, 3, 3]]), "expected the points of a polygon"),
        (annotated([[0, 0, 3]]), "expected the points of a polygon"),
        (annotated([["a", "b"]]), "expected the points of a polygon"),
        (annotated([[[[[0, 0]]]]]), "expected the points of a polygon"),
        (annotated([]), "has no segmentation, perhaps a box"),
        (annotated([[0, -9, 9, 99] * 50_000]), "crosses the rows of the image"),
        (annotated(None), "has no segmentation"),
        (annotated([[0, 0, 3, 3, 0, 3]], 7), "has the category 7; expected one that 'categories' has"),
        (annotated([[0, 0, 3, 3, 0, 3]], -1), "has the id -1"),
        (annotated([[0, 0, 3, 3, 0, 3]], 10**9), "has the id 1000000000"),
        (named("a\nb"), "expected one line of text"),
        (named("\x1b[31mred"), "expected one line of text"),
        (named(MANY), "of 5,000 characters"),
        (named(7), "expected text"),
        (coco(images=[3]), "image 0: is a number; expected an object"),
        (coco(images=[]), "has masks of no view"),
        (coco(categories=None), "is null; expected a list"),
        (coco(annotations=[{}]), "annotation 0: lacks 'image_id' (has nothing)"),
        (coco(annotations=[{"image_id": 1, "segments_info": []}]), "is of COCO's panoptic form"),
    ],
)  # fmt: skip
def test_coco_that_is_wrong_is_refused(tmp_path: Path, whole: dict[str, object], said: str) -> None:
    make_cameras(tmp_path)
    (tmp_path / "coco.json").write_text(json.dumps(whole))
    refused(tmp_path, "coco.json", f"{tmp_path}/coco.json", said)


@pytest.mark.parametrize("name", ["<script>alert(1)</script>", "../../etc/passwd", "..", "a/b", "%s%n", "{}"])
def test_names_that_could_do_harm_elsewhere_stay_names(tmp_path: Path, name: str) -> None:
    make_cameras(tmp_path)
    (tmp_path / "coco.json").write_text(json.dumps(named(name)))
    assert Dataset(tmp_path, "coco.json").class_names[1] == name
    (tmp_path / "coco.json").write_text(
        json.dumps(coco(images=[{"id": 1, "file_name": name, "width": 1, "height": 1}]))
    )
    refused(tmp_path, "coco.json", "has masks of no view")


@pytest.mark.parametrize("opened", ["[", '{"a":', '{"shapes":[', '{"images":[],"annotations":['])
def test_json_that_is_nested_without_end_is_refused(tmp_path: Path, opened: str) -> None:
    make_cameras(tmp_path)
    for levels in (900, 990, 100_000):
        (tmp_path / "deep.json").write_text(opened + "[" * levels + "]" * levels + ("]}" if opened[-1] == "[" else "}"))
        refused(tmp_path, "deep.json")


@pytest.mark.parametrize(
    ("image", "said"),
    [
        ('<polygon label="a" points="0,0;nan,3;3,3" z_order="0"/>', "a polygon has the point (nan, 3)"),
        ('<polygon label="a" points="" z_order="0"/>', "has ''; expected numbers"),
        ('<polygon points="0,0;3,3;0,3"/>', "a class has the name None"),
        ('<polygon label="a" points="0,0;3,3;0,3" z_order="1e9"/>', "'z_order' is '1e9'"),
        ('<mask label="a" rle="1000000000, 5" left="0" top="0" width="3" height="3"/>', "pixels long; expected 9"),
        ('<mask label="a" rle="nan, 9" left="0" top="0" width="3" height="3"/>', "'rle' is 'nan'; expected a whole"),
        ('<mask label="a" rle="inf, 9" left="0" top="0" width="3" height="3"/>', "'rle' is 'inf'; expected a whole"),
        ('<mask label="a" rle="4.5,4.5" left="0" top="0" width="3" height="3"/>', "'rle' is '4.5'; expected a whole"),
        ('<mask label="a" rle="5" left="0" top="0" width="99999999" height="99999999"/>', "limit max_pixels"),
        ('<mask label="a" rle="5" left="0" top="0" height="9"/>', "'width' is ''; expected a whole number"),
        ('<box label="a" xtl="0" ytl="0" xbr="3" ybr="3"/>', "has a box, which is not an outline"),
        ("<polygon", "not valid XML"),
        ("</image>", "not valid XML"),
    ],
)
def test_cvat_that_is_wrong_is_refused(tmp_path: Path, image: str, said: str) -> None:
    make_cameras(tmp_path)
    begin = f'<annotations><image name="frame_001.jpg" width="{WIDTH}" height="{HEIGHT}">'
    (tmp_path / "a.xml").write_text(f"{begin}{image}</image></annotations>")
    refused(tmp_path, "a.xml", f"{tmp_path}/a.xml", said)


def test_entities_of_xml_are_never_expanded(tmp_path: Path) -> None:
    make_cameras(tmp_path)
    laughs = "".join(f'<!ENTITY l{i} "{f"&l{i - 1};" * 10 if i else "lol"}">' for i in range(12))
    for doctype in (f"<!DOCTYPE a [{laughs}]>", '<!DOCTYPE a SYSTEM "file:///etc/passwd">'):
        (tmp_path / "a.xml").write_text(f"<annotations>{'&l11;'}</annotations>")
        refused(tmp_path, "a.xml", "not valid XML")
        (tmp_path / "a.xml").write_text(f"{doctype}<annotations></annotations>")
        refused(tmp_path, "a.xml", f"{tmp_path}/a.xml: ")
        (tmp_path / "a.xml").write_text(f"<annotations>{doctype}</annotations>")
        refused(tmp_path, "a.xml", "not valid XML")
        (tmp_path / "a.xml").write_text(f"<!-- > <annotations -->{doctype}<annotations>&l11;</annotations>")
        refused(tmp_path, "a.xml", "has a document type declaration")


@pytest.mark.parametrize("encoding", ["gb2312", "klingon"])
def test_xml_in_an_encoding_that_cannot_be_read_is_refused(tmp_path: Path, encoding: str) -> None:
    make_cameras(tmp_path)
    (tmp_path / "a.xml").write_text(f'<?xml version="1.0" encoding="{encoding}"?><annotations></annotations>')
    refused(tmp_path, "a.xml", f"{tmp_path}/a.xml: not valid XML (", "encoding")


@pytest.mark.parametrize("name", ["coco", "detections"])
def test_files_that_macos_adds_beside_masks_are_left_alone(tmp_path: Path, name: str) -> None:
    make_cameras(tmp_path)
    folder = tmp_path / ("labels" if name == "coco" else "labels/frame_001")
    folder.mkdir(parents=True)
    mask = folder / ("all.json" if name == "coco" else "1.png")
    if name == "coco":
        mask.write_text(json.dumps(coco()))
    else:
        Image.new("L", (WIDTH, HEIGHT), 255).save(mask)
    (folder / f"._{mask.name}").write_bytes(b"\0\5\x16\7\0\2\0\0Mac OS X")
    views = [view for view in Dataset(tmp_path).views() if view.has_mask]
    assert [view.name for view in views] == ["frame_001"] and (views[0].read_labels() == 1).any()


def test_a_video_of_cvat_is_refused_with_what_to_do(tmp_path: Path) -> None:
    make_cameras(tmp_path)
    (tmp_path / "a.xml").write_text('<annotations><track id="0" label="a"><box/></track></annotations>')
    refused(tmp_path, "a.xml", "has a track", "exported as CVAT for images 1.1")


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("0 0.5 0.5 0.2 0.2", "line 1: is a box"),
        ("0 0 0 0.5 nan 1 1", "has the coordinate nan"),
        ("0 0 0 0.5 1e9 1 1", "has the coordinate 1e+09"),
        ("0 0 0 0.5 0.5 1 1\n0 0 0 0.5 x 1 1", "line 2: is '0 0 0 0.5 x 1 1'; expected a class and pairs"),
        ("0 0.5 0.5 0.2 0.2 0.9", "line 1: is a box"),
        ("0 0.5 0.5 0.2 0.2 0.9 7", "line 1: is a box"),
        ("99999999 0 0 0.5 0.5 1 1", "expected a class and pairs"),
        ("65535 0 0 0.5 0.5 1 1", "has the id 65535"),
    ],
)
def test_yolo_that_is_wrong_is_refused(tmp_path: Path, line: str, said: str) -> None:
    make_cameras(tmp_path)
    (tmp_path / "t").mkdir()
    (tmp_path / "t/frame_001.txt").write_text(line if "nan" not in line else f"0 0 0 1 0 1 1\n{line}")
    refused(tmp_path, "t", f"{tmp_path}/t/frame_001.txt", said)


@pytest.mark.parametrize(
    "content",
    [
        "a: &a [1]\nnames: [*a]",
        "names: 7",
        "names: {a: b}",
        "{",
        "names: [[a]]",
        "",
        "names: !!bool x",
        "names: !!int ''",
    ],
)
def test_names_of_yolo_that_are_wrong_are_refused(tmp_path: Path, content: str) -> None:
    pytest.importorskip("yaml")
    make_cameras(tmp_path)
    (tmp_path / "t").mkdir()
    (tmp_path / "t/frame_001.txt").write_text("0 0 0 0.5 0 0.5 1\n")
    (tmp_path / "t/data.yaml").write_text(content)
    refused(tmp_path, "t", f"{tmp_path}/t/data.yaml: ")


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ("../x,9", "has a mask '../x' of '9' pixels"),
        ("-1,9", "has a mask '-1'"),
        ("5,9", "5.png: cannot be read"),
        ("9" * 2**18, "metadata.csv: is not CSV"),
    ],
)
def test_a_list_of_automatic_masks_that_names_others_is_refused(tmp_path: Path, row: str, said: str) -> None:
    place = written(tmp_path, PER_VIEW_WRITERS["SAM folders"])
    (tmp_path / place / "frame_001/metadata.csv").write_text(f"{AMG_HEADER}\n{row}")
    refused(tmp_path, place, said)


def test_a_name_of_eiseg_with_a_million_spaces_is_read_in_the_time_of_its_length(tmp_path: Path) -> None:
    place = tmp_path / written(tmp_path, WRITERS["EISeg images"])
    (place / "autosave_label.txt").write_text(f" 1 red{' ' * 10**6}box 255 0 0 \n")
    assert Dataset(tmp_path, place).class_names[1] == "red box"


def test_a_mask_of_labelme_that_inflates_is_refused_before_it_does(tmp_path: Path) -> None:
    import base64
    import struct
    import zlib

    make_cameras(tmp_path)
    header = struct.pack(">IIBBBBB", 60_000, 60_000, 8, 0, 0, 0, 0)
    chunk = struct.pack(">I", 13) + b"IHDR" + header + struct.pack(">I", zlib.crc32(b"IHDR" + header))
    bomb = base64.b64encode(b"\x89PNG\r\n\x1a\n" + chunk).decode()
    for mask in (bomb, "no base64!", base64.b64encode(b"no image").decode(), ""):
        shape = {"label": "a", "points": [[0, 0], [3, 3]], "shape_type": "mask", "mask": mask}
        whole = {"shapes": [shape], "imagePath": "", "imageWidth": WIDTH, "imageHeight": HEIGHT}
        (tmp_path / "frame_001.json").write_text(json.dumps(whole))
        refused(tmp_path, "frame_001.json", f"{tmp_path}/frame_001.json, shape 0")


@pytest.mark.parametrize("make", [lambda path: path.mkdir(), lambda path: path.symlink_to("/dev/zero")])
def test_what_is_no_file_is_refused(tmp_path: Path, make: Callable[[Path], None]) -> None:
    place = written(tmp_path, WRITERS["LabelMe polygons"])
    (tmp_path / place / "frame_002.json").unlink()
    make(tmp_path / place / "frame_002.json")
    if (tmp_path / place / "frame_002.json").is_dir():
        read_all(tmp_path, place)
    else:
        refused(tmp_path, place, "frame_002.json: cannot be read (is a device)")


# RLE and polygons beside other implementations


@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 2**32 - 1))
def test_runs_are_those_of_pycocotools(width: int, height: int, seed: int) -> None:
    coco_mask = pytest.importorskip("pycocotools.mask")
    rng = np.random.default_rng(seed)
    inside = rng.random((height, width)) < rng.random()
    text = coco_mask.encode(np.asfortranarray(inside, np.uint8))["counts"].decode()
    assert run_lengths(text, "").tolist() == runs(inside) and compressed(runs(inside)) == text
    np.testing.assert_array_equal(runs_to_mask(run_lengths(text, ""), width, height, ""), inside)


@given(st.integers(1, 60), st.integers(1, 60), st.integers(3, 40), st.integers(0, 2**32 - 1))
def test_polygons_are_those_of_scikit_image_at_the_centres_of_pixels(
    width: int, height: int, corners: int, seed: int
) -> None:
    draw = pytest.importorskip("skimage.draw")
    ring = np.random.default_rng(seed).uniform(-20, 80, (corners, 2))
    found = paint([Shape(1, Polygons([ring], ""))], width, height)
    np.testing.assert_array_equal(found > 0, draw.polygon2mask((height, width), ring[:, ::-1] - 0.5))


def test_a_polygon_of_coco_covers_what_pycocotools_says_but_for_its_outline() -> None:
    coco_mask = pytest.importorskip("pycocotools.mask")
    angles = np.linspace(0, 2 * np.pi, 50, endpoint=False)
    ring = np.stack([60 + 45.3 * np.cos(angles), 50 + 38.7 * np.sin(angles)], axis=1)
    (drawn,) = coco_mask.frPyObjects([ring.ravel().tolist()], 100, 120)
    theirs = runs_to_mask(run_lengths(drawn["counts"].decode(), ""), 120, 100, "")
    ours = paint([Shape(1, Polygons([ring], ""))], 120, 100) > 0
    assert (ours != theirs).sum() < 0.02 * theirs.sum()


def polygons(seed: int, count: int, size: int) -> list[np.ndarray]:
    """Some that cross themselves, stick out of the image, have no point, or corners at centres and edges of pixels."""
    rng = np.random.default_rng(seed)
    return [np.round(rng.uniform(-size / 5, size * 1.2, (rng.integers(12), 2)) * 2) / 2 for _ in range(count)]


def inside(ring: np.ndarray, width: int, height: int) -> np.ndarray:
    """Say, edge by edge, which pixels have an odd number of crossings with edges on their left or at their centre."""
    found, (row, column), points = np.zeros((height, width), bool), np.mgrid[:height, :width], (ring - 0.5).tolist()
    for (x, y), (next_x, next_y) in zip(points, points[1:] + points[:1], strict=True):
        if y != next_y:
            crosses = (min(y, next_y) <= row) & (row < max(y, next_y))
            found ^= crosses & (x + (row - y) * ((next_x - x) / (next_y - y)) <= column)
    return found


@pytest.mark.parametrize("at_once", [7, 2**18])
@pytest.mark.parametrize("seed", range(20))
def test_polygons_of_one_shape_cover_what_each_covers(monkeypatch: pytest.MonkeyPatch, seed: int, at_once: int) -> None:
    rings = polygons(seed, 8, 50)
    expected = np.any([inside(ring, 50, 40) for ring in rings], axis=0)
    monkeypatch.setattr(shapes, "_AT_ONCE", at_once)
    for most in (0, 2**16):  # One after the other, and together.
        monkeypatch.setattr(shapes, "_RING_PIXELS", most)
        np.testing.assert_array_equal(paint([Shape(1, Polygons(rings, ""))], 50, 40) > 0, expected)


def test_polygons_as_large_as_the_image_take_the_time_of_their_outlines() -> None:
    def seconds(count: int) -> float:
        shape = Shape(1, Polygons(polygons(1, count, 1000), ""))
        start = time.process_time()
        paint([shape], 1000, 1000)
        return time.process_time() - start

    seconds(10)
    assert seconds(1000) < 20 * seconds(10)


def test_a_polygon_of_millions_of_points_is_filled_or_refused_in_bounded_memory() -> None:
    angles = np.linspace(0, 2 * np.pi, 1_000_000, endpoint=False)
    ring = np.stack([100 + 90 * np.cos(angles), 100 + 90 * np.sin(angles)], axis=1)
    tracemalloc.start()
    try:
        inside = paint([Shape(1, Polygons([ring], "a"))], 200, 200) > 0
        zigzag = np.stack([np.linspace(0, 199, 1_000_000), np.tile([0.0, 200.0], 500_000)], axis=1)
        with pytest.raises(
            MaskFormatError, match=r"a polygon of 1,000,000 points crosses the rows of the image 200,000,000"
        ):
            paint([Shape(1, Polygons([zigzag], "a"))], 200, 200)
        assert tracemalloc.get_traced_memory()[1] < 2**28
    finally:
        tracemalloc.stop()
    assert inside.sum() == pytest.approx(np.pi * 90**2, rel=1e-3)
