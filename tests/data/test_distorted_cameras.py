"""Lenses in camera files: what an image of any model shows of a point is at its place in the view, in every format."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_folders import POINT, WORLD_TO_CAMERA, assert_refused, transforms, write_colmap, write_json
from lens_cases import COEFFICIENTS, HEIGHT, WIDTH, colmap_camera, colmap_params
from PIL import Image

from gsseg_core.data.dataset import Dataset
from gsseg_core.data.label_images import UNKNOWN, write_mask
from gsseg_core.errors import IntrinsicsError, MaskSizeError
from gsseg_core.scene.lens import MODELS_BY_NAME

MARK = 3


def write_image_of_point(root: Path, name: str) -> None:
    """Write the mask of an image that a lens took, MARK where COLMAP has POINT land and 1 elsewhere; and a photo."""
    place = (WORLD_TO_CAMERA @ [*POINT, 1])[:3]
    column, row = colmap_camera(name).img_from_cam(place).ravel().astype(int)
    labels = np.ones((HEIGHT, WIDTH), np.int32)
    labels[row - 2 : row + 3, column - 2 : column + 3] = MARK
    write_mask(root / "labels" / "0001.png", labels, 8)
    (root / "images").mkdir()
    Image.fromarray((labels == MARK).astype(np.uint8) * 255).convert("RGB").save(root / "images" / "0001.png")


def assert_point_is_seen(root: Path) -> None:
    seen = 0
    for view in Dataset(root).views("train"):
        labels, photo = view.read_labels(), view.read_photo()
        assert photo is not None and photo.shape == (*labels.shape, 3)
        uv, depth = view.camera.project([POINT])
        if depth[0] > 0 and ((uv >= 0) & (uv < (view.camera.width, view.camera.height))).all():
            column, row = uv[0].astype(int)
            assert labels[row, column] == MARK and photo[row, column].min() > 250
            seen += 1
        assert set(np.unique(labels)) <= {1, MARK, UNKNOWN}
    assert seen == 1


@pytest.mark.parametrize("text", [False, True], ids=["bin", "txt"])
@pytest.mark.parametrize("name", COEFFICIENTS)
def test_a_point_of_a_colmap_image_is_at_its_place_in_the_view(tmp_path: Path, name: str, text: bool) -> None:
    size = (WIDTH, HEIGHT)
    write_colmap(tmp_path / "sparse" / "0", model=name, params=tuple(colmap_params(name)), text=text, size=size)
    write_image_of_point(tmp_path, name)
    assert_point_is_seen(tmp_path)


def of_nerfstudio(name: str) -> dict[str, Any]:
    params, names = colmap_params(name), MODELS_BY_NAME[name].coefficients
    coefficients = dict(zip(names, COEFFICIENTS[name], strict=False))
    content = {"camera_model": name, "w": WIDTH, "h": HEIGHT, **coefficients}
    if name == "EQUIRECTANGULAR":
        return content | {"fl_x": None, "fl_y": None, "cx": None, "cy": None}
    *focal, cx, cy = params[: len(params) - len(coefficients)]
    return content | {"fl_x": focal[0], "fl_y": focal[-1], "cx": cx, "cy": cy}


@pytest.mark.parametrize("name", COEFFICIENTS)
def test_a_point_of_a_nerfstudio_image_is_at_its_place_in_the_view(tmp_path: Path, name: str) -> None:
    write_json(tmp_path / "transforms.json", transforms(**of_nerfstudio(name)))
    write_image_of_point(tmp_path, name)
    assert_point_is_seen(tmp_path)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("OPENCV", {"camera_model": None}),
        ("OPENCV", {"camera_model": "PINHOLE"}),
        ("OPENCV_FISHEYE", {"camera_model": None, "is_fisheye": True}),
        ("OPENCV_FISHEYE", {"camera_model": "OPENCV", "is_fisheye": True}),
    ],
)
def test_nerfstudio_files_that_say_their_model_otherwise_are_understood(
    tmp_path: Path, name: str, said: dict[str, Any]
) -> None:
    write_json(tmp_path / "transforms.json", transforms(**of_nerfstudio(name) | said))
    write_image_of_point(tmp_path, name)
    assert_point_is_seen(tmp_path)


def test_every_frame_may_have_a_lens_of_its_own(tmp_path: Path) -> None:
    content = transforms(frame=of_nerfstudio("OPENCV_FISHEYE"), camera_model="OPENCV", k1=-9.0)
    write_json(tmp_path / "transforms.json", content)
    write_image_of_point(tmp_path, "OPENCV_FISHEYE")
    assert_point_is_seen(tmp_path)


def test_a_panorama_has_six_views_wherever_its_stem_is_named(tmp_path: Path) -> None:
    frames = transforms()["frames"] + transforms("images/0002.png")["frames"]
    write_json(tmp_path / "transforms.json", transforms(**of_nerfstudio("EQUIRECTANGULAR"), frames=frames))
    write_json(tmp_path / "split.json", {"train": ["0001"], "test": ["0002"]})
    write_image_of_point(tmp_path, "EQUIRECTANGULAR")
    write_json(tmp_path / "labels" / "supervises.json", {"0001": [1, MARK]})
    dataset = Dataset(tmp_path)
    names = [f"0001_{face}" for face in ("front", "right", "back", "left", "up", "down")]
    assert [view.name for view in dataset.views("train")] == names
    assert [view.name for view in dataset.views("test")] == [name.replace("0001", "0002") for name in names]
    seen = [view.read_seen() for view in dataset.views("train")]
    assert all(mask.evidence is not None and mask.evidence.supervised.tolist() == [1, MARK] for mask in seen)
    assert not any(view.has_mask for view in dataset.views("test"))


def test_probabilities_are_undistorted_as_labels_are_and_unknown_outside(tmp_path: Path) -> None:
    write_json(tmp_path / "transforms.json", transforms(**of_nerfstudio("OPENCV")))
    write_image_of_point(tmp_path, "OPENCV")
    (view,) = Dataset(tmp_path).views()
    labels = view.read_labels()
    of_image = np.asarray(Image.open(tmp_path / "labels" / "0001.png"))
    probabilities = np.stack([of_image == c for c in range(MARK + 1)]) * np.float32(0.75)
    (tmp_path / "labels" / "0001.png").unlink()
    np.savez(tmp_path / "labels" / "0001.npz", probabilities=probabilities)
    (view,) = Dataset(tmp_path).views()
    seen = view.read_seen()
    np.testing.assert_array_equal(seen.named(), labels)
    assert seen.evidence is not None and seen.evidence.mass is not None
    assert np.unique(seen.labels[seen.labels >= 0]).tolist() == list(range(len(seen.evidence.mass)))


def test_a_mask_of_the_size_of_the_view_is_refused_with_the_size_of_the_image(tmp_path: Path) -> None:
    write_json(tmp_path / "transforms.json", transforms(**of_nerfstudio("OPENCV")))
    (view,) = Dataset(tmp_path).views()
    write_mask(tmp_path / "labels" / "0001.png", np.zeros((view.camera.height, view.camera.width), np.int32), 8)
    with pytest.raises(MaskSizeError, match=rf"0001\.png.* expected {WIDTH} x {HEIGHT}"):
        Dataset(tmp_path).views()[0].read_seen()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"k1": math.nan}, ("entry 0", "k1 = nan")),
        ({"k1": 1e300}, ("entry 0", "lens OPENCV", "is it calibrated for")),
        ({"k1": -50}, ("entry 0", "cannot be undone")),
        ({"k6": 0.1}, ("entry 0", "lens OPENCV: has k6 = 0.1; expected k1, k2, p1, p2, k3, k4")),
        ({"camera_model": "OPENCV_FISHEYE", "k1": -9}, ("entry 0", "lens OPENCV_FISHEYE", "cannot be undone")),
        ({"camera_model": "EQUIRECTANGULAR", "w": 0}, ("entry 0", "at least 1 x 1")),
        ({"camera_model": "FISHEYE624"}, ("entry 0", "FISHEYE624; expected", "THIN_PRISM_FISHEYE")),
    ],
)
def test_absurd_lenses_of_a_nerfstudio_file_are_refused(
    tmp_path: Path, changes: dict[str, Any], words: tuple[str, ...]
) -> None:
    write_json(tmp_path / "transforms.json", transforms(**changes))
    assert_refused(tmp_path, IntrinsicsError, "transforms.json", *words)


@pytest.mark.parametrize(
    ("model", "params", "words"),
    [
        ("SIMPLE_RADIAL", (100, 32, 24, -99), ("cannot be undone",)),
        ("SIMPLE_RADIAL", (100, 32, 24, math.nan), ("k1 = nan",)),
        ("OPENCV", (100, 100, 32, 24, 1e9, 0, 0, 0), ("without its distortion",)),
        ("FOV", (100, 100, 32, 24, 0.5), ("camera is FOV", "expected one of", "undistort the images first")),
    ],
)
def test_absurd_lenses_of_a_colmap_model_are_refused(
    tmp_path: Path, model: str, params: tuple[float, ...], words: tuple[str, ...]
) -> None:
    write_colmap(tmp_path / "sparse" / "0", model=model, params=params)
    assert_refused(tmp_path, IntrinsicsError, "room/0001.jpg", *words)
