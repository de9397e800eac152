"""What a dataset folder of another layout gets: what was looked for, what lies near, and what to type."""

from __future__ import annotations

import errno
import json
import shlex
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import mask_writers
import numpy as np
import pytest
from camera_folders import write_colmap
from PIL import Image
from small_scenes import write_dataset

from gsseg_core.cli.main import main
from gsseg_core.data.camera_files import read_cameras
from gsseg_core.data.dataset import Dataset
from gsseg_core.data.hints import camera_hint, mask_hint
from gsseg_core.data.label_images import read_mask
from gsseg_core.errors import CameraFileError
from gsseg_core.scene.scene_formats import scene_hint


@pytest.fixture
def data(tmp_path: Path) -> Path:
    return write_dataset(tmp_path / "data")


def error_of(capsys: pytest.CaptureFixture[str], data: Path, *more: str, scene: str = "scene.ply") -> str:
    """The one line of `segment`; no kernel is compiled before it."""
    command = ["segment", f"{data}/{scene}", "--data", str(data), "--out", f"{data}/../out", "--quiet", *more]
    assert main(command) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1, lines
    return lines[0]


def typed(error: str, option: str) -> list[str]:
    """What the error says to type after an option."""
    assert f"type {option} " in error, error
    return shlex.split(error[error.index(f"type {option} ") + 5 :])[1:2]


def test_masks_in_a_folder_of_another_name_are_found_and_the_option_that_is_told_works(
    data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (data / "deep").mkdir()
    (data / "labels").rename(data / "deep/my masks")
    error = error_of(capsys, data)
    assert f"looked for {data}/labels/view" in error and "found 4 masks of these names in deep/my masks/" in error
    (folder,) = typed(error, "--labels")
    assert main(["segment", f"{data}/scene.ply", "--data", str(data), "--out", f"{data}/../out", "--quiet",
                 "--labels", folder]) == 0  # fmt: skip


@pytest.mark.parametrize("place", ["", "annotations"])
def test_annotations_of_another_program_are_found(data: Path, capsys: pytest.CaptureFixture[str], place: str) -> None:
    labels = {path.stem: np.array(Image.open(path)) for path in (data / "labels").iterdir()}
    shutil.rmtree(data / "labels")
    (data / place).mkdir(exist_ok=True)
    mask_writers.coco(data / place, labels, {0: "background", 1: "mug", 2: "cup", 3: "box"})
    (folder,) = typed(error_of(capsys, data), "--labels")
    assert folder == (place or "annotations.json")


@pytest.mark.parametrize("beside", [False, True])
def test_an_export_as_coco_that_is_named_by_its_folder_is_answered_with_its_file(
    data: Path, capsys: pytest.CaptureFixture[str], beside: bool
) -> None:
    labels = {path.stem: np.array(Image.open(path)) for path in (data / "labels").iterdir()}
    export = data.parent / "export" if beside else data / "export"
    (export / "annotations").mkdir(parents=True)
    mask_writers.coco(export / "annotations", labels, {0: "background", 1: "mug", 2: "cup", 3: "box"})
    annotations = export / "annotations/annotations.json"
    (annotations.parent / "test.json").write_text('{"images": [], "annotations": [], "categories": []}')
    for named in (export, annotations.parent):
        (file,) = typed(error_of(capsys, data, "--labels", str(named)), "--labels")
        assert (data / file).resolve() == annotations.resolve()


def test_a_file_that_lists_images_without_a_shape_is_said_to_have_none(
    data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    labels = {path.stem: np.zeros_like(Image.open(path)) for path in (data / "labels").iterdir()}
    shutil.rmtree(data / "labels")
    mask_writers.coco(data, labels, {0: "background", 1: "mug"})
    (data / "annotations.json").rename(data / "labels.json")
    for named in ("labels.json", "labels"):
        error = error_of(capsys, data, "--labels", named)
        assert ("labels.json lists 4 images of these names, and no shape in any of them" in error) == ("." in named)
        assert "type --labels" not in error


def test_masks_in_several_folders_are_found_together(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for i, path in enumerate(sorted((data / "labels").iterdir())):
        (data / f"masks/{i % 2}").mkdir(parents=True, exist_ok=True)
        path.rename(data / f"masks/{i % 2}" / path.name)
    assert "found 4 masks of these names in masks/: type --labels masks" in error_of(capsys, data)


def a_broken_link(data: Path) -> None:
    shutil.rmtree(data / "labels")
    (data / "labels").symlink_to("../unmounted")


def photos(data: Path) -> None:
    shutil.rmtree(data / "labels")
    (data / "images").mkdir()
    for i in range(6):
        Image.fromarray(np.zeros((48, 64, 3), np.uint8)).save(data / f"images/view{i}.png")


def other_names(data: Path) -> None:
    for path in (data / "labels").iterdir():
        path.rename(path.with_name(f"{path.stem}_seen.png"))


def other_files(data: Path) -> None:
    for path in (data / "labels").iterdir():
        path.rename(path.with_suffix(".tif"))


def other_files_beside(data: Path) -> None:
    other_files(data)
    (data / "labels").rename(data / "masks")
    (data / "images").mkdir()
    (data / "images/view0.png").touch()


def by_class(data: Path) -> None:
    for path in list((data / "labels").iterdir()):
        for label in (1, 2):
            (data / f"labels/{label}").mkdir(exist_ok=True)
            shutil.copy(path, data / f"labels/{label}")
        path.unlink()


def other_detections(data: Path) -> None:
    for path in list((data / "labels").iterdir()):
        (data / f"labels/{path.stem}_objects").mkdir()
        path.rename(data / f"labels/{path.stem}_objects/1.png")


def one_for_each_object(data: Path) -> None:
    for path in list((data / "labels").iterdir()):
        shutil.copy(path, data / f"labels/{path.stem}_1.png")
        path.rename(data / f"labels/{path.stem}_2.png")


def emptied(data: Path) -> None:
    shutil.rmtree(data / "labels")
    (data / "labels").mkdir()


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (photos, "there is no folder labels/ (images/ holds photos; a 2D segmenter makes masks of them)"),
        (other_names, "labels/ holds names such as view0_seen.png: rename them"),
        (other_files, "labels/ holds files such as view0.tif; expected label images as PNG, and probabilities as view"),
        (
            other_files_beside,
            "masks/ holds files such as view0.tif; expected label images as PNG, and probabilities as",
        ),
        (by_class, "labels/ has a folder for each class, such as 1/: make one for each view, labels/view"),
        (other_detections, "labels/ holds names such as view0_objects: rename them"),
        (one_for_each_object, "view0_1.png, several of a view: make a folder for each view, labels/view0/"),
        (emptied, "labels/ holds no mask"),
        (a_broken_link, "labels is a link to ../unmounted, which does not exist"),
        (lambda data: shutil.rmtree(data / "labels"), "there is no folder labels/"),
    ],
)
def test_a_dataset_without_masks_says_what_lies_in_their_place(
    data: Path, capsys: pytest.CaptureFixture[str], change: Callable[[Path], None], told: str
) -> None:
    change(data)
    assert told in error_of(capsys, data)


def into_npz(folder: Path) -> None:
    for path in list(folder.iterdir()):
        labels = read_mask(path).labels
        probabilities = np.stack([labels == k for k in range(labels.max() + 1)]).astype(np.float32)
        np.savez_compressed(path.with_suffix(".npz"), probabilities=probabilities)
        path.unlink()


def into_detections(folder: Path) -> None:
    for path in list(folder.iterdir()):
        labels = read_mask(path).labels
        (folder / path.stem).mkdir()
        for k in (1, 2, 3):
            Image.fromarray((labels == k).astype(np.float32)).save(folder / path.stem / f"{k}.tif")
        path.unlink()


@pytest.mark.parametrize("change", [into_npz, into_detections])
def test_soft_masks_in_a_folder_of_another_name_are_found_as_plain_ones_are(
    data: Path, capsys: pytest.CaptureFixture[str], change: Callable[[Path], None]
) -> None:
    change(data / "labels")
    (data / "labels").rename(data / "soft")
    error = error_of(capsys, data)
    assert ".npz, or a folder view" in error and "found 4 masks of these names in soft/" in error
    assert typed(error, "--labels") == ["soft"]
    assert all(view.has_mask for view in Dataset(data, "soft").views("train"))


def test_masks_below_the_folder_that_was_named_come_before_those_beside_it(
    data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (data / "coco/annotations").mkdir(parents=True)
    (data / "labels").rename(data / "true")
    images = {path.stem: np.array(Image.open(path)) for path in sorted((data / "true").iterdir())[:-1]}
    mask_writers.coco(data / "coco/annotations", images, {1: "mug", 2: "cup", 3: "box"})
    assert typed(error_of(capsys, data, "--labels", "coco"), "--labels") == ["coco/annotations"]
    assert typed(error_of(capsys, data), "--labels") == ["true"]


def test_a_folder_of_a_view_without_images_of_classes_says_what_is_there(
    data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (data / "labels/view0.png").rename(data / "mask.png")
    (data / "labels/view0").mkdir()
    for name in ("mask.jpg", "mask.json"):
        (data / "labels/view0" / name).touch()
    assert "labels/view0: holds no detections, but mask.jpg, mask.json; expected" in error_of(capsys, data)


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (
            [{"id": 1, "annotations": [], "data": {"image": "a.jpg"}}],
            "but Label Studio's own: export it as COCO; gsseg",
        ),
        ([{"id": 1, "image": "a.jpg", "annotation_id": 3, "lead_time": 2.5}], "but Label Studio's own: export it"),
        ({"size": {"height": 1, "width": 1}, "objects": []}, "but Supervisely's: export it as COCO; gsseg reads"),
        ({"a.jpg77": {"filename": "a.jpg", "size": 77, "regions": []}}, "but VIA's: export it as COCO; gsseg reads"),
        ([{"image_id": 1, "category_id": 2, "score": 0.9}], "but COCO's results alone: expected a whole file"),
    ],
)
def test_files_of_masks_that_are_not_read_are_refused_with_whose_they_are_and_what_to_do(
    data: Path, capsys: pytest.CaptureFixture[str], content: object, told: str
) -> None:
    (data / "project.json").write_text(json.dumps(content))
    assert f"not a file of masks in a known format, {told}" in error_of(capsys, data, "--labels", "project.json")


def test_masks_of_sam_as_pixels_are_refused_with_what_to_have_it_write(
    data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (data / "sam").mkdir()
    (data / "sam/view0.json").write_text(json.dumps([{"segmentation": [[True]], "predicted_iou": 0.9}]))
    error = error_of(capsys, data, "--labels", "sam", "--ids", "per-view")
    assert "view0.json, mask 0: 'segmentation' lists pixels or points; expected RLE (output_mode='coco_rle'" in error


def test_photos_in_the_place_of_masks_are_refused_as_photos(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photos(data)
    error = error_of(capsys, data, "--labels", "images")
    assert "view0.png: is RGB" in error and "ids themselves" in error


@pytest.mark.parametrize(
    ("file", "link"),
    [("colmap/sparse/7/cameras.bin", "sparse"), ("sparse/1/cameras.bin", "sparse/0"),
     ("a/b/cameras.json", "cameras.json"), ("model/transforms.json", "transforms.json")],
)  # fmt: skip
def test_cameras_below_the_masks_are_linked_to_where_they_are_read(data: Path, file: str, link: str) -> None:
    (data / "cameras.json").unlink()
    (data / file).parent.mkdir(parents=True)
    (data / file).touch()
    source = (data / file).parent if "sparse" in link else data / file
    assert camera_hint(data).endswith(f"type ln -s {source} {data}/{link}")


@pytest.mark.parametrize("file", ["cameras.json", "sparse/0/images.bin"])
def test_a_dataset_below_the_folder_that_was_given_is_found(tmp_path: Path, file: str) -> None:
    folder = tmp_path / "captures/room one"
    (folder / file).parent.mkdir(parents=True)
    (folder / file).with_name(file.rpartition("/")[2].replace("images", "cameras")).touch()
    assert typed(camera_hint(tmp_path / "captures"), "--data") == [str(folder)]


def test_cameras_above_or_beside_a_wrong_data_folder_are_found(data: Path) -> None:
    for wrong in (data / "labels", data / "scene.ply", data.parent / "dataa"):
        assert typed(camera_hint(wrong), "--data") == [str(data)]


def test_a_colmap_model_in_the_folder_itself_is_linked_to_where_it_is_read(tmp_path: Path) -> None:
    root = write_colmap(tmp_path / "from photos", text=True)
    with pytest.raises(CameraFileError) as caught:
        read_cameras(root)
    command = str(caught.value).partition("found COLMAP's cameras.txt and images.txt: type ")[2]
    subprocess.run(command, shell=True, check=True)
    assert [camera.name for camera in read_cameras(root)] == ["0001"]


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("poses_bounds.npy", "LLFF"),
        ("database.db", "mapper"),
        ("mesh_info.json", "ns-process-data polycam"),
        ("cameras.xml", "ns-process-data metashape"),
        ("sfm_data.json", "openMVG_main_openMVG2Colmap"),
        ("reconstruction.json", "opensfm export_colmap"),
        ("metadata.json", "ns-process-data record3d"),
    ],
)
def test_cameras_of_other_programs_are_recognised(tmp_path: Path, name: str, told: str) -> None:
    (tmp_path / "capture").mkdir()
    (tmp_path / "capture" / name).touch()
    assert told in camera_hint(tmp_path / "capture")


def test_a_folder_in_which_nothing_is_known_is_listed(tmp_path: Path) -> None:
    (tmp_path / "capture/photos").mkdir(parents=True)
    assert camera_hint(tmp_path / "capture/photos") == "; the folder is empty"
    assert camera_hint(tmp_path / "capture") == "; found photos/"


def test_a_folder_that_cannot_be_listed_is_still_said_to_have_no_cameras(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def denied(path: Path) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(Path, "iterdir", denied)
    with pytest.raises(CameraFileError, match=r"has no cameras; looked for cameras\.json"):
        read_cameras(tmp_path)


def test_a_folder_in_the_place_of_a_scene_leads_to_the_ply_of_most_steps(
    data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for steps in (7000, 30000):
        (data / f"model/point_cloud/iteration_{steps}").mkdir(parents=True)
        shutil.copy(data / "scene.ply", data / f"model/point_cloud/iteration_{steps}/point_cloud.ply")
    (data / "model/input.ply").write_text("ply\n")  # COLMAP's points, which the trainer copies
    error = error_of(capsys, data, scene="model")
    assert error.endswith(f"; type {data}/model/point_cloud/iteration_30000/point_cloud.ply")
    assert error_of(capsys, data, scene="scen.ply").endswith(f"found scene.ply in {data}")
    (data / "nothing").mkdir()
    assert scene_hint(data / "nothing") == "; no scene lies in it"
    assert scene_hint(data / "no/where/scene.ply") == ""


def test_hints_do_not_read_a_large_tree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for i in range(30):
        (tmp_path / f"a{i}/b/c/d/e").mkdir(parents=True)
    seen: list[Path] = []
    iterdir = Path.iterdir
    monkeypatch.setattr(Path, "iterdir", lambda self: (seen.append(self), iterdir(self))[1])
    assert "there is no folder labels/" in mask_hint(tmp_path, "labels", ["x"])
    assert not [path for path in seen if len(path.relative_to(tmp_path).parts) > 3]
