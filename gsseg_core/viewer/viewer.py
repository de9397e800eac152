"""Serves the viewer to browsers, and handles their clicks. Needs the extra `view`."""

from __future__ import annotations

import contextlib
import io
import tempfile
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import viser
import viser.transforms as vtf

from gsseg_core.data.view import View
from gsseg_core.errors import GssegError, SettingsError
from gsseg_core.export.pictures import overlay, palette
from gsseg_core.export.view_pictures import background_image
from gsseg_core.raster.backends import make_operator
from gsseg_core.scene.camera import Camera
from gsseg_core.segmentation import Segmentation
from gsseg_core.viewer.access import Listener, listen
from gsseg_core.viewer.clients import AUTO, DRAWN_BY, ClientRenderers
from gsseg_core.viewer.corrections import Corrections
from gsseg_core.viewer.live_source import LiveSource
from gsseg_core.viewer.model import BY_RELIABILITY, MODES, ViewModel, completed
from gsseg_core.viewer.panel import Panel
from gsseg_core.viewer.picking import ViewVotes, pick, scene_camera
from gsseg_core.viewer.picture import Picture
from gsseg_core.viewer.server import start_server
from gsseg_core.viewer.splat_chunks import cut

DRAWING_HEIGHT = 480
"""Most rows of the image in which a correction is drawn; finer than the Gaussians is of no use."""

_OVERLAY_DISTANCE = 0.02
_MASK = "/mask"


class Viewer:
    """Shows a segmentation to browsers, and lets people correct it.

    Parameters
    ----------
    model : ViewModel
        What to show.
    views : sequence of View
        Those that the segmentation was learnt from; the camera can jump to them.
    reliability : mapping from the name of a view to float
        How far each can be trusted, in [0, 1], as far as that is known.
    source : LiveSource, optional
        Class probabilities that change while the viewer runs.
    listener : Listener, optional
        Where to listen, and who is answered; it is closed with the viewer. By default, what `listen` gives.
    draw : str
        Who draws: 'browser'; 'server', this program, which sends images; or 'auto', the browser if it is fast.
    device : str
        Where clicks and corrections are rendered, and what the server draws.

    Attributes
    ----------
    model : ViewModel
        What is shown.
    url : str
        Where to look.

    Raises
    ------
    SettingsError
        `draw` is none of these, no port is free, or viser is of an unknown version.
    """

    def __init__(
        self,
        model: ViewModel,
        views: Sequence[View] = (),
        reliability: Mapping[str, float] | None = None,
        source: LiveSource | None = None,
        *,
        listener: Listener | None = None,
        draw: str = AUTO,
        device: str = "cpu",
    ) -> None:
        if draw not in DRAWN_BY:
            raise SettingsError(f"draw is {draw!r}; expected one of {', '.join(DRAWN_BY)}")
        self.model, self.views, self.reliability, self.device = model, tuple(views), dict(reliability or {}), device
        self.corrections = Corrections(model.scene, device=device)
        self.added_names: dict[int, str] = {}
        self._before = model.labelling
        self._view_votes: ViewVotes | None = None
        self._view_votes_lock = threading.Lock()
        self._lock = threading.RLock()
        self._stale, self._closing = threading.Event(), threading.Event()
        self._source = source
        self._listener = listener or listen()
        self.server = start_server(self._listener)
        self.url = self._listener.url
        self.renderers = ClientRenderers(self.server, model.scene, self._seen_by, draw, device)
        self._set_up_camera()
        self.panel = Panel(self)
        self.server.scene.on_click()(self._on_click)
        self.server.scene.on_click(modifier="shift")(self._on_correction_click)
        self.server.scene.on_rect_select(modifier="shift")(self._on_correction_box)
        self._recut()
        self._show()
        self._threads = [threading.Thread(target=self._keep_showing, name="viewer", daemon=True)]
        if source is not None:
            self._threads.append(threading.Thread(target=self._follow, name="live source", daemon=True))
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """End the server; browsers are told that it is gone."""
        self._closing.set()
        self._stale.set()
        for thread in self._threads:
            thread.join()
        if self._source is not None:
            self._source.close()
        self.renderers.close()
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()
        self._listener.close()

    @property
    def follows(self) -> bool:
        """Whether class probabilities change while the viewer runs."""
        return self._source is not None

    # What the panel calls.

    def change(self, action: Callable[[ViewModel], object]) -> None:
        """Change what is shown, and have the browser follow; changes that come fast are shown together."""
        with self._lock:
            action(self.model)
        self._stale.set()

    def set_mode(self, mode: str) -> None:
        """Colour by something else.

        Raises
        ------
        SettingsError
            There is no such mode, or it is the reliability of the views, and that is not known.
        """
        if mode not in MODES:
            raise SettingsError(f"colour by {mode!r}; expected one of {', '.join(MODES)}")
        if mode == BY_RELIABILITY and self.model.reliability is None:
            if not self.reliability or not self.views:
                raise SettingsError(
                    "view reliability is not known; expected --data, and a report.json of `gsseg segment --learner em` "
                    "beside the segmentation"
                )
            self.model.reliability = self.view_votes().mean_reliability(self.reliability)
        self.change(lambda model: setattr(model, "mode", mode))

    def view_votes(self) -> ViewVotes:
        """Return the votes of each view for each Gaussian; collected when first asked for."""
        with self._view_votes_lock:
            if self._view_votes is None:
                self._view_votes = ViewVotes(
                    self.model.scene, self.views, device=self.device, progress=self.panel.show_progress
                )
            return self._view_votes

    def jump(self, client: viser.ClientHandle, view: View, with_mask: bool) -> None:
        """Look from where a view was taken; lay its mask over the picture."""
        camera = view.camera
        pose = np.linalg.inv(camera.world_to_camera)
        with client.atomic():
            client.camera.up_direction = -pose[:3, 1]
            client.camera.position = pose[:3, 3]
            client.camera.look_at = pose[:3, 3] + pose[:3, 2] * self._reach
            client.camera.fov = _vertical_fov(camera)
        self.server.scene.remove_by_name(_MASK)
        if with_mask:
            self._hang(view, pose)
        self.server.flush()

    def hide_mask(self) -> None:
        """Take the mask off the picture."""
        self.server.scene.remove_by_name(_MASK)
        self.server.flush()

    def selection_ply(self) -> bytes:
        """Write what is shown as a 3DGS PLY.

        Raises
        ------
        EmptySceneError
            Nothing is shown.
        """
        with self._lock:
            shown = self.model.shown()
        return _as_file(lambda path: self.model.scene.subset(shown).save(path), "selection.ply")

    def segmentation_npz(self) -> bytes:
        """Write labels and class probabilities, corrections included, as a `segmentation.npz`."""
        labels, probabilities, names = self.model.labelling
        nothing, none = np.zeros(len(labels), bool), np.empty((0, probabilities.shape[1]), np.float32)
        result = Segmentation(labels, completed(probabilities), names, self.model.scene.digest, nothing, none)
        return _as_file(result.with_ids(self.model.ids()).save, "segmentation.npz")

    def undo(self) -> bool:
        """Take the last correction back; return whether there was one."""
        with self._lock:
            undone = self.corrections.undo()
            self._relabel()
        return undone

    # Clicks.

    def _on_click(self, event: viser.SceneClickEvent) -> None:
        with self.panel.telling(event.client):
            picked = pick(
                self.model.scene,
                np.array(event.ray_origin),
                np.array(event.ray_direction),
                self.model.shown(),
                focal=self.camera_of(event.client, event.client.camera.image_height).fy,
                device=self.device,
            )
            self.panel.show_picked(picked, None)
            if picked is not None and self.views:
                self.panel.show_picked(picked, self.view_votes().of(picked.gaussian))

    def _on_correction_click(self, event: viser.SceneClickEvent) -> None:
        with self.panel.telling(event.client):
            camera = self.camera_of(event.client)
            x, y = np.clip(event.screen_pos, 0, 1 - 1e-9) * (camera.width, camera.height)
            self._correct(self.panel.drawn(camera, float(x), float(y), lambda: self._label_map(camera)))

    def _on_correction_box(self, event: viser.SceneRectSelectEvent) -> None:
        with self.panel.telling(event.client):
            camera = self.camera_of(event.client)
            low, high = (np.array(p) * (camera.width, camera.height) for p in (event.screen_min, event.screen_max))
            self._correct(self.panel.drawn_box(camera, tuple(low.tolist()), tuple(high.tolist())))

    def _correct(self, view: View) -> None:
        with self._lock:
            before = self.model.labelling.labels
            self.corrections.add(view)
            self._relabel()
            changed = int(np.count_nonzero(before != self.model.labelling.labels))
        self.panel.tell_corrected(changed)

    def _label_map(self, camera: Camera) -> np.ndarray:
        """Labels (H, W) of what is shown, -1 where nothing is."""
        with self._lock:
            labelling, shown = self.model.labelling, self.model.shown()
        # The last channel is for what has no class, so that it is a region as well.
        one_hot = np.eye(labelling.probabilities.shape[1] + 1, dtype=np.float32)[np.maximum(labelling.labels, -1)]
        image = make_operator(self.model.scene, camera, self.device).without(~shown).render(one_hot)
        labels = np.where(image.max(axis=2) > 0, image.argmax(axis=2), -1)
        labels[labels == one_hot.shape[1] - 1] = -1
        return labels

    def camera_of(self, client: viser.ClientHandle, rows: int | None = None) -> Camera:
        """Make a camera of what a browser looks from, of so many rows; by default as corrections are drawn."""
        camera = client.camera
        height = rows or min(camera.image_height, DRAWING_HEIGHT)
        pose = np.eye(4)
        pose[:3, :3] = vtf.SO3(camera.wxyz).as_matrix()
        pose[:3, 3] = camera.position
        return scene_camera("viewer", max(round(height * camera.aspect), 1), height, camera.fov, pose)

    def _seen_by(self, client: viser.ClientHandle, rows: int) -> Camera:
        return self.camera_of(client, min(client.camera.image_height, rows))

    # What follows from a change.

    def _relabel(self) -> None:
        self.model.relabel(self.corrections.apply(self._before, self.added_names))
        self._recut()
        self._stale.set()

    def _recut(self) -> None:
        self._parts = cut(self.model.labelling.labels, self.model.confidence)

    def _show(self) -> None:
        with self._lock:
            picture = Picture(self.model.scene, self._parts, self.model.shown(), self.model.colors())
            rows = self.model.rows()
        self.renderers.show(picture)
        self.panel.show_classes(rows)

    def _keep_showing(self) -> None:
        while self._stale.wait() and not self._closing.is_set():
            self._stale.clear()
            self._show()

    def _follow(self) -> None:
        assert self._source is not None
        while not self._closing.is_set():
            try:
                update = self._source.wait(0.5)
            except GssegError as error:
                self.panel.show_live(str(error))
                self._closing.wait(1.0)
                continue
            if update is not None:
                with self._lock:
                    self._before = update.labelling
                    self._relabel()
                self.panel.show_live(f"{update.num_views} views so far")

    # Where things are.

    def _set_up_camera(self) -> None:
        means = self.model.scene.means
        low, high = np.percentile(means, [5, 95], axis=0)
        self._reach = float(np.linalg.norm(high - low)) / 2
        start = self.server.initial_camera
        if self.views:
            poses = np.array([np.linalg.inv(view.camera.world_to_camera) for view in self.views])
            self.server.scene.set_up_direction(-poses[:, :3, 1].mean(axis=0))
            start.position, start.look_at = poses[0, :3, 3], poses[0, :3, 3] + poses[0, :3, 2] * self._reach
            start.fov = _vertical_fov(self.views[0].camera)
        else:
            start.look_at = (low + high) / 2
            start.position = (low + high) / 2 + np.array([1.2, 1.2, 0.9]) * self._reach
        start.near = min(_OVERLAY_DISTANCE * self._reach / 4, 0.05)

    def _hang(self, view: View, pose: np.ndarray) -> None:
        camera, scene = view.camera, self.model.scene
        labels = view.read_labels()
        picture = overlay(
            background_image(scene, make_operator(scene, camera, self.device)),
            labels,
            palette(max(int(labels.max(initial=0)), *self.model.labelling.class_names) + 1),
        )
        distance = _OVERLAY_DISTANCE * self._reach
        # The middle of the image, which need not be where the optical axis is.
        middle = np.array([(camera.width / 2 - camera.cx) / camera.fx, (camera.height / 2 - camera.cy) / camera.fy, 1])
        self.server.scene.add_image(
            _MASK,
            picture,
            camera.width / camera.fx * distance,
            camera.height / camera.fy * distance,
            format="png",
            wxyz=vtf.SO3.from_matrix(pose[:3, :3]).wxyz,
            position=pose[:3, 3] + pose[:3, :3] @ middle * distance,
        )


def _vertical_fov(camera: Camera) -> float:
    """Field of view in radians, as viser takes it."""
    return float(2 * np.arctan(camera.height / 2 / camera.fy))


def _as_file(write: Callable[[Path], Any], name: str) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder) / name)
        return (Path(folder) / name).read_bytes()
