"""Serves the viewer to browsers, and handles their clicks. Needs the extra `view`."""

from __future__ import annotations

import contextlib
import io
import threading
from collections.abc import Mapping, Sequence

import numpy as np
import viser

from gsseg_core.data.view import View
from gsseg_core.errors import SettingsError, explained
from gsseg_core.scene.camera import Camera
from gsseg_core.text import counted
from gsseg_core.viewer.access import Listener, listen
from gsseg_core.viewer.clients import AUTO, DRAWN_BY, ClientRenderers
from gsseg_core.viewer.live_source import LiveSource
from gsseg_core.viewer.model import ViewModel
from gsseg_core.viewer.panel import Panel, Place
from gsseg_core.viewer.picking import pick
from gsseg_core.viewer.server import start_server
from gsseg_core.viewer.state import ViewerState
from gsseg_core.viewer.viewpoint import Viewpoint, camera_of

DRAWING_HEIGHT = 480  # rows of the image in which a correction is drawn; finer than the Gaussians is of no use
SOURCE_SECONDS = 1.0  # that a live source gets to come back at the end, before it is closed while it waits


class Viewer:
    """Shows a segmentation to browsers at a `url`, and lets people correct it.

    Raises `SettingsError` where no port is free, or viser is of an unknown version.
    """

    def __init__(
        self,
        model: ViewModel,  # what to show, and what is known of it, as in `ViewerState`
        views: Sequence[View] = (),
        reliability: Mapping[str, float] | None = None,
        source: LiveSource | None = None,  # of class probabilities that change while the viewer runs
        *,
        listener: Listener | None = None,  # where to listen, closed with the viewer; by default, what `listen` gives
        draw: str = AUTO,  # who draws: one of `DRAWN_BY`
        device: str = "cpu",
    ) -> None:
        if draw not in DRAWN_BY:
            raise SettingsError(f"draw is {draw!r}; expected one of {', '.join(DRAWN_BY)}")
        self.state = ViewerState(model, views, reliability or {}, device)
        self._source, self._closing = source, threading.Event()
        self._listener = listener or listen()
        self.server = start_server(self._listener)
        self.url = self._listener.url
        self.renderers = ClientRenderers(self.server, model.scene, draw, device)
        self.panel = Panel(self.server.gui, self.state, Viewpoint(self.server, self.state), source is not None)
        self.server.scene.on_click()(self._on_click)
        self.server.scene.on_click(modifier="shift")(self._on_correction_click)
        self.server.scene.on_rect_select(modifier="shift")(self._on_correction_box)
        self._show()
        self._threads = [threading.Thread(target=self._keep_showing, name="viewer", daemon=True)]
        if source is not None:
            follow = threading.Thread(target=self._follow, args=(source,), name="live source", daemon=True)
            self._threads.append(follow)
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """End the server; browsers are told that it is gone."""
        self._closing.set()
        self.state.stale.set()
        for thread in self._threads:
            thread.join(SOURCE_SECONDS)
        if self._source is not None:
            self._source.close()
        for thread in self._threads:
            thread.join()
        self.renderers.close()
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()
        self._listener.close()

    def _on_click(self, event: viser.SceneClickEvent) -> None:
        state, asked = self.state, self.panel.answer.ask()
        with self.panel.answer.telling(event.client):
            self.panel.clicked[event.client] = _place(event)
            with state.lock:  # What it is known by may change meanwhile, and is kept.
                shown = state.model.shown()
            picked = pick(
                state.model.scene,
                camera_of(event.client),
                np.array(event.ray_origin),
                np.array(event.ray_direction),
                shown,
                device=state.device,
            )
            self.panel.answer.show_picked(asked, picked)
            if picked is not None and state.views:
                votes = None
                with self.panel.answer.telling(event.client, in_place=False):
                    votes = state.view_votes(self.panel.answer.show_progress).of(picked.gaussian)
                self.panel.answer.show_picked(asked, picked, votes)

    def _on_correction_click(self, event: viser.SceneClickEvent) -> None:
        with self.panel.answer.telling(event.client):
            self.panel.correct_at(*_place(event))

    def _on_correction_box(self, event: viser.SceneRectSelectEvent) -> None:
        with self.panel.answer.telling(event.client):
            camera = camera_of(event.client, DRAWING_HEIGHT)
            self.panel.correct_box(camera, _pixel(camera, event.screen_min), _pixel(camera, event.screen_max))

    def _show(self) -> None:
        picture, rows = self.state.seen()
        self.renderers.show(picture)
        self.panel.show_classes(rows)

    def _keep_showing(self) -> None:
        while self.state.stale.wait() and not self._closing.is_set():
            self.state.stale.clear()
            with self.panel.answer.telling(None):
                self._show()

    def _follow(self, source: LiveSource) -> None:
        while not self._closing.is_set():
            try:
                update = source.wait(0.5)
                if update is not None:
                    self.state.replace(update.labelling)
                    self.panel.show_live(f"{counted(update.num_views, 'view')} so far")
            except Exception as error:
                if self._closing.is_set():  # The source was closed while it waited.
                    return
                if (what := explained(error)) is None:
                    raise
                self.panel.show_live(what)
                self._closing.wait(1.0)


def _place(event: viser.SceneClickEvent) -> Place:
    camera = camera_of(event.client, DRAWING_HEIGHT)
    return camera, *_pixel(camera, np.clip(event.screen_pos, 0, 1 - 1e-9))


def _pixel(camera: Camera, place: Sequence[float] | np.ndarray) -> tuple[float, float]:
    """Column and row of a place in the picture, which viser gives as parts of its width and height."""
    return float(place[0]) * camera.width, float(place[1]) * camera.height
