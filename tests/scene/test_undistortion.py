"""Pinhole views of distorted images: their pixels are those that their rays land in, and their number is bounded."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from lens_cases import COEFFICIENTS, HEIGHT, WIDTH, lens

from gsseg_core.errors import IntrinsicsError
from gsseg_core.scene.camera import undistorted_camera
from gsseg_core.scene.lens import MODELS_BY_NAME, Lens
from gsseg_core.scene.undistortion import GROWTH, Undistortion, undistortions

OUTSIDE = -1


def rays_of(view: Undistortion) -> np.ndarray:
    """Rays (height, width, 3) of a view's pixels, in the axes of the lens."""
    columns, rows = np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
    local = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(view.K).T
    return local @ np.reshape(view.rotation, (3, 3)).T


@pytest.mark.parametrize("name", COEFFICIENTS)
def test_a_pixel_of_a_view_is_the_one_that_its_ray_lands_in(name: str) -> None:
    image = np.arange(WIDTH * HEIGHT).reshape(HEIGHT, WIDTH)
    for view in undistortions(lens(name)):
        landed = lens(name).project(rays_of(view))
        inside = ((landed >= 0) & (landed < (WIDTH, HEIGHT))).all(axis=-1)
        columns, rows = np.moveaxis(np.floor(np.where(inside[..., None], landed, 0)).astype(int), -1, 0)
        differ = view.sample(image, OUTSIDE) != np.where(inside, image[rows, columns], OUTSIDE)
        assert differ.mean() < 1e-3  # on the line between two pixels


@pytest.mark.parametrize("name", [name for name in COEFFICIENTS if name != "EQUIRECTANGULAR"])
def test_the_middle_stays_as_it_is_and_next_to_nothing_of_a_view_is_unknown(name: str) -> None:
    image = np.arange(WIDTH * HEIGHT).reshape(HEIGHT, WIDTH)
    (view,) = undistortions(lens(name))
    column, row = (int(number) for number in view.principal)
    middle = view.sample(image, OUTSIDE)[row - 3 : row + 4, column - 3 : column + 4]
    column, row = (int(number) for number in lens(name).principal)
    np.testing.assert_array_equal(middle, image[row - 3 : row + 4, column - 3 : column + 4])
    assert (view.sample(image, OUTSIDE) == OUTSIDE).mean() < 0.08
    sizes = view.width / WIDTH, view.height / HEIGHT
    assert GROWTH[0] <= min(sizes) and max(sizes) <= GROWTH[1]


def test_a_view_of_a_fisheye_that_sees_behind_itself_ends_at_120_degrees() -> None:
    (view,) = undistortions(Lens(MODELS_BY_NAME["FISHEYE"], 400, 400, (100.0, 100.0), (200.0, 200.0)))
    assert (view.width, view.height) == (2 * 173, 2 * 173)  # 100 tan(60 degrees)


@pytest.mark.parametrize("width", [64, 66, 1920])  # Of all but the first, faces have a pixel in their very middle.
def test_no_pixel_of_a_panoramas_faces_is_outside_of_it(width: int) -> None:
    image = np.zeros((width // 2, width), np.int32)
    for view in undistortions(Lens(MODELS_BY_NAME["EQUIRECTANGULAR"], width, width // 2)):
        assert not (view.sample(image, OUTSIDE) == OUTSIDE).any(), view.face


def test_the_six_faces_of_a_panorama_show_every_direction_once() -> None:
    views = undistortions(Lens(MODELS_BY_NAME["EQUIRECTANGULAR"], 400, 200))
    assert [view.face for view in views] == ["front", "right", "back", "left", "up", "down"]
    solid_angle = 0.0
    for view in views:
        rays = rays_of(view)
        solid_angle += (np.linalg.norm(rays, axis=-1) ** -3 / view.focal[0] ** 2).sum()
        rotation = np.reshape(view.rotation, (3, 3))
        np.testing.assert_array_equal(rotation @ rotation.T, np.eye(3))
        assert np.linalg.det(rotation) == 1
    assert solid_angle == pytest.approx(4 * np.pi, rel=0.03)
    # East of forward is right, and what is above the horizon is in the upper rows.
    panorama = np.indices((200, 400))[1]
    assert panorama[0, 200] == 200 and views[1].sample(panorama, OUTSIDE)[63, 63] == pytest.approx(300, abs=2)
    assert views[4].sample(np.indices((200, 400))[0], OUTSIDE)[63, 63] < 2


def test_a_panorama_is_named_by_face_and_its_image_by_its_stem() -> None:
    cameras = [undistorted_camera("a_front", view, np.eye(4)) for view in undistortions(lens("EQUIRECTANGULAR"))]
    assert [camera.name for camera in cameras[:2]] == ["a_front_front", "a_front_right"]
    assert {camera.image for camera in cameras} == {"a_front"}
    assert cameras[1].image_size == (WIDTH, HEIGHT) != (cameras[1].width, cameras[1].height)
    np.testing.assert_allclose(cameras[1].world_to_camera[:3, :3] @ (1, 0, 0), (0, 0, 1), atol=1e-12)


def test_a_photo_is_interpolated_and_black_outside() -> None:
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    ramp = np.stack([columns / 2, rows, np.full_like(rows, 200)], axis=-1).astype(np.uint8)
    (view,) = undistortions(
        Lens(MODELS_BY_NAME["SIMPLE_RADIAL"], WIDTH, HEIGHT, (150.0, 150.0), (160.0, 120.0), (0.1,))
    )
    photo, landed = view.photo(ramp), view.lens.project(rays_of(view))
    outside = view.sample(rows, OUTSIDE) == OUTSIDE
    assert outside[0, 0] and not photo[outside].any()
    expected = np.stack([(landed[..., 0] - 0.5) / 2, landed[..., 1] - 0.5], axis=-1)[~outside]
    np.testing.assert_allclose(photo[~outside][:, :2], expected, atol=1.5)
    assert (photo[~outside][:, 2] == 200).all()


def test_the_map_of_a_lens_is_made_once_for_all_its_views() -> None:
    from gsseg_core.scene.undistortion import _nearest_pixels

    (view,), (same,) = undistortions(lens("OPENCV")), undistortions(lens("OPENCV"))
    other = pickle.loads(pickle.dumps(view))
    assert _nearest_pixels(view) is _nearest_pixels(same) is _nearest_pixels(other)
    assert len(pickle.dumps(view)) < 2000


def test_a_lens_whose_view_would_be_of_an_absurd_size_is_refused() -> None:
    for coefficient, focal in ((1e9, 150.0), (-0.15, 1.0)):
        with pytest.raises(IntrinsicsError, match="is it calibrated for"):
            undistortions(
                Lens(MODELS_BY_NAME["SIMPLE_RADIAL"], WIDTH, HEIGHT, (focal, focal), (160.0, 120.0), (coefficient,))
            )
    with pytest.raises(IntrinsicsError, match="face of a panorama of 67108864 x 1 pixels"):
        undistortions(Lens(MODELS_BY_NAME["EQUIRECTANGULAR"], 2**26, 1))
