"""The commands on images that a lens bent: what they write is of pinhole views, and what they compare is, too."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from small_scenes import HEIGHT, WIDTH, balls_on_a_table, look_at, ring, true_labels, write_dataset

from gsseg_core.cli.main import main
from gsseg_core.data.dataset import Dataset
from gsseg_core.data.label_images import write_mask
from gsseg_core.files.json_files import write_json
from gsseg_core.scene.lens import MODELS_BY_NAME, Lens

LENS = Lens(MODELS_BY_NAME["OPENCV"], WIDTH, HEIGHT, (55.0, 55.0), (WIDTH / 2, HEIGHT / 2), (-0.2, 0.03))


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of five bent images with photos, and what `segment` and `render` make of it."""
    place = tmp_path_factory.mktemp("lenses")
    write_dataset(place / "data")
    for path in (place / "data" / "labels").iterdir():
        path.unlink()
    for name in ("cameras.json", "split.json"):
        (place / "data" / name).unlink(missing_ok=True)
    (place / "data" / "images").mkdir(exist_ok=True)
    scene, truth = balls_on_a_table()
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = LENS.rays(np.stack([columns, rows], axis=-1))
    frames = []
    for camera in ring(5):
        # A pinhole that sees all that the lens does, four times as finely.
        wide = look_at(camera.name, camera.center, 4 * 96, 4 * 72, 4 * 55.0)
        uv = rays[..., :2] / rays[..., 2:] * 4 * 55.0 + (4 * 48, 4 * 36)
        labels = true_labels(scene, truth, wide)[uv[..., 1].astype(int), uv[..., 0].astype(int)]
        write_mask(place / "data" / "labels" / f"{camera.name}.png", labels, 8)
        photo = np.repeat(60 * labels[..., None], 3, axis=2).astype(np.uint8)
        Image.fromarray(photo).save(place / "data" / "images" / f"{camera.name}.png")
        pose = np.linalg.inv(camera.world_to_camera) @ np.diag([1, -1, -1, 1])
        frames.append({"file_path": camera.name, "transform_matrix": pose.tolist()})
    intrinsics = {"fl_x": 55.0, "fl_y": 55.0, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT}
    content = {**intrinsics, "camera_model": "OPENCV", "k1": -0.2, "k2": 0.03, "frames": frames}
    write_json(place / "data" / "transforms.json", content)
    write_json(place / "data" / "split.json", {"train": [f"view{i}" for i in range(4)], "test": ["view4"]})
    inputs = [f"{place}/data/scene.ply", "--data", f"{place}/data", "--quiet"]
    assert main(["segment", *inputs, "--out", f"{place}/out", "--learner", "votes"]) == 0
    assert main(["render", *inputs, "--out", f"{place}/maps", "--segmentation", f"{place}/out/segmentation.npz"]) == 0
    return place


def test_label_maps_are_those_of_the_pinhole_view_and_score_against_bent_truth(place: Path) -> None:
    camera = Dataset(place / "data").views("test")[0].camera
    with Image.open(place / "maps" / "view4.png") as rendered:
        assert rendered.size == (camera.width, camera.height) != (WIDTH, HEIGHT)
    scores = place / "scores.json"
    arguments = ["--pred", f"{place}/maps", "--truth", f"{place}/data/labels", "--json", str(scores)]
    assert main(["eval", *arguments]) == 0
    assert json.loads(scores.read_text())["mean_iou"] > 0.9


def test_an_object_is_picked_by_a_mask_drawn_on_the_bent_photo(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    inputs = [
        f"{place}/data/scene.ply",
        "--data",
        f"{place}/data",
        "--quiet",
        "--view",
        "view0",
        "--out",
        f"{tmp_path}/o",
    ]
    mask = place / "data" / "labels" / "view0.png"
    assert main(["pick", *inputs, "--mask", str(mask), "--label", "1"]) == 0
    _, truth = balls_on_a_table()
    picked = np.load(tmp_path / "o" / "pick.npz")["ids"]
    assert (truth[picked] == 1).mean() > 0.8
    write_mask(tmp_path / "small.png", np.ones((9, 9), np.int32), 8)
    assert main(["pick", *inputs, "--mask", f"{tmp_path}/small.png"]) == 2
    assert f"small.png: is for an image of 9 x 9 pixels; expected {WIDTH} x {HEIGHT}" in capsys.readouterr().err


def test_the_report_shows_photos_without_the_distortion(place: Path) -> None:

    for view in Dataset(place / "data").views():
        photo = view.read_photo()
        assert photo is not None and photo.shape == (view.camera.height, view.camera.width, 3)
        near = np.abs(photo[..., 0].astype(int) - 60 * np.maximum(view.read_labels(), 0)) < 30
        assert near.mean() > 0.9
