"""The table of scene formats: how each is recognised, and who reads it."""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from gsseg_core.errors import SceneFileError
from gsseg_core.files.input_files import reason
from gsseg_core.scene.ply import read_vertices


@dataclass(frozen=True)
class SceneFormat:
    """A format of scenes: what messages call it, its reader, and the suffixes of its files.

    The reader gets a file, and a folder below which that must lie, or None. It returns the Gaussians as a structured
    array (N,) with the properties of a 3DGS PLY.
    """

    name: str
    read: Callable[[Path, Path | None], npt.NDArray[np.void]]
    suffixes: tuple[str, ...]

    @property
    def looked_for(self) -> str:
        """What marks this format, for messages."""
        return " or ".join(self.suffixes)


SCENE_FORMATS = [SceneFormat("3DGS PLY", read_vertices, (".ply",))]
"""All formats, the first being that of a file whose suffix nobody knows; who adds one, adds it here."""


def read_scene(path: str | os.PathLike[str], within: Path | None = None) -> npt.NDArray[np.void]:
    """Read a scene of any of `SCENE_FORMATS`, a structured array (N,) with the properties of a 3DGS PLY.

    With `within`, the file must lie below that folder, links followed.

    Raises
    ------
    SceneFileError, ScenePropertyError
        The file is missing or broken; see the reader of its format.
    PathNotAllowedError
        It lies outside `within`.
    """
    path = Path(path)
    suited = [known for known in SCENE_FORMATS if path.suffix.lower() in known.suffixes]
    scene_format = (suited or SCENE_FORMATS)[0]
    try:
        return scene_format.read(path, within)
    except (SceneFileError, OSError) as error:
        what = str(error)
        if isinstance(error, OSError):
            what = f"{path}: cannot be read ({reason(error)}); expected a {scene_format.name}"
        formats = ", ".join(f"{known.name} ({known.looked_for})" for known in SCENE_FORMATS)
        known = "" if suited else f"; gsseg reads {formats}"
        hint = scene_hint(path) if within is None else ""  # It looks around, wherever links lead.
        raise SceneFileError(f"{what}{known}{hint}") from error


def scene_hint(path: Path) -> str:
    """Tell where a scene lies, if a folder or nothing was found in its place."""
    if path.is_dir():
        # Trainers write point_cloud/iteration_30000/point_cloud.ply; the one of most steps is wanted.
        trained = sorted(path.glob("point_cloud/iteration_*"), key=lambda folder: (len(folder.name), folder.name))
        found = [scene for folder in (*trained, path) for scene in _scenes_in(folder)]
        return f"; it is a folder: type {shlex.quote(str(found[-1]))}" if found else "; it is a folder without a scene"
    if not path.exists():
        near = _scenes_in(path.parent)
        return f"; found {', '.join(file.name for file in near[:4])} in {path.parent}" if near else ""
    return ""


def _scenes_in(folder: Path) -> list[Path]:
    suffixes = {suffix for known in SCENE_FORMATS for suffix in known.suffixes}
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in suffixes) if folder.is_dir() else []
