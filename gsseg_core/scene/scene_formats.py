"""The table of scene formats: how each is recognised, what reads it, and what it keeps of a Gaussian."""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from gsseg_core.errors import SceneFileError
from gsseg_core.files.input_files import open_input, reason
from gsseg_core.scene import checkpoint, compressed_ply, gltf, ksplat, ply, ply_variants, sog, splat, spz
from gsseg_core.scene.vertices import ReadScene

_HEAD = 1 << 16  # bytes that tell one format from another; a header of PLY with 60 properties takes 2,000


@dataclass(frozen=True)
class SceneFormat:
    """A format of scenes: what messages call it, its reader, the suffixes of its files, and what it keeps.

    The reader gets a file, and a folder below which that must lie, or None. It returns the Gaussians in the order of
    the file, as vertices of a 3DGS PLY (`gsseg_core.scene.vertices.pack_vertices`), and raises `SceneFileError` where
    the file is missing, broken, of another version, or does not hold what its header says. `marks` tells from the first
    bytes of a file, whatever its suffix, that it is of this format, or of one behind it in the table that marks it more
    closely; without it the suffix decides.
    """

    name: str
    read: Callable[[Path, Path | None], ReadScene]
    suffixes: tuple[str, ...]
    keeps: str = ""
    marks: Callable[[bytes], bool] | None = None

    @property
    def looked_for(self) -> str:
        """What marks this format, for messages."""
        return " or ".join(self.suffixes)


SCENE_FORMATS = [
    SceneFormat("3DGS PLY", ply_variants.read_3dgs, (".ply",), "everything, but SH up to degree 3", ply.is_ply),
    SceneFormat(
        "PlayCanvas compressed PLY", compressed_ply.read_compressed_ply, (".compressed.ply",),
        "SH degree 0 to 3 in 8 bits; positions and scales in 10 to 11 bits per block of 256, rotations in 10, colours "
        "and opacities in 8", compressed_ply.is_compressed_ply,
    ),
    SceneFormat(
        "Mip-Splatting PLY", ply_variants.read_mip_splatting, (".ply",),
        "everything; its 3D filter is fused into scales and opacities, its 2D filter is left out",
        ply_variants.is_mip_splatting,
    ),
    SceneFormat(
        "2DGS PLY", ply_variants.read_2dgs, (".ply",), "everything; the discs become a thousandth as thick as wide",
        ply_variants.is_2dgs,
    ),
    SceneFormat(
        "SPZ", spz.read_spz, (".spz",),
        "SH degree 0 to 3 in 4 to 8 bits; positions to 1/4096 of a unit as a rule, scales, colours and opacities in 8 "
        "bits, rotations in 8 to 10", spz.is_spz,
    ),
    SceneFormat(
        "SOG", sog.read_sog, (".sog", "meta.json"),
        "SH degree 0 to 3 from a palette of up to 65,536; positions in 16 bits, all else in 8; most writers sort the "
        "Gaussians", sog.is_sog,
    ),
    SceneFormat(
        "splat", splat.read_splat, (".splat",),
        "no SH above degree 0; positions and scales as floats, colours, opacities and rotations in 8 bits; some "
        "writers sort the Gaussians",
    ),
    SceneFormat(
        "ksplat", ksplat.read_ksplat, (".ksplat",),
        "SH degree 0 to 3; floats (level 0), or 16 bits for positions, scales and rotations (levels 1 and 2); colours "
        "and opacities in 8 bits; its writers sort the Gaussians",
    ),
    SceneFormat(
        "glTF with KHR_gaussian_splatting", gltf.read_gltf, (".glb", ".gltf"),
        "everything, as floats or as normalised integers", gltf.is_gltf,
    ),
    SceneFormat(
        "gsplat or nerfstudio checkpoint", checkpoint.read_checkpoint, (".pt", ".ckpt"),
        "everything, but SH up to degree 3", checkpoint.is_checkpoint,
    ),
]  # fmt: skip
"""All formats, the first for a file that is of no known one; a new one is added here."""


def find_format(path: Path, within: Path | None = None) -> SceneFormat | None:
    """Find the format of a file, or of a folder of SOG, by its first bytes or else by its suffix; None if unknown.

    A file that cannot be opened is of the format of its suffix, whose reader says why; `PathNotAllowedError` if it lies
    outside `within`.
    """
    name = path.name.lower()
    suited = [known for known in SCENE_FORMATS if name.endswith(known.suffixes)]
    if os.path.isdir(path):  # Unlike `Path.is_dir`, false where one may not even look.
        is_sog = os.path.exists(path / "meta.json")
        return next((known for known in SCENE_FORMATS if known.name == "SOG" and is_sog), None)
    try:
        with open_input(path, within) as file:
            head = file.read(_HEAD)
    except OSError:
        head = b""
    by_content = [known for known in reversed(SCENE_FORMATS) if known.marks and known.marks(head)]
    return next(iter([*by_content, *suited]), None)


def read_scene(path: str | os.PathLike[str], within: Path | None = None) -> ReadScene:
    """Read a scene of any of `SCENE_FORMATS`: its Gaussians in the order of the file, as vertices of a 3DGS PLY.

    Raises `SceneFileError` or `ScenePropertyError` where the file is missing or broken, `PathNotAllowedError` where it
    does not lie below `within`, links followed.
    """
    path = Path(path)
    suited = find_format(path, within)
    scene_format = suited or SCENE_FORMATS[0]
    try:
        return scene_format.read(path, within)
    except (SceneFileError, OSError) as error:
        what = str(error)
        if isinstance(error, OSError):  # of a reader that does not see to that itself
            what = f"{path}: cannot be read ({reason(error)}); expected a {scene_format.name}"
        formats = ", ".join(f"{known.name} ({known.looked_for})" for known in SCENE_FORMATS)
        known = "" if suited or os.path.isdir(path) else f"; gsseg reads {formats}"
        if known and path.suffix.lower() in (".usd", ".usda", ".usdc"):
            known = "; gsseg writes USD, and does not read it: give the scene that it was made from"
        hint = scene_hint(path) if within is None else ""  # It looks around, wherever links lead.
        raise SceneFileError(f"{what}{known}{hint}") from error


def scene_hint(path: Path) -> str:
    """Hint at where a scene lies, if a folder or nothing was found in its place; "" where one may not look."""
    with suppress(OSError):
        if path.is_dir():
            # Trainers write point_cloud/iteration_30000/point_cloud.ply; the one of most steps is wanted, and not the
            # input.ply beside it, which are COLMAP's points.
            trained = sorted(path.glob("point_cloud/iteration_*"), key=lambda folder: (len(folder.name), folder.name))
            found = [scene for folder in (path, *trained) for scene in _scenes_in(folder)]
            return f"; type {shlex.quote(str(found[-1]))}" if found else "; no scene lies in it"
        if not path.exists():
            near = _scenes_in(path.parent)
            return f"; found {', '.join(file.name for file in near[:4])} in {path.parent}" if near else ""
    return ""


def _scenes_in(folder: Path) -> list[Path]:
    suffixes = tuple(suffix for known in SCENE_FORMATS for suffix in known.suffixes)
    return sorted(path for path in folder.iterdir() if path.name.lower().endswith(suffixes)) if folder.is_dir() else []
