"""The table of formats that scenes are written in: what writes each, and which extra of gsseg it needs."""

from __future__ import annotations

import importlib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from gsseg_core.errors import SceneValueError, SettingsError
from gsseg_core.files.atomic import write_atomically
from gsseg_core.text import clipped

if TYPE_CHECKING:
    from gsseg_core.scene.gaussian_scene import GaussianScene
    from gsseg_core.scene.triangle_mesh import TriangleMesh


class SceneWriter(NamedTuple):
    """A format that scenes are written in.

    Its function takes the path of an empty file, a `GaussianScene` (or a sequence of `SceneObject`, if it keeps objects
    apart) and the id of a run or None.
    """

    suffixes: tuple[str, ...]  # of its files; the first is what gsseg gives them
    write: str = ""  # its function as "module:function", imported when it is used; "" is `GaussianScene.save`
    extra: str = ""  # the extra of gsseg with the library that this needs, if it needs one
    together: bool = False  # whether a file holds several objects and keeps them apart


class SceneObject(NamedTuple):
    """An object of a file that holds several: its Gaussians; of its class, if any, id and name; its collision mesh."""

    scene: GaussianScene
    label: int | None = None
    name: str = ""
    collision: TriangleMesh | None = None


_WRITERS = "gsseg_core.scene.writers"

SCENE_WRITERS = {
    "ply": SceneWriter((".ply",)),
    "compressed-ply": SceneWriter((".compressed.ply",), f"{_WRITERS}.compressed_ply:write_compressed_ply", "formats"),
    "spz": SceneWriter((".spz",), f"{_WRITERS}.spz:write_spz", "formats"),
    "sog": SceneWriter((".sog",), f"{_WRITERS}.sog:write_sog"),
    "splat": SceneWriter((".splat",), f"{_WRITERS}.splat:write_splat"),
    "glb": SceneWriter((".glb",), f"{_WRITERS}.glb:write_glb"),
    "usd": SceneWriter((".usdc", ".usd", ".usda"), f"{_WRITERS}.usd:write_usd", "usd", together=True),
}
"""Every format by the name that options have for it; the first is the default."""

DEFAULT = next(iter(SCENE_WRITERS))
# What is named so is taken for what it says, and is no PLY.
_FOREIGN = (".usdz", ".obj", ".stl", ".fbx", ".dae", ".pcd", ".las", ".laz", ".e57")


def check_format(name: str) -> None:
    """Raise `SettingsError` if there is no such format, or the library that writes it is not installed."""
    if name not in SCENE_WRITERS:
        raise SettingsError(f"format is {clipped(name)!r}; expected one of {', '.join(SCENE_WRITERS)}")
    writer_of(name)


def writer_of(name: str) -> Any:
    """Import the module that writes one of `SCENE_WRITERS`, and return its function; None where the scene does it.

    Raises `SettingsError` where the library that it needs is not installed.
    """
    writer = SCENE_WRITERS[name]
    if not writer.write:
        return None
    module, function = writer.write.split(":")
    try:
        return getattr(importlib.import_module(module), function)
    except ImportError as error:
        raise SettingsError(
            f"format {name}: needs {error.name}, which is not installed; expected: pip install 'gsseg[{writer.extra}]'"
        ) from error


def format_of(path: str | os.PathLike[str], asked: str | None = None) -> str:
    """Name of the format for a file: the one that is asked for, else that of its suffix, else PLY.

    Raises `SettingsError` where the suffix is that of another format than is asked for, or of one that gsseg does not
    write, and what `check_format` raises of what is asked for.
    """
    from gsseg_core.scene.scene_formats import SCENE_FORMATS  # `gsseg --help` does without.

    if asked is not None:
        check_format(asked)
    file = Path(path).name.lower()
    fits = {suffix: name for name, writer in SCENE_WRITERS.items() for suffix in writer.suffixes}
    by_suffix = fits.get(max(filter(file.endswith, fits), key=len, default=""))
    if by_suffix is None:
        only_read = next((known.name for known in SCENE_FORMATS if file.endswith(known.suffixes)), None)
        if only_read or file.endswith(_FOREIGN):
            known = f"{only_read}, which gsseg reads and does not write" if only_read else "a format of others"
            suffixes = ", ".join(writer.suffixes[0] for writer in SCENE_WRITERS.values())
            raise SettingsError(f"{path}: has the suffix of {known}; expected {suffixes}")
    if asked is None or by_suffix in (None, asked):
        return asked or by_suffix or DEFAULT
    raise SettingsError(
        f"{path}: has the suffix of the format {by_suffix}, but {asked} is asked for; expected the suffix "
        f"{SCENE_WRITERS[asked].suffixes[0]}"
    )


def write_scene(
    scene: GaussianScene, path: str | os.PathLike[str], scene_format: str | None = None, run: str | None = None
) -> None:
    """Write a scene in a format of `SCENE_WRITERS`, atomically.

    Parameters
    ----------
    scene_format : str, optional
        Name of the format; by default, what the suffix of `path` says, and PLY if that says nothing.
    run : str, optional
        Id of the run that it belongs to, which PLY, SOG, GLB and USD keep.

    Raises
    ------
    SettingsError
        There is no such format, the suffix is that of another, or the library that writes it is not installed.
    SceneValueError
        The format cannot hold this scene.
    WriteError
        The file cannot be written; an earlier one is unchanged.
    """
    name = format_of(path, scene_format)
    if SCENE_WRITERS[name].together:
        write_objects([SceneObject(scene)], path, name, run)
        return
    write = writer_of(name)
    if write is None:
        scene.save(path, run)
        return
    with write_atomically(path) as temporary:
        try:
            write(temporary, scene, run)
        except SceneValueError as error:  # Nobody knows the file into which it was written.
            raise SceneValueError(f"{path}: {error}") from error


def write_objects(
    objects: Sequence[SceneObject], path: str | os.PathLike[str], scene_format: str, run: str | None = None
) -> None:
    """Write objects into one file of a format that keeps them apart, atomically; raises what `write_scene` does."""
    check_format(scene_format)
    with write_atomically(path) as temporary:
        writer_of(scene_format)(temporary, objects, run)
