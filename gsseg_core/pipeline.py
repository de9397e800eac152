"""From files to files: what the command line and the demo do, one function per sub-command."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from gsseg_core.data.dataset import Dataset, View, spread
from gsseg_core.data.hints import mask_hint
from gsseg_core.data.label_images import write_mask
from gsseg_core.errors import NoUsableViewsError, SettingsError
from gsseg_core.export.class_plys import class_file_name, write_classes
from gsseg_core.export.pictures import save_png
from gsseg_core.export.summary import build_report
from gsseg_core.export.view_pictures import (
    Drawn,
    draw_views,
    draw_worst_views,
    view_file_name,
    write_overview,
    write_pictures,
)
from gsseg_core.files.earlier_outputs import earlier_render, earlier_segment
from gsseg_core.files.json_files import write_json
from gsseg_core.files.run_folder import StagedRun, staged_run
from gsseg_core.learn.calibrate import calibrate
from gsseg_core.learn.em.em_learner import EMLearner
from gsseg_core.learn.learner import MEMORY_BUDGET, NO_MASK, Learner, Progress, silent
from gsseg_core.learn.mask_reliability import OtherViews, ViewCheck, hold_against, reliability_report
from gsseg_core.learn.registry import DISTRIBUTED, make_learner
from gsseg_core.objects.object_table import IDS, PER_VIEW, find_objects
from gsseg_core.progress import Stopwatch
from gsseg_core.refine.label_propagation import GraphSettings, is_scarce, spread_if_scarce
from gsseg_core.refine.settings import RefineSettings
from gsseg_core.report.findings import Evidence
from gsseg_core.report.page import write_report_page
from gsseg_core.report.pictures import ViewImages
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import Segmentation

PICTURED_VIEWS = 12
"""Views that `segment` draws, spread evenly over the dataset."""


def segment_places(class_names: Mapping[int, str], views: Iterable[View]) -> list[str]:
    """Files that `gsseg segment` writes, as far as they are known before it learns; relative to its folder."""
    pictures = ["contact_sheet.png", "legend.png", "worst_views.png"]
    pictures += [view_file_name(view.name, "overlay_") for view in views]
    plys = [class_file_name(k, name) for k, name in class_names.items()]
    return [
        "segmentation.npz", "report.json", "report.html",
        *(f"classes/{name}" for name in plys), *(f"pictures/{name}" for name in pictures),
    ]  # fmt: skip


def segment(
    scene_path: str | os.PathLike[str],
    data: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    labels: str = "labels",
    learner: str = "em",
    views: int | None = None,
    refine: RefineSettings | None = None,
    graph: bool = True,
    device: str = "cpu",
    memory_budget: int = MEMORY_BUDGET,
    seed: int = 0,
    scheduler: str | None = None,
    ids: str = "global",
    progress: Progress = silent,
) -> dict[str, Any]:
    """Learn from the train views of a dataset, refine, and write everything into `out`.

    Parameters
    ----------
    scene_path : path
        A 3DGS PLY.
    data : path
        Dataset folder.
    out : path
        Gets `segmentation.npz`, `classes/`, `pictures/`, and at last `report.html` and `report.json`.
    labels : str
        Sub-folder of the dataset with the masks.
    learner : str
        One of `LEARNERS`.
    views : int, optional
        Learn from this many train views, spread evenly; from all by default.
    refine : RefineSettings, optional
        The paper's by default.
    graph : bool
        Where views are few, let codes spread to Gaussians that few or no pixels saw, before refinement; see
        `gsseg_core.refine.label_propagation`.
    memory_budget : int
        Bytes of prepared views to keep between the steps of learning; see docs/memory.md.
    scheduler : str, optional
        Address of a Dask scheduler whose workers learn; everything else is done here.
    ids : str
        One of `IDS`: whether an id means the same in every view, or the objects are to be found.

    Returns
    -------
    dict
        What `report.json` holds.

    Raises
    ------
    GssegError
        Whatever is wrong with the input; see `gsseg_core.errors`. What was in `out` before is whole and unchanged.
    """
    with staged_run(out, "segment", earlier=earlier_segment, places=segment_places({}, [])) as run:
        return _segment(
            run,
            scene_path,
            data,
            labels=labels,
            learner=learner,
            views=views,
            refine=refine,
            graph=graph,
            device=device,
            memory_budget=memory_budget,
            seed=seed,
            scheduler=scheduler,
            ids=ids,
            progress=progress,
        )


def _segment(
    run: StagedRun,
    scene_path: str | os.PathLike[str],
    data: str | os.PathLike[str],
    *,
    labels: str,
    learner: str,
    views: int | None,
    refine: RefineSettings | None,
    graph: bool,
    device: str,
    memory_budget: int,
    seed: int,
    scheduler: str | None,
    ids: str,
    progress: Progress,
) -> dict[str, Any]:
    """Do what `segment` does, and leave it to the caller to make the run the result."""
    if scheduler is not None and learner not in DISTRIBUTED:
        raise SettingsError(
            f"scheduler {scheduler}: the learner {learner} takes one view after the other, each at the codes that the "
            f"one before it left, so there is nothing to share out; expected one of {', '.join(DISTRIBUTED)}"
        )
    if ids not in IDS:
        raise SettingsError(f"ids is {ids!r}; expected one of {', '.join(IDS)}")
    refine = refine or RefineSettings()
    watch = Stopwatch()
    table = None
    with ExitStack() as stack:
        with watch.stage("load"):
            client = None
            if scheduler is not None:
                from gsseg_core.learn.distributed.dask_cluster import connected

                client = stack.enter_context(connected(scheduler))
            scene = GaussianScene.load(scene_path)
            dataset, class_ids = Dataset(data, labels), None
            if ids != PER_VIEW:
                dataset, class_ids = dataset.numbered(), dataset.class_ids
            train = spread(dataset.views("train"), views)
            class_names = {} if ids == PER_VIEW else dataset.class_names
        if ids == PER_VIEW:
            with watch.stage("associate"):
                table = find_objects(scene, train, device=device, progress=progress)
                train, class_names = [table.relabelled(view) for view in train], table.class_names
        chosen = spread(dataset.views("all"), PICTURED_VIEWS)
        run.claim(segment_places(class_names, chosen))
        with watch.stage("observe"):
            teacher = make_learner(
                learner, scene, max(class_names) + 1,
                seed=seed, device=device, memory_budget=memory_budget, client=client,
            )  # fmt: skip
            teacher.observe_all(train, progress)
        with watch.stage("learn"):
            try:
                teacher.fit(progress)
            except NoUsableViewsError as error:
                blank = set(teacher.rejected.values()) == {NO_MASK}
                hint = mask_hint(dataset.root, labels, [view.name for view in train]) if blank else ""
                raise NoUsableViewsError(f"{data}: {error}{hint}") from error
        if type(teacher) is not EMLearner:
            with watch.stage("calibrate"):  # while there still are workers
                calibration = calibrate(teacher, progress=progress)
    learnt: dict[str, Any] = {
        "views": {"used": len(teacher.views), "rejected": teacher.reject_summary(), "names": teacher.rejected},
        "objective": teacher.history_,
    }
    more = _settings_of(teacher)
    worst: np.ndarray | None = None
    masks, checks, held_out = dict(teacher.views), list[ViewCheck](), False
    if type(teacher) is EMLearner:
        with watch.stage("check views"):
            others = OtherViews(teacher, progress)
            checks, held_out = others.check_all(progress), True
            learnt["views"]["reliability"] = reliability_report(checks, class_names)
            worst = draw_worst_views(others, checks)
        with watch.stage("calibrate"):
            calibration = calibrate(teacher, others, progress)
        del others
    codes, evidence = teacher.codes_, teacher.evidence()
    del teacher  # Its votes take as much memory as all that follows.
    with watch.stage("refine"):
        if graph:
            codes = spread_if_scarce(scene, codes, evidence)
        result = Segmentation.from_codes(scene, codes, class_names, refine).calibrated(calibration.temperature)
        del codes
    if refine.carve:
        # Only now: the kernels of the carving take a while to compile, and most runs do without.
        from gsseg_core.objects.silhouette_carving import carved

        with watch.stage("carve"):
            cameras = [view.camera for view in spread(train, refine.carve_views)]
            result = carved(scene, result, cameras, device)
    named = result if class_ids is None else result.with_ids(class_ids)
    with watch.stage("export"):
        named.save(run.folder / "segmentation.npz", run.id)
        plys = write_classes(scene, named, run.folder / "classes", run.id)
    with watch.stage("pictures"):
        images = ViewImages(scene, device)
        drawn = draw_views(scene, result, chosen, device=device)
        if not held_out:
            drawn = _held_against_masks(drawn, masks, result.num_classes, checks)
        pictures = write_pictures(result, _keeping_images(drawn, images), run.folder / "pictures", run.id)
        if worst is not None:
            pictures.append(run.folder / "pictures" / "worst_views.png")
            save_png(pictures[-1], worst, run.id)
    report = build_report(
        scene,
        named,
        **learnt,
        settings={
            "learner": learner, "labels": labels, "views": views, "device": device, "memory_budget": memory_budget,
            "seed": seed, "scheduler": scheduler, "ids": ids, "refine": asdict(refine),
            "graph": asdict(GraphSettings()) if graph and is_scarce(evidence) else None, **more,
        },
        plys={k: str(path.relative_to(run.folder)) for k, path in plys.items()},
        pictures=[str(path.relative_to(run.folder)) for path in pictures],
        seconds=watch.seconds,
    )  # fmt: skip
    report["run"] = run.id
    report["calibration"] = calibration.as_dict()
    if table is not None:
        report["ids"] = table.summary()
    with watch.stage("report page"):
        write_report_page(run.folder / "report.html", report, scene, result, Evidence(checks, masks, held_out), images)
    report["page"] = "report.html"
    report["seconds"]["report page"] = round(watch.seconds["report page"], 3)
    write_json(run.folder / "report.json", report)
    return report


def render(
    scene_path: str | os.PathLike[str],
    data: str | os.PathLike[str],
    segmentation_path: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    split: str = "test",
    device: str = "cpu",
    progress: Progress = silent,
) -> list[Path]:
    """Render label maps of a split as `<stem>.png`, in the masks' own encoding, and overlays in `overlays/`.

    Those of an earlier `render` into the same folder are replaced, all of them, whatever their split.

    Returns
    -------
    list of pathlib.Path
        The label maps.
    """
    scene = GaussianScene.load(scene_path)
    dataset = Dataset(data)
    result = Segmentation.load(segmentation_path, scene)
    ids, numbered = result.class_ids, result.numbered()
    views = dataset.views(split)
    if not views:
        raise NoUsableViewsError(f"{data}: split {split!r} has no views; expected at least one to render")
    bits = 16 if result.num_classes > 255 else max((view.mask_bits or 8 for view in views), default=8)
    names = [view_file_name(view.name) for view in views]
    overlays = []
    places = [*names, *(f"overlays/{name}" for name in (*names, "contact_sheet.png", "legend.png"))]
    with staged_run(out, "render", earlier=earlier_render, places=places) as run:
        for done, (_, labels, image, _) in enumerate(draw_views(scene, numbered, views, device=device)):
            progress("render", done, len(views))
            write_mask(run.folder / names[done], ids[labels], bits, run.id)
            overlays.append(image)
            save_png(run.folder / "overlays" / names[done], image, run.id)
        progress("render", len(views), len(views))
        write_overview(numbered, overlays, [view.name for view in views], run.folder / "overlays", run.id)
    return [Path(out) / name for name in names]


def _keeping_images(drawn: Iterable[Drawn], images: ViewImages) -> Iterator[Drawn]:
    """Pass drawn views on; what was rendered for them, the report page need not render again."""
    for one in drawn:
        images.keep(one.view, one.image)
        yield one


def _held_against_masks(
    drawn: Iterable[Drawn], masks: Mapping[str, View], num_classes: int, checks: list[ViewCheck]
) -> Iterator[Drawn]:
    """Pass drawn views on, and note how the masks of those that were learnt from compare."""
    for one in drawn:
        if one.view.name in masks:
            checks.append(hold_against(masks[one.view.name], one.labels, num_classes))
        yield one


def _settings_of(learner: Learner) -> Mapping[str, Any]:
    settings = getattr(learner, "settings", None)
    return {} if settings is None else {"learner_settings": asdict(settings)}
