"""One object from one view or a few: a mask in it gives the object in 3D, and what it hides is not the object."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import small_scenes
from mask_writers import PER_VIEW_WRITERS, WRITERS
from PIL import Image
from small_scenes import NAMES

from gsseg_core.cli.main import main
from gsseg_core.data.label_images import write_mask
from gsseg_core.data.view import View
from gsseg_core.errors import MaskFormatError, MaskSizeError, NoUsableViewsError, SettingsError
from gsseg_core.objects.pick import Pick, pick_mask, pick_masks, read_object_mask
from gsseg_core.raster.backends import make_operator
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene

SCENE, TRUTH = small_scenes.balls_on_a_table()
CAMERA = small_scenes.ring(1)[0]
LABELS = small_scenes.true_labels(SCENE, TRUTH, CAMERA)


def iou_of_gaussians(picked: Pick, label: int) -> float:
    mine, true = picked.membership >= 0.5, label == TRUTH
    return float((mine & true).sum() / (mine | true).sum())


@pytest.mark.parametrize("label", [1, 2, 3])
def test_a_mask_in_one_view_gives_the_object_in_the_others(label: int) -> None:
    picked = pick_mask(SCENE, View.from_arrays(CAMERA, (label == LABELS).astype(int)))
    assert iou_of_gaussians(picked, label) > 0.85
    for camera in small_scenes.ring(3, turn=0.4):
        true = small_scenes.true_labels(SCENE, TRUTH, camera) == label
        seen = picked.silhouette(SCENE, camera)
        assert (seen & true).sum() / max((seen | true).sum(), 1) > 0.6


def test_what_shines_through_a_surface_tells_of_what_lies_just_under_it() -> None:
    operator = make_operator(SCENE, CAMERA)
    picked = pick_mask(SCENE, View.from_arrays(CAMERA, (LABELS == 1).astype(int)))
    np.testing.assert_allclose(picked.evidence, operator.visibility(), atol=1e-3)
    lifted = operator.observe((LABELS == 1).astype(np.int32))
    assert (picked.evidence > 0).sum() > len(lifted.ids)


def test_what_lies_behind_the_mask_is_not_the_object() -> None:
    """A wall that a panel hides, but for its rim: the mask of the panel covers it and says nothing of it."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(-1.2, 1.2, 17), np.linspace(-1.2, 1.2, 17)))
    wall, panel = np.stack([x, y, 0 * x], axis=1), np.stack([x / 2, y / 2, 0 * x + 1.2], axis=1)
    truth = np.repeat([0, 1], len(x))
    scene = small_scenes.build(truth, np.concatenate([wall, panel]), np.full((2 * len(x), 3), [[0.1, 0.1, 0.02]]))
    camera = small_scenes.look_at("front", np.array([0.0, 0.0, 4.0]))
    labels = small_scenes.true_labels(scene, truth, camera)
    picked = pick_mask(scene, View.from_arrays(camera, labels))
    behind = (truth == 0) & (np.abs(scene.means[:, :2]).max(axis=1) < 0.5)
    assert behind.sum() > 20
    assert (picked.membership[behind] < 0.5).all()
    assert (picked.membership[truth == 1] >= 0.5).mean() > 0.95


def test_scribbles_of_both_kinds_are_enough() -> None:
    labels = np.full_like(LABELS, -1)
    for k, wanted in ((1, LABELS == 2), (0, LABELS != 2)):
        rows, columns = np.nonzero(wanted)
        few = slice(None, None, 7)
        labels[rows[few], columns[few]] = k
    assert iou_of_gaussians(pick_mask(SCENE, View.from_arrays(CAMERA, labels)), 2) > 0.7


def test_what_is_far_is_no_object_because_a_trace_of_light_comes_from_it() -> None:
    """Room behind room: of what is hidden, every vote is one for the object, and there is next to none."""
    near, far = (np.random.default_rng(k).uniform(-0.5, 0.5, (400, 3)) for k in range(2))
    truth = np.repeat([1, 0], 400)
    scene = small_scenes.build(truth, np.concatenate([near, 8 * far - [0, 0, 20]]), np.full((800, 3), 0.1))
    camera = small_scenes.look_at("front", np.array([0.0, 0.0, 4.0]))
    labels = small_scenes.true_labels(scene, truth, camera)
    picked = pick_mask(scene, View.from_arrays(camera, labels))
    assert (picked.membership[truth == 0] >= 0.5).mean() < 0.02
    assert (picked.membership[truth == 1] >= 0.5).mean() > 0.9


def test_the_unit_of_length_does_not_matter() -> None:
    view = View.from_arrays(CAMERA, (LABELS == 1).astype(int))
    small = GaussianScene.from_arrays(SCENE.means / 64, SCENE.quats, SCENE.scales / 64, SCENE.opacities, SCENE.sh)
    moved = CAMERA.world_to_camera.copy()
    moved[:3, 3] /= 64
    near = Camera("near", CAMERA.width, CAMERA.height, CAMERA.K, moved)
    picked = [pick_mask(SCENE, view), pick_mask(small, View.from_arrays(near, view.read_labels()))]
    assert np.abs(picked[0].membership - picked[1].membership).max() < 0.01


def test_prompts_that_say_nothing_are_refused() -> None:
    everything, other = (View.from_arrays(CAMERA, np.full_like(LABELS, k)) for k in (1, 2))
    with pytest.raises(NoUsableViewsError, match="label 0"):
        pick_mask(SCENE, everything)
    with pytest.raises(SettingsError, match="expected 1"):
        pick_mask(SCENE, other)


def test_a_second_mask_adds_to_the_first_and_the_view_that_tells_most_is_not_the_same_again() -> None:
    around = small_scenes.ring(5)
    masks = [
        View.from_arrays(camera, (small_scenes.true_labels(SCENE, TRUTH, camera) == 2).astype(int)) for camera in around
    ]
    first = pick_mask(SCENE, masks[0])
    following = first.next_view(SCENE, around)
    assert following != 0
    both, turned = (pick_masks(SCENE, pair) for pair in ([masks[0], masks[following]], [masks[following], masks[0]]))
    assert iou_of_gaussians(both, 2) >= iou_of_gaussians(first, 2)
    np.testing.assert_allclose(both.membership, turned.membership, atol=1e-4)
    assert (both.evidence >= first.evidence).all()
    with pytest.raises(SettingsError, match="expected a view that has no mask yet"):
        first.next_view(SCENE, [])
    with pytest.raises(SettingsError, match="expected at least one view"):
        pick_masks(SCENE, [])


def test_drawn_masks_are_read_black_and_white_or_by_label(tmp_path: Path) -> None:
    small = Camera("small", 4, 1, np.eye(3), np.eye(4))
    write_mask(tmp_path / "drawn.png", np.array([[-1, 0, 0, 0]]), 8)  # written as 255, white
    assert read_object_mask(tmp_path / "drawn.png", small).tolist() == [[1, 0, 0, 0]]
    write_mask(tmp_path / "labels.png", np.array([[3, 5, 0, -1]]), 8)
    assert read_object_mask(tmp_path / "labels.png", small).tolist() == [[1, 1, 0, -1]]
    assert read_object_mask(tmp_path / "labels.png", small, 5).tolist() == [[0, 1, 0, -1]]
    with pytest.raises(MaskFormatError, match="expected pixels with the label 7"):
        read_object_mask(tmp_path / "labels.png", small, 7)
    assert read_object_mask(tmp_path / "labels.png", small, "cup", {3: "box", 5: "cup"}).tolist() == [[0, 1, 0, -1]]
    with pytest.raises(SettingsError, match=r"labels\.png: label is 'cup'; expected a number"):
        read_object_mask(tmp_path / "labels.png", small, "cup")
    with pytest.raises(
        SettingsError, match=r"^classes\.json: 2 classes have the name 'cup'; expected one of their ids"
    ):
        read_object_mask(tmp_path / "labels.png", small, "cup", {3: "cup", 5: "cup"})
    with pytest.raises(MaskSizeError, match="for an image of 4 x 1 pixels"):
        read_object_mask(tmp_path / "labels.png", CAMERA)


def test_of_a_black_and_white_mask_with_soft_edges_the_white_is_the_object(tmp_path: Path) -> None:
    camera = Camera("soft", 64, 48, np.eye(3), np.eye(4))
    rows, columns = np.mgrid[:96, :128]
    disc = ((rows - 40) ** 2 + (columns - 70) ** 2 < 24**2).reshape(48, 2, 64, 2).mean(axis=(1, 3))
    Image.fromarray(np.rint(255 * disc).astype(np.uint8)).save(tmp_path / "soft.png")
    np.testing.assert_array_equal(read_object_mask(tmp_path / "soft.png", camera), disc >= 0.5)
    # Ids beside much that is unknown stay ids.
    labels = np.where(disc == 1, 254, np.where(disc > 0, 80, -1))
    write_mask(tmp_path / "ids.png", labels, 8)
    np.testing.assert_array_equal(read_object_mask(tmp_path / "ids.png", camera), np.where(disc > 0, 1, -1))


@pytest.mark.parametrize("name", [*WRITERS, *PER_VIEW_WRITERS])
def test_a_mask_of_any_program_is_that_of_the_label_image(tmp_path: Path, name: str) -> None:
    place = (WRITERS | PER_VIEW_WRITERS)[name](tmp_path, {CAMERA.name: LABELS}, NAMES)
    if place.is_dir() and not any(path.is_dir() for path in place.iterdir()):
        file = next(path for path in place.iterdir() if path.stem == CAMERA.name)
        place = file.rename(file.with_name(f"drawn{file.suffix}"))
    np.testing.assert_array_equal(read_object_mask(place, CAMERA), LABELS > 0)


def test_an_object_of_another_program_is_asked_for_by_name(tmp_path: Path) -> None:
    labels = LABELS.copy()
    labels[:2] = 2
    place = WRITERS["COCO text"](tmp_path, {CAMERA.name: labels}, NAMES)
    np.testing.assert_array_equal(read_object_mask(place, CAMERA, NAMES[2]), labels == 2)
    with pytest.raises(SettingsError, match=r"\.json: class 'lamp' does not exist; expected one of 0"):
        read_object_mask(place, CAMERA, "lamp")


def test_the_command_writes_a_ply_and_the_ids(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = small_scenes.write_dataset(tmp_path / "data")
    start = ["pick", str(data / "scene.ply"), "--data", str(data), "--view", "view0", "--quiet"]
    by_mask = ["--mask", str(data / "labels/view0.png"), "--label", "1", "--out", str(tmp_path / "mask")]
    assert main(start + by_mask) == 0
    with np.load(tmp_path / "mask/pick.npz") as file:
        ids, membership, header = file["ids"], file["membership"], json.loads(str(file["header"]))
        assert membership.shape == (len(SCENE),)
    scene = GaussianScene.load(data / "scene.ply")
    assert header.pop("run") and header == {"format": "gsseg-pick-1", "scene": scene.digest}
    np.testing.assert_array_equal(GaussianScene.load(tmp_path / "mask/object.ply").means, scene.means[ids])
    assert (tmp_path / "mask/pick.png").is_file()
    told = re.search(r"a mask of view '(view\d)' would help most", capsys.readouterr().out)
    assert told and (tmp_path / "mask/next.png").is_file()
    again = told[1]
    assert main([*start, *by_mask[:4], "--view", again, "--mask", str(data / f"labels/{again}.png"), *by_mask[4:]]) == 0
    with np.load(tmp_path / "mask/pick.npz") as file:
        assert not np.array_equal(file["membership"], membership)
    for wrong, expected in (("nowhere", "has no view 'nowhere'"), ("view0", "of 1 views, and --mask 1 times")):
        assert main([*start, "--view", wrong, *by_mask]) == 2
        assert expected in capsys.readouterr().err


@pytest.mark.parametrize(("scene_format", "file"), [("spz", "object.spz"), ("usd", "object.usdc")])
def test_the_command_writes_the_format_asked_for_and_a_mesh(tmp_path: Path, scene_format: str, file: str) -> None:
    data = small_scenes.write_dataset(tmp_path / "data")
    start = ["pick", f"{data}/scene.ply", "--data", str(data), "--view", "view0", "--quiet", "--out", f"{tmp_path}/o"]
    mask = ["--mask", f"{data}/labels", "--label", "1"]
    assert main([*start, *mask, "--format", scene_format, "--collision"]) == 0
    assert {path.name for path in (tmp_path / "o").glob("object*")} == {"object.obj", file}
