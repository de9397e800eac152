"""Depth images beside masks: read, brought to the mask's pixels, and held against the scene."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from sensor_msgs.msg import Image

from gsseg_core.data.mask_formats.shapes import scaled
from gsseg_core.data.view import View
from gsseg_core.errors import GssegError, MaskFormatError
from gsseg_core.live.session import LiveSession
from gsseg_core.raster.depth_gating import Gated, gate_view
from gsseg_ros.conversions import picture_from_image, require_encoding, require_proportions, require_size
from gsseg_ros.errors import DepthImageError
from gsseg_ros.node.parameters import Settings

_METRES = {"16UC1": 1e-3, "32FC1": 1.0}
"""Of one unit of each encoding (REP 118)."""


def gate_by_image(
    session: LiveSession, view: View, message: Image, topic: str, frame_id: str, settings: Settings
) -> Gated:
    """Make those pixels of a view's mask unknown in which a depth image contradicts the scene.

    The depth image (of `topic`) is of the same image as the mask (of `frame_id`), of its size or of another of the same
    proportions; of a raw image, it is undistorted as the mask was. Raises `DepthImageError`: it is of another frame,
    encoding or shape, or broken.
    """
    try:
        require_size(message, settings.max_pixels, topic)
        if message.header.frame_id != frame_id and message.header.frame_id and frame_id:
            raise MaskFormatError(
                f"{topic}: frame_id is '{message.header.frame_id}', the mask's is '{frame_id}'; expected depth "
                "registered to the camera of the masks, as depth_image_proc or the camera's driver makes it"
            )
        depth = depth_from_image(message, topic)
        require_proportions((message.width, message.height), view.camera.image_size, topic, "masks are")
        depth = scaled(depth, view.camera)
        if view.camera.undistortion is not None:
            depth = view.camera.undistortion.sample(depth, 0)
        scale = settings.scene_to_map.scale
        return gate_view(session.scene, view, depth, settings.depth_tolerance, scale=scale, device=session.device)
    except GssegError as error:
        raise DepthImageError(str(error)) from error


def depth_from_image(message: Image, topic: str) -> npt.NDArray[np.float32]:
    """Read a depth image (H, W) in metres, sent as 16UC1 in millimetres or as 32FC1; 0 or NaN where there is none.

    Raises `MaskFormatError`: another encoding, a size of zero, or data too short.
    """
    require_encoding(message, topic, _METRES, "depth as ")
    depth: npt.NDArray[np.float32] = picture_from_image(message, topic).astype(np.float32)
    depth *= np.float32(_METRES[message.encoding])
    return depth
