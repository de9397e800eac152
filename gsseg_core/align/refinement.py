"""Refinement of a similarity that is right to a few pixels, by matches of photos with renderings from moved cameras.

From nearly the right place a rendering looks like its photo, so hundreds of features match in each. All photos together
determine seven numbers, a rotation, a translation and a scale, by least squares over all reprojection errors. Large
errors count by their size, not its square, since matches may be wrong and surfaces of a scene badly trained.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from gsseg_core.align.conventions import Alignment
from gsseg_core.align.features import Photo, PhotosInScene, matches
from gsseg_core.data.view import spread
from gsseg_core.scene.similarity import Similarity

_SEARCH_PX = (40.0, 12.0, 6.0)  # how far from its place a feature is looked for, in each step
_LEAST = 20  # matches from which seven numbers are fitted


class _Matches(NamedTuple):
    """Pixels of photos, the points of the scene that they match, and the cameras of the photos."""

    rotations: np.ndarray  # (P, 3, 3): of the photo's camera, world to camera
    translations: np.ndarray  # (P, 3)
    lenses: np.ndarray  # (P, 4): fx, fy, cx, cy
    pixels: np.ndarray  # (P, 2)
    points: np.ndarray  # (P, 3)

    def errors(self, points: np.ndarray) -> np.ndarray:  # (P, 3)
        """Reprojection errors of points, (P, 2), in px."""
        local = np.einsum("pij,pj->pi", self.rotations, points) + self.translations
        depth = np.maximum(local[:, 2:], 1e-9)
        return local[:, :2] / depth * self.lenses[:, :2] + self.lenses[:, 2:] - self.pixels


def refined(photos: PhotosInScene, alignment: Alignment) -> Alignment:
    """Fit the similarity of an alignment to all photos; where hardly anything matches, it is returned as it was."""
    for step in range(photos.settings.refinements):
        found = _match(photos, photos.photos, alignment, _SEARCH_PX[min(step, len(_SEARCH_PX) - 1)])
        if found is None:
            return alignment
        alignment = Alignment(alignment.convention, _fit(found).inverse().after(alignment.similarity))
    return alignment


def offset_px(photos: PhotosInScene, alignment: Alignment) -> float | None:
    """How far some photos and renderings are apart, in px of the photos as matched: median over features of both."""
    found = _match(photos, spread(photos.photos, photos.settings.views), alignment, _SEARCH_PX[0])
    return None if found is None else float(np.median(np.linalg.norm(found.errors(found.points), axis=1)))


def _match(photos: PhotosInScene, some: Sequence[Photo], alignment: Alignment, within_px: float) -> _Matches | None:
    """Match some of the photos with renderings of the scene from their cameras; None if hardly anything matches."""
    rows = []
    for camera, features in some:
        moved = alignment.camera(camera)
        rendering = photos.rendering(moved)
        pairs = matches(features, rendering, photos.settings.ratio, within_px)
        if len(pairs) == 0 or rendering.points is None:
            continue
        pose = moved.world_to_camera
        lens = np.array([moved.fx, moved.fy, moved.cx, moved.cy])
        repeated = (np.repeat(each[None], len(pairs), axis=0) for each in (pose[:3, :3], pose[:3, 3], lens))
        rows.append((*repeated, features.pixels[pairs[:, 0]], rendering.points[pairs[:, 1]]))
    if sum(len(pixels) for *_, pixels, _ in rows) < _LEAST:
        return None
    return _Matches(*(np.concatenate(column) for column in zip(*rows, strict=True)))


def _fit(found: _Matches) -> Similarity:
    """Fit the similarity that moves points of the scene to where the cameras see their pixels."""
    middle = np.median(found.points, axis=0)
    size = max(float(np.median(np.abs(found.points - middle))), 1e-9)

    def similarity(values: np.ndarray) -> Similarity:  # (7,)
        rotation, scale = Rotation.from_rotvec(values[:3]).as_matrix(), float(np.exp(values[6]))
        return Similarity(scale, rotation, middle + size * values[3:6] - scale * rotation @ middle)

    fitted = least_squares(
        lambda values: found.errors(similarity(values).points(found.points)).ravel(),
        np.zeros(7), loss="soft_l1", f_scale=1.0,
    )  # fmt: skip
    return similarity(fitted.x)
