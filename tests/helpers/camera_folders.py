"""Camera files of all formats with one known camera, and a point that lands on a known pixel of it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from gsseg_core.data.camera_files import read_cameras
from gsseg_core.errors import GssegError
from gsseg_core.scene.camera import Camera

# A camera at POSITION looks along the world's +x, the world's +z being up. POINT lies 2 before it, 0.5 to its right and
# 0.25 below its axis: with focal lengths 100 and 120 it lands 25 pixels right of, and 15 below, the principal point.
POSITION = (1.0, 2.0, 3.0)
RIGHT, DOWN, FORWARD = (0.0, -1.0, 0.0), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0)
POINT = (3.0, 1.5, 2.75)
ROTATION = np.stack([RIGHT, DOWN, FORWARD], axis=1)  # camera to world, OpenCV axes
WIDTH, HEIGHT, FX, FY = 64, 48, 100.0, 120.0
K = np.array([[FX, 0, 32], [0, FY, 24], [0, 0, 1]])
WORLD_TO_CAMERA = np.block([[ROTATION.T, -ROTATION.T @ np.array(POSITION)[:, None]], [np.zeros(3), 1]])


def entry_3dgs(name: str = "0001", **changes: Any) -> dict[str, Any]:
    entry = {"id": 0, "img_name": name, "width": WIDTH, "height": HEIGHT, "position": list(POSITION)}
    return entry | {"rotation": ROTATION.tolist(), "fx": FX, "fy": FY} | changes


def transforms(name: str = "images/0001.png", frame: dict[str, Any] | None = None, **changes: Any) -> dict[str, Any]:
    pose = np.eye(4)
    pose[:3, :3] = np.stack([RIGHT, np.negative(DOWN), np.negative(FORWARD)], axis=1)  # OpenGL: y up, z backward
    pose[:3, 3] = POSITION
    content = {"fl_x": FX, "fl_y": FY, "cx": 30.0, "cy": 20.0, "w": WIDTH, "h": HEIGHT}
    content["frames"] = [{"file_path": name, "transform_matrix": pose.tolist()} | (frame or {})]
    return {key: value for key, value in (content | changes).items() if value is not None}


def write_colmap(
    folder: Path,
    names: tuple[str, ...] = ("room/0001.jpg",),
    model: str = "PINHOLE",
    params: tuple[float, ...] = (FX, FY, 30, 20),
    text: bool = False,
    size: tuple[int, int] = (WIDTH, HEIGHT),
) -> Path:
    """Write a model as COLMAP does, with keypoints, one triangulated point, and one image that was not registered."""
    reconstruction = pycolmap.Reconstruction()
    camera = pycolmap.Camera(camera_id=7, model=model, width=size[0], height=size[1], params=params)
    reconstruction.add_camera_with_trivial_rig(camera)
    point = reconstruction.add_point3D(np.array(POINT), pycolmap.Track(), np.zeros(3, np.uint8))
    for i, name in enumerate(names):
        keypoints = np.array([[1.0, 2.0], [55.0, 35.0]])
        image = pycolmap.Image(name=name, camera_id=7, image_id=i + 1, keypoints=keypoints)
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d(WORLD_TO_CAMERA[:3]))
        reconstruction.add_observation(point, pycolmap.TrackElement(i + 1, 1))
    reconstruction.add_image_with_trivial_frame(pycolmap.Image(name="lost.jpg", camera_id=7, image_id=99))
    folder.mkdir(parents=True)
    (reconstruction.write_text if text else reconstruction.write_binary)(str(folder))
    return folder


def write_json(path: Path, content: object) -> Path:
    path.write_text(json.dumps(content))
    return path


def assert_lands(camera: Camera, u: float, v: float) -> None:
    uv, depth = camera.project([POINT])
    np.testing.assert_allclose(uv, [[u, v]], atol=1e-9)
    np.testing.assert_allclose(depth, [2], atol=1e-12)
    np.testing.assert_allclose(camera.center, POSITION, atol=1e-12)
    assert (camera.name, camera.width, camera.height) == ("0001", WIDTH, HEIGHT)


def assert_refused(folder: Path, error: type[GssegError], *words: str) -> None:
    with pytest.raises(error) as caught:
        read_cameras(folder)
    message = str(caught.value)
    assert type(caught.value) is error and "\n" not in message
    for word in (str(folder), *words):
        assert word in message, message
