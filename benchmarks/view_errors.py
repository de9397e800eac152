"""Views as robots really get them: masks that are wrong and poses that are off, each kind of error from 0 to 1.

`errors_at` says what a strength means, and `corrupt_views` draws the views. Each view has streams of its own, one for
its mask and one for its pose, so a kind of error that is switched off leaves the draws of the others as they were, and
a larger strength hits, as far as its kind can, the same objects and some more.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation
from wrong_masks import WrongMasks, corrupt

from gsseg_core.data.view import View
from gsseg_core.errors import SettingsError
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene

STRONGEST = {
    "missed objects": "half of the objects of a view are missed",
    "wrong ids": "half of the objects of a view carry the id of another one",
    "swapped pairs": "half of the objects of a view have exchanged ids, two by two",
    "moved edges": "outlines lie up to 10 px too far in or out, each object's on its own",
    "holes": "every object has a hole of up to 16 px mean radius",
    "clutter": "16 blobs of up to 24 px mean radius lie in a view",
    "shifted masks": "a mask lies up to 16 px beside its image",
    "jittered poses": "cameras are off by 2 degrees and by 3 % of the typical depth (root mean squares)",
    "bad frames": "in half of the frames no object carries its own id",
}
"""What strength 1 means, by kind; at strength s, chances and sizes are s times those."""


@dataclass(frozen=True)
class PoseErrors:
    """How far cameras are from where they are said to be.

    Attributes
    ----------
    rotation : float
        Root mean square of the angle by which a camera is turned about its centre, in degrees; any axis is as likely.
    translation : float
        Root mean square of the distance by which a camera is moved, in scene units; any direction is as likely.

    Raises
    ------
    SettingsError
        One of them is negative.
    """

    rotation: float = 0.0
    translation: float = 0.0

    def __post_init__(self) -> None:
        """Validate."""
        for name in ("rotation", "translation"):
            if not getattr(self, name) >= 0:
                raise SettingsError(f"pose errors: found {name} = {getattr(self, name)}; expected 0 or more")


def jitter(camera: Camera, rng: np.random.Generator, settings: PoseErrors) -> Camera:
    """Draw one wrong pose of a camera; without errors it is the camera itself.

    Parameters
    ----------
    camera : Camera
        Where it really is.
    rng : numpy.random.Generator
        Source of all randomness; a stream for each of the two errors is spawned from it.
    settings : PoseErrors
        How wrong.
    """
    turn, move = (stream.normal(size=3) / np.sqrt(3) for stream in rng.spawn(2))
    if settings == PoseErrors():
        return camera
    pose = camera.world_to_camera.copy()
    pose[:3, :3] = Rotation.from_rotvec(settings.rotation * turn, degrees=True).as_matrix() @ pose[:3, :3]
    pose[:3, 3] = -pose[:3, :3] @ (camera.center + settings.translation * move)
    return replace(camera, world_to_camera=pose)


def errors_at(
    kind: str, strength: float, *, missed_label: int | None = 0, depth: float = 1.0
) -> tuple[WrongMasks, PoseErrors]:
    """Give the settings for one kind of error at a strength, and no other error.

    Parameters
    ----------
    kind : str
        One of `STRONGEST`, which says what strength 1 means.
    strength : float
        From 0, no error at all, to 1.
    missed_label : int or None
        As in `WrongMasks`.
    depth : float
        How far away what the cameras see lies, in scene units; errors of poses go with it. See `typical_depth`.

    Raises
    ------
    SettingsError
        There is no such kind, or the strength is not in [0, 1].
    """
    if kind not in STRONGEST:
        raise SettingsError(f"kind of error is {kind!r}; expected one of {', '.join(STRONGEST)}")
    if not 0 <= strength <= 1:
        raise SettingsError(f"strength of {kind} is {strength}; expected a number in [0, 1]")
    none = WrongMasks(missed=0.0, swapped=0.0, edge_px=0, missed_label=missed_label)
    masks = {
        "missed objects": replace(none, missed=0.5 * strength),
        "wrong ids": replace(none, swapped=0.5 * strength),
        "swapped pairs": replace(none, exchanged=0.5 * strength),
        "moved edges": replace(none, edge_px=round(10 * strength)),
        "holes": replace(none, holes=strength, hole_px=16.0),
        "clutter": replace(none, blobs=16 * strength, blob_px=24.0),
        "shifted masks": replace(none, shift_px=16 * strength),
        "bad frames": replace(none, bad_frame=0.5 * strength),
    }
    poses = PoseErrors(2 * strength, 0.03 * strength * depth) if kind == "jittered poses" else PoseErrors()
    return masks.get(kind, none), poses


def corrupt_views(views: Iterable[View], seed: int, masks: WrongMasks, poses: PoseErrors | None = None) -> list[View]:
    """Draw one wrong version of each view, held in memory.

    Parameters
    ----------
    views : iterable of View
        With masks.
    seed : int
        The same one gives the same errors.
    masks : WrongMasks
        How wrong the masks are.
    poses : PoseErrors, optional
        How wrong the poses are; right by default.
    """
    mask_rng, pose_rng = np.random.default_rng(seed).spawn(2)
    return [
        View.from_arrays(
            jitter(view.camera, pose_rng, poses or PoseErrors()), corrupt(view.read_labels(), mask_rng, masks)
        )
        for view in views
    ]


def typical_depth(scene: GaussianScene, cameras: Sequence[Camera]) -> float:
    """Median depth of the Gaussians in the images of cameras, in scene units.

    Raises
    ------
    SettingsError
        No camera has a Gaussian in its image.
    """
    depths = []
    for camera in cameras:
        uv, depth = camera.project(scene.means)
        with np.errstate(invalid="ignore"):  # NaN behind the camera
            depths.append(depth[((uv >= 0) & (uv < (camera.width, camera.height))).all(axis=1)])
    if not sum(map(len, depths)):
        raise SettingsError(f"none of {len(cameras)} cameras has a Gaussian in its image; expected one that does")
    return float(np.median(np.concatenate(depths)))
