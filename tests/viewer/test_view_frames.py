"""Images for browsers that draw slowly: what is in them, and when they come."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from contextlib import closing

import numpy as np
import pytest
from labellings import labelled
from patience import wait_until
from small_scenes import NAMES, balls_on_a_table, clean_views

pytest.importorskip("viser")

import viser.transforms as vtf

from gsseg_core.raster.backends import make_operator
from gsseg_core.scene.camera import Camera
from gsseg_core.viewer import server_frames
from gsseg_core.viewer.model import ViewModel
from gsseg_core.viewer.picture import Picture, cut
from gsseg_core.viewer.server_frames import FINE_ROWS, QUICK_ROWS, Frames
from gsseg_core.viewer.viewpoint import camera_of

SCENE, TRUTH = balls_on_a_table()
MODEL = ViewModel(SCENE, labelled(TRUTH.astype(np.int32), np.eye(4, dtype=np.float32)[TRUTH], dict(NAMES)))
CAMERA = clean_views(1)[0].camera


def picture(shown: np.ndarray) -> Picture:
    return Picture(SCENE, cut(MODEL.labelling.labels, MODEL.labelling.confidence), shown, MODEL.colors())


class Client:
    """A browser that looks from `CAMERA`, and keeps the images that it gets; it moves when it is told to."""

    aspect, image_height = CAMERA.width / CAMERA.height, 1080
    fov = float(2 * np.arctan(CAMERA.height / 2 / CAMERA.fy))
    wxyz = vtf.SO3.from_matrix(CAMERA.world_to_camera[:3, :3].T).wxyz
    position = CAMERA.center

    def __init__(self) -> None:
        self.camera, self.scene = self, self
        self.images: list[np.ndarray] = []
        self.move: Callable[[object], object] = print

    def on_update(self, callback: Callable[[object], object]) -> None:
        self.move = callback

    def set_background_image(self, image: np.ndarray, **_: object) -> None:
        self.images.append(image)

    def flush(self) -> None:
        pass

    def wait_for(self, count: int) -> None:
        wait_until(lambda: len(self.images) >= count, f"{count} images")


def test_an_image_has_the_colours_of_what_is_shown_and_nothing_else() -> None:
    shown = TRUTH == 2
    image = picture(shown).draw(make_operator(SCENE, CAMERA))
    codes = MODEL.colors().astype(np.float32) / 255
    alone = make_operator(SCENE.subset(shown), CAMERA).render(codes[shown])
    assert np.abs(image - 255 * alone).max() <= 0.5001
    assert image.any()
    assert not picture(np.zeros(len(SCENE), bool)).draw(make_operator(SCENE, CAMERA)).any()


def test_a_change_is_answered_by_a_quick_image_and_then_by_a_fine_one() -> None:
    client = Client()
    with closing(Frames(client)) as frames:  # type: ignore[arg-type]
        frames.show(picture(TRUTH >= 0))
        client.wait_for(2)
        client.move(None)
        client.wait_for(4)
        client.move(None)
        client.wait_for(6)
    assert [len(image) for image in client.images] == [QUICK_ROWS, FINE_ROWS] * 3  # And none came between.
    assert np.array_equal(client.images[1], client.images[3])


def test_a_window_that_is_too_small_for_a_picture_gets_one_once_it_is_larger(monkeypatch: pytest.MonkeyPatch) -> None:
    client, asked = Client(), []
    client.image_height = 0

    def ask(client: Client, rows: int) -> Camera:
        try:
            return camera_of(client, rows)  # type: ignore[arg-type]
        finally:
            asked.append(rows)

    monkeypatch.setattr(server_frames, "camera_of", ask)
    with closing(Frames(client)) as frames:  # type: ignore[arg-type]
        frames.show(picture(TRUTH >= 0))
        wait_until(lambda: len(asked) == 2, "both images to be tried")
        client.image_height = 1080
        client.move(None)
        client.wait_for(2)
    assert len(client.images) == len(asked) - 2


def test_a_camera_of_a_viewer_sees_what_the_viewer_sees() -> None:
    client = Client()
    client.image_height = CAMERA.height
    camera = camera_of(client)  # type: ignore[arg-type]
    assert np.allclose(camera.K, CAMERA.K) and np.allclose(camera.world_to_camera, CAMERA.world_to_camera)
    assert camera_of(client, 12).height == 12  # type: ignore[arg-type]


def test_after_the_end_no_image_comes() -> None:
    client = Client()
    frames = Frames(client)  # type: ignore[arg-type]
    frames.show(picture(TRUTH >= 0))
    client.wait_for(1)
    frames.close()
    count = len(client.images)
    client.move(None)
    frames.show(picture(TRUTH == 1))
    assert not frames._thread.is_alive() and len(client.images) == count


def test_of_a_browser_that_has_left_no_projected_scene_is_kept() -> None:
    client = Client()
    frames = Frames(client)  # type: ignore[arg-type]
    frames.show(picture(TRUTH > 0))
    client.wait_for(2)
    kept = [weakref.ref(operator) for operator in frames._operators.values()]
    frames.close()
    assert kept and not any(operator() for operator in kept)
