"""The table of camera formats: how each is recognised in a dataset folder, and what reads it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from gsseg_core.data.camera_formats.colmap import read_colmap
from gsseg_core.data.camera_formats.dataparser import original_to_trained, saved_to_trained
from gsseg_core.data.camera_formats.gaussian_splatting import read_3dgs
from gsseg_core.data.camera_formats.nerfstudio import read_nerfstudio
from gsseg_core.errors import CameraFileError
from gsseg_core.files.input_files import is_there
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.similarity import Similarity


@dataclass(frozen=True)
class CameraFormat:
    """A format of cameras: the program that writes it, its reader, and the files by which it is recognised.

    A dataset is of this format if it has one of `files`, in one of its sub-folders `folders` if there are any. `read`
    takes that file, or with `folders` the sub-folder, and a folder below which all that is read must lie, or None; it
    returns the cameras in the order of the file. nerfstudio moves cameras before it trains on them: for formats that it
    reads, `frame_of_training` tells how, from the same file or folder and its `dataparser_transforms.json`.
    """

    name: str
    read: Callable[[Path, Path | None], list[Camera]]
    files: tuple[str, ...]
    folders: tuple[str, ...] = ()
    frame_of_training: Callable[[Path, Path], Similarity] | None = None

    def find(self, dataset: Path) -> Path | None:
        """Find what `read` reads of a dataset folder; None if it has no cameras of this format."""
        places = [self.find_in(dataset / name) for name in self.folders or ("",)]
        return next((place for place in places if place is not None), None)

    def find_in(self, folder: Path) -> Path | None:
        """Find what `read` reads, in the folder that holds `files` itself."""
        for name in self.files:
            if is_there(folder / name, CameraFileError):
                return folder if self.folders else folder / name
        return None

    @property
    def looked_for(self) -> str:
        """What marks this format, for messages."""
        return " or ".join(self.files) + (f" in {' or '.join(self.folders)}" if self.folders else "")


CAMERA_FORMATS = [
    CameraFormat("3DGS", read_3dgs, ("cameras.json",)),
    CameraFormat(
        "nerfstudio", read_nerfstudio, ("transforms.json", "transforms_train.json"), frame_of_training=saved_to_trained
    ),
    CameraFormat("COLMAP", read_colmap, ("cameras.bin", "cameras.txt"), ("sparse/0", "sparse"), original_to_trained),
]
"""All formats; the first that a dataset has is read. A new one is added here."""
