"""What the node's services share: settings, the live session, the job slot, and the number of the last run."""

from __future__ import annotations

import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from builtin_interfaces.msg import Time

from gsseg_core.errors import PathNotAllowedError
from gsseg_core.live import LiveSession
from gsseg_core.live_ids import PerViewSession
from gsseg_core.pipeline import PER_VIEW
from gsseg_core.refine_settings import RefineSettings
from gsseg_core.report import Stopwatch
from gsseg_core.scene import GaussianScene
from gsseg_ros.errors import (
    InvalidRequestError,
    MissingFileError,
    NoSceneError,
    NotActiveError,
    UnknownClassError,
)
from gsseg_ros.jobs import JobSlot
from gsseg_ros.parameters import Settings


@dataclass
class Run:
    """One run, whose outputs all carry its stamp and number.

    Attributes
    ----------
    job : str
        What runs.
    stamp : Time
        When it began.
    revision : int
        Its number, counted from 1.
    dropped : Counter of str
        As that of the workspace, when it began.
    watch : Stopwatch
        Seconds of its stages.
    """

    job: str
    stamp: Time
    revision: int
    dropped: Counter[str]
    watch: Stopwatch = field(default_factory=Stopwatch)
    _started: float = field(default_factory=time.perf_counter)

    @property
    def total_seconds(self) -> float:
        """Seconds since it began."""
        return time.perf_counter() - self._started


class Workspace:
    """Holds what there is between requests. All its methods may be called from any thread.

    Attributes
    ----------
    settings : Settings
        As of now.
    slot : JobSlot
        Taken by whatever must not run beside a learn job.
    active : bool
        Whether the node's lifecycle state is active.
    last_job : str
        What the last job was, and how it ended.
    dropped : Counter of str
        Masks that never came to be views, by reason, since the scene was loaded or reset.
    """

    def __init__(self, settings: Settings, now: Callable[[], Time]) -> None:
        self.settings, self.slot = settings, JobSlot()
        self._scene_at_start = settings.scene_path
        self.active = False
        self.last_job = "none"
        self.dropped: Counter[str] = Counter()
        self._now = now
        self._session: LiveSession | None = None
        self._lock = threading.Lock()
        self._revision = 0

    @property
    def has_scene(self) -> bool:
        """Whether a scene is loaded."""
        return self._session is not None

    @property
    def session(self) -> LiveSession:
        """The session of the scene.

        Raises
        ------
        NoSceneError
            No scene is loaded.
        """
        if self._session is None:
            raise NoSceneError("no scene is loaded; expected the parameter scene_path, or a call of ~/load_scene")
        return self._session

    def require_allowed_scene(self, path: str) -> None:
        """Refuse what a peer may not set the parameter scene_path to.

        Raises
        ------
        PathNotAllowedError
            It is not what was given at the start, and no request could name it.
        """
        if path in ("", self._scene_at_start):
            return
        try:
            self.path(os.path.abspath(path))
        except (PathNotAllowedError, ValueError) as error:
            raise PathNotAllowedError(f"parameter scene_path, set after the start: {error}") from error

    def scene_path(self) -> tuple[Path, Path | None]:
        """Path of the parameter scene_path, and the folder that it must not lead out of: none for that of the start.

        Raises
        ------
        MissingFileError
            There is no such file.
        PathNotAllowedError
            It was set later, and does not lie below data_root.
        """
        path = Path(self.settings.scene_path)
        self.require_allowed_scene(self.settings.scene_path)
        if not path.is_file():
            raise MissingFileError(f"parameter scene_path: {path} does not exist; expected a 3DGS PLY")
        return path, None if self.settings.scene_path == self._scene_at_start else self.root

    def load_scene(self, path: str | Path, within: Path | None = None) -> None:
        """Load a scene in place of the one there is, with all that was known of that; on any error nothing changes."""
        settings = self.settings
        scene = GaussianScene.load(path, within)
        kept: dict[str, Any] = {"max_views": settings.max_views, "device": settings.device}
        if settings.ids == PER_VIEW:
            session: LiveSession = PerViewSession(scene, **kept)
        else:
            session = LiveSession(scene, settings.names_by_id, **kept)
        self.dropped = Counter()
        session.prepare(RefineSettings(k=settings.k))
        self._session = session

    def reset(self) -> int:
        """Forget codes and views, if there is a scene; return how many views were forgotten."""
        self.dropped = Counter()
        return self._session.reset() if self._session is not None else 0

    def close(self) -> None:
        """Forget the scene."""
        self._session = None

    def require_active(self) -> None:
        """Raise `NotActiveError` unless the node is active."""
        if not self.active:
            raise NotActiveError("the node is not active; expected it to be configured and activated first")

    @contextmanager
    def run(self, job: str) -> Iterator[Run]:
        """Give a run its number; if it fails, that number is skipped."""
        with self._lock:
            self._revision += 1
            run = Run(job, self._now(), self._revision, Counter(self.dropped))
        try:
            yield run
        except Exception as error:
            self.last_job = f"{job} failed: {error}"
            raise
        self.last_job = f"{job} done in {run.total_seconds:.2f} s"

    @property
    def root(self) -> Path:
        """The folder data_root, links followed."""
        return Path(self.settings.data_root).resolve()

    def path(self, request: str, default: str = "") -> Path:
        """Resolve a path of a request, absolute or relative to data_root.

        Between this and the opening any part of it may become a link to elsewhere: open it as
        `gsseg_core.confined_files` does.

        Raises
        ------
        PathNotAllowedError
            It is not below data_root once all links are followed, or data_root is not set.
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

        Raises
        ------
        PathNotAllowedError
            As `path` does.
        MissingFileError
            There is no such file or folder.
        """
        path = self.path(request, default)
        if not os.path.exists(path):  # Path.exists raises an error where a name is too long.
            raise MissingFileError(f"{path}: does not exist")
        if not (path.is_file() or path.is_dir()):
            raise MissingFileError(f"{path}: is neither a file nor a folder, and reading it might never end")
        return path


def chosen_classes(request: Any, class_names: Mapping[int, str]) -> list[int]:
    """Ids of the classes that a request asks for, ascending; all if it names none.

    Raises
    ------
    UnknownClassError
        A name or number does not exist.
    """
    ids = {name: k for k, name in class_names.items()}
    chosen: set[int] = set()
    for wanted in request.classes:
        k = ids.get(wanted, int(wanted) if wanted.isascii() and wanted.isdigit() else -1)
        if k not in class_names:
            known = ", ".join(class_names.values())
            raise UnknownClassError(f"class '{wanted[:60]}' does not exist; expected one of {known[:500]}")
        chosen.add(k)
    return sorted(chosen or class_names)


def checked_confidence(request: Any) -> float:
    """Threshold of a request.

    Raises
    ------
    InvalidRequestError
        It is not in [0, 1].
    """
    if not 0 <= request.min_confidence <= 1:
        raise InvalidRequestError(f"min_confidence is {request.min_confidence}; expected 0 to 1")
    return float(request.min_confidence)
