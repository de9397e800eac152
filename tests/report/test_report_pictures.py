"""Pictures of the report page show what they should."""

from __future__ import annotations

import base64
import threading
from pathlib import Path

import numpy as np
import pytest
from patience import PATIENCE
from report_cases import painted
from small_scenes import balls_on_a_table, look_at

from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.data.view import View
from gsseg_core.export.pictures import palette
from gsseg_core.learn.mask_reliability import compare_mask
from gsseg_core.report import pictures
from gsseg_core.report.findings import MaskChecks
from gsseg_core.report.pictures import THUMBNAIL_PX, ViewImages, draw_triple, jpeg_uri, thumbnails

SCENE, TRUTH = balls_on_a_table()


def view_of(name: str, labels: np.ndarray) -> View:
    return View.from_arrays(look_at(name, np.array([3.0, 0, 3])), labels)


def test_thumbnail_is_cut_from_the_view_that_shows_the_class_whole() -> None:
    cut_off = view_of("cut_off", painted((1, slice(0, 20), slice(0, 30))))
    whole = view_of("whole", painted((1, slice(10, 26), slice(20, 44))))
    tiny = view_of("tiny", painted((1, slice(10, 12), slice(20, 22))))
    views = {view.name: view for view in (cut_off, whole, tiny)}
    checked = MaskChecks([compare_mask(view, view.read_labels(), 3) for view in views.values()], views, True)
    images = ViewImages(SCENE)
    for view in views.values():
        images.keep(view, np.where(view.read_labels()[..., None] == 1, np.uint8(200), np.uint8(100)).repeat(3, axis=2))
    found = thumbnails(range(3), checked, images, palette(3))
    assert set(found) == {0, 1}
    name, picture = found[1]
    assert name == "whole" and picture.shape == (THUMBNAIL_PX, THUMBNAIL_PX, 3)
    bright, middle = (picture == 200).all(axis=2), THUMBNAIL_PX // 2
    # 16 x 24 px in a square of 36: two thirds of the width, the rest dimmed.
    assert bright[middle, middle] and 0.2 < bright.mean() < 0.35
    assert (picture[:8] < 100).all() and (picture == palette(3)[1]).all(axis=2).any()


def checks_of(*views: View) -> MaskChecks:
    checks = [compare_mask(view, view.read_labels(), 3) for view in views]
    return MaskChecks(checks, {view.name: view for view in views}, True)


def test_enough_pixels_at_hand_are_as_good_as_more_that_would_have_to_be_rendered(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    most = view_of("most", painted((1, slice(10, 40), slice(10, 50))))
    enough = view_of("enough", painted((1, slice(10, 22), slice(10, 22))))
    few = view_of("few", painted((1, slice(10, 17), slice(10, 17))))
    checked, grey = checks_of(few, most, enough), np.full((48, 64, 3), 120, np.uint8)

    def shown_with(*at_hand: View) -> str:
        images = ViewImages(SCENE)
        for view in at_hand:
            images.keep(view, grey)
        return thumbnails([1], checked, images, palette(3))[1][0]

    assert shown_with(few, enough) == "most"
    monkeypatch.setattr(pictures, "ENOUGH", 144)
    assert shown_with(few, enough) == "enough" and shown_with(few) == "most"
    # Where nothing needs to be rendered, more is still better.
    assert shown_with(few, enough, most) == "most"


def test_a_small_rest_is_not_shown_because_nothing_cuts_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pictures, "ENOUGH", 100)
    views = view_of("large", painted((1, slice(0, 30), slice(0, 50)))), view_of("rest", painted((1, 9, slice(9, 59))))
    assert thumbnails([1], checks_of(*views), ViewImages(SCENE), palette(3))[1][0] == "large"


def test_views_that_have_to_be_rendered_for_thumbnails_are_so_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsseg_core.several_at_once.numba.get_num_threads", lambda: 2)
    meeting = threading.Barrier(2, timeout=PATIENCE)

    def rendered(_: ViewImages, view: View) -> np.ndarray:
        meeting.wait()
        return np.zeros((view.camera.height, view.camera.width, 3), np.uint8)

    monkeypatch.setattr(ViewImages, "rendered", rendered)
    views = [view_of(str(k), painted((k, slice(10, 20), slice(10, 20)))) for k in (1, 2)]
    found = thumbnails([1, 2], checks_of(*views), ViewImages(SCENE), palette(3))
    assert {k: name for k, (name, _) in found.items()} == {1: "1", 2: "2"}


def test_of_views_without_photos_no_more_images_are_kept_than_a_page_shows_of_whole_views(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(pictures, "MOST_KEPT", 2)
    views = [view_of(str(k), painted((k, slice(10, 20), slice(10, 20)))) for k in range(1, 6)]
    checks, images = [compare_mask(view, view.read_labels(), 6) for view in views], ViewImages(SCENE)
    checked = MaskChecks(checks, {view.name: view for view in views}, True)
    assert len(thumbnails(range(1, 6), checked, images, palette(6))) == 5
    assert 1 <= sum(map(images.at_hand, views)) <= 3  # Two threads may each keep the last one.


def test_thumbnails_of_large_views_have_no_holes_where_nothing_was_compared() -> None:
    labels = np.zeros((480, 640), np.int32)
    labels[100:300, 200:400] = 1
    labels[350:450, 50:150] = 1  # which is a mistake of the mask
    predicted = np.where(np.arange(480)[:, None] < 320, labels, 0)
    camera = look_at("a", np.array([3.0, 0, 3]), 640, 480)
    view = View.from_arrays(camera, labels)
    compared = np.subtract.outer(np.arange(480) // 16, np.arange(640) // 16) % 3 == 0
    checked = MaskChecks([compare_mask(view, np.where(compared, predicted, UNKNOWN), 2)], {"a": view}, True)
    images = ViewImages(SCENE)
    images.keep(view, np.full((480, 640, 3), 200, np.uint8))
    _, picture = thumbnails([1], checked, images, palette(2))[1]
    bright = (picture == 200).all(axis=2)
    assert bright[28:100, 28:100].all() and not bright[112:].any() and not bright[:, :16].any()
    np.testing.assert_array_equal(checked.checks[0].completed(labels)[32:-32, 32:-32] == 1,
                                  (predicted == 1)[32:-32, 32:-32])  # fmt: skip


def test_what_is_rendered_is_kept_beside_a_photo(tmp_path: Path) -> None:
    from dataclasses import replace

    from PIL import Image

    Image.new("RGB", (64, 48), (10, 200, 30)).save(tmp_path / "photo.png")
    view, image = replace(view_of("a", painted()), image_path=tmp_path / "photo.png"), np.zeros((48, 64, 3), np.uint8)
    images = ViewImages(SCENE)
    images.keep(view, image)
    assert images.rendered(view) is image and (images.of(view) == (10, 200, 30)).all()


def test_what_only_the_mask_says_is_on_no_thumbnail() -> None:
    view = view_of("a", painted((1, slice(10, 20), slice(10, 20)), (2, slice(30, 40), slice(10, 20))))
    predicted = painted((1, slice(10, 20), slice(10, 20)))
    checked = MaskChecks([compare_mask(view, predicted, 3)], {"a": view}, True)
    assert set(thumbnails(range(3), checked, ViewImages(SCENE), palette(3))) == {0, 1}


def test_differences_are_red_and_only_they() -> None:
    labels = painted((1, slice(10, 20), slice(10, 20)))
    labels[0] = UNKNOWN
    view = view_of("a", labels)
    predicted = painted((1, slice(10, 20), slice(15, 25)))
    images = ViewImages(SCENE)
    images.keep(view, np.full((48, 64, 3), 120, np.uint8))
    triple = draw_triple(compare_mask(view, predicted, 2), view, images, palette(2))
    difference = triple[2]
    red = difference[..., 0] > difference[..., 1].astype(int) + 80
    np.testing.assert_array_equal(red, (labels != predicted) & (labels != UNKNOWN))
    assert all(picture.shape == (48, 64, 3) and picture.dtype == np.uint8 for picture in triple)


def test_pictures_are_shrunk_not_grown() -> None:
    from io import BytesIO

    from PIL import Image

    for width, shown in ((640, 100), (40, 40)):
        uri = jpeg_uri(np.zeros((20, width, 3), np.uint8), 100)
        with Image.open(BytesIO(base64.b64decode(uri.removeprefix("data:image/jpeg;base64,")))) as image:
            assert image.size[0] == shown


def test_a_photo_is_preferred_and_a_broken_one_or_one_of_another_size_is_rendered_over(tmp_path: Path) -> None:
    from dataclasses import replace

    from PIL import Image

    Image.new("RGB", (64, 48), (10, 200, 30)).save(tmp_path / "good.png")
    Image.new("RGB", (32, 24), (10, 200, 30)).save(tmp_path / "small.png")
    (tmp_path / "broken.png").write_bytes(b"\x89PNG\r\n\x1a\nno")
    for name, is_photo in (("good", True), ("small", False), ("broken", False), ("missing", False)):
        view = replace(view_of(name, painted()), image_path=tmp_path / f"{name}.png")
        image = ViewImages(SCENE).of(view)
        assert image.shape == (48, 64, 3) and (image == (10, 200, 30)).all() == is_photo
