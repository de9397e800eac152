"""Cameras of a dataset folder, from whichever camera format it has."""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import replace
from itertools import takewhile
from pathlib import Path

from gsseg_core.data.camera_formats.table import CAMERA_FORMATS, CameraFormat
from gsseg_core.data.class_names import flaw_of_view_name
from gsseg_core.data.hints import camera_hint
from gsseg_core.errors import CameraFileError
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.similarity import Similarity
from gsseg_core.text import quoted


def read_cameras(folder: str | os.PathLike[str], within: Path | None = None) -> list[Camera]:
    """Read the cameras of a dataset folder, from the first of `CAMERA_FORMATS` that it has, in the order of the file.

    Names are the stems of the image names, after those of their folders where two images share a stem: `left_0001` and
    `right_0001` of `left/0001.jpg` and `right/0001.jpg`. Where a lens bent the images, the cameras are those of their
    pinhole views; of a panorama there are six, named `<stem>_front` and so on: see `Camera.undistortion`. With
    `within`, the files must lie below that folder, links followed.

    Raises `CameraFileError` where there are no cameras, a file is broken or two images still share a name, `PoseError`
    or `IntrinsicsError` where a camera is unusable or its lens of no known model, `PathNotAllowedError` where a file
    lies outside `within`.
    """
    folder = Path(folder)
    found = find_cameras(folder)
    if found is None:
        hint = camera_hint(folder) if within is None else ""  # It looks around, wherever links lead.
        what = "has no cameras" if folder.is_dir() else "is not a folder"
        *most, last = (f"{known.looked_for} ({known.name})" for known in CAMERA_FORMATS)
        raise CameraFileError(f"{folder}: {what}; looked for {', '.join(most)}, and {last}{hint}")
    camera_format, path = found
    cameras = _named(camera_format.read(path, within))
    if not cameras:
        raise CameraFileError(f"{path}: holds no camera; expected at least one")
    for camera in cameras:
        if flaw := flaw_of_view_name(camera.name):
            raise CameraFileError(f"{path}: an image has the name {flaw}")
    stem, count = Counter(camera.name for camera in cameras).most_common(1)[0]
    if count > 1:
        raise CameraFileError(f"{path}: {count} images have the stem {quoted(stem)}; expected another one for each")
    return cameras


def _named(cameras: list[Camera]) -> list[Camera]:
    """Name cameras, whose names are still those of images in folders, as `read_cameras` says."""
    paths = [camera.name.split("/") for camera in cameras]
    names = [path[-1] for path in paths]
    if len(set(names)) < len(names):
        folders = zip(*(path[:-1] for path in paths), strict=False)
        shared = len(list(takewhile(lambda level: len(set(level)) == 1, folders)))
        names = ["_".join(path[shared:]) for path in paths]
    return [replace(camera, name=name) for camera, name in zip(cameras, names, strict=True)]


def frame_of_training(folder: Path, dataparser: Path) -> Similarity | None:
    """Read how nerfstudio moved the cameras of a dataset folder before it trained on them: from theirs to its frame.

    `dataparser` is the `dataparser_transforms.json` beside the trained config. None if the cameras are of a format that
    nerfstudio does not train from; raises `CameraFileError` or `PoseError` where a file is missing or broken.
    """
    found = find_cameras(folder)
    if found is None or found[0].frame_of_training is None:
        return None
    return found[0].frame_of_training(found[1], dataparser)


def find_cameras(folder: Path) -> tuple[CameraFormat, Path] | None:
    """Find the cameras of a dataset folder, and of which format they are; None where it has none."""
    return next(((known, path) for known in CAMERA_FORMATS if (path := known.find(folder))), None)
