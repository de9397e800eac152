"""Pinhole cameras in OpenCV axes: x right, y down, z forward; pixel (c, r) covers [c, c+1) x [r, r+1)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from gsseg_core.errors import IntrinsicsError, MaskSizeError, PoseError, SettingsError
from gsseg_core.files.input_files import check_pixels
from gsseg_core.files.limits import LIMITS
from gsseg_core.scene.lens import MODELS_BY_NAME, Lens
from gsseg_core.scene.undistortion import Undistortion
from gsseg_core.text import clipped

# Poses come from text files of few digits; a deviation this small moves no point by a pixel.
RIGID_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class Camera:
    """A posed pinhole camera; where a lens bent the image, the pinhole view that is made of it.

    Attributes
    ----------
    name : str
        Stem of the image's file name, after its folders' where two share one; of a panorama, `_front` and so on follow.
    width, height : int
        Image size in pixels.
    K : ndarray (3, 3) float64
        Intrinsic matrix in pixels, without skew.
    world_to_camera : ndarray (4, 4) float64
        Rigid motion from the world (the scene) to the camera.
    undistortion : Undistortion or None
        How the view is made of the image, and the masks of the view of those of the image; None if they are the same.

    Raises
    ------
    IntrinsicsError
        Size or `K` is not that of a pinhole camera, or the picture would be larger than `Limits.max_pixels`.
    PoseError
        `world_to_camera` is NaN, not invertible, or not a rigid motion.
    """

    name: str
    width: int
    height: int
    K: npt.NDArray[np.float64]  # (3, 3)
    world_to_camera: npt.NDArray[np.float64]  # (4, 4)
    undistortion: Undistortion | None = None

    def __post_init__(self) -> None:
        """Copy the matrices and validate."""
        for side in ("width", "height"):
            if isinstance(size := getattr(self, side), np.integer):  # Products of short ones overflow.
                object.__setattr__(self, side, int(size))
        object.__setattr__(self, "K", np.array(self.K, np.float64))
        object.__setattr__(self, "world_to_camera", np.array(self.world_to_camera, np.float64))
        if flaw := self._flaw_of_intrinsics():
            raise IntrinsicsError(f"{self._who}: {flaw}")
        if flaw := self._flaw_of_pose():
            raise PoseError(f"{self._who}: {flaw}")

    @property
    def fx(self) -> float:
        """Focal length along x, in pixels."""
        return float(self.K[0, 0])

    @property
    def fy(self) -> float:
        """Focal length along y, in pixels."""
        return float(self.K[1, 1])

    @property
    def cx(self) -> float:
        """Principal point along x, in pixels from the image's left edge."""
        return float(self.K[0, 2])

    @property
    def cy(self) -> float:
        """Principal point along y, in pixels from the image's upper edge."""
        return float(self.K[1, 2])

    @property
    def center(self) -> npt.NDArray[np.float64]:
        """Position (3,) of the camera in the world."""
        return -self.world_to_camera[:3, :3].T @ self.world_to_camera[:3, 3]

    def project(self, points: npt.ArrayLike) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:  # (M, 3)
        """Project world points into the image.

        Returns
        -------
        uv : ndarray (M, 2)
            Pixel coordinates, NaN for points that are not in front of the camera.
        depth : ndarray (M,)
            z in the camera, in scene units.
        """
        local = np.asarray(points, np.float64) @ self.world_to_camera[:3, :3].T + self.world_to_camera[:3, 3]
        depth = local[:, 2]
        divisor = np.where(depth > 0, depth, np.nan)[:, None]
        return local[:, :2] / divisor * self.K[[0, 1], [0, 1]] + self.K[:2, 2], depth

    @property
    def image(self) -> str:
        """Stem of the file name of the image that the view is made of."""
        face = self.undistortion.face if self.undistortion else ""
        return self.name.removesuffix(f"_{face}") if face else self.name

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height in pixels of the image as it was taken, and of masks drawn on it."""
        taken_by = self.undistortion.lens if self.undistortion else self
        return taken_by.width, taken_by.height

    def check_image(self, image: npt.NDArray[Any], found: str, channels: bool = False) -> None:
        """Raise `MaskSizeError` unless an image is (H, W) of this view, or (H, W, K); `found` is like "labels have"."""
        if image.ndim != 2 + channels or image.shape[:2] != (self.height, self.width):
            expected = f"({self.height}, {self.width}{', K' * channels})"
            raise MaskSizeError(f"view '{self.name}': {found} shape {image.shape}; expected {expected}")

    def check_mask_size(self, width: int, height: int, source: str, *, drawn_on_image: bool = False) -> None:
        """Raise `MaskSizeError` if a mask of this view, or one that is drawn on its image, has another size."""
        expected = self.image_size if drawn_on_image else (self.width, self.height)
        if (width, height) != expected:
            raise MaskSizeError(
                f"{source}: mask is {width} x {height} pixels; expected {expected[0]} x {expected[1]}, the size "
                f"of {self._who} (masks like this one are never resized)"
            )

    def checked_pixel(self, row: int | None, column: int | None) -> tuple[int, int]:
        """Return row and column, or raise `SettingsError` unless that is a pixel of the view."""
        if (
            isinstance(row, int | np.integer)
            and isinstance(column, int | np.integer)
            and 0 <= row < self.height
            and 0 <= column < self.width
        ):
            return row, column
        raise SettingsError(
            f"view '{self.name}': pixel is (row {row}, column {column}); expected a row from 0 to "
            f"{self.height - 1} and a column from 0 to {self.width - 1}, whole numbers"
        )

    @property
    def _who(self) -> str:
        return f"camera '{clipped(self.name)}'"

    def _flaw_of_intrinsics(self) -> str:
        """Say what is wrong with size and `K`, or "" if they are usable."""
        for side, size in (("width", self.width), ("height", self.height)):
            if not isinstance(size, int) or size < 1:
                return f"{side} is {clipped(size)}; expected a whole number of pixels, at least 1"
        check_pixels(self.width, self.height, self._who, IntrinsicsError)
        K = self.K
        if K.shape != (3, 3) or not np.isfinite(K).all():
            return f"K is {clipped(K.tolist())}; expected 3 x 3 finite numbers"
        if self.fx <= 0 or self.fy <= 0:
            return f"focal lengths are {self.fx:g} and {self.fy:g}; expected positive pixels"
        if K[0, 1] or K[1, 0] or K[2].tolist() != [0, 0, 1]:
            return f"K is {clipped(K.tolist(), 160)}; expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"
        return ""

    def _flaw_of_pose(self) -> str:
        """Say what is wrong with the pose, or "" if it is usable."""
        pose = self.world_to_camera
        if pose.shape != (4, 4):
            return f"pose has shape {pose.shape}; expected (4, 4)"
        if not np.isfinite(pose).all():
            return "pose holds NaN or infinite numbers; expected a rigid motion"
        if np.abs(pose).max() > LIMITS.max_value:
            return f"pose holds {np.abs(pose).max():.3g}; expected at most {LIMITS.max_value:g} (limit max_value)"
        rotation = pose[:3, :3]
        determinant = np.linalg.det(rotation)
        if abs(determinant) < 1e-9:
            return f"pose is not invertible (determinant {determinant:.3g}); expected a rigid motion"
        off = max(abs(rotation @ rotation.T - np.eye(3)).max(), abs(pose[3] - (0, 0, 0, 1)).max())
        if determinant < 0 or off > RIGID_TOLERANCE:
            rigid = "a rotation of determinant 1, a translation, and 0 0 0 1 as the last row"
            return f"pose is not a rigid motion (determinant {determinant:.6g}, off by {off:.3g}); expected {rigid}"
        return ""


def rigid_motion(rotation: npt.ArrayLike, translation: npt.ArrayLike) -> npt.NDArray[np.float64]:  # (3, 3), (3,)
    """Make the matrix (4, 4) of a rotation and a translation."""
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = rotation, translation
    return motion


def pose_looking(
    forward: npt.NDArray[np.float64], up: npt.NDArray[np.float64], position: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """World-to-camera (4, 4) of a camera at a position (3,) that looks along a unit vector (3,); `up` (3,) is above."""
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return rigid_motion(rotation, -rotation @ position)


def undistorted_camera(
    image: str,
    undistortion: Undistortion,
    world_to_lens: npt.NDArray[np.float64],  # (4, 4)
) -> Camera:
    """Make the camera of a pinhole view of an image that was taken by a lens from a pose."""
    lens_to_view = rigid_motion(np.reshape(undistortion.rotation, (3, 3)).T, np.zeros(3))
    name = f"{image}_{undistortion.face}" if undistortion.face else image
    with np.errstate(all="ignore"):  # A camera refuses what is NaN or too large.
        pose = lens_to_view @ world_to_lens
    return Camera(name, undistortion.width, undistortion.height, undistortion.K, pose, undistortion)


def smaller_camera(camera: Camera, step: int) -> Camera:
    """Make the camera whose pixels are every step-th of each row and column, from pixel step // 2 on.

    Its pixels have the centres of those that are kept, so that masks and photos of the image fit.
    """
    width, height = (max(-((step // 2 - side) // step), 1) for side in (camera.width, camera.height))
    whole = camera.undistortion or Undistortion(
        Lens(MODELS_BY_NAME["PINHOLE"], camera.width, camera.height, (camera.fx, camera.fy), (camera.cx, camera.cy)),
        camera.width, camera.height, (camera.fx, camera.fy), (camera.cx, camera.cy),
    )  # fmt: skip
    aside = (step - 1) / 2 - step // 2
    small = replace(
        whole, width=width, height=height, focal=(camera.fx / step, camera.fy / step),
        principal=((camera.cx + aside) / step, (camera.cy + aside) / step),
    )  # fmt: skip
    return replace(camera, width=width, height=height, K=small.K, undistortion=small)


def resized_camera(camera: Camera, width: int, height: int) -> Camera:
    """Make the camera that shows the same in another number of pixels, for which there is no mask."""
    scale = np.diag([width / camera.width, height / camera.height, 1])
    return replace(camera, width=width, height=height, K=scale @ camera.K, undistortion=None)
