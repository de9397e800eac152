"""Pinhole views of images that a lens bent: which ones are made of an image, and from which of its pixels."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from gsseg_core.errors import IntrinsicsError, MaskSizeError
from gsseg_core.files.input_files import check_pixels
from gsseg_core.scene.lens import Lens, Projection

WIDEST = math.radians(60)  # how far a pinhole view reaches to each side; beyond, pixels grow without bound
GROWTH = (0.5, 2.0)  # sizes that a view may have, as multiples of its image's; no real lens comes near
_IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
_FACES = {
    "front": _IDENTITY,
    "right": (0.0, 0.0, 1.0, 0.0, 1.0, 0.0, -1.0, 0.0, 0.0),
    "back": (-1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0),
    "left": (0.0, 0.0, -1.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0),
    "up": (1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0),
    "down": (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, -1.0, 0.0),
}
"""Views of a panorama, with their rotations as in `Undistortion`."""
_MAPS_KEPT = len(_FACES)
_BLOCK_PX = 2**18


@dataclass(frozen=True)
class Undistortion:
    """A pinhole view of an image that a lens bent."""

    lens: Lens  # what took the image
    width: int  # of the view, in pixels
    height: int  # of the view, in pixels
    focal: tuple[float, float]  # focal lengths along x and y, in pixels
    principal: tuple[float, float]  # principal point, x and y in pixels
    rotation: tuple[float, ...] = _IDENTITY  # (3, 3) row by row: from the axes of the view to those of the lens
    face: str = ""  # which of several views of the image it is; "" if there is one only

    @property
    def K(self) -> npt.NDArray[np.float64]:
        """Intrinsic matrix (3, 3) of the view."""
        (fx, fy), (cx, cy) = self.focal, self.principal
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])

    @property
    def reached(self) -> npt.NDArray[np.bool_]:
        """Which pixels of the view the image reaches, (height, width)."""
        return _nearest_pixels(self) >= 0

    def sample(
        self,
        image: npt.NDArray[Any],  # (H, W, ...), of the lens
        outside: int,
    ) -> npt.NDArray[Any]:
        """Take the nearest pixels of an image: (height, width, ...), `outside` where the image does not reach.

        Raises `MaskSizeError` where the image has another size than those of the lens.
        """
        self._check_size(image)
        pixels = _nearest_pixels(self)
        view: npt.NDArray[Any] = image.reshape(-1, *image.shape[2:])[pixels]
        view[pixels < 0] = outside
        return view

    def photo(
        self,
        image: npt.NDArray[np.uint8],  # (H, W, 3), of the lens
    ) -> npt.NDArray[np.uint8]:
        """Interpolate a photo: (height, width, 3), black where it does not reach; raises as `sample` does."""
        from scipy import ndimage  # Slow to load, and only photos need it.

        self._check_size(image)
        view = np.empty((self.height, self.width, 3), np.uint8)
        for rows, landed, inside in _landings(self):
            places = landed[..., 1] - 0.5, landed[..., 0] - 0.5
            for channel in range(3):
                shades = ndimage.map_coordinates(image[..., channel], places, order=1, mode="nearest")
                view[rows, :, channel] = np.where(inside, shades, 0)
        return view

    def _check_size(self, image: npt.NDArray[Any]) -> None:
        if image.shape[:2] != (self.lens.height, self.lens.width):
            raise MaskSizeError(
                f"image is {image.shape[1]} x {image.shape[0]} pixels; expected {self.lens.width} x "
                f"{self.lens.height}, those of its lens {self.lens.model.name}"
            )


@lru_cache(maxsize=64)
def undistortions(lens: Lens) -> tuple[Undistortion, ...]:
    """Choose the pinhole views of the images of a lens: one, or the six faces of a cube around a panorama.

    The view keeps the focal length and the axis, so that the middle of the image stays as it is, and reaches as far as
    the middles of the image's sides, but no farther than `WIDEST`; COLMAP's and nerfstudio's trainers see scenes like
    that. The faces of a panorama have as many pixels per radian in their middle as the panorama has. Raises
    `IntrinsicsError` where a view would be too large, or of a size for which the lens must be a mistake.
    """
    if lens.model.projection is Projection.PANORAMA:
        side = max(round(lens.width / math.pi), 1)
        check_pixels(side, side, f"a face of a panorama of {lens.width} x {lens.height} pixels", IntrinsicsError)
        half = (side / 2, side / 2)
        return tuple(Undistortion(lens, side, side, half, half, turned, face) for face, turned in _FACES.items())
    middles = np.array([[0, 0.5], [1, 0.5], [0.5, 0], [0.5, 1]])
    rays = lens.rays(middles * (lens.width, lens.height))
    farthest = min(lens.reach, WIDEST)
    angles = np.array([np.arctan2(rays[i, i // 2], rays[i, 2]) for i in range(4)])
    angles = np.clip(np.where(np.isnan(angles), (-4, 4, -4, 4), angles), -farthest, farthest)
    focal, principal = np.repeat(lens.focal, 2), np.repeat(lens.principal, 2)
    # By whole pixels, so that those in the middle of the view are those of the image.
    left, right, top, bottom = np.round(principal + focal * np.tan(angles)).tolist()
    size = right - left, bottom - top
    growth = size[0] / lens.width, size[1] / lens.height
    if not GROWTH[0] <= min(growth) <= max(growth) <= GROWTH[1]:
        raise IntrinsicsError(
            f"lens {lens.model.name}: images of {lens.width} x {lens.height} pixels become {size[0]:g} x {size[1]:g} "
            f"without its distortion; expected {GROWTH[0]:g} to {GROWTH[1]:g} times the size: is it calibrated for it?"
        )
    principal_point = lens.principal[0] - left, lens.principal[1] - top
    return (Undistortion(lens, int(size[0]), int(size[1]), lens.focal, principal_point),)


def _landings(view: Undistortion) -> Iterator[tuple[slice, npt.NDArray[np.float64], npt.NDArray[np.bool_]]]:
    """Find where in the image the pixels of a view land, (rows, width, 2), and whether they do, a few rows at a time.

    Those that do not land in the image are at its corner (0, 0).
    """
    count = max(_BLOCK_PX // view.width, 1)
    columns = (np.arange(view.width) + 0.5 - view.principal[0]) / view.focal[0]
    for start in range(0, view.height, count):
        rows = (np.arange(start, min(start + count, view.height)) + 0.5 - view.principal[1]) / view.focal[1]
        x, y = np.meshgrid(columns, rows)
        rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.reshape(view.rotation, (3, 3)).T
        landed = view.lens.project(rays)
        with np.errstate(invalid="ignore"):  # NaN is in no image.
            inside: npt.NDArray[np.bool_] = np.all((landed >= 0) & (landed < (view.lens.width, view.lens.height)), -1)
        yield slice(start, start + len(rows)), np.where(inside[..., None], landed, 0), inside


@lru_cache(maxsize=_MAPS_KEPT)
def _nearest_pixels(view: Undistortion) -> npt.NDArray[np.int32]:
    """Pixel of the image, row * width + column, that each pixel of a view shows, (height, width); -1 for none."""
    pixels = np.empty((view.height, view.width), np.int32)
    for rows, landed, inside in _landings(view):
        places = landed.astype(np.int32)
        pixels[rows] = np.where(inside, places[..., 1] * view.lens.width + places[..., 0], -1)
    pixels.setflags(write=False)
    return pixels
