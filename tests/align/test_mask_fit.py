"""Masks that do not lie on what they show: padded, cut out, mirrored, moved; and what is said of right ones."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gsseg_core.align.agreement import Agreement, Pictures, look_at
from gsseg_core.align.mask_fit import THOROUGH, how_they_lie
from gsseg_core.align.placing import place
from gsseg_core.align.settings import AlignSettings
from gsseg_core.cli.main import main
from gsseg_core.data.dataset import Dataset
from gsseg_core.data.label_images import write_mask
from gsseg_core.data.view import View
from gsseg_core.errors import AlignmentError
from gsseg_core.export.view_pictures import background_image
from gsseg_core.raster.backends import make_operator
from gsseg_core.report.findings import frame_of, warnings_of
from gsseg_core.scene.gaussian_scene import GaussianScene

SETTINGS = AlignSettings(views=THOROUGH)
Change = Callable[[Image.Image], Image.Image]


def padded(mask: Image.Image) -> Image.Image:
    """As a network sees an image that was padded to a square, squeezed to the image's size."""
    square = Image.new(mask.mode, (mask.width, mask.width))
    square.paste(mask, (0, (mask.width - mask.height) // 2))
    return square.resize(mask.size, Image.Resampling.NEAREST)


def cut(mask: Image.Image) -> Image.Image:
    """The square in the middle, stretched to the image's size."""
    left = (mask.width - mask.height) // 2
    return mask.resize(mask.size, Image.Resampling.NEAREST, (left, 0, left + mask.height, mask.height))


def zoomed(mask: Image.Image) -> Image.Image:
    middle = (0.1 * mask.width, 0.1 * mask.height, 0.9 * mask.width, 0.9 * mask.height)
    return mask.resize(mask.size, Image.Resampling.NEAREST, middle)


def moved(mask: Image.Image) -> Image.Image:
    return Image.fromarray(np.roll(np.asarray(mask), (-25, 33), (0, 1)))


CHANGES: dict[str, tuple[Change, str]] = {
    "padded": (padded, "if masks are stretched, which undoes padding the images to squares$"),
    "cut": (cut, "if masks are squeezed, which undoes cutting squares out of the images$"),
    "mirrored": (lambda mask: mask.transpose(Image.Transpose.FLIP_LEFT_RIGHT), "if masks are mirrored$"),
    "upside down": (lambda mask: mask.transpose(Image.Transpose.FLIP_TOP_BOTTOM), "if masks are upside down$"),
    "turned": (lambda mask: mask.transpose(Image.Transpose.ROTATE_180), "if masks are turned by half$"),
    "zoomed": (zoomed, "if masks are shrunk to 80 %$"),
    "moved": (moved, r"if masks are moved by [89] % left and [567] % down \(of the longer side\)$"),
}


@pytest.fixture(scope="module")
def data(demo_run: Path) -> Dataset:
    return Dataset(demo_run / "scene")


@pytest.fixture(scope="module")
def pictures(demo_run: Path) -> Pictures:
    return Pictures.of(GaussianScene.load(demo_run / "scene/scene.ply"), SETTINGS)


def changed(view: View, change: Change) -> View:
    return View.from_arrays(view.camera, np.asarray(change(Image.fromarray(view.read_labels()))).astype(np.int32))


@pytest.mark.parametrize("name", CHANGES)
def test_it_is_said_how_masks_would_lie_on_what_they_show(name: str, data: Dataset, pictures: Pictures) -> None:
    change, said = CHANGES[name]
    told = str(how_they_lie(pictures, look_at([changed(view, change) for view in data.views("train")], SETTINGS)))
    assert told.startswith("masks do not lie on what they show: their outlines agree with edges of the scene by 0.")
    assert re.search(said, told)


def test_nothing_is_said_of_masks_that_lie_there_of_masks_of_anything_else_and_of_few(
    data: Dataset, pictures: Pictures
) -> None:
    views = data.views("train")
    assert how_they_lie(pictures, look_at(views, SETTINGS)).change == ""
    rng = np.random.default_rng(0)
    blobs = [np.kron(rng.integers(0, 9, (5, 8)), np.ones((60, 50), int)).astype(np.int32) for _ in views]
    elsewhere = [View.from_arrays(view.camera, blob) for view, blob in zip(views, blobs, strict=True)]
    assert how_they_lie(pictures, look_at(elsewhere, SETTINGS)).change == ""
    mirrored = [changed(view, CHANGES["mirrored"][0]) for view in views]
    assert how_they_lie(pictures, look_at(mirrored[::6], SETTINGS)).change == ""
    assert how_they_lie(pictures, look_at(mirrored[::5], SETTINGS)).change != ""
    assert how_they_lie(pictures, look_at(mirrored[::5] * 3, SETTINGS)).change != ""
    assert how_they_lie(pictures, look_at(mirrored[::6] * 3, SETTINGS)).change == "", (
        "more from the same places tell no more"
    )
    assert how_they_lie(pictures, [], 0).change == ""


def test_masks_of_real_scenes_as_they_came_lie_on_what_they_show(real_data: Path) -> None:
    for name in ("kitchen_table", "replica_apartment", "shelf", "workbench"):
        scene = GaussianScene.load(real_data / name / "scene.ply")
        for labels in ("labels", "labels_noisy", "labels_parts"):
            if (real_data / name / labels).exists():
                masks = place(scene, Dataset(real_data / name, labels), check=True).masks
                assert masks is not None and masks.agrees and not masks.misplaced, (name, labels, masks)
        views = Dataset(real_data / name, "labels_noisy").views("train")
        beside = look_at([changed(view, CHANGES["moved"][0]) for view in views], SETTINGS)
        told = str(how_they_lie(Pictures.of(scene, SETTINGS), beside))
        assert "if masks are moved by" in told and " % left " in told, (name, told)


def test_without_photos_it_may_be_the_cameras_too(demo_run: Path, data: Dataset, tmp_path: Path) -> None:
    shutil.copy(data.root / "cameras.json", tmp_path)
    for view in data.views("train"):
        write_mask(tmp_path / f"labels/{view.name}.png", changed(view, moved).read_labels(), 8)
    scene = GaussianScene.load(demo_run / "scene/scene.ply")
    found = place(scene, Dataset(tmp_path), check=True)
    assert found.agreement is not None and found.masks is None and not found.fits
    assert "if masks are moved by" in found.agreement.misplaced
    with pytest.raises(AlignmentError, match=r"masks do not lie on what they show: .* if masks are moved by"):
        place(scene, Dataset(tmp_path), align=True)  # Among all conventions, one would agree by chance.
    told = frame_of({"scene": {}, "frame": found.as_dict()})
    assert len(told) == 1 + (found.agreement.agrees is False)
    assert told[-1].endswith("; expected masks in the pixels of the images, and cameras that fit the scene")


def test_commands_say_it_where_photos_agree_with_the_scene(
    demo_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene, data = GaussianScene.load(demo_run / "scene/scene.ply"), Dataset(demo_run / "scene")
    for name in ("cameras.json", "classes.json"):
        shutil.copy(data.root / name, tmp_path)
    (tmp_path / "images").mkdir()
    for view in data.views()[::2]:
        photo = background_image(scene, make_operator(scene, view.camera))
        Image.fromarray(photo).save(tmp_path / f"images/{view.name}.png")
        write_mask(tmp_path / f"labels/{view.name}.png", changed(view, padded).read_labels(), 8)
    found = place(scene, Dataset(tmp_path), check=True)
    assert found.agreement is not None and found.agreement.agrees and found.agreement.compared == "photos"
    assert (
        found.masks is not None and "undoes padding the images to squares" in found.masks.misplaced and not found.fits
    )
    (told,) = frame_of({"scene": {}, "frame": found.as_dict()})
    assert told == f"{found.masks.misplaced}; expected masks in the pixels of the images"
    of_old = {key: value for key, value in vars(found.masks).items() if key != "misplaced"}
    assert replace(found.masks, misplaced="") == Agreement(**of_old), "reports of earlier versions are read"
    segment = ["segment", str(demo_run / "scene/scene.ply"), "--data", str(tmp_path), "--quiet"]
    assert main([*segment, "--out", str(tmp_path / "out")]) == 0
    assert "padding the images to squares; expected masks in the pixels of the images" in capsys.readouterr().err
    report = json.loads((tmp_path / "out/report.json").read_text())
    assert "padding the images to squares" in report["frame"]["masks"]["misplaced"]
    assert "padding the images to squares" in (tmp_path / "out/report.html").read_text()
    unused, cause, *effects = warnings_of(report, None)
    assert "18 no mask" in unused and "padding the images to squares" in cause, "the cause comes first"
    assert any("with the other views" in effect for effect in effects)
    assert main(["doctor", str(tmp_path), "--scene", str(demo_run / "scene/scene.ply"), "--quiet"]) == 2
    assert "padding the images to squares" in capsys.readouterr().out
