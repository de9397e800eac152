"""Holds what the node's services share: settings, the live session, the job slot, the number of the last run."""

from __future__ import annotations

import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from builtin_interfaces.msg import Time

from gsseg_core.data.label_images import PER_VIEW
from gsseg_core.data.label_map import read_new_names
from gsseg_core.errors import PathNotAllowedError, SettingsError
from gsseg_core.live.living_session import Changed, LivingSession
from gsseg_core.live.session import LiveSession
from gsseg_core.progress import Stopwatch
from gsseg_core.refine.settings import RefineSettings
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_ros.conversions import stamp_message, stamp_ns
from gsseg_ros.errors import InvalidRequestError, MissingFileError, NoSceneError, NotActiveError
from gsseg_ros.node.frame_check import FrameCheck
from gsseg_ros.node.jobs import JobSlot, Requests
from gsseg_ros.node.masks.label_space import LabelSpace, NewNames
from gsseg_ros.node.parameters import Settings
from gsseg_ros.node.placement import Placement

_PATHS = {"scene_path": "a scene", "label_map": "a label map"}


@dataclass
class Run:
    """One piece of work for a request; all its outputs carry its stamp and number."""

    job: str  # what runs
    era: object  # as that of the workspace, when it began
    stamp: Time = field(default_factory=Time)  # when it was given its number
    revision: int = 0  # its number, counted from 1; 0 until it has one
    dropped: Counter[str] = field(default_factory=Counter)  # as that of the workspace, when it was given its number
    watch: Stopwatch = field(default_factory=Stopwatch)  # seconds of its stages
    _started: float = field(default_factory=time.perf_counter)

    @property
    def total_seconds(self) -> float:
        """Seconds since it began."""
        return time.perf_counter() - self._started


class Workspace:
    """Holds settings, session and job slot between requests. All its methods may be called from any thread."""

    def __init__(self, settings: Settings, now: Callable[[], Time]) -> None:
        self.settings, self.requests = settings, Requests()  # as of now; those at work
        self.slot = JobSlot()  # taken by whatever must not run beside a learn job
        self.placement = Placement(lambda: self._session)
        self.frames = FrameCheck()
        self.forget_waiting: Callable[[], None] = lambda: None  # drops the masks that wait to be fused
        self.label_space = LabelSpace(settings.class_names, None, settings.max_classes)
        self._at_start = {name: getattr(settings, name) for name in _PATHS}
        # Whether the node's state is active; what names of views begin with, a token of each activation.
        self.active, self.activations = False, set[str]()
        self.last_job = "none"  # and how it ended
        self.dropped: Counter[str] = Counter()  # masks that never became views, by reason, since a load or a reset
        # Changes of the scene made and refused, and the views that they left, lifted anew, and did not find.
        self.changes: Counter[str] = Counter()
        # When the last message of the topic scene_delta was refused (s, `time.monotonic`), and why.
        self.refused_change = (float("-inf"), "")
        self._now = now
        self._session: LiveSession | None = None
        self._lock = threading.Lock()
        self._revision = self._clock = self._stamp = 0

    @property
    def loaded(self) -> LiveSession | None:
        """The session of the scene; None if no scene is loaded."""
        return self._session

    @property
    def session(self) -> LiveSession:
        """The session of the scene. Raises `NoSceneError`: no scene is loaded."""
        if (session := self._session) is None:
            raise NoSceneError("no scene is loaded; expected the parameter scene_path, or a call of ~/load_scene")
        return session

    @property
    def living_session(self) -> LivingSession:
        """The session of the scene, for what changes it and for what other robots have learnt.

        Raises `NoSceneError`: no scene is loaded; `InvalidRequestError`: the session finds its objects itself, and so
        cannot follow.
        """
        if not isinstance(session := self.session, LivingSession):
            raise InvalidRequestError(
                "the parameter ids is per-view: objects that the node finds itself cannot follow a change of the "
                "scene, nor be merged with another robot's; expected ids given, or ~/load_scene with the new scene"
            )
        return session

    @property
    def era(self) -> object:
        """Token that changes when the scene or what is known of it is replaced; a mask carries that of its arrival."""
        session = self._session
        return self if session is None else session.era

    def require_allowed(self, settings: Settings) -> None:
        """Refuse what a peer may not set the parameters scene_path and label_map to.

        Raises `PathNotAllowedError`: it is not what was given at the start, and no request could name it.
        """
        for name, at_start in self._at_start.items():
            path = getattr(settings, name)
            try:
                if path not in ("", at_start):
                    self.path(os.path.abspath(path))
            except (PathNotAllowedError, ValueError) as error:
                raise PathNotAllowedError(f"parameter {name}, set after the start: {error}") from error

    def parameter_path(self, name: str) -> tuple[Path, Path | None]:
        """Path of the parameter scene_path or label_map, and the folder that it must not lead out of.

        There is no such folder for what was given at the start. Raises `MissingFileError`: there is no such file;
        `PathNotAllowedError`: it was set later, and does not lie below data_root.
        """
        path = Path(getattr(self.settings, name))
        self.require_allowed(self.settings)
        if not path.exists():
            raise MissingFileError(f"parameter {name}: {path} does not exist; expected {_PATHS[name]}")
        return path, None if str(path) == self._at_start[name] else self.root

    def configure(self, settings: Settings) -> None:
        """Take in the parameters, and read the label map. Raises `GssegError`: the label map cannot be used."""
        self.settings, new_names = settings, None
        if settings.label_map:
            path, within = self.parameter_path("label_map")
            new_names = NewNames(read_new_names(path, within), str(path))
            if settings.ids == PER_VIEW and any(name is not None for name in new_names.given.values()):
                raise SettingsError(
                    f"parameter label_map: {path} gives classes new names, but with ids '{PER_VIEW}' the node names "
                    "the objects that it finds itself; expected null for all of them"
                )
        self.label_space = LabelSpace(settings.class_names, new_names, settings.max_classes)

    def load_scene(self, path: str | Path, within: Path | None, placed: AbstractContextManager[object]) -> None:
        """Load a scene in place of the one there is, with all that was known of that; on any error nothing changes.

        `within` is a folder that its links must not lead out of. `placed` is entered last, to put the scene where it is
        to lie; what it raises ends the work.
        """
        settings = self.settings
        scene = GaussianScene.load(path, within)
        kept: dict[str, Any] = {
            "max_views": settings.max_views, "device": settings.device, "max_classes": settings.max_classes,
        }  # fmt: skip
        if settings.ids == PER_VIEW:
            from gsseg_core.live.per_view_session import PerViewSession  # Others start without SciPy.

            session: LiveSession = PerViewSession(scene, **kept)
        else:
            session = LivingSession(scene, self.label_space.classes, **kept)
        with placed:
            self._replace(session)
        self.dropped = Counter()
        self.forget_waiting()
        self._prepare(session)

    def grow_scene(
        self, path: str | Path, within: Path | None, tolerance: float, placed: AbstractContextManager[object]
    ) -> Changed:
        """Go over to a scene that has grown out of the one there is, with its votes; on any error nothing changes.

        `placed` puts it where it is to lie, and back where it lay if something is raised in its body.
        """
        session, scene = self.living_session, GaussianScene.load(path, within)
        with self.placement.fusing, placed:  # No mask is fused, and no view follows, before it is clear where to.
            changed = session.replace_scene(scene, tolerance)
        self.count(changed)
        self._prepare(session)
        return changed

    def _prepare(self, session: LiveSession) -> None:
        """Begin to find what the first request needs; without memory for a thread, that request finds it itself."""
        with suppress(RuntimeError):
            session.prepare(RefineSettings(k=self.settings.k))

    def count(self, changed: Changed) -> None:
        """Count a change of the scene."""
        counts = {"kept": changed.num_views_kept, "lifted anew": changed.num_views_lifted,
                  "named and not kept": changed.num_views_unknown}  # fmt: skip
        with self._lock:
            self.changes.update({"made": 1, **{f"views {what}": count for what, count in counts.items()}})

    def load_state(self, path: str | Path, within: Path | None = None) -> int:
        """Replace what is known of the scene by a saved state; return how many views are in it."""
        with self.placement.fusing:  # Views of the state may have the names of some that are still to follow.
            loaded = self.session.load(path, within)
            self.placement.forget()
        self.forget_waiting()
        return loaded

    def reset(self) -> int:
        """Forget all views and what was learnt, if there is a scene; return how many views were forgotten."""
        forgotten = self._session.reset() if self._session is not None else 0
        self.dropped = Counter()
        self.forget_waiting()
        return forgotten

    def close(self) -> None:
        """Forget the scene."""
        self._replace(None)

    def retire(self) -> None:
        """Refuse the results of whatever is still at work; the session stays."""
        if self._session is not None:
            self._session.retire()

    def _replace(self, session: LiveSession | None) -> None:
        self.placement.forget()
        before, self._session = self._session, session
        if before is not None:
            before.retire()

    def require_active(self) -> None:
        """Raise `NotActiveError` unless the node is active."""
        if not self.active:
            raise NotActiveError("the node is not active; expected it to be configured and activated first")

    @contextmanager
    def run(self, job: str) -> Iterator[Run]:
        """Begin a run, and note how it ends; `number` gives it its number."""
        run = Run(job, self.era)
        try:
            yield run
        except Exception as error:
            self.last_job = f"{job} failed: {error}"
            raise
        self.last_job = f"{job} done in {run.total_seconds:.2f} s"

    def number(self, run: Run) -> None:
        """Give a run its number and stamp, once it has what it goes by: to be long at work makes it no older."""
        with self._lock:
            self._revision += 1
            now = stamp_ns(self._now())
            # By its stamp a cloud is told from those of other runs, also while a simulator is paused.
            self._clock, self._stamp = now, self._stamp + 1 if now == self._clock else now
            run.stamp, run.revision, run.dropped = stamp_message(self._stamp), self._revision, Counter(self.dropped)

    def holds(self, run: Run) -> bool:
        """Whether a run is still valid: nothing was replaced, nor the node deactivated, since it began."""
        return run.era is self.era

    @property
    def root(self) -> Path:
        """The folder data_root, links followed."""
        return Path(self.settings.data_root).resolve()

    def path(self, request: str, default: str = "") -> Path:
        """Resolve a path of a request, absolute or relative to data_root.

        Between this and the opening any part of it may become a link to elsewhere: open it as `open_input` and
        `pinned_folder` do. Raises `PathNotAllowedError`: it is not below data_root once all links are followed, or
        data_root is not set.
        """
        if not self.settings.data_root:
            raise PathNotAllowedError(
                f"path '{request or default}': the parameter data_root is empty, so no path is allowed; expected it to "
                "be set to a folder"
            )
        root = self.root
        try:
            path = (root / (request or default)).resolve()
        except (OSError, RuntimeError, ValueError) as error:  # Links in a circle, or a NUL.
            raise PathNotAllowedError(f"path {request!r}: {error}; expected one below {root}") from error
        if "\0" in request or (path != root and root not in path.parents):
            raise PathNotAllowedError(f"path '{request}' is not below data_root; expected one below {root}")
        return path

    def existing(self, request: str, default: str = "") -> Path:
        """Resolve a path of a request as `path` does.

        Raises `PathNotAllowedError`: as `path` does; `MissingFileError`: there is no such file or folder.
        """
        path = self.path(request, default)
        if not os.path.exists(path):  # Path.exists raises an error where a name is too long.
            raise MissingFileError(f"{path}: does not exist")
        if not (path.is_file() or path.is_dir()):
            raise MissingFileError(f"{path}: is neither a file nor a folder, and reading it might never end")
        return path

    def existing_in(self, folder: Path, request: str) -> Path | None:
        """Resolve a path of a request that lies in a folder, or else below data_root; None for none.

        Raises `PathNotAllowedError`, `MissingFileError`: as `existing` does.
        """
        if not request:
            return None
        inside = self.path(str(folder / request))
        return self.existing(str(inside) if os.path.exists(inside) else request)
