"""Keeps the views that were fused where the parameters scene_to_map say the scene lies, while these change."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from typing import Any, TypeAlias

from gsseg_core.errors import GssegError
from gsseg_core.scene.camera import Camera
from gsseg_ros.frames import Similarity

_Ways: TypeAlias = dict[str, tuple[Similarity, Similarity]]


class Placement:
    """Has views follow the scene: cameras were measured in the map, and stay there when the scene is put elsewhere.

    Each view is moved by itself, in a thread, and others are fused in between. In the end votes are what they would be
    if every view that is kept had come when the scene was there already.
    """

    def __init__(self, loaded: Callable[[], Any]) -> None:
        # Held from where a view's pose is brought into the scene until it is fused, and while the scene is moved.
        self.fusing = threading.RLock()
        self._loaded = loaded  # the session, if any: a `LivingSession`, or a `PerViewSession`, which loads SciPy
        self.settled: Callable[[], None] = lambda: None  # called in that thread when all views have followed
        # Told what was wrong with a view that cannot follow; it stays where it is until the next change.
        self.refused: Callable[[str], None] = lambda message: None
        self._moved_from: _Ways = {}  # By view, to where it has to follow.
        self._left: dict[str, Similarity] = {}  # By view that could not follow: where the scene was for it.
        self._running = False

    def change(self, before: Similarity, after: Similarity, take_over: Callable[[], None]) -> None:
        """Move the scene, and begin to have the views follow; `take_over` makes it known to those that come now."""
        with self.fusing:
            take_over()
            session = self._loaded()
            names = [] if session is None else session.view_names
            at = self._left | {name: moved[0] for name, moved in self._moved_from.items()}
            moved_from = {name: (at.get(name, before), after) for name in names}
            # To go nowhere costs as much as to go far, and rounds the camera.
            self._moved_from = {name: (left, to) for name, (left, to) in moved_from.items() if left != to}
            self._left = {}
            self._begin()

    def bring(self, names: Iterable[str]) -> None:
        """Have some views follow before anything else; whoever goes on from where they are then holds `fusing`."""
        with self.fusing:
            moved_from, session = self._moved_from, self._loaded()
            waiting = [] if session is None else set(names) & moved_from.keys()
            for name in waiting:
                self._follows(session, name, moved_from)

    def finish(self, check: Callable[[], object] = lambda: None) -> None:
        """Have all views follow, one by one, others being fused in between; `check` may end it by raising something."""
        while self._next_follows():
            check()

    def forget(self) -> None:
        """Leave all views where they are, as they are replaced."""
        # Without the lock: whoever replaces the scene must not wait for a view that is being fused.
        self._moved_from, self._left = {}, {}

    def _begin(self) -> None:
        if self._running:
            return
        try:
            threading.Thread(target=self._follow, name="placement", daemon=True).start()
            self._running = True
        except RuntimeError as error:  # Memory is too short for a thread.
            later = "they do with its next change, or with ~/learn, ~/save_state or ~/export"
            self.refused(f"views do not follow the scene yet ({error}); {later}")

    def _follow(self) -> None:
        self.finish()
        self.settled()

    def _next_follows(self) -> bool:
        """Have one view follow; returns whether there was one."""
        with self.fusing:
            self._running, moved_from = False, self._moved_from  # Whatever is raised here, others may follow later.
            session = self._loaded()
            if not moved_from or session is None:
                return False
            self._follows(session, next(iter(moved_from)), moved_from)
            self._running = True
            return True

    def _follows(self, session: Any, name: str, moved_from: _Ways) -> None:
        before, after = moved_from[name]
        try:
            done = session.move_view(name, partial(_moved, before=before, after=after), session.era)
        except GssegError as error:
            self._left[name] = before
            self.refused(f"a view cannot follow the scene and stays where it was: {error}")
            done = True
        if done:
            del moved_from[name]


def _moved(camera: Camera, before: Similarity, after: Similarity) -> Camera:
    """Keep a camera where it is in the map."""
    pose = before.camera_in_map(camera.world_to_camera)
    return replace(camera, world_to_camera=after.world_to_camera(pose))
