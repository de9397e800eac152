"""Views of every second or fourth pixel: they see what those pixels saw, and learning from them finds the objects."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import small_scenes
from hypothesis import given
from hypothesis import strategies as st

from gsseg_core import pipeline
from gsseg_core.cli.arguments import build_parser
from gsseg_core.data.label_images import write_mask
from gsseg_core.data.view import QUALITIES, View
from gsseg_core.errors import SettingsError
from gsseg_core.scene.camera import Camera, smaller_camera, undistorted_camera
from gsseg_core.scene.lens import MODELS_BY_NAME, Lens
from gsseg_core.scene.undistortion import undistortions
from gsseg_core.segmentation import Segmentation

STEPS = sorted(set(QUALITIES.values()) - {1})


def a_camera(width: int, height: int) -> Camera:
    K = np.array([[70.0, 0, width / 3], [0, 65.0, height / 1.7], [0, 0, 1]])
    return Camera("a", width, height, K, np.eye(4))


@given(width=st.integers(5, 40), height=st.integers(5, 40), step=st.sampled_from(STEPS), seed=st.integers(0, 99))
def test_pixels_of_a_smaller_camera_are_centred_on_those_that_are_kept(
    width: int, height: int, step: int, seed: int
) -> None:
    points = np.random.default_rng(seed).normal((0, 0, 5), size=(20, 3))
    camera = a_camera(width, height)
    uv, _ = camera.project(points)
    small, _ = smaller_camera(camera, step).project(points)
    np.testing.assert_allclose((small - 0.5) * step + step // 2 + 0.5, uv, atol=1e-9)


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("size", [(37, 22), (40, 24), (5, 41)])
def test_masks_in_files_and_in_memory_keep_the_same_pixels(tmp_path: Path, size: tuple[int, int], step: int) -> None:
    camera, rng = a_camera(*size), np.random.default_rng(0)
    labels = rng.integers(0, 5, (camera.height, camera.width)).astype(np.int32)
    write_mask(tmp_path / "a.png", labels, 8)
    kept = labels[step // 2 :: step, step // 2 :: step]
    for view in (View(camera, tmp_path / "a.png"), View.from_arrays(camera, labels)):
        small = view.smaller(step)
        assert (small.camera.height, small.camera.width) == kept.shape
        np.testing.assert_array_equal(small.read_labels(), kept)
        assert view.smaller(1) is view


def test_a_mask_behind_a_lens_keeps_every_second_pixel_of_its_pinhole_view(tmp_path: Path) -> None:
    lens = Lens(MODELS_BY_NAME["OPENCV"], 60, 44, (50.0, 52.0), (29.0, 23.0), (-0.1, 0.02, 0.001, 0.0))
    camera = undistorted_camera("a", undistortions(lens)[0], np.eye(4))
    write_mask(tmp_path / "a.png", np.arange(44 * 60, dtype=np.int32).reshape(44, 60), 16)
    view = View(camera, tmp_path / "a.png")
    np.testing.assert_array_equal(view.smaller(2).read_labels(), view.read_labels()[1::2, 1::2])


def test_a_view_without_such_a_pixel_stays_as_it_is() -> None:
    view = View.from_arrays(a_camera(1, 9), np.zeros((9, 1), np.int32))
    assert view.smaller(2) is view


@pytest.mark.parametrize("learner", ["em", "votes"])
def test_half_the_rows_and_columns_find_the_objects(tmp_path: Path, learner: str) -> None:
    data = small_scenes.write_dataset(tmp_path / "data")
    report = pipeline.segment(data / "scene.ply", data, tmp_path / "out", learner=learner, quality="half")
    assert report["settings"]["quality"] == "half"
    scene, truth = small_scenes.balls_on_a_table()
    assert (Segmentation.load(tmp_path / "out/segmentation.npz", scene).labels == truth).mean() > 0.9
    assert json.loads((tmp_path / "out/report.json").read_text())["settings"]["quality"] == "half"


def test_the_command_offers_the_qualities_there_are_and_others_are_refused(tmp_path: Path) -> None:
    for quality in QUALITIES:
        options = build_parser().parse_args(["segment", "s", "--data", "d", "--out", "o", "--quality", quality])
        assert options.quality == quality
    with pytest.raises(SettingsError, match="quality is 'best'; expected one of full, half, quarter"):
        pipeline.segment("scene.ply", tmp_path, tmp_path / "out", quality="best")
