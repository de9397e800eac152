"""Where photos were taken in a scene of which nothing is known: neither its scale, nor where up is.

The scene is rendered from places all around and inside it, and features of each rendering are matched with those of
some photos. Correspondences of pixels and points of the scene give the camera's pose (RANSAC over three points, as
COLMAP does it). One photo that is located so is enough for a start: rendered from its place, the scene looks like it,
and so matches its neighbours, too. Two located cameras and the dataset's own poses of them give a similarity: its
rotation turns the dataset's cameras into the located ones, its scale makes their centres equally far apart.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations, product
from typing import NamedTuple

import numpy as np

from gsseg_core.align.conventions import AXIS_ROTATIONS, Alignment, Convention
from gsseg_core.align.features import Photo, PhotosInScene, matches
from gsseg_core.progress import Progress, with_progress
from gsseg_core.scene.camera import Camera, pose_looking
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.similarity import Similarity

LOOKING = "look for photos in the scene"  # what progress calls it
_SHELLS = (1.6, 1.0, 0.0, 2.5)  # radii of the scene at which it is looked at from outside; 0: from inside
_SOLID = 0.3  # opacity from which on a Gaussian counts for the size of the scene
# By how much a located camera may differ from the similarity's: its angle; its centre, of the extent of all centres.
_TURN_DEGREES, _SHIFT = 5.0, 0.1


class Located(NamedTuple):
    """A camera with the pose that was found for its photo, and the matches that agree with it."""

    camera: Camera
    inliers: int


def candidates(photos: PhotosInScene, progress: Progress) -> Iterator[Alignment]:
    """Guess alignments, each from other photos than the last; most guesses are right, to a few px."""
    if len(photos.photos) < 2:
        return
    cameras = list(virtual_cameras(photos.scene, photos.photos[0].camera, photos.settings.virtual_views))
    for camera in with_progress(progress, LOOKING, cameras):
        found = locate(photos, camera)
        for _ in range(2):  # from where the surest one was taken, the scene looks like it
            if found:
                found = locate(photos, max(found.values(), key=lambda located: located.inliers).camera)
        if len(found) > 1 and (guess := fit_poses(photos.photos, found)) is not None:
            yield guess


def virtual_cameras(scene: GaussianScene, like: Camera, count: int) -> Iterator[Camera]:
    """Place cameras with the lens of another one around a scene and inside, some of each kind in turn."""
    solid = scene.opacities > _SOLID
    means = scene.means[solid] if solid.any() else scene.means
    low, middle, high = np.percentile(means, (5, 50, 95), axis=0).astype(np.float64)
    radius = max(float(np.linalg.norm(high - low)) / 2, 1e-9)
    rng = np.random.default_rng(0)
    for i in range(count):
        shell = _SHELLS[i % len(_SHELLS)]
        away, up = rng.normal(size=(2, 3))
        away /= np.linalg.norm(away)
        place = middle + shell * radius * away if shell else rng.uniform(low, high)
        yield replace(like, world_to_camera=pose_looking(-away, -up, place))


def locate(photos: PhotosInScene, camera: Camera) -> dict[int, Located]:
    """Locate photos, by their numbers, of which the scene shows enough from a camera."""
    import pycolmap

    rendering, settings = photos.rendering(camera), photos.settings
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = settings.reprojection_px
    options.ransac.random_seed = 0
    options.ransac.max_num_trials = 2000
    found = {}
    for number, (camera, features) in enumerate(photos.photos):
        pairs = matches(features, rendering, settings.ratio)
        if len(pairs) < settings.matches or rendering.points is None:
            continue
        lens = pycolmap.Camera(
            model="PINHOLE", width=camera.width, height=camera.height,
            params=[camera.fx, camera.fy, camera.cx, camera.cy],
        )  # fmt: skip
        pixels, points = features.pixels[pairs[:, 0]], rendering.points[pairs[:, 1]]
        pose = pycolmap.estimate_and_refine_absolute_pose(pixels, points, lens, options)
        if pose is not None and pose["num_inliers"] >= settings.matches:
            matrix = np.vstack([pose["cam_from_world"].matrix(), (0, 0, 0, 1)])
            found[number] = Located(replace(camera, world_to_camera=matrix), int(pose["num_inliers"]))
    return found


def fit_poses(photos: Sequence[Photo], found: Mapping[int, Located]) -> Alignment | None:
    """Find the alignment that brings most cameras of a dataset to where their photos were located; None if under two.

    Poses may be inverted, and cameras have any axes; where several conventions do equally well, the plainest is taken.
    """
    best, most = None, 1
    located = _Poses.of([each.camera for each in found.values()])
    for inverted, axes in product((False, True), AXIS_ROTATIONS):
        convention = Convention(inverted, camera_axes=axes)
        given = _Poses.of([convention.camera(photos[number].camera) for number in found])
        for first, second in combinations(range(len(found)), 2):
            similarity = _between(given, located, first, second)
            if similarity is not None and (inliers := _inliers(similarity, given, located)) > most:
                best, most = Alignment(convention, similarity), inliers
    return best


class _Poses(NamedTuple):
    """Poses of cameras, camera-to-world."""

    rotations: np.ndarray  # (P, 3, 3)
    centers: np.ndarray  # (P, 3)

    @classmethod
    def of(cls, cameras: Sequence[Camera]) -> _Poses:
        rotations = np.stack([camera.world_to_camera[:3, :3].T for camera in cameras])
        return cls(rotations, np.stack([camera.center for camera in cameras]))


def _between(given: _Poses, located: _Poses, first: int, second: int) -> Similarity | None:
    """Find the similarity that takes two cameras to where they were located; None if they are in one place."""
    span, wider = (float(np.linalg.norm(poses.centers[first] - poses.centers[second])) for poses in (given, located))
    if min(span, wider) < 1e-9:
        return None
    scale, rotation = wider / span, located.rotations[first] @ given.rotations[first].T
    middle, found_middle = ((poses.centers[first] + poses.centers[second]) / 2 for poses in (given, located))
    return Similarity(scale, rotation, found_middle - scale * rotation @ middle)


def _inliers(similarity: Similarity, given: _Poses, located: _Poses) -> int:
    """Count the cameras that a similarity takes to about where they were located."""
    extent = float(np.ptp(located.centers, axis=0).max())
    near = np.linalg.norm(similarity.points(given.centers) - located.centers, axis=1) <= _SHIFT * extent
    turned = similarity.rotation @ given.rotations
    cosines = (np.einsum("pij,pij->p", turned, located.rotations) - 1) / 2
    return int((near & (cosines >= np.cos(np.radians(_TURN_DEGREES)))).sum())
