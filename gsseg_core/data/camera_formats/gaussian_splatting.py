"""Cameras of the original 3DGS trainer: `cameras.json`."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from gsseg_core.data.camera_formats.entries import Intrinsics, cameras_of, entries, inverse_pose
from gsseg_core.errors import CameraFileError
from gsseg_core.files.json_files import read_json, write_json
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.lens import MODELS_BY_NAME


def read_3dgs(path: Path, within: Path | None) -> list[Camera]:
    """Read `cameras.json`: camera-to-world poses in OpenCV axes; the principal point is the image's centre."""
    cameras = []
    for entry in entries(path, read_json(path, CameraFileError, within), "a list of cameras"):
        width, height = entry.size("width"), entry.size("height")
        focal = entry.number("fx"), entry.number("fy")
        pose = inverse_pose(entry.array("rotation", (3, 3)), entry.array("position", (3,)))
        intrinsics = Intrinsics(MODELS_BY_NAME["PINHOLE"], (width, height), focal, (width / 2, height / 2))
        cameras += cameras_of(entry.where, entry.stem("img_name"), intrinsics, pose)
    return cameras


def write_3dgs(path: Path, cameras: Iterable[Camera]) -> None:
    """Write `cameras.json`, atomically; it keeps no principal point, and no numbers of the cameras but their order."""
    entries = [
        {
            "id": i,
            "img_name": camera.name,
            "width": camera.width,
            "height": camera.height,
            "position": camera.center.tolist(),
            "rotation": camera.world_to_camera[:3, :3].T.tolist(),
            "fx": camera.fx,
            "fy": camera.fy,
        }
        for i, camera in enumerate(cameras)
    ]
    write_json(path, entries)
