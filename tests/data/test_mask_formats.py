"""Masks of other programs: each format comes back as it was written, and is told from the others by what it holds."""

from __future__ import annotations

import json
import pickle
from pathlib import Path

import mask_writers
import numpy as np
import pytest
from mask_writers import NAMELESS, PER_VIEW_WRITERS, WRITERS, Writer
from PIL import Image

from gsseg_core.data.dataset import Dataset
from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.data.mask_formats.place import view_of
from gsseg_core.data.mask_formats.table import MASK_FORMATS, known_formats
from gsseg_core.errors import GssegError, MaskFormatError, MaskSizeError, SettingsError

WIDTH, HEIGHT = 24, 18
STEMS = ("frame_001", "frame_002", "frame_003")
NAMES = {0: "background", 1: "arm chair", 2: "tür", 3: "wall"}  # from A to Z, as formats without ids number them


def make_cameras(root: Path, stems: tuple[str, ...] = STEMS, width: int = WIDTH, height: int = HEIGHT) -> Path:
    camera = {"width": width, "height": height, "position": [0, 0, 0], "rotation": np.eye(3).tolist()}
    root.mkdir(exist_ok=True)
    cameras = [camera | {"fx": 20, "fy": 20, "img_name": stem} for stem in stems]
    (root / "cameras.json").write_text(json.dumps(cameras))
    return root


def label_images(seed: int = 0, width: int = WIDTH, height: int = HEIGHT) -> dict[str, np.ndarray]:
    """Blobs of three classes in two of the views."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 4, (len(STEMS) - 1, height // 3, width // 3))
    images = np.repeat(np.repeat(coarse, 3, axis=1), 3, axis=2)
    images[:, :4, :5], images[:, -2:, -7:], images[:, 8, 9:12] = 1, 2, 3
    return dict(zip(STEMS, images.astype(np.int32), strict=False))


def written(root: Path, writer: Writer, labels: dict[str, np.ndarray] | None = None) -> Path:
    """A dataset with masks of one format; what `--labels` is to name."""
    make_cameras(root)
    (root / "masks").mkdir()
    return writer(root / "masks", label_images() if labels is None else labels, NAMES).relative_to(root)


@pytest.mark.parametrize("name", WRITERS)
def test_masks_come_back_as_they_were_written(tmp_path: Path, name: str) -> None:
    dataset = Dataset(tmp_path, written(tmp_path, WRITERS[name]))
    labels = label_images()
    for view in dataset.views():
        assert view.has_mask == (view.name in labels)
        if view.has_mask:
            np.testing.assert_array_equal(view.read_labels(), labels[view.name])
    assert list(dataset.class_names) == sorted(dataset.class_names)
    if name in NAMELESS:
        assert dataset.class_names == {0: "background", 1: "class_01", 2: "class_02", 3: "class_03"}
    else:
        assert dataset.class_names == NAMES


@pytest.mark.parametrize("name", PER_VIEW_WRITERS)
def test_ids_of_automatic_masks_hold_in_their_own_view(tmp_path: Path, name: str) -> None:
    dataset = Dataset(tmp_path, written(tmp_path, PER_VIEW_WRITERS[name]))
    assert dataset.masks is not None and dataset.masks.per_view and dataset.class_names[0] == "background"
    for stem, labels in label_images().items():
        (view,) = [view for view in dataset.views() if view.name == stem]
        outside = UNKNOWN if (labels > 0).mean() > 0.5 else 0
        np.testing.assert_array_equal(view.read_labels(), np.where(labels == 0, outside, labels))


@pytest.mark.parametrize("name", [*WRITERS, *PER_VIEW_WRITERS])
def test_a_mask_that_was_opened_can_go_to_another_process(tmp_path: Path, name: str) -> None:
    view = Dataset(tmp_path, written(tmp_path, (WRITERS | PER_VIEW_WRITERS)[name])).views()[0]
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(view)).read_labels(), view.read_labels())


@pytest.mark.parametrize("name", [*WRITERS, *PER_VIEW_WRITERS])
def test_masks_of_another_size_are_scaled_by_nearest_pixel_and_that_is_said(tmp_path: Path, name: str) -> None:
    large = {stem: np.repeat(np.repeat(image, 3, axis=0), 3, axis=1) for stem, image in label_images().items()}
    dataset = Dataset(tmp_path, written(tmp_path, (WRITERS | PER_VIEW_WRITERS)[name], large))
    if name == "EISeg polygons":  # They state no size.
        return
    outside = UNKNOWN if name in PER_VIEW_WRITERS else 0
    expected = np.where(label_images()["frame_001"] == 0, outside, label_images()["frame_001"])
    np.testing.assert_array_equal(dataset.views()[0].read_labels(), expected)
    if name not in ("YOLO", "SAM folders", "SAM 2 video"):  # The first has none, the others tell it when they are read.
        said = dataset.describe_masks()
        assert said is not None and said["scaled"] == f"{3 * WIDTH} x {3 * HEIGHT} to {WIDTH} x {HEIGHT} pixels"


@pytest.mark.parametrize("name", [*WRITERS, *PER_VIEW_WRITERS])
def test_masks_of_another_shape_are_refused(tmp_path: Path, name: str) -> None:
    if name in ("YOLO", "EISeg polygons"):  # They state no size.
        return
    turned = {stem: image.T for stem, image in label_images().items()}
    with pytest.raises(MaskSizeError, match=r"masks.* is for an image of 18 x 24 pixels; expected 24 x 18"):
        Dataset(tmp_path, written(tmp_path, (WRITERS | PER_VIEW_WRITERS)[name], turned)).views()[0].read_labels()


@pytest.mark.parametrize("name", [*WRITERS, *PER_VIEW_WRITERS])
def test_nothing_is_read_that_lies_outside_of_a_folder(tmp_path: Path, name: str) -> None:
    place = written(tmp_path / "data", (WRITERS | PER_VIEW_WRITERS)[name])
    (tmp_path / "data/masks").rename(tmp_path / "elsewhere")
    (tmp_path / "data/masks").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(GssegError, match="leads out of"):
        Dataset(tmp_path / "data", place, within=tmp_path / "data").views()[0].read_labels()


# What is on top


def one_view(root: Path, name: str, content: object) -> np.ndarray:
    """The labels of a view from a JSON file."""
    make_cameras(root)
    (root / name).write_text(json.dumps(content))
    return Dataset(root, name).views()[0].read_labels()


def boxes(*sizes: int) -> list[list[list[float]]]:
    return [mask_writers.corners([0.0, 0.0, float(size), float(size)]) for size in sizes]


def test_of_coco_and_labelme_the_last_shape_is_on_top(tmp_path: Path) -> None:
    small, large = boxes(3, 6)
    shapes = [{"label": name, "points": box} for name, box in (("a", small), ("b", large))]
    labels = one_view(
        tmp_path, "frame_001.json", {"shapes": shapes, "imagePath": "", "imageWidth": WIDTH, "imageHeight": HEIGHT}
    )
    assert set(np.unique(labels)) == {0, 2} and (labels == 2).sum() == 36
    annotations = [
        {"image_id": 1, "category_id": k, "segmentation": [np.ravel(box).tolist()]}
        for k, box in ((5, large), (4, small))
    ]
    images = [{"id": 1, "file_name": "frame_001.jpg", "width": WIDTH, "height": HEIGHT}]
    categories = [{"id": 4, "name": "a"}, {"id": 5, "name": "b"}]
    labels = one_view(tmp_path, "coco.json", {"images": images, "annotations": annotations, "categories": categories})
    assert (labels == 4).sum() == 9 and (labels == 5).sum() == 27


def test_of_isat_the_higher_layer_is_on_top(tmp_path: Path) -> None:
    small, large = boxes(3, 6)
    entries = [
        {"category": "s", "segmentation": small, "layer": 2.0},
        {"category": "l", "segmentation": large, "layer": 1},
    ]
    info = {"width": WIDTH, "height": HEIGHT, "name": "frame_001.jpg"}
    labels = one_view(tmp_path, "frame_001.json", {"info": info, "objects": entries})
    assert (labels == 2).sum() == 9 and (labels == 1).sum() == 27


def test_of_grounded_sam_the_smaller_mask_is_on_top_whatever_their_order(tmp_path: Path) -> None:
    sizes = {"cup": 3, "table": 6, "on it": 2}
    masks = {name: np.pad(np.ones((n, n), bool), ((0, HEIGHT - n), (0, WIDTH - n))) for name, n in sizes.items()}
    annotations = [
        {"class_name": name, "segmentation": {"size": [HEIGHT, WIDTH], "counts": mask_writers.runs(mask)}}
        for name, mask in masks.items()
    ]
    whole = {"annotations": annotations, "img_width": WIDTH, "img_height": HEIGHT}
    labels = one_view(tmp_path, "frame_001.json", whole)
    assert [(labels == k).sum() for k in (1, 2, 3)] == [5, 4, 27]


def test_of_cvat_the_higher_z_order_is_on_top(tmp_path: Path) -> None:
    make_cameras(tmp_path)
    polygon = '<polygon label="{}" points="0,0;{},0;{},{};0,{}" z_order="{}"/>'
    image = f'<image name="x/frame_001.png" width="{WIDTH}" height="{HEIGHT}">'
    shapes = polygon.format("s", 3, 3, 3, 3, 1) + polygon.format("l", 6, 6, 6, 6, 0)
    (tmp_path / "a.xml").write_text(f"<annotations>{image}{shapes}<tag label='t'/></image></annotations>")
    labels = Dataset(tmp_path, "a.xml").views()[0].read_labels()
    assert (labels == 1).sum() == 9 and (labels == 2).sum() == 27


def test_of_video_masks_the_smaller_id_is_on_top_and_an_object_0_is_an_object(tmp_path: Path) -> None:
    make_cameras(tmp_path)
    for k, n in ((0, 3), (4, 6)):
        (tmp_path / f"v/{k:03d}").mkdir(parents=True)
        mask = np.pad(np.ones((n, n), np.uint8), ((0, HEIGHT - n), (0, WIDTH - n)))
        Image.fromarray(mask).save(tmp_path / f"v/{k:03d}/frame_001.png")
    labels = Dataset(tmp_path, "v").views()[0].read_labels()
    assert (labels == 1).sum() == 9 and (labels == 5).sum() == 27


# Ids and names


def test_annotations_of_coco_none_of_which_is_of_an_image_are_refused(tmp_path: Path) -> None:
    path = tmp_path / written(tmp_path, mask_writers.coco)
    whole = json.loads(path.read_text())
    for annotation in whole["annotations"]:
        annotation["image_id"] = str(annotation["image_id"])  # as some exports have it, the images' ids being numbers
    path.write_text(json.dumps(whole))
    with pytest.raises(MaskFormatError, match=r"annotation 0: is of the image '7'.* expected ids such as 7"):
        Dataset(tmp_path, path)


def test_a_category_0_of_coco_is_an_object_unless_it_is_called_background(tmp_path: Path) -> None:
    make_cameras(tmp_path)
    images = [{"id": 0, "file_name": "frame_001.jpg", "width": WIDTH, "height": HEIGHT}]
    annotations = [{"image_id": 0, "category_id": 0, "segmentation": [[0, 0, 3, 0, 3, 3, 0, 3]]}]
    for name, ids in (("cat", {0: "background", 1: "cat", 2: "dog"}), ("Background", {0: "background", 1: "dog"})):
        categories = [{"id": 0, "name": name}, {"id": 1, "name": "dog"}]
        whole = {"images": images, "annotations": annotations, "categories": categories}
        (tmp_path / "c.json").write_text(json.dumps(whole))
        dataset = Dataset(tmp_path, "c.json")
        assert dataset.class_names == ids
        assert (dataset.views()[0].read_labels() > 0).sum() == (9 if name == "cat" else 0)


def test_labelme_draws_rectangles_and_circles_and_knows_background_and_what_to_ignore(tmp_path: Path) -> None:
    shapes = [
        {"label": "box", "points": [[8, 8], [2, 2]], "shape_type": "rectangle"},
        {"label": "ball", "points": [[14, 9], [18, 9]], "shape_type": "circle"},
        {"label": "turned", "points": [[20, 8], [22, 10], [20, 12], [18, 10]], "shape_type": "oriented_rectangle"},
        {"label": "__ignore__", "points": boxes(3)[0]},
        {"label": "_background_", "points": boxes(1)[0]},
    ]
    whole = {"shapes": shapes, "imagePath": "", "imageWidth": WIDTH, "imageHeight": HEIGHT}
    labels = one_view(tmp_path, "frame_001.json", whole)
    assert (labels == UNKNOWN).sum() == 8 and labels[0, 0] == 0 and (labels == 2).sum() == 35
    assert (labels == 1).sum() == pytest.approx(np.pi * 16, rel=0.1) and (labels == 3).sum() == pytest.approx(8, abs=4)
    shapes[2]["shape_type"] = "rotation"  # as X-AnyLabeling has it
    np.testing.assert_array_equal(one_view(tmp_path, "frame_001.json", whole), labels)


def test_yolo_without_names_numbers_its_classes(tmp_path: Path) -> None:
    make_cameras(tmp_path)
    (tmp_path / "texts").mkdir()
    (tmp_path / "texts/frame_001.txt").write_text("0 0 0 0.5 0 0.5 1 0 1\n\n7 0.5 0 1 0 1 1 0.5 1\n")
    (tmp_path / "texts/frame_002.txt").write_text("")
    dataset = Dataset(tmp_path, "texts")
    assert dataset.class_names == {0: "background", 1: "class_00", 8: "class_07"}
    assert set(np.unique(dataset.views()[0].read_labels())) == {1, 8}
    assert not dataset.views()[1].read_labels().any() and not dataset.views()[2].has_mask


@pytest.mark.parametrize("end", ["", " 0.87", " 12"])
def test_yolo_takes_predictions_as_they_are_saved(tmp_path: Path, end: str) -> None:
    """Ultralytics' `save_txt` ends lines with confidences or ids of tracks; a mask of few pixels has few points."""
    make_cameras(tmp_path)
    (tmp_path / "labels").mkdir()
    outlines = ("1 0.5 0.5", "1", "1 0.1 0.1 0.2 0.1", "0 0 0 0.5 0 0.5 1 0 1")
    (tmp_path / "labels/frame_001.txt").write_text("".join(f"{line}{end}\n" for line in outlines))
    found = next(view for view in Dataset(tmp_path).views() if view.name == "frame_001").read_labels()
    expected = np.zeros_like(found)
    expected[:, : found.shape[1] // 2] = 1
    np.testing.assert_array_equal(found, expected)


def test_yolo_with_confidences_and_tracks_has_no_point_of_them(tmp_path: Path) -> None:
    """Ultralytics' `track` with `save_conf`; the third view had no track, so that its line ends with a confidence."""
    make_cameras(tmp_path)
    (tmp_path / "labels").mkdir()
    half = "0 0 0 0.5 0 0.5 1 0 1"
    (tmp_path / "labels/frame_001.txt").write_text(f"{half} 0.87 1\n")
    (tmp_path / "labels/frame_002.txt").write_text(f"{half} 0.9 1\n1 0.91 2\n1 0.5 0.5 0.8123 3\n")
    (tmp_path / "labels/frame_003.txt").write_text(f"{half} 0.34\n")
    for view in Dataset(tmp_path).views()[:3]:
        labels = view.read_labels()
        middle = labels.shape[1] // 2
        assert (labels[:, :middle] == 1).all() and (labels[:, middle:] == 0).all()


def test_yolo_whose_lines_end_with_points_or_with_the_one_track_is_refused(tmp_path: Path) -> None:
    make_cameras(tmp_path)
    (tmp_path / "labels").mkdir()
    for stem in STEMS[:2]:
        (tmp_path / f"labels/{stem}.txt").write_text("0 0 0 0.5 0 0.5 0.5 0 0.5 0.81 1\n")
    with pytest.raises(MaskFormatError, match=r"lines end with '0\.81 1' and the like"):
        Dataset(tmp_path)


def test_yolo_takes_names_from_classes_txt(tmp_path: Path) -> None:
    make_cameras(tmp_path)
    (tmp_path / "texts").mkdir()
    (tmp_path / "texts/frame_001.txt").write_text("1 0 0 0.5 0 0.5 1 0 1\n")
    (tmp_path / "texts/classes.txt").write_text("cat\ndog\n")
    assert Dataset(tmp_path, "texts").class_names == {0: "background", 1: "cat", 2: "dog"}


@pytest.mark.parametrize("place", ["texts", ".", ".."])  # LabelImg, Label Studio
def test_yolo_takes_names_from_above_and_texts_of_windows(tmp_path: Path, place: str) -> None:
    texts = tmp_path / "data/texts"
    texts.mkdir(parents=True)
    make_cameras(tmp_path / "data")
    (texts / "frame_001.txt").write_bytes(b"\xef\xbb\xbf1 0 0 0.5 0 0.5 1 0 1\r\n")
    (texts.parent / place / "classes.txt").write_bytes(b"cat\r\ndog\r\n")
    data = Dataset(tmp_path / "data", "texts")
    assert data.class_names == {0: "background", 1: "cat", 2: "dog"}
    assert data.views()[0].read_labels().max() == 2


@pytest.mark.parametrize("writer", [mask_writers.coco, mask_writers.cvat])
def test_an_image_that_is_listed_without_an_annotation_has_no_mask(tmp_path: Path, writer: Writer) -> None:
    labels = label_images()
    labels[STEMS[1]][:] = 0
    data = Dataset(tmp_path, written(tmp_path, writer, labels))
    assert [view.has_mask for view in data.views()] == [True, False, False]


# Names of files


@pytest.mark.parametrize(
    ("name", "view"),
    [
        ("a.png", "a"), ("a.jpg.png", "a"), ("a_mask.png", "a"), ("a_labels.json", "a"), ("a.jpg.json", "a"),
        ("mask_a.json", "a"),
        ("images/a.JPG", "a"), ("C:\\x\\a.jpg", "a"), ("a_jpg.rf.0123abcd.jpg", "a"), ("a.jpg_mask.png", "a"),
        ("upload/1/0123abcd-a.jpg", "a"), ("images/left/1.JPG.png", "left_1"), ("left/x/1.png", None),
        ("a.b.png", "a.b"), ("a_mask_mask.png", None), ("ab.png", None), ("a.c.png", None), ("../a.png", "a"),
        ("", None), ("/", None), ("x" * 10**6, None),
    ],
)  # fmt: skip
def test_names_of_files_tell_their_view(name: str, view: str | None) -> None:
    assert view_of(name, {"a", "a.b", "left_1"}) == view


def test_a_view_whose_name_looks_like_that_of_a_mask_goes_before_another(tmp_path: Path) -> None:
    assert view_of("a_mask.png", {"a", "a_mask"}) == "a_mask"


@pytest.mark.parametrize("suffix", [".jpg.png", "_mask.png", "_label.png"])
def test_label_images_with_longer_names_are_found(tmp_path: Path, suffix: str) -> None:
    place = tmp_path / written(tmp_path, mask_writers.object_masks)
    (place / "frame_001.png").rename(place / f"frame_001{suffix}")
    for stem, labels in label_images().items():
        (view,) = [view for view in Dataset(tmp_path, "masks").views() if view.name == stem]
        np.testing.assert_array_equal(view.read_labels(), labels)


def test_of_two_masks_for_one_view_none_is_taken_unless_one_has_its_very_name(tmp_path: Path) -> None:
    place = tmp_path / written(tmp_path, mask_writers.object_masks)
    (place / "frame_001_mask.png").write_bytes((place / "frame_002.png").read_bytes())
    np.testing.assert_array_equal(Dataset(tmp_path, place).views()[0].read_labels(), label_images()["frame_001"])
    (place / "frame_001.png").rename(place / "frame_001_label.png")
    with pytest.raises(MaskFormatError, match=r"frame_001_label\.png and frame_001_mask\.png"):
        Dataset(tmp_path, place)


# Which format it is


def test_a_file_of_no_known_format_is_refused_with_a_list_of_those_that_are(tmp_path: Path) -> None:
    make_cameras(tmp_path)
    for name, content in (("a.json", "{}"), ("b.json", "[]"), ("c.xml", "<svg/>"), ("d.bin", "\0"), ("e.json", "[1]")):
        (tmp_path / name).write_text(content)
        with pytest.raises(MaskFormatError) as caught:
            Dataset(tmp_path, name)
        message = str(caught.value)
        assert message.startswith(f"{tmp_path / name}: ") and message.endswith(known_formats())
        assert all(known.name in message for known in MASK_FORMATS) and len(message) < 1000


def test_masks_of_two_formats_in_one_folder_are_refused(tmp_path: Path) -> None:
    place = tmp_path / written(tmp_path, mask_writers.labelme)
    mask_writers.object_masks(place, label_images(), NAMES)
    with pytest.raises(MaskFormatError, match="may be masks of LabelMe or label images; expected those of one program"):
        Dataset(tmp_path, place)


def test_annotations_beside_photos_and_beside_the_list_of_classes_are_read(tmp_path: Path) -> None:
    place = tmp_path / written(tmp_path, mask_writers.labelme)
    for stem in STEMS[:2]:
        Image.new("RGB", (WIDTH, HEIGHT)).save(place / f"{stem}.png")
    assert Dataset(tmp_path, place).class_names == NAMES


def test_label_images_beside_a_file_of_annotations_count_alone(tmp_path: Path) -> None:
    place = tmp_path / written(tmp_path, mask_writers.object_masks)
    mask_writers.coco(place, label_images(), NAMES)
    assert Dataset(tmp_path, place).masks is None
    assert Dataset(tmp_path, place / "annotations.json").class_names == NAMES


@pytest.mark.parametrize("name", ["COCO text", "CVAT masks"])
def test_a_folder_with_nothing_but_the_file_of_annotations_is_as_good_as_the_file(tmp_path: Path, name: str) -> None:
    written(tmp_path, WRITERS[name])
    assert Dataset(tmp_path, "masks").class_names == NAMES


def test_annotations_of_other_images_are_refused_with_names_that_were_found_and_expected(tmp_path: Path) -> None:
    place = written(tmp_path, mask_writers.coco, {"elsewhere": label_images()["frame_001"]})
    with pytest.raises(MaskFormatError, match=r"of no view but of 'images/elsewhere\.jpg'; expected .* 'frame_001'"):
        Dataset(tmp_path, place)


def test_a_label_map_and_global_ids_are_refused_where_ids_hold_in_their_own_view(tmp_path: Path) -> None:
    place = written(tmp_path, mask_writers.sam_json)
    (tmp_path / "map.json").write_text("{}")
    with pytest.raises(SettingsError, match="SAM JSON, whose ids hold in their own view only"):
        Dataset(tmp_path, place, label_map=tmp_path / "map.json")


def test_every_format_of_the_table_has_a_round_trip() -> None:
    tried = {name.split()[0] for name in [*WRITERS, *PER_VIEW_WRITERS]}
    assert {known.name.split()[0] for known in MASK_FORMATS} <= tried
