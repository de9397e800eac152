"""Datasets: which view has what, splits, lazy masks, and masks that do not fit."""

from __future__ import annotations

import errno
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gsseg_core.data.dataset import Dataset
from gsseg_core.data.label_images import UNKNOWN, write_mask
from gsseg_core.data.view import View
from gsseg_core.errors import (
    CameraFileError,
    ClassesFileError,
    MaskFormatError,
    MaskSizeError,
    SettingsError,
    SplitFileError,
    UnknownLabelError,
)
from gsseg_core.scene.camera import Camera

WIDTH, HEIGHT = 6, 4
LABELS = np.arange(WIDTH * HEIGHT, dtype=np.int32).reshape(HEIGHT, WIDTH) % 4


def write_cameras(root: Path, images: tuple[str, ...]) -> None:
    camera = {"width": WIDTH, "height": HEIGHT, "position": [0, 0, 0], "rotation": np.eye(3).tolist(), "fx": 5, "fy": 5}
    (root / "cameras.json").write_text(json.dumps([camera | {"img_name": image} for image in images]))


def make_dataset(root: Path, stems: tuple[str, ...] = ("a", "b", "c"), labels: np.ndarray = LABELS) -> Path:
    """Write cameras, and labels for all but the last."""
    root.mkdir(exist_ok=True)
    write_cameras(root, stems)
    for stem in stems[:-1]:
        write_mask(root / "labels" / f"{stem}.png", labels, 8)
    return root


def camera(name: str = "a") -> Camera:
    return Camera(name, WIDTH, HEIGHT, np.array([[5.0, 0, 3], [0, 5, 2], [0, 0, 1]]), np.eye(4))


# Views


def test_a_view_in_memory_gives_its_labels() -> None:
    view = View.from_arrays(camera(), LABELS.astype(np.uint8))
    assert view.name == "a" and view.has_mask and view.mask_bits == 8
    assert view.mask_path is None and view.image_path is None
    labels = view.read_labels()
    assert labels.dtype == np.int32
    labels[:] = 99
    np.testing.assert_array_equal(view.read_labels(), LABELS)


def test_a_view_in_memory_has_the_bits_that_its_labels_need() -> None:
    for label, bits in ((UNKNOWN, 8), (254, 8), (255, 16), (65534, 16)):
        assert View.from_arrays(camera(), np.full((HEIGHT, WIDTH), label)).mask_bits == bits


def test_a_mask_that_is_held_needs_its_file_no_more(tmp_path: Path) -> None:
    view = Dataset(make_dataset(tmp_path)).views()[0].held()
    (tmp_path / "labels" / "a.png").unlink()
    np.testing.assert_array_equal(view.read_labels(), LABELS)
    assert view.mask_bits == 8


def test_what_is_masked_of_labels_in_memory_is_unknown() -> None:
    labels = np.ma.MaskedArray(LABELS.astype(np.uint8), mask=LABELS == 2)
    assert np.array_equal(View.from_arrays(camera(), labels).read_labels(), np.where(LABELS == 2, UNKNOWN, LABELS))


def test_labels_in_memory_are_checked_at_once() -> None:
    with pytest.raises(MaskSizeError, match=r"view 'a': mask is 4 x 6 pixels; expected 6 x 4, the size of camera 'a'"):
        View.from_arrays(camera(), LABELS.T)
    with pytest.raises(UnknownLabelError, match="view 'a': mask holds the labels 2, 3; expected ids from 0 to 1 that"):
        View.from_arrays(camera(), LABELS, {0: "background", 1: "chair"})
    with pytest.raises(UnknownLabelError, match="mask holds the labels -5; expected 0 to 65534, or -1 for unknown"):
        View.from_arrays(camera(), np.full((HEIGHT, WIDTH), -5))
    with pytest.raises(
        UnknownLabelError, match=r"the labels 1000, 1001, .*, 1019 and 4 more; expected ids from 0 to 0 that"
    ):
        View.from_arrays(camera(), np.arange(1000, 1024).reshape(HEIGHT, WIDTH), {0: "background"})
    with pytest.raises(UnknownLabelError):
        View.from_arrays(camera(), np.full((HEIGHT, WIDTH), 2**31 + 7))
    with pytest.raises(MaskFormatError, match=r"labels are float64 of shape \(4, 6\); expected integers \(H, W\)"):
        View.from_arrays(camera(), LABELS / 2)
    with pytest.raises(MaskFormatError, match=r"labels are uint8 of shape \(4, 6, 3\)"):
        View.from_arrays(camera(), np.zeros((HEIGHT, WIDTH, 3), np.uint8))


def test_unknown_pixels_need_no_name() -> None:
    view = View.from_arrays(camera(), np.full((HEIGHT, WIDTH), UNKNOWN), {0: "background"})
    assert (view.read_labels() == UNKNOWN).all()


# Datasets


def test_views_know_their_files(tmp_path: Path) -> None:
    root = make_dataset(tmp_path)
    (root / "images").mkdir()
    for name in ("a.jpg", "b.PNG", "d.png", "notes.txt"):
        (root / "images" / name).write_bytes(b"")
    dataset = Dataset(root)
    a, b, c = dataset.views("all")
    assert [view.name for view in (a, b, c)] == ["a", "b", "c"] == [camera.name for camera in dataset.cameras]
    assert (a.mask_path, b.mask_path, c.mask_path) == (root / "labels/a.png", root / "labels/b.png", None)
    assert (a.image_path, b.image_path, c.image_path) == (root / "images/a.jpg", root / "images/b.PNG", None)
    np.testing.assert_array_equal(a.read_labels(), LABELS)
    assert a.mask_bits == 8


def test_a_missing_mask_is_no_error_until_it_is_read(tmp_path: Path) -> None:
    view = Dataset(make_dataset(tmp_path)).views()[2]
    assert not view.has_mask and view.mask_bits is None
    with pytest.raises(MaskFormatError, match=r"view 'c': has no mask; expected a label image c\.png"):
        view.read_labels()


def test_masks_are_read_anew_each_time(tmp_path: Path) -> None:
    view = Dataset(make_dataset(tmp_path)).views()[0]
    np.testing.assert_array_equal(view.read_labels(), LABELS)
    write_mask(tmp_path / "labels" / "a.png", LABELS + 300, 16)
    np.testing.assert_array_equal(view.read_labels(), LABELS + 300)
    assert view.mask_bits == 16
    (tmp_path / "labels" / "a.png").unlink()
    with pytest.raises(MaskFormatError, match=r"labels/a\.png: cannot be read"):
        view.read_labels()


def test_another_folder_of_labels_can_be_named(tmp_path: Path) -> None:
    root = make_dataset(tmp_path)
    write_mask(root / "labels_noisy" / "c.png", LABELS + 1, 8)
    a, _, c = Dataset(root, labels="labels_noisy").views()
    assert not a.has_mask
    np.testing.assert_array_equal(c.read_labels(), LABELS + 1)
    assert not any(view.has_mask for view in Dataset(root, labels="elsewhere").views())


@pytest.mark.parametrize("unreadable", ["labels", "images"])
def test_a_folder_that_cannot_be_listed_is_refused_by_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, unreadable: str
) -> None:
    make_dataset(tmp_path)
    (tmp_path / "images").mkdir(exist_ok=True)
    listed = Path.iterdir

    def denied(path: Path) -> Iterator[Path]:
        if path.name == unreadable:
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return listed(path)

    monkeypatch.setattr(Path, "iterdir", denied)
    with pytest.raises(MaskFormatError, match=rf"{unreadable}: cannot be read \(Permission denied\)"):
        Dataset(tmp_path)


def test_masks_that_the_system_does_not_let_one_look_for_are_refused(tmp_path: Path) -> None:
    make_dataset(tmp_path)
    with pytest.raises(MaskFormatError, match=r"cannot be read \(File name too long\)"):
        Dataset(tmp_path, "a" * 300)


@pytest.mark.parametrize("factor", [2, 3, 7])
def test_a_larger_mask_of_the_same_shape_is_scaled_by_nearest_pixel_and_that_is_said(
    tmp_path: Path, factor: int
) -> None:
    large = np.repeat(np.repeat(LABELS, factor, axis=0), factor, axis=1)
    dataset = Dataset(make_dataset(tmp_path, labels=large))
    np.testing.assert_array_equal(dataset.views()[0].read_labels(), LABELS)
    size = f"{WIDTH * factor} x {HEIGHT * factor} to {WIDTH} x {HEIGHT} pixels"
    assert dataset.describe_masks() == {"format": "label images", "ids": "global", "views": 2, "scaled": size}


def test_of_masks_as_they_should_be_nothing_is_said(tmp_path: Path) -> None:
    assert Dataset(make_dataset(tmp_path)).describe_masks() is None


def test_a_mask_of_another_shape_is_refused(tmp_path: Path) -> None:
    view = Dataset(make_dataset(tmp_path)).views()[0]
    write_mask(tmp_path / "labels" / "a.png", np.zeros((HEIGHT * 2, WIDTH), np.int32), 8)
    with pytest.raises(MaskSizeError) as caught:
        view.read_labels()
    assert str(caught.value) == (
        f"{tmp_path}/labels/a.png: is for an image of 6 x 8 pixels; expected 6 x 4, the size of camera 'a', or the "
        "same larger or smaller"
    )


def test_the_error_of_an_id_without_a_name_proposes_no_option_of_one_command(tmp_path: Path) -> None:
    (make_dataset(tmp_path) / "classes.json").write_text('{"0": "background", "3": "table"}')
    view = Dataset(tmp_path).views()[0]
    write_mask(tmp_path / "labels" / "a.png", np.full((HEIGHT, WIDTH), 9, np.int32), 8)
    with pytest.raises(UnknownLabelError, match=r"labels 9; expected ids from 0 to 3 that classes\.json names$"):
        view.read_labels()


def test_a_mask_that_was_turned_by_exif_is_told_from_one_of_another_shape(tmp_path: Path) -> None:
    view = Dataset(make_dataset(tmp_path)).views()[0]
    write_mask(tmp_path / "labels" / "a.png", np.zeros((WIDTH * 2, HEIGHT * 2), np.int32), 8)
    with pytest.raises(MaskSizeError, match=r"is for an image of 8 x 12 pixels; .* or smaller; it lies on its side"):
        view.read_labels()


def test_an_rgb_mask_is_refused(tmp_path: Path) -> None:
    view = Dataset(make_dataset(tmp_path)).views()[0]
    Image.new("RGB", (WIDTH, HEIGHT)).save(tmp_path / "labels" / "a.png")
    with pytest.raises(MaskFormatError, match=r"labels/a\.png: is RGB of 8 bits per channel; expected a one-channel"):
        view.read_labels()


def test_labels_that_the_classes_do_not_name_are_refused(tmp_path: Path) -> None:
    root = make_dataset(tmp_path)
    (root / "classes.json").write_text('{"1": "chair", "3": "table"}')
    dataset = Dataset(root)
    assert dataset.class_names == {0: "background", 1: "chair", 3: "table"} and dataset.num_classes == 4
    with pytest.raises(
        UnknownLabelError, match=r"labels/a\.png: mask holds the labels 2; expected ids from 0 to 3 that"
    ):
        dataset.views()[0].read_labels()


def test_without_classes_the_ids_of_the_masks_get_names(tmp_path: Path) -> None:
    root = make_dataset(tmp_path)
    write_mask(root / "labels" / "b.png", np.full((HEIGHT, WIDTH), 300), 16)
    write_mask(root / "labels" / "c.png", np.full((HEIGHT, WIDTH), UNKNOWN), 8)
    dataset = Dataset(root)
    names = {0: "background", 1: "class_01", 2: "class_02", 3: "class_03", 300: "class_300"}
    assert list(dataset.class_names.items()) == list(names.items()) and dataset.num_classes == 301


def test_without_masks_there_is_only_the_background(tmp_path: Path) -> None:
    dataset = Dataset(make_dataset(tmp_path, ("only",)))
    assert dataset.class_names == {0: "background"} and dataset.num_classes == 1


def test_without_a_split_all_views_are_for_training(tmp_path: Path) -> None:
    dataset = Dataset(make_dataset(tmp_path))
    assert [view.name for view in dataset.views("train")] == ["a", "b", "c"]
    assert dataset.views("test") == []


def test_a_split_is_followed_in_its_order(tmp_path: Path) -> None:
    (make_dataset(tmp_path) / "split.json").write_text('{"train": ["c", "a"], "test": ["b"], "spare": ["z"]}')
    dataset = Dataset(tmp_path)
    assert [view.name for view in dataset.views("train")] == ["c", "a"]
    assert [view.name for view in dataset.views("test")] == ["b"]
    assert [view.name for view in dataset.views("all")] == ["a", "b", "c"]
    with pytest.raises(SettingsError, match="split is 'spare'; expected 'train', 'test' or 'all'"):
        dataset.views("spare")


def test_a_split_may_name_views_as_files(tmp_path: Path) -> None:
    (make_dataset(tmp_path) / "split.json").write_text('{"train": ["c.jpg", "images/a.png"], "test": ["b.png"]}')
    assert [view.name for view in Dataset(tmp_path).views("train")] == ["c", "a"]


IMAGES = {
    "one stem each": (("left/1.jpg", "right/2.jpg"), ("1", "2")),
    "stems twice": (("left/1.jpg", "right/1.jpg"), ("left_1", "right_1")),
}


@pytest.mark.parametrize("case", IMAGES)
def test_masks_and_photos_in_folders_as_their_images_are_found(tmp_path: Path, case: str) -> None:
    images, names = IMAGES[case]
    write_cameras(tmp_path, tuple(f"images/{name}" for name in images))
    for i, name in enumerate(images):
        for folder in ("images", "labels"):
            (tmp_path / folder / name).parent.mkdir(parents=True, exist_ok=True)
        write_mask(tmp_path / f"labels/{name}.png", np.full((HEIGHT, WIDTH), i + 1), bits=8)
        Image.new("RGB", (WIDTH, HEIGHT)).save(tmp_path / "images" / name)
    views = Dataset(tmp_path).views()
    assert [view.name for view in views] == list(names)
    assert [view.read_labels().max() for view in views] == [1, 2]
    assert [view.image_path for view in views] == [tmp_path / "images" / name for name in images]


def test_folders_with_several_masks_for_a_view_are_no_masks(tmp_path: Path) -> None:
    write_cameras(tmp_path, ("a.jpg",))
    for thing in ("cup", "box"):
        (tmp_path / "labels" / thing).mkdir(parents=True)
        write_mask(tmp_path / f"labels/{thing}/a.png", np.ones((HEIGHT, WIDTH), int), bits=8)
    assert not Dataset(tmp_path).views()[0].has_mask


def test_an_accented_name_is_one_however_its_file_system_writes_it(tmp_path: Path) -> None:
    write_cameras(tmp_path, ("K\u00fcche.jpg",))
    (tmp_path / "labels").mkdir()
    write_mask(tmp_path / "labels/Ku\u0308che.png", np.ones((HEIGHT, WIDTH), int), bits=8)
    assert Dataset(tmp_path).views()[0].has_mask


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "not valid JSON"),
        ("[]", "holds a list; expected"),
        ('{"test": []}', 'no "train" in it; expected'),
        ('{"train": "a"}', '"train" is a; expected a list of image stems'),
        ('{"train": [1]}', r'"train" is \[1\]; expected a list of image stems'),
        (
            '{"train": ["a", "x", "y"]}',
            r""""train" names views without a camera \(2, the first 'x'\); expected .* such as 'a'""",
        ),
        ('{"train": ["a"], "test": ["b.x"]}', r""""test" names views without a camera \(1, the first 'b.x'\)"""),
        ('{"train": ["a", "a.png"]}', "stem 'a' occurs 2 times; expected each stem once"),
        ('{"train": ["a", "b"], "test": ["b"]}', "stem 'b' occurs 2 times; expected each stem once"),
    ],
)
def test_broken_splits_are_refused(tmp_path: Path, content: str, message: str) -> None:
    (make_dataset(tmp_path) / "split.json").write_text(content)
    with pytest.raises(SplitFileError, match=rf"split\.json: {message}"):
        Dataset(tmp_path)


@pytest.mark.parametrize(
    ("content", "flaw"), [("{", ""), ('{"1": "mug", "2": "jug", "1": "cup"}', "'1' stands more than once in an object")]
)
def test_broken_classes_are_refused_when_the_dataset_is_opened(tmp_path: Path, content: str, flaw: str) -> None:
    (make_dataset(tmp_path) / "classes.json").write_text(content)
    with pytest.raises(ClassesFileError, match=rf"classes\.json: not valid JSON \({flaw}"):
        Dataset(tmp_path)


def test_a_folder_without_cameras_is_no_dataset(tmp_path: Path) -> None:
    with pytest.raises(CameraFileError, match=r"has no cameras; looked for cameras\.json"):
        Dataset(tmp_path)


@pytest.mark.parametrize("labels", ["labels", "labels_noisy"])
def test_the_real_dataset_is_complete(real_data: Path, labels: str) -> None:
    dataset = Dataset(real_data / "replica_apartment", labels=labels)
    train, test = dataset.views("train"), dataset.views("test")
    assert (len(train), len(test), dataset.num_classes) == (105, 14, 41)
    assert all(view.has_mask and view.image_path for view in train + test)
    for view in train[::20] + test[::5]:
        assert view.read_labels().shape == (320, 320) and view.mask_bits == 8


def test_a_real_dataset_without_masks_opens(real_data: Path) -> None:
    dataset = Dataset(real_data / "fern")
    assert len(dataset.cameras) == 20 and dataset.class_names == {0: "background"}
    assert not any(view.has_mask for view in dataset.views())
