"""What the segmentation node answers to a request for its objects, and what it publishes then."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gsseg_msgs.msg import ObjectArray, SegmentationReport
from gsseg_msgs.srv import Export, Segment
from ros_checks import TOKENS, counts, latched_clouds
from ros_fixtures import parameters_fixture, root_fixture, running_fixture, scene_fixture, shared_fixture  # noqa: F401
from ros_robot import CLASSES, LATCHED, SERVICES, Learn, Robot, core_session, viewpoint
from sensor_msgs.msg import Image, PointCloud2
from small_scenes import NAMES, clean_views

from gsseg_core.export.pictures import overlay, palette
from gsseg_core.export.view_pictures import background_image
from gsseg_core.raster.backends import make_operator
from gsseg_core.refine.settings import PAPER, RefineSettings
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import REMOVED, Segmentation
from gsseg_ros.cloud_messages import arrays_from_cloud
from gsseg_ros.conversions import labels_from_image
from gsseg_ros.node.request_fields import refinement


@pytest.fixture
def robot(running: Robot) -> Robot:
    """A node that has fused six views, shared by the tests of this file."""
    running.done("reset")
    running.fuse(clean_views(6))
    return running


def refined(scene: GaussianScene) -> Segmentation:
    return core_session(scene, clean_views(6)).segmentation(PAPER)


def test_a_request_left_at_its_defaults_means_all_classes_refined_without_a_threshold(
    robot: Robot, scene: GaussianScene
) -> None:
    robot.done("segment", skip_refinement=True)  # Else the answer may be there already.
    report, expected = robot.done("segment").report, refined(scene)
    assert counts(report) == dict(zip(NAMES.values(), expected.counts().tolist(), strict=True))
    assert (report.k, report.filtered, report.min_confidence) == (50, True, 0.0)
    assert report.beta == pytest.approx(0.65)
    assert report.num_removed == (expected.labels == REMOVED).sum()
    assert (
        report.num_gaussians
        == len(scene)
        == (report.num_objects + report.num_background + report.num_unobserved + report.num_removed)
    )
    assert (report.job, report.learner, report.num_views, report.num_views_rejected) == ("segment", "votes", 6, 0)
    assert [stage.name for stage in report.stages] == ["codes", "knn", "filter", "boxes", "publish"]
    assert 0 < sum(stage.seconds for stage in report.stages) <= report.total_seconds
    for summary in report.classes:
        index = expected.labels == summary.class_id
        assert summary.mean_confidence == pytest.approx(expected.confidence[index].mean(), abs=1e-4)
        assert summary.min_confidence == pytest.approx(expected.confidence[index].min(), abs=1e-4)
        found = [[getattr(point, axis) for axis in "xyz"] for point in (summary.centroid, summary.box_min)]
        means = scene.means[index]
        np.testing.assert_allclose(found, [means.mean(axis=0), means.min(axis=0)], atol=1e-5)


def test_refinement_is_left_out_when_asked(robot: Robot, scene: GaussianScene) -> None:
    session = core_session(scene, clean_views(6))
    raw = robot.done("segment", skip_refinement=True).report
    assert (raw.k, raw.filtered, raw.num_removed) == (0, False, 0)
    observed = session.codes().any(axis=1)
    assert raw.num_unobserved == (~observed).sum() > 0
    clustered = robot.done("segment", skip_filter=True).report
    assert (clustered.k, clustered.filtered, clustered.num_removed) == (50, False, 0)


@pytest.mark.parametrize("kind", [Segment, Export])
def test_neighbours_weigh_alike_where_the_papers_way_is_asked_for_with_its_filter_or_without(kind: Any) -> None:
    def weighs(**fields: Any) -> bool:
        return refinement(kind.Request(**fields), SimpleNamespace(k=50, beta=0.65)).weigh

    assert not weighs(refine="paper") and not weighs(refine="paper", skip_filter=True)
    assert weighs(refine="carve") and weighs(refine="carve", skip_filter=True) and weighs(skip_filter=True)


def test_min_confidence_leaves_out_what_is_less_sure(robot: Robot, scene: GaussianScene) -> None:
    expected = refined(scene)
    sure = np.sort(expected.confidence[expected.labels >= 0])
    middle = sure[len(sure) // 4 : -len(sure) // 4]
    # In the widest gap: the node may round in another way.
    widest = int(np.diff(middle).argmax())
    threshold = float(middle[widest : widest + 2].mean())
    report = robot.done("segment", min_confidence=threshold).report
    kept = expected.labels[(expected.labels >= 0) & (expected.confidence >= threshold)]
    assert list(counts(report).values()) == np.bincount(kept, minlength=4).tolist()
    assert report.min_confidence == pytest.approx(threshold)
    assert all(summary.min_confidence >= threshold - 1e-6 for summary in report.classes if summary.num_gaussians)
    exported = robot.exported(robot.out("threshold"), min_confidence=threshold, refine="paper")
    assert exported.counts().tolist() == list(counts(report).values())


@pytest.mark.parametrize(
    ("classes", "expected"),
    [
        (["cup/mug"], ["cup/mug"]),
        (["3"], ["box"]),
        (["box", "1", "red ball"], ["red ball", "box"]),
        (["0", "background"], ["background"]),
        ([], CLASSES),
    ],
)
def test_classes_are_chosen_by_name_and_by_number(robot: Robot, classes: list[str], expected: list[str]) -> None:
    everything = counts(robot.done("segment").report)
    report = robot.done("segment", classes=classes).report
    assert counts(report) == {name: everything[name] for name in expected}
    assert [summary.topic for summary in report.classes] == [
        f"/gsseg/classes/{TOKENS[CLASSES.index(name)]}" for name in expected
    ]


def test_clouds_hold_the_centres_colours_labels_and_confidences_of_their_class(
    robot: Robot, scene: GaussianScene
) -> None:
    expected = refined(scene)
    robot.done("segment")
    clouds = latched_clouds(robot)
    colors = palette(4)
    for k, name in enumerate(TOKENS):
        found, index = arrays_from_cloud(clouds[f"classes/{name}"]), expected.labels == k
        np.testing.assert_array_equal(found.points, scene.means[index])
        np.testing.assert_allclose(found.confidence, expected.confidence[index], atol=1e-4)
        assert (found.labels == k).all() and (found.rgb == colors[k]).all()
    objects = arrays_from_cloud(clouds["cloud"])
    assert np.bincount(objects.labels, minlength=4).tolist() == [0, *expected.counts()[1:].tolist()]


def test_a_late_subscriber_gets_the_clouds_and_the_report_of_the_last_run(robot: Robot) -> None:
    robot.done("segment")
    report = robot.done("segment", min_confidence=0.3).report
    clouds = latched_clouds(robot)
    assert robot.latched((SegmentationReport, "report")) == [report]
    assert {cloud.header.frame_id for cloud in clouds.values()} == {"map"}
    assert all(cloud.header.stamp == report.header.stamp for cloud in clouds.values())
    assert [clouds[f"classes/{token}"].width for token in TOKENS] == list(counts(report).values())


def test_every_output_of_one_run_carries_the_same_stamp_and_later_runs_have_larger_numbers(robot: Robot) -> None:
    heard: dict[str, list[Any]] = {
        topic: robot.ros.collect(kind, f"/gsseg/{topic}", LATCHED)
        for topic, kind in [
            ("report", SegmentationReport), ("overlay", Image), ("cloud", PointCloud2),
            *((f"classes/{token}", PointCloud2) for token in TOKENS),
        ]
    }  # fmt: skip
    runs = []

    def all_have_spoken() -> bool:
        runs.append(robot.done("segment", **viewpoint(clean_views(1)[0])))
        return bool(heard["overlay"])

    robot.ros.wait_until(all_have_spoken, "an overlay, which is drawn for those who listen")
    last = runs[-1]
    robot.ros.wait_until(
        lambda: all(sent and sent[-1].header.stamp == last.report.header.stamp for sent in heard.values()),
        "all outputs of the last run",
    )
    assert last.label_image.header.stamp == last.report.header.stamp
    assert last.label_image.header.frame_id == heard["overlay"][-1].header.frame_id == "camera"
    assert heard["report"][-1] == last.report
    revisions = [run.report.revision for run in runs] + [
        robot.done("render_view", **viewpoint(clean_views(1)[0])).revision
    ]
    assert revisions == sorted(set(revisions))
    stamps = [(run.report.header.stamp.sec, run.report.header.stamp.nanosec) for run in runs]
    assert stamps == sorted(set(stamps))


def test_what_one_caller_asks_for_is_in_the_answer_and_topics_have_all_classes(robot: Robot) -> None:
    everything = robot.done("segment").report
    response = robot.done("segment", classes=["box"])
    assert counts(response.report) == {"box": counts(everything)["box"]}
    assert [thing.name for thing in response.objects] == ["box"]
    clouds = latched_clouds(robot)
    assert [clouds[f"classes/{token}"].width for token in TOKENS] == list(counts(everything).values())
    assert clouds["cloud"].width == everything.num_objects
    assert all(cloud.header.stamp == response.report.header.stamp for cloud in clouds.values())
    report, objects = robot.latched((SegmentationReport, "report"), (ObjectArray, "objects"))
    assert (report.revision, counts(report)) == (response.report.revision, counts(everything))
    assert [thing.name for thing in objects.objects] == CLASSES[1:]


def test_an_answer_for_one_caller_has_its_cloud_and_changes_no_topic(robot: Robot) -> None:
    published = robot.done("segment")
    before = latched_clouds(robot)
    response = robot.done("segment", classes=["box", "red ball"], publish_nothing=True)
    cloud = arrays_from_cloud(response.cloud)
    assert response.cloud.header == response.report.header
    assert np.bincount(cloud.labels, minlength=4).tolist() == [
        0,
        *(counts(response.report).get(k, 0) for k in CLASSES[1:]),
    ]
    assert [thing.name for thing in response.objects] == ["red ball", "box"]
    assert {summary.topic for summary in response.report.classes} == {""}
    assert published.cloud.width == 0
    robot.done("render_view", **viewpoint(clean_views(1)[0]))  # Whatever had been published would have come by now.
    assert latched_clouds(robot) == before
    assert robot.latched((SegmentationReport, "report")) == [published.report]


def test_carving_can_be_asked_for_and_the_papers_filter_in_exports(robot: Robot, scene: GaussianScene) -> None:
    session = core_session(scene, clean_views(6))
    carved = session.segmentation(RefineSettings()).counts().tolist()
    assert list(counts(robot.done("segment", refine="carve").report).values()) == carved
    exported = robot.exported(robot.out("paper"), refine="paper")
    assert exported.counts().tolist() == refined(scene).counts().tolist() != carved
    for service in ("segment", "render_view", "export"):
        response = robot.ask(service, refine="sand", **(viewpoint(clean_views(1)[0]) if service != "export" else {}))
        assert response.error_code == type(response).INVALID_REQUEST
        assert response.error_msg == "refine is 'sand'; expected paper, carve, or nothing"


def test_reset_forgets_views_and_codes_and_clears_the_clouds(robot: Robot) -> None:
    robot.done("segment")
    assert robot.done("reset").num_views_dropped == 6
    assert all(cloud.width == 0 for cloud in latched_clouds(robot).values())
    assert robot.ask("segment").error_code == SERVICES["segment"].Response.NO_CODES
    assert robot.learn()[1].error_code == Learn.Result.NO_VIEWS
    robot.fuse(clean_views(2))
    assert robot.done("reset").num_views_dropped == 2
    assert robot.done("reset").num_views_dropped == 0


def test_the_label_image_of_a_viewpoint_is_that_of_the_exported_segmentation(
    robot: Robot, scene: GaussianScene
) -> None:
    view = clean_views(1, "other", 0.4)[0]
    exported = robot.exported(robot.out("viewpoint"))
    expected = exported.render(make_operator(scene, view.camera)).labels
    response = robot.done("segment", **viewpoint(view))
    assert response.label_image.encoding == "mono16"
    np.testing.assert_array_equal(labels_from_image(response.label_image, "label_image"), expected)
    response = robot.done("segment", classes=["box"], **viewpoint(view))
    found = labels_from_image(response.label_image, "label_image")
    np.testing.assert_array_equal(found, np.where(expected == 3, 3, 0))
    assert robot.done("segment").label_image.width == 0


def test_render_view_draws_labels_confidence_and_overlay_and_publishes_nothing(
    robot: Robot, scene: GaussianScene
) -> None:
    view = clean_views(1, "other", 0.4)[0]
    robot.done("segment")
    reports = robot.ros.collect(SegmentationReport, "/gsseg/report", LATCHED)
    robot.ros.wait_until(lambda: reports, "the latched report")
    operator = make_operator(scene, view.camera)
    expected = core_session(scene, clean_views(6)).segmentation().render(operator)

    response = robot.done("render_view", **viewpoint(view))
    assert (response.confidence_image.width, response.overlay_image.width) == (0, 0)
    np.testing.assert_array_equal(labels_from_image(response.label_image, "label_image"), expected.labels)

    response = robot.done("render_view", **viewpoint(view), with_confidence=True, with_overlay=True)
    labels, confidence, picture = response.label_image, response.confidence_image, response.overlay_image
    assert (confidence.encoding, picture.encoding) == ("32FC1", "rgb8")
    assert labels.header == confidence.header == picture.header
    found = np.frombuffer(confidence.data, "<f4").reshape(48, 64)
    np.testing.assert_allclose(found, np.minimum(expected.confidence, 1), atol=1e-4)
    drawn = overlay(background_image(scene, operator), expected.labels, palette(4)).astype(int)
    assert np.abs(np.frombuffer(picture.data, np.uint8).reshape(48, 64, 3) - drawn).max() <= 1
    assert [stage.name for stage in response.stages][-1] == "render"
    robot.done("segment")
    robot.ros.wait_until(lambda: len(reports) == 2, "the report of the next run")
    assert reports[1].revision == response.revision + 1
