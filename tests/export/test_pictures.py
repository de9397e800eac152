"""Pictures: colours that can be told apart, outlines where classes meet, sheets and legends that hold everything."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.errors import WriteError
from gsseg_core.export.pictures import (
    BACKGROUND,
    CELL_PX,
    FILL,
    PAPER,
    contact_sheet,
    legend,
    outline,
    overlay,
    palette,
    save_png,
    shown_at,
)


def test_colours_are_all_different_and_the_first_is_the_background() -> None:
    colors = palette(1000)
    assert colors.shape == (1000, 3) and colors.dtype == np.uint8
    assert len(np.unique(colors, axis=0)) == 1000
    assert tuple(colors[0]) == BACKGROUND


def test_a_small_palette_is_the_beginning_of_a_large_one() -> None:
    np.testing.assert_array_equal(palette(10), palette(60)[:10])
    assert palette(1).shape == (1, 3)


def test_colours_of_few_classes_are_far_apart() -> None:
    colors = palette(20).astype(float)
    distances = np.linalg.norm(colors[:, None] - colors, axis=-1) + 1e3 * np.eye(20)
    assert distances.min() > 40


@pytest.mark.parametrize(("red", "blue"), [(0.11238, 0.00401), (0.29275, -0.02234)])
def test_colours_of_few_classes_are_far_apart_for_eyes_that_lack_red_or_green(red: float, blue: float) -> None:
    """By another model than the one they were chosen by: Vienot, Brettel and Mollon 1999."""
    r, g, b = ((palette(17) / 255) ** 2.2).T
    alike = red * r + (1 - red) * g
    seen = 255 * np.clip([alike, alike, blue * (r - g) + b], 0, 1).T ** (1 / 2.2)
    distances = np.linalg.norm(seen[:, None] - seen, axis=-1) + 1e3 * np.eye(17)
    assert distances[:8, :8].min() > 40 and distances.min() > 20


def test_more_classes_than_colours_still_get_one_each() -> None:
    assert palette(5000).shape == (5000, 3)


@pytest.mark.parametrize("labels", [np.full((4, 5), 3), np.zeros((5, 5), int)])
def test_labels_without_a_colour_or_of_another_size_are_refused(labels: np.ndarray) -> None:
    with pytest.raises(ValueError, match=r"overlay: found .* expected \(4, 5\), below 3"):
        overlay(np.zeros((4, 5, 3), np.uint8), labels, palette(3))


def test_an_overlay_draws_lines_exactly_where_labels_change() -> None:
    labels = np.zeros((20, 30), int)
    labels[5:15, 10:20] = 1
    image = np.full((20, 30, 3), 120, np.uint8)
    picture = overlay(image, labels, palette(2))
    inside, line, outside = picture[10, 15], picture[10, 10], picture[1, 1]
    assert picture.shape == image.shape and picture.dtype == np.uint8
    assert (picture[6:14, 11:19] == inside).all()
    assert (picture[5:15, [10, 19]] == line).all() and (picture[[5, 14], 10:20] == line).all()
    assert (picture[:4] == outside).all()
    assert len({tuple(inside), tuple(line), tuple(outside)}) == 3
    assert (image == 120).all()


def slow_overlay(image: np.ndarray, labels: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """Do the same with whole arrays."""
    own, seen = np.maximum(labels, 0), image.astype(np.float32)
    grey = ((seen[..., 0] + seen[..., 1] + seen[..., 2]) / 3)[..., None]
    named, line = (labels > 0)[..., None], outline(labels)[..., None]
    area = np.float32(1 - FILL) * grey + (FILL * colors.astype(np.float32))[own]
    other = (np.float32(0.35) * seen + np.float32(0.65 * 0.75) * grey + np.float32(0.65 * 30)) * np.where(line, 0.45, 1)
    return np.rint(np.where(named, np.where(line, np.minimum(1.12 * colors[own], 255), area), other)).astype(np.uint8)


def test_an_overlay_is_that_of_whole_arrays() -> None:
    random = np.random.default_rng(0)
    image, labels = (
        random.integers(0, 256, (40, 50, 3), np.uint8),
        np.kron(random.integers(-1, 4, (8, 10)), np.ones((5, 5), int)),
    )
    found, expected = overlay(image, labels, palette(4)), slow_overlay(image, labels, palette(4))
    assert np.abs(found.astype(int) - expected).max() <= 1, "halves may be rounded either way"
    assert (found == expected).mean() > 0.999


def test_unknown_pixels_are_shown_like_background() -> None:
    image = np.full((4, 4, 3), 90, np.uint8)
    unknown = overlay(image, np.full((4, 4), UNKNOWN), palette(2))
    np.testing.assert_array_equal(unknown, overlay(image, np.zeros((4, 4), int), palette(2)))


def test_a_contact_sheet_holds_every_picture_whole() -> None:
    colors = palette(8)[1:]
    images = [np.broadcast_to(color, (30 + 4 * i, 50, 3)) for i, color in enumerate(colors)]
    sheet = contact_sheet(images, [f"a caption that is much too long for its picture {i}" for i in range(7)], columns=3)
    for image, color in zip(images, colors, strict=True):
        assert (sheet == color).all(axis=-1).sum() == image.shape[0] * image.shape[1]
    assert tuple(sheet[0, 0]) == PAPER


def test_large_pictures_are_shrunk_onto_a_contact_sheet() -> None:
    wide, small = np.full((400, 1600, 3), 200, np.uint8), np.full((90, 120, 3), 90, np.uint8)
    sheet = contact_sheet([wide, small], ["wide", "small"], columns=2)
    assert sheet.shape[1] < 2 * CELL_PX + 50
    assert (sheet == 200).all(axis=-1).sum() == CELL_PX // 4 * CELL_PX and (sheet == 90).all(axis=-1).sum() == 90 * 120


def test_pictures_are_thinned_out_no_further_than_they_are_shown() -> None:
    labels = np.zeros((250, 401), int)
    labels[:, 200:] = 1
    image = np.where(labels[..., None] == 1, 255, 0).astype(np.uint8).repeat(3, axis=2)
    assert shown_at(300, image, labels)[0] is image
    thin, fewer = shown_at(100, image, labels)
    assert thin.shape == (63, 101, 3) and fewer.shape == (63, 101)
    assert (thin[:, :50] == 0).all() and (thin[:, 50:] == 255).all()
    np.testing.assert_array_equal(fewer, thin[..., 0] // 255)


def test_a_legend_has_a_swatch_for_every_class_in_as_many_columns_as_it_takes() -> None:
    colors = palette(60)
    names = {k: "object " * (k % 9) for k in range(60)}
    sheet = legend(names, colors, np.arange(60) * 10_000)
    for color in colors:
        assert (sheet == color).all(axis=-1).sum() > 200
    assert sheet.shape[1] > legend({0: "background"}, colors, np.zeros(60, int)).shape[1]
    assert legend({}, colors, np.zeros(60, int)).ndim == 3


def test_names_on_pictures_are_written_as_everywhere_else() -> None:
    def drawn(name: str) -> np.ndarray:
        return legend({1: name}, palette(2), np.zeros(2, int))

    for written in ("\u00e9clair", "e\u0301clair"):  # as others write it, and as macOS does
        np.testing.assert_array_equal(drawn(written), drawn("eclair"), "the font has no accents, and no boxes of them")
    np.testing.assert_array_equal(drawn("exe.\u202egnp"), drawn(r"exe.\u202egnp"))


def test_names_that_are_too_long_are_still_told_apart_by_their_beginning_and_by_their_end() -> None:
    def drawn(caption: str) -> np.ndarray:
        return contact_sheet([np.zeros((90, 160, 3), np.uint8)], [caption], columns=1)

    name = "2024-05-01_kitchen_scan_left_camera_frame_000123"
    for other in (name.replace("123", "124"), name.replace("2024", "2023"), f"{name}: 33 % reliable"):
        assert (drawn(name) != drawn(other)).any(), other


def test_a_legend_of_hundreds_of_classes_is_about_as_wide_as_high() -> None:
    for count in (300, 1000):
        sheet = legend({k: f"object_{k:03d}" for k in range(count)}, palette(count), np.full(count, 1_000))
        assert 0.75 < sheet.shape[1] / sheet.shape[0] < 1.25


def test_a_saved_picture_reads_back_and_survives_a_failed_write(tmp_path: Path) -> None:
    picture = np.random.default_rng(0).integers(0, 255, (5, 7, 3), np.uint8)
    path = tmp_path / "new folder" / "picture.png"
    save_png(path, picture)
    np.testing.assert_array_equal(np.asarray(Image.open(path)), picture)
    with pytest.raises(WriteError, match=r"picture\.png"):
        save_png(path / "below a file.png", picture)
    np.testing.assert_array_equal(np.asarray(Image.open(path)), picture)
