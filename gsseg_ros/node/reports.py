"""Turns a segmentation into messages: the report, one cloud per class, and the objects with their boxes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from gsseg_msgs.msg import ClassSummary, Object, ObjectArray, SegmentationReport, StageTiming
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from gsseg_core.export.pictures import palette
from gsseg_core.export.summary import gaussian_counts
from gsseg_core.live.session import LiveSession
from gsseg_core.objects.oriented_boxes import class_box
from gsseg_core.refine.settings import RefineSettings
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import Segmentation
from gsseg_ros.cloud_messages import CLOUD_POINT, cloud_of_records, fill_records
from gsseg_ros.frames import Similarity
from gsseg_ros.node.workspace import Run
from gsseg_ros.object_messages import color_message, object_message, point_message

_AT_ONCE = 1 << 15  # points of a cloud that are put together at a time


@dataclass(frozen=True, eq=False)
class Selection:
    """Those classes and Gaussians of a segmentation that a request asked for."""

    session: LiveSession  # what it comes from
    result: Segmentation  # of all classes
    chosen: Sequence[int]  # ids of the classes that were asked for, ascending
    min_confidence: float  # Gaussians less sure than this are left out
    similarity: Similarity  # from the scene to the map

    @property
    def scene(self) -> GaussianScene:
        """The scene that the result is of; the session's may have changed since."""
        return self.session.scene_of(self.result)

    @property  # Kept, it would hold itself, and all arrays that belong to it, until the collector comes by.
    def of_all_classes(self) -> Selection:
        """The same without a choice of classes."""
        everything = sorted(self.result.class_names)
        return self if list(self.chosen) == everything else replace(self, chosen=everything)

    @cached_property
    def indices(self) -> dict[int, np.ndarray]:
        """Gaussians (M,) of each class that was asked for."""
        labels = self.result.labels
        # Short numbers are sorted by their digits, in a quarter of the time.
        order = np.argsort(labels.astype(np.int16) if self.result.num_classes < 2**15 else labels, kind="stable")
        kept = order[self._confidence[order] >= self.min_confidence]
        bounds = np.searchsorted(labels[kept], [(k, k + 1) for k in self.chosen])
        return {k: kept[first:last] for k, (first, last) in zip(self.chosen, bounds.tolist(), strict=True)}

    @cached_property
    def present(self) -> list[int]:
        """Ids of the classes that have Gaussians, whether asked for or not."""
        return [int(k) for k in np.unique(self.result.labels) if k >= 0]

    @cached_property
    def _confidence(self) -> np.ndarray:
        return self.result.confidence

    @cached_property
    def _colors(self) -> np.ndarray:
        return palette(self.result.num_classes)

    @cached_property
    def _records(self) -> dict[int, np.ndarray]:
        """Points of each class, as clouds hold them: parts of one array, those of the objects side by side."""
        records = np.empty(sum(map(len, self.indices.values())), CLOUD_POINT)
        found, end = {}, 0
        for k, index in self.indices.items():
            found[k] = records[end : end + len(index)]
            end += len(index)
            # What is put together at a time stays in the processor's cache.
            for first in range(0, len(index), _AT_ONCE):
                part = index[first : first + _AT_ONCE]
                points = self.similarity.points_to_map(self.scene.means[part])
                fill_records(found[k][first : first + _AT_ONCE], points, self._colors[k], k, self._confidence[part])
        return found

    def class_cloud(self, k: int, header: Header) -> PointCloud2:
        """Cloud of one class."""
        return cloud_of_records(header, self._records[k])

    def objects_cloud(self, header: Header) -> PointCloud2:
        """Cloud of all objects that were asked for: every class but the background."""
        parts = [records for k, records in self._records.items() if k > 0]
        return cloud_of_records(header, *parts)

    def objects(self, header: Header, revision: int) -> ObjectArray:
        """Put boxes around all objects that were asked for."""
        return ObjectArray(
            header=header,
            revision=revision,
            objects=[self._object(k, index) for k, index in self.indices.items() if k > 0 and len(index)],
        )

    def _object(self, k: int, index: np.ndarray) -> Object:
        confidence = self._confidence[index]
        box = self.similarity.box_to_map(class_box(self.scene, index, confidence))
        return object_message(k, self.result.class_names[k], color_message(self._colors[k]), confidence, box)

    def class_summary(self, k: int, topic: str) -> ClassSummary:
        """Summarise one class in numbers."""
        index = self.indices[k]
        summary = ClassSummary(
            class_id=k,
            name=self.result.class_names[k],
            topic=topic,
            color=color_message(self._colors[k]),
            num_gaussians=len(index),
        )
        if len(index):
            records = self._records[k]
            points = np.stack([records[axis] for axis in "xyz"], axis=1)
            confidence = np.ascontiguousarray(records["confidence"])
            summary.mean_confidence = float(confidence.mean(dtype=np.float64))
            summary.min_confidence = float(confidence.min())
            summary.centroid = point_message(points.mean(axis=0, dtype=np.float64))
            summary.box_min, summary.box_max = point_message(points.min(axis=0)), point_message(points.max(axis=0))
        return summary


def report_message(
    run: Run, selection: Selection, settings: RefineSettings, map_frame: str, topics: Mapping[int, str] | None = None
) -> SegmentationReport:
    """Report a run; the stages so far and the total are filled in by `finish`."""
    session, result = selection.session, selection.result
    counts, learnt = gaussian_counts(result), session.learnt
    background = int((result.labels == 0).sum())
    rejected = sorted((Counter(session.rejected) + run.dropped).items())
    return SegmentationReport(
        header=Header(stamp=run.stamp, frame_id=map_frame),
        revision=run.revision,
        job=run.job,
        scene_path=str(selection.scene.path),
        scene_hash=selection.scene.digest,
        num_gaussians=len(selection.scene),
        num_objects=counts["labelled"] - background,
        num_background=background,
        num_unobserved=counts["unobserved"],
        num_removed=counts["removed"],
        learner="votes" if learnt is None else learnt.learner,
        num_views=session.num_fused if learnt is None else learnt.num_views,
        num_views_rejected=sum(count for _, count in rejected),
        rejection_reasons=[reason for reason, _ in rejected],
        rejection_counts=[count for _, count in rejected],
        k=settings.k if settings.cluster else 0,
        beta=settings.beta,
        filtered=settings.filter or settings.carve,
        min_confidence=selection.min_confidence,
        classes=[selection.class_summary(k, (topics or {}).get(k, "")) for k in selection.chosen],
    )


def empty_report(run: Run, session: LiveSession | None, map_frame: str) -> SegmentationReport:
    """Report an empty segmentation, after a run that has made all earlier ones invalid."""
    report = SegmentationReport(
        header=Header(stamp=run.stamp, frame_id=map_frame), revision=run.revision, job=run.job,
        total_seconds=run.total_seconds,
    )  # fmt: skip
    if session is not None:
        report.scene_path, report.scene_hash = str(session.scene.path), session.scene.digest
        report.num_gaussians = report.num_unobserved = len(session.scene)
    return report


def finish(report: SegmentationReport, run: Run) -> SegmentationReport:
    """Fill in how long the run took."""
    report.stages = stage_timings(run)
    report.total_seconds = run.total_seconds
    return report


def stage_timings(run: Run) -> list[StageTiming]:
    """Seconds of every stage, in the order in which they ran."""
    return [StageTiming(name=name, seconds=seconds) for name, seconds in run.watch.seconds.items()]
