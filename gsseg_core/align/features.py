"""Features of photos and of renderings, by COLMAP's SIFT, and matches between them.

The depth of a rendering's pixel gives its feature a point in the scene. So a match with a photo is a correspondence of
a pixel of that photo and a point of the scene.
"""

from __future__ import annotations

import platform
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from gsseg_core.align.agreement import LUMINANCE
from gsseg_core.align.settings import AlignSettings
from gsseg_core.data.view import View, spread
from gsseg_core.errors import AlignmentError
from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.depth import COVERED, colours_and_depth
from gsseg_core.scene.camera import Camera, resized_camera
from gsseg_core.scene.gaussian_scene import GaussianScene

_LENGTH = 128  # of a descriptor


class Features(NamedTuple):
    """Features of a picture; of a rendering, with their points."""

    pixels: np.ndarray  # (M, 2) float64: column, row
    descriptors: np.ndarray  # (M, 128) float32, of length 1
    points: np.ndarray | None = None  # (M, 3) float64: in the scene


class Photo(NamedTuple):
    """A photo to be located: its camera as the dataset has it, at the size that is matched, and its features."""

    camera: Camera
    features: Features


class Extractor:
    """COLMAP's SIFT on the CPU, which is the same from run to run."""

    def __init__(self, settings: AlignSettings) -> None:
        try:
            import pycolmap
        except ModuleNotFoundError as missing:
            arm = platform.machine() == "aarch64"  # as in setup.py
            how = "there is no wheel of it for ARM, so build it from COLMAP's source" if arm else "pip install pycolmap"
            raise AlignmentError(f"locating photos in a scene needs pycolmap, which is missing: {how}") from missing
        pycolmap.logging.minloglevel = max(pycolmap.logging.minloglevel, 1)  # It logs every extractor that it makes.
        options = pycolmap.FeatureExtractionOptions()
        options.use_gpu, options.num_threads = False, 1
        options.sift.max_num_features = settings.features
        self._sift: Any = pycolmap.FeatureExtractor.create(options, device=pycolmap.Device.cpu)

    def photo(self, photo: np.ndarray) -> Features:  # (H, W) float32, 0 to 1
        """Find the features of a picture in grey."""
        keypoints, descriptors = self._sift.extract_from_uint8_array(np.rint(255 * photo.clip(0, 1)).astype(np.uint8))
        pixels = np.array([(point.x, point.y) for point in keypoints]).reshape(-1, 2)
        described = np.asarray(descriptors.data, np.float32).reshape(len(pixels), _LENGTH)
        return Features(pixels, described / np.maximum(np.linalg.norm(described, axis=1, keepdims=True), 1e-6))


@dataclass(frozen=True, eq=False)
class PhotosInScene:
    """Photos of a dataset, and the scene whose renderings they are matched with."""

    photos: list[Photo]
    scene: GaussianScene
    extractor: Extractor  # of the features of both
    settings: AlignSettings
    device: str  # that renders

    @classmethod
    def read(cls, views: Sequence[View], scene: GaussianScene, settings: AlignSettings, device: str) -> PhotosInScene:
        """Read some photos, spread evenly over those that there are, with their features."""
        photos, extractor = [], Extractor(settings)
        for view in spread([view for view in views if view.image_path is not None], settings.photos):
            taken = view.read_photo()
            if taken is not None:
                camera = _shrunk(view.camera, settings.photo_px)
                grey = Image.fromarray(taken).convert("L").resize((camera.width, camera.height), Image.Resampling.BOX)
                photos.append(Photo(camera, extractor.photo(np.asarray(grey, np.float32) / 255)))
        return cls(photos, scene, extractor, settings, device)

    def rendering(self, camera: Camera) -> Features:
        """Render the scene, and find features with their points; those where the scene is not opaque are left out."""
        image, left_over = colours_and_depth(self.scene, make_operator(self.scene, camera, self.device))
        found = self.extractor.photo(image[..., :3] @ LUMINANCE)
        column, row = np.clip(found.pixels.astype(int), 0, (camera.width - 1, camera.height - 1)).T
        coverage = 1 - left_over[row, column]
        solid = coverage > COVERED
        pixels, depth = found.pixels[solid], image[row, column, 3][solid] / coverage[solid]
        rays = np.column_stack([(pixels - camera.K[:2, 2]) / camera.K[[0, 1], [0, 1]], np.ones(len(pixels))])
        points = (rays * depth[:, None] - camera.world_to_camera[:3, 3]) @ camera.world_to_camera[:3, :3]
        return Features(pixels, found.descriptors[solid], points)


def matches(photo: Features, rendering: Features, ratio: float, within_px: float = np.inf) -> np.ndarray:
    """Match features that are each other's nearest, and nearer than `ratio` times the second: indices (P, 2).

    With `within_px`, only features that are no farther apart in the two pictures.
    """
    if min(len(photo.pixels), len(rendering.pixels)) < 2:
        return np.zeros((0, 2), int)
    alike = photo.descriptors @ rendering.descriptors.T
    if np.isfinite(within_px):
        apart = np.linalg.norm(photo.pixels[:, None] - rendering.pixels[None], axis=2)
        alike = np.where(apart <= within_px, alike, -1)
    rows, best = np.arange(len(alike)), alike.argmax(axis=1)
    first = alike[rows, best]
    mutual = alike.argmax(axis=0)[best] == rows
    alike[rows, best] = -1
    # Of unit vectors, the squared distance is 2 - 2 times their product.
    kept = mutual & (first > 0) & (1 - first < ratio**2 * (1 - alike.max(axis=1)))
    return np.column_stack([rows[kept], best[kept]])


def _shrunk(camera: Camera, longer_px: int) -> Camera:
    """Shrink a camera's picture so that its longer side is at most `longer_px`."""
    scale = min(1.0, longer_px / max(camera.width, camera.height))
    width, height = (max(round(scale * side), 1) for side in (camera.width, camera.height))
    return resized_camera(camera, width, height)
