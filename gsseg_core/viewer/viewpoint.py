"""Where browsers look from: cameras of theirs, jumps to the views, and masks hung before them."""

from __future__ import annotations

import numpy as np
import viser
import viser.transforms as vtf

from gsseg_core.data.view import View
from gsseg_core.export.pictures import overlay, palette
from gsseg_core.export.view_pictures import background_image
from gsseg_core.raster.backends import make_operator
from gsseg_core.scene.camera import Camera, rigid_motion
from gsseg_core.viewer.state import ViewerState

_OVERLAY_DISTANCE = 0.02  # of a mask from the camera, in halves of the diagonal of the scene
_FARTHEST = 100.0  # what a browser draws at least, in halves of the diagonal
_MASK = "/mask"


class Viewpoint:
    """Moves the cameras of browsers; at first they look from the first view, or at the scene from outside."""

    def __init__(self, server: viser.ViserServer, state: ViewerState) -> None:
        self._state = state
        low, high = np.percentile(state.model.scene.means, [5, 95], axis=0)
        self._reach = float(np.linalg.norm(high - low)) / 2 or 3 * float(state.model.scene.scales.max())
        start = server.initial_camera
        if state.views:
            poses = np.array([np.linalg.inv(view.camera.world_to_camera) for view in state.views])
            server.scene.set_up_direction(-poses[:, :3, 1].mean(axis=0))
            self._look(start, state.views[0], poses[0])
        else:
            start.look_at = (low + high) / 2
            start.position = (low + high) / 2 + np.array([1.2, 1.2, 0.9]) * self._reach
        start.near = min(_OVERLAY_DISTANCE * self._reach / 4, 0.05)
        start.far = max(_FARTHEST * self._reach, start.far)

    def jump(self, client: viser.ClientHandle, view: View, with_mask: bool) -> None:
        """Look from where a view was taken; lay its mask over the picture."""
        pose = np.linalg.inv(view.camera.world_to_camera)
        with client.atomic():
            client.camera.up_direction = -pose[:3, 1]
            self._look(client.camera, view, pose)
        self.hide_mask(client)
        if with_mask:
            self._hang(client, view, pose)
            client.flush()

    def _look(self, through: viser.InitialCameraConfig | viser.CameraHandle, view: View, pose: np.ndarray) -> None:
        """Have a browser look from where a view was taken, of which the pose (4, 4) is camera to world."""
        through.position, through.look_at = pose[:3, 3], pose[:3, 3] + pose[:3, 2] * self._reach
        through.fov = float(2 * np.arctan(view.camera.height / 2 / view.camera.fy))  # vertical, in radians

    def hide_mask(self, client: viser.ClientHandle) -> None:
        """Take the mask off the picture of a browser."""
        client.scene.remove_by_name(_MASK)
        client.flush()

    def _hang(self, client: viser.ClientHandle, view: View, pose: np.ndarray) -> None:
        """Hang the mask of a view right before its camera, of which the pose (4, 4) is camera to world."""
        camera, model = view.camera, self._state.model
        labels = view.read_labels()
        image = background_image(model.scene, make_operator(model.scene, camera, self._state.device))
        colors = palette(max(int(labels.max(initial=0)), *model.labelling.class_names) + 1)
        distance = _OVERLAY_DISTANCE * self._reach
        # The middle of the image, which need not be where the optical axis is.
        middle = np.array([(camera.width / 2 - camera.cx) / camera.fx, (camera.height / 2 - camera.cy) / camera.fy, 1])
        client.scene.add_image(
            _MASK,
            overlay(image, labels, colors),
            camera.width / camera.fx * distance,
            camera.height / camera.fy * distance,
            format="png",
            wxyz=vtf.SO3.from_matrix(pose[:3, :3]).wxyz,
            position=pose[:3, 3] + pose[:3, :3] @ middle * distance,
        )


def camera_of(client: viser.ClientHandle, most_rows: int | None = None) -> Camera:
    """Make a camera of what a browser looks from, of its picture's size or of this many rows at most."""
    seen = client.camera
    height = seen.image_height if most_rows is None else min(seen.image_height, most_rows)
    width = max(round(height * seen.aspect), 1)
    focal = height / (2 * np.tan(seen.fov / 2))
    pose: np.ndarray = rigid_motion(vtf.SO3(seen.wxyz).as_matrix(), seen.position)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Camera("viewer", width, height, K, np.linalg.inv(pose))
