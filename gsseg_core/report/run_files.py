"""All files of a run of `gsseg segment`, written from what it was given and from what it found."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsseg_core.data.view import View
from gsseg_core.export.class_files import class_paths, mesh_file_name, write_classes
from gsseg_core.export.collision import collision_meshes
from gsseg_core.export.pictures import save_png
from gsseg_core.export.summary import RunReport, RunSettings, class_table
from gsseg_core.export.view_pictures import Drawn, draw_views, draw_worst_views, write_pictures
from gsseg_core.files.run_folder import StagedRun
from gsseg_core.files.write_behind import WriteBehind
from gsseg_core.learn.calibrate import Calibration
from gsseg_core.learn.mask_reliability import ViewCheck, compare_mask
from gsseg_core.progress import Progress, Stopwatch
from gsseg_core.report.findings import MaskChecks
from gsseg_core.report.page import load_templates, write_report_page
from gsseg_core.report.pictures import ViewImages
from gsseg_core.report.sections import PageInputs
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import Segmentation

if TYPE_CHECKING:
    import numpy as np

    from gsseg_core.objects.object_table import ObjectTable


@dataclass(frozen=True, eq=False)
class Inputs:
    """What a run learns from."""

    scene: GaussianScene
    digest: str  # of the scene as it is in its file
    places: np.ndarray | None  # (N,) int32 in this scene of the Gaussians in that order; None where it is the same
    root: Path  # of the dataset
    train: list[View]
    looked_at: list[View]  # of these, to carve objects by
    pictured: list[View]
    class_names: Mapping[int, str]  # of classes as they are learnt, numbered without gaps
    class_ids: tuple[int, ...] | None  # of these classes in the dataset; None where the classes are objects
    frame: Mapping[str, Any]  # `frame` in `report.json`
    masks: Mapping[str, Any] | None  # `masks` in `report.json`
    objects: ObjectTable | None = None  # which the ids of the views were found to be


@dataclass(frozen=True, eq=False)
class Assessment:
    """What is known of the views once they have been learnt from."""

    views: Mapping[str, View]  # by name, those that were used
    checks: list[ViewCheck] | None  # their masks beside what the others predict; None where the learner cannot tell
    calibration: Calibration
    objective: list[float]  # of the learner, after each step
    report: Mapping[str, Any]  # `views` in `report.json`
    memory: Mapping[str, int]  # `prepared_views` there


def write_run(
    run: StagedRun, inputs: Inputs, assessment: Assessment, result: Segmentation, drawn: Mapping[str, Drawn],
    settings: RunSettings, watch: Stopwatch, behind: WriteBehind[...], progress: Progress,
) -> RunReport:  # fmt: skip
    """Write all files of a run but `report.json`, some of them behind the work, and report it."""
    scene, folder, level = inputs.scene, run.folder, result.at(settings.granularity)
    named = result if inputs.class_ids is None else result.with_ids(inputs.class_ids)
    exported = named if level is result else level
    with watch.stage("export"):
        behind(load_templates)
        if level is not result:
            run.claim(settings.places(level.class_names, inputs.pictured))
        in_file = named if inputs.places is None else named.in_order_of(inputs.digest, inputs.places)
        behind(in_file.save, folder / "segmentation.npz", run.id)
        meshes = collision_meshes(scene, exported.labels, exported.confidence, settings.collision, progress)
        files = class_paths(exported, folder / "classes", settings.scene_format)
        behind(write_classes, scene, exported, folder / "classes", run.id, settings.scene_format, meshes, inputs.places)
    with watch.stage("pictures"):
        images = ViewImages(scene, settings.device, drawn.values())
        shown = [drawn[view.name] for view in inputs.pictured]
        checked, pictures = _picture(run, inputs, assessment, result, level, shown, images, behind)
    with watch.stage("report page"):
        report = RunReport.of(
            scene, exported, run=run.id, views=assessment.report, settings=settings.as_dict(), seconds=watch.seconds,
            objective=assessment.objective, calibration=assessment.calibration.as_dict(), frame=inputs.frame,
            prepared_views=assessment.memory, masks=inputs.masks,
            ids=inputs.objects and inputs.objects.summary(result), digest=inputs.digest,
            files={k: str(path.relative_to(folder)) for k, path in files.items()},
            meshes={k: f"classes/{mesh_file_name(k, exported.class_names[k])}" for k in meshes},
            pictures=[str(path.relative_to(folder)) for path in pictures],
        )  # fmt: skip
        told = report if level is result else replace(report, classes=class_table(scene, result))
        write_report_page(folder / "report.html", PageInputs(told.as_dict(), scene, result, checked, images))
    # Of objects, those that learning gave no Gaussian are none; a class that was asked for is told of in any case.
    classes = [one for one in report.classes if one["gaussians"] or not (inputs.objects and one["id"])]
    return replace(report, classes=classes, page="report.html", seconds=watch.seconds)


def _picture(
    run: StagedRun, inputs: Inputs, assessment: Assessment, result: Segmentation, level: Segmentation,
    shown: Iterable[Drawn], images: ViewImages, behind: WriteBehind[...],
) -> tuple[MaskChecks, list[Path]]:  # fmt: skip
    """Write the pictures; images of views that are rendered for them are kept for the report page."""
    views, folder, checks = assessment.views, run.folder / "pictures", list(assessment.checks or ())
    if assessment.checks is None:  # What is compared then is drawn in full size.
        views = {view.name: view for view in inputs.train if view.name in views}
        compared = [drawn for drawn in shown if drawn.view.name in views]
        checks = [compare_mask(views[drawn.view.name], drawn.labels, result.num_classes) for drawn in compared]
    save = partial(behind, save_png, run=run.id)
    if level is not result:  # What is compared with the masks are objects, as they are.
        shown = draw_views(inputs.scene, level, inputs.pictured, device=images.device)
    pictures = write_pictures(level, shown, folder, save, inputs.class_ids)
    if assessment.checks:
        pictures.append(folder / "worst_views.png")
        save(pictures[-1], draw_worst_views(images.rendered, views, assessment.checks, device=images.device))
    return MaskChecks(checks, views, assessment.checks is not None), pictures
