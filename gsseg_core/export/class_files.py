"""One file for each object of a segmentation, or one for all of them, in any format that scenes are written in."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.recfunctions import repack_fields

from gsseg_core.export.collision import check_collision, collision_meshes
from gsseg_core.files.atomic import check_replaceable, write_atomically
from gsseg_core.files.run_folder import staged_run
from gsseg_core.progress import Progress, silent
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.ply import write_parts
from gsseg_core.scene.scene_writers import DEFAULT, SCENE_WRITERS, SceneObject, check_format, write_objects, write_scene
from gsseg_core.scene.triangle_mesh import LONE, TriangleMesh
from gsseg_core.scene.vertices import chosen
from gsseg_core.segmentation import REMOVED, Segmentation
from gsseg_core.spatial.row_order import rows_by_label, take_rows_into

TOGETHER = "objects"  # stem of the file in which a format keeps the objects of all classes
_PART = 1 << 15  # vertices that are copied and written at a time


def export_classes(
    scene: GaussianScene,
    segmentation: Segmentation,
    folder: str | os.PathLike[str],
    scene_format: str = DEFAULT,
    collision: str | None = None,
) -> dict[int, Path]:
    """Write `<id>_<name>.ply` for every class that has Gaussians; valid 3DGS PLYs with all properties kept.

    Two properties are added: `label` (int), the class, and `confidence` (float), that of the segmentation.

    Another format has another suffix, and keeps what it can hold (docs/formats.md). USD holds all classes in one file,
    `objects.usdc`. All files of an earlier export are replaced in one step, as `gsseg_core.files.run_folder` says;
    other files stay.

    Parameters
    ----------
    scene_format : str
        One of `gsseg_core.scene.scene_writers.SCENE_WRITERS`.
    collision : str, optional
        One of `gsseg_core.export.collision.KINDS`: such a mesh of every object, as `<id>_<name>.obj` and in the USD.

    Returns
    -------
    dict of int to pathlib.Path
        The file of each class.

    Raises
    ------
    SettingsError
        There is no such format or kind of mesh, or the library that it needs is not installed.
    StateMismatchError
        The segmentation belongs to another scene.
    SceneValueError
        The format cannot hold the scene.
    PathTakenError
        The folder, or the name of a file, is taken by what is no earlier export, or the scene is a file of that, which
        would be lost; nothing was written.
    WriteError
        Something cannot be written; an earlier export is unchanged.
    """
    check_format(scene_format)
    check_collision(collision)
    segmentation.require(scene)
    folder = Path(folder)
    with staged_run(folder, "classes", inputs=filter(None, [scene.path])) as run:
        meshes = collision_meshes(scene, segmentation.labels, segmentation.confidence, collision)
        written = write_classes(scene, segmentation, run.folder, run.id, scene_format, meshes)
    return {k: folder / path.name for k, path in written.items()}


def write_classes(
    scene: GaussianScene,
    segmentation: Segmentation,
    folder: Path,
    run: str,
    scene_format: str,
    meshes: Mapping[int, TriangleMesh],
    order: np.ndarray | None = None,  # (N,) int64
) -> dict[int, Path]:
    """Write the files of `export_classes` into a folder of a run with this id, with these meshes to collide with.

    Gaussians are written in the order of the scene, or in another `order`.
    """
    confidence, names = segmentation.confidence, segmentation.class_names
    order = np.arange(len(scene)) if order is None else order
    members = {k: order[ids] for k, ids in _members(segmentation.labels[order]).items()}
    paths = class_paths(segmentation, folder, scene_format)
    for k, mesh in meshes.items():
        mesh.save(folder / mesh_file_name(k, names[k]), run)
    if SCENE_WRITERS[scene_format].together:
        if paths:
            objects = _objects(scene, members, names, meshes)
            write_objects(objects, next(iter(paths.values())), scene_format, run)
        return paths
    for k, path in paths.items():
        if scene_format == DEFAULT:
            write_parts(path, len(members[k]), *_with_confidence(scene.vertices, members[k], k, confidence), run)
        else:
            write_scene(scene.subset(members[k]), path, scene_format, run)
    return paths


def write_selection(
    scene: GaussianScene,
    chosen: np.ndarray,  # (N,) bool
    labels: np.ndarray,  # (N,) int
    confidence: np.ndarray,  # (N,)
    class_names: Mapping[int, str],
    path: str | os.PathLike[str],
    scene_format: str,
    collision: str | None = None,
    progress: Progress = silent,  # of making meshes
) -> None:
    """Write some Gaussians of a scene as one file, in which USD keeps the classes of these labels apart.

    Meshes to collide with, of a kind if one is given, are of what is chosen. They go into the USD, or beside another
    file, as `<its stem>_<id>_<name>.obj`; those that an earlier call wrote there for other classes are removed. If
    anything cannot be written, all files are as they were. Raises what `gsseg_core.scene.scene_writers.write_scene` and
    `check_collision` do, `EmptySceneError` where none is chosen, and `PathTakenError` where a file that is none of
    these is in the place of a mesh.
    """
    part = scene.subset(chosen)
    meshes = collision_meshes(scene, np.where(chosen, labels, REMOVED), confidence, collision, progress)
    if SCENE_WRITERS[scene_format].together:
        labels = labels[chosen]
        objects = _objects(part, _members(labels), class_names, meshes)
        if (labels < 0).any():
            objects.append(SceneObject(part.subset(labels < 0)))
        write_objects(objects, path, scene_format)
        return
    stem = stem_of(path, scene_format)
    places = {k: Path(path).with_name(f"{stem}_{mesh_file_name(k, name)}") for k, name in class_names.items()}
    for k in meshes:
        check_replaceable(places[k], "mesh of an earlier call", _is_lone_mesh(places[k]))
    with ExitStack() as written:  # Meshes get their names once the scene has its own.
        for k, mesh in meshes.items():
            mesh.write(written.enter_context(write_atomically(places[k])))
        write_scene(part, path, scene_format)
    for k in places.keys() - meshes.keys() if collision else ():
        if _is_lone_mesh(places[k]) and not places[k].is_symlink():
            with suppress(OSError):
                places[k].unlink()


def _is_lone_mesh(path: Path) -> bool:
    """Whether a file is a mesh of an earlier selection."""
    with suppress(OSError, UnicodeDecodeError):
        if path.is_file():
            with open(path, encoding="ascii") as file:
                return file.readline(len(LONE)) == LONE
    return False


def _members(labels: np.ndarray) -> dict[int, np.ndarray]:  # (N,) int
    """List the Gaussians of each class that has any, (M,) int64."""
    return {k: ids for k, ids in rows_by_label(labels).items() if k >= 0}


def _objects(
    scene: GaussianScene,
    members: Mapping[int, np.ndarray],  # (M,) int64 of each class
    class_names: Mapping[int, str],
    meshes: Mapping[int, TriangleMesh],
) -> list[SceneObject]:
    """All classes that have Gaussians, as objects of one file."""
    return [SceneObject(scene.subset(ids), k, class_names[k], meshes.get(k)) for k, ids in members.items()]


def class_paths(segmentation: Segmentation, folder: Path, scene_format: str) -> dict[int, Path]:
    """File that `write_classes` writes for each class that has Gaussians."""
    names, present = segmentation.class_names, np.flatnonzero(segmentation.counts()).tolist()
    return {k: folder / class_file_name(k, names[k], scene_format) for k in present}


def class_places(class_names: Mapping[int, str], scene_format: str, collision: str | None) -> list[str]:
    """Names of the files that `write_classes` may write."""
    meshes = [mesh_file_name(k, name) for k, name in class_names.items() if collision]
    return [*dict.fromkeys(class_file_name(k, name, scene_format) for k, name in class_names.items()), *meshes]


def class_file_name(label: int, name: str, scene_format: str = DEFAULT) -> str:
    """File name of a class, safe on any file system."""
    writer = SCENE_WRITERS[scene_format]
    return f"{TOGETHER if writer.together else _stem(label, name)}{writer.suffixes[0]}"


def mesh_file_name(label: int, name: str) -> str:
    """File name of the mesh to collide with of a class, safe on any file system."""
    return f"{_stem(label, name)}.obj"


def stem_of(path: str | os.PathLike[str], scene_format: str) -> str:
    """Name of a file without the suffix of its format, or without the last one it has."""
    path = Path(path)
    suffixes = (s for s in SCENE_WRITERS[scene_format].suffixes if path.name.lower().endswith(s))
    return path.name[: -len(next(suffixes, path.suffix)) or None]


def _stem(label: int, name: str) -> str:
    return f"{label}_{re.sub(r'[^0-9A-Za-z._-]+', '_', name)[:100].strip('._') or 'class'}"


def _with_confidence(
    vertices: np.ndarray,  # (N,) records
    ids: np.ndarray,  # (M,)
    label: int,
    confidence: np.ndarray,  # (N,)
) -> tuple[np.dtype[Any], Iterator[np.ndarray]]:
    """Add the properties `label` (int32) and `confidence` to some of the vertices: their dtype, and they in parts.

    Earlier properties of these names go. A part must be written before the next one is asked for.
    """
    names = [name for name in vertices.dtype.names or () if name not in ("label", "confidence")]
    kept = repack_fields(vertices[:0][names])
    dtype = np.dtype([*kept.dtype.descr, ("label", "<i4"), ("confidence", "<f4")])
    as_numbers = kept.itemsize == vertices.itemsize and kept.itemsize % 4 == 0 and vertices.flags.c_contiguous

    def parts() -> Iterator[np.ndarray]:
        buffer = np.empty(min(len(ids), _PART), dtype)
        for first in range(0, len(ids), _PART):
            some = ids[first : first + _PART]
            out = buffer[: len(some)]
            if as_numbers:  # Four bytes at a time are only copied, whatever they stand for.
                into, table = (array.view(np.float32).reshape(len(array), -1) for array in (out, vertices))
                take_rows_into(into, table, some)
            else:  # As bytes: property by property takes several times as long.
                part = repack_fields(chosen(vertices, some)[names])
                rows = out.view(np.uint8).reshape(len(out), -1)
                rows[:, : kept.itemsize] = part.view(np.uint8).reshape(len(part), -1)
            out["label"], out["confidence"] = label, confidence[some]
            yield out

    return dtype, parts()
