"""Arguments and results of `SegmentationClient`: arrays and plain values in place of messages."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from gsseg_msgs.msg import SegmentationReport

from gsseg_core.objects.oriented_boxes import OrientedBox
from gsseg_core.scene.camera import Camera


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """A camera in the map, from which the node renders.

    Attributes
    ----------
    camera_in_map : (4, 4)
        Pose of the camera's optical frame (x right, y down, z forward) in the map frame, metres.
    K : (3, 3)
        Intrinsic matrix of the rectified camera, pixels.
    width, height : int
        Image size, pixels.

    Raises
    ------
    PoseError, IntrinsicsError
        Not a rigid motion, or not a pinhole camera.
    """

    camera_in_map: npt.ArrayLike  # (4, 4)
    K: npt.ArrayLike  # (3, 3)
    width: int
    height: int

    def __post_init__(self) -> None:
        """Validate."""
        _ = self.camera

    @cached_property
    def camera(self) -> Camera:
        """The camera, in the map."""
        # Checked as it is, so that a message speaks of the numbers that were given; its inverse may not exist.
        K, pose = np.asarray(self.K, np.float64), np.asarray(self.camera_in_map, np.float64)
        given = Camera("viewpoint", self.width, self.height, K, pose)
        map_to_camera = np.linalg.inv(given.world_to_camera).astype(np.float64)
        return Camera(given.name, given.width, given.height, given.K, map_to_camera)

    @classmethod
    def of(cls, camera: Camera) -> Viewpoint:
        """Look from where a camera of `gsseg_core` does; its world is the map."""
        return cls(np.linalg.inv(camera.world_to_camera), camera.K, camera.width, camera.height)


@dataclass(frozen=True, eq=False)
class SegmentedObject:
    """All Gaussians of one class.

    Attributes
    ----------
    class_id : int
        Number of the class in the masks.
    name : str
        Its name.
    points : (M, 3) float32
        Centres in the map frame, metres; M is at least 1.
    confidence : (M,) float32
        Probability of the class, 0 to 1.
    color : (3,) uint8
        Of the class in clouds and pictures.
    oriented_box : OrientedBox
        The box that it fills, which lies as it does, with its mean and covariance, in the map frame, metres; see
        `gsseg_core.objects.oriented_boxes`. Stray Gaussians do not blow it up.
    """

    class_id: int
    name: str
    points: npt.NDArray[np.float32]
    confidence: npt.NDArray[np.float32]
    color: npt.NDArray[np.uint8]
    oriented_box: OrientedBox

    @property
    def centroid(self) -> npt.NDArray[np.float64]:
        """Mean of the points, (3,), metres."""
        mean: npt.NDArray[np.float64] = self.points.mean(axis=0, dtype=np.float64)
        return mean

    @property
    def box(self) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        """Lower and upper corner (3,) of the axis-aligned box around all of the points, metres."""
        return self.points.min(axis=0), self.points.max(axis=0)


class Timed:
    """A result with the report of the run that it comes from."""

    report: SegmentationReport

    @property
    def seconds(self) -> dict[str, float]:
        """Seconds of every stage in the node, in the order in which they ran."""
        return seconds_of(self.report.stages)


@dataclass(frozen=True, eq=False)
class SegmentResult(Timed):
    """Segmentation of the scene: all objects that were asked for, without the background.

    Attributes
    ----------
    points : (M, 3) float32
        Centres of the Gaussians in the map frame, metres, by class.
    labels : (M,) int32
        Class of each.
    confidence : (M,) float32
        Probability of that class, 0 to 1.
    rgb : (M, 3) uint8
        Colour of that class.
    report : gsseg_msgs.msg.SegmentationReport
        Counts, confidences and boxes by class (background included), settings, seconds. Its stamp and frame are those
        of the points.
    label_image : (H, W) int32 or None
        What the viewpoint sees, -1 where that is unknown; None without a viewpoint.
    boxes : dict of int to OrientedBox
        Box of every object by its class, in the map frame, metres.
    """

    points: npt.NDArray[np.float32]
    labels: npt.NDArray[np.int32]
    confidence: npt.NDArray[np.float32]
    rgb: npt.NDArray[np.uint8]
    report: SegmentationReport
    label_image: npt.NDArray[np.int32] | None
    boxes: dict[int, OrientedBox]

    @cached_property
    def objects(self) -> dict[str, SegmentedObject]:
        """Objects by the name of their class: those that have points."""
        objects = {}
        for summary in self.report.classes:
            members = self.labels == summary.class_id
            if members.any():
                objects[summary.name] = SegmentedObject(
                    summary.class_id,
                    summary.name,
                    self.points[members],
                    self.confidence[members],
                    self.rgb[members][0],
                    self.boxes[summary.class_id],
                )
        return objects


@dataclass(frozen=True, eq=False)
class LearnResult(Timed):
    """Outcome of learning.

    Attributes
    ----------
    report : gsseg_msgs.msg.SegmentationReport
        Views used and rejected, seconds, and the classes as learnt, before refinement.
    num_steps : int
        Steps that were done; 0 for a learner that has none.
    converged : bool
        Whether it stopped because it had converged.
    loss : float
        What the learner minimised, as of its last step, in nats per labelled pixel: em the negative log posterior,
        gradient the cross-entropy; NaN where there is no such thing.
    """

    report: SegmentationReport
    num_steps: int
    converged: bool
    loss: float


@dataclass(frozen=True, eq=False)
class PickedObject:
    """One object of M Gaussians that a view shows.

    Attributes
    ----------
    indices : (M,) int64
        Its Gaussians in the scene's file, from 0, ascending.
    points : (M, 3) float32
        Their centres in the map frame, metres.
    confidence : (M,) float32
        How sure it is that each belongs to the object, 0.5 to 1.
    oriented_box : OrientedBox or None
        The box that it fills, in the map frame, metres; None where M is 0.
    seconds : dict of str to float
        Seconds of every stage in the node.
    """

    indices: npt.NDArray[np.int64]
    points: npt.NDArray[np.float32]
    confidence: npt.NDArray[np.float32]
    oriented_box: OrientedBox | None
    seconds: dict[str, float]


@dataclass(frozen=True, eq=False)
class RenderedView:
    """Labels, confidences and overlay rendered from a viewpoint.

    Attributes
    ----------
    labels : (H, W) int32
        Class of each pixel, -1 where that is unknown.
    confidence : (H, W) float32 or None
        Its probability, where asked for.
    overlay : (H, W, 3) uint8 or None
        The scene, each pixel tinted in the colour of its class, where asked for.
    seconds : dict of str to float
        Seconds of every stage in the node.
    """

    labels: npt.NDArray[np.int32]
    confidence: npt.NDArray[np.float32] | None
    overlay: npt.NDArray[np.uint8] | None
    seconds: dict[str, float]


@dataclass(frozen=True, eq=False)
class LoadedScene:
    """A scene that the node has loaded: file, hash, size, and the box (3,), (3,) around it in the map frame, metres.

    Where votes were kept, also how many Gaussians were carried over, and by what they were found: "id" or "position".
    """

    path: Path
    digest: str
    num_gaussians: int
    box: tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]
    num_carried: int | None = None
    matched_by: str = ""


@dataclass(frozen=True)
class UpdatedScene:
    """What a change of the scene did: its number, hash and size now, Gaussians that went and came, views, seconds.

    Views are counted whose votes stayed, that were lifted anew, and that the change names and the node has not.
    """

    revision: int
    digest: str
    num_gaussians: int
    num_removed: int
    num_added: int
    num_views_kept: int
    num_views_lifted: int
    num_views_unknown: int
    seconds: float


@dataclass(frozen=True)
class MergedStates:
    """What the node knows after a merge: class names by id, views in the votes, and how many of them came with it."""

    class_names: dict[int, str]
    num_views: int
    num_merged: int


@dataclass(frozen=True)
class SavedState:
    """A state that the node has saved: file, size in bytes, and the number of views that it comes from."""

    path: Path
    num_bytes: int
    num_views: int


@dataclass(frozen=True)
class LoadedState:
    """A state that the node has loaded: file, class names by id, and the number of views that it comes from."""

    path: Path
    class_names: dict[int, str]
    num_views: int


@dataclass(frozen=True, eq=False)
class Exported(Timed):
    """Files that the node has written: the folder, the files in it with their full paths, and the report."""

    folder: Path
    files: list[Path]
    report: SegmentationReport


def seconds_of(stages: Any) -> dict[str, float]:
    """Seconds by stage, of a sequence of gsseg_msgs.msg.StageTiming."""
    return {stage.name: stage.seconds for stage in stages}
