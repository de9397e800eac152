"""From files to files: what the command line and the demo do, one function per sub-command."""

from __future__ import annotations

import os
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsseg_core.align.placing import Placed, place
from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.dataset import Dataset, folders_of
from gsseg_core.data.hints import FRAME_HINT, mask_hint
from gsseg_core.data.label_images import GLOBAL, PER_VIEW, write_mask
from gsseg_core.data.view import QUALITIES, spread
from gsseg_core.errors import NoUsableViewsError, SettingsError
from gsseg_core.export.pictures import CELL_PX, save_png, shrunk
from gsseg_core.export.summary import RunSettings
from gsseg_core.export.view_pictures import Drawn, draw_views, look_and_draw, view_file_name, write_overview
from gsseg_core.files.json_files import write_json
from gsseg_core.files.run_folder import staged_run
from gsseg_core.files.write_behind import writing_behind
from gsseg_core.learn.calibrate import calibrate
from gsseg_core.learn.learner import Learner
from gsseg_core.learn.mask_reliability import MaskChecker, reliability_report, shown_views
from gsseg_core.learn.prepared_views import default_budget
from gsseg_core.learn.registry import make_learner
from gsseg_core.learn.renamed_ids import renamed_ids, renamed_report
from gsseg_core.learn.usable_views import NO_MASK, SEES_NOTHING
from gsseg_core.progress import Progress, Stopwatch, silent, with_progress
from gsseg_core.refine.label_propagation import UNKNOWN_SHARE, GraphSettings, propagate
from gsseg_core.refine.settings import RefineSettings
from gsseg_core.report.run_files import Assessment, Inputs, write_run
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.scene_writers import DEFAULT as DEFAULT_FORMAT
from gsseg_core.segmentation import Segmentation
from gsseg_core.several_at_once import beside
from gsseg_core.spatial.neighbour_graph import graph_of
from gsseg_core.spatial.row_order import along_curve, in_curve_order

if TYPE_CHECKING:
    from distributed import Client

PICTURED_VIEWS = 12  # views that `segment` draws, spread evenly over the dataset


def segment(
    scene_path: str | os.PathLike[str],  # of any format in `gsseg_core.scene.scene_formats`
    data: str | os.PathLike[str],  # folder of the dataset
    out: str | os.PathLike[str],  # gets `segmentation.npz`, `classes/`, `pictures/`, `report.html` and `report.json`
    *,
    labels: str | os.PathLike[str] = "labels",  # sub-folder of masks, or those of another program: docs/formats.md
    learner: str = "em",  # one of `LEARNERS`
    views: int | None = None,  # learn from so many train views, spread evenly; from all by default
    refine: RefineSettings | None = None,  # KNN clustering and carving by default
    graph: bool = True,  # where views are few, propagate labels: `gsseg_core.refine.label_propagation`
    device: str = "cpu",
    memory_budget: int | None = None,  # bytes of prepared views; an eighth of what is free by default: docs/memory.md
    seed: int = 0,
    scheduler: str | None = None,  # address of a Dask scheduler whose workers learn; everything else is done here
    ids: str | None = None,  # one of `IDS`; by default, as the format of the masks has it
    granularity: float | None = None,  # where the tree of objects is cut for `classes/` and `pictures/`: docs/ids.md
    scene_format: str = DEFAULT_FORMAT,  # of the files in `classes/`, one of `SCENE_WRITERS`
    collision: str | None = None,  # kind of meshes of each object, one of `gsseg_core.export.collision.KINDS`
    label_map: str | os.PathLike[str] | None = None,  # renames, merges and ignores classes: `gsseg_core.data.label_map`
    align: bool = False,  # as for `gsseg_core.align.placing.place`, with `dataparser`: docs/frames.md
    dataparser: str | os.PathLike[str] | None = None,
    quality: str = "full",  # one of `QUALITIES`: of which pixels of the views to learn: docs/memory.md
    progress: Progress = silent,
) -> dict[str, Any]:
    """Learn from train views of a dataset, refine, and write everything into `out`; return what `report.json` holds.

    Raises `GssegError` for whatever is wrong with the input; what was in `out` before is whole and unchanged.
    """
    settings = RunSettings(
        learner, str(labels), views, device, default_budget(device) if memory_budget is None else memory_budget, seed,
        scheduler, ids, refine or RefineSettings(), GraphSettings() if graph else None, granularity, scene_format,
        collision, None if label_map is None else str(label_map), quality,
    )  # fmt: skip
    watch = Stopwatch()
    settings.check()
    inputs_read = (scene_path, *folders_of(data, labels))
    with staged_run(out, "segment", places=settings.places({}, []), inputs=inputs_read) as run:
        with ExitStack() as workers:
            with watch.stage("load"):
                client = _connect(scheduler, workers)
                scene, dataset = GaussianScene.load(scene_path), Dataset(data, labels, label_map=label_map)
                settings = replace(settings, ids=_ids(dataset, settings))
                settings.check()
            with watch.stage("place cameras"), beside(partial(_look_over, scene, ordered=client is None)):
                placed = place(
                    scene, dataset, align=align, check=True, dataparser=dataparser, device=device, progress=progress
                )
            with watch.stage("load"):
                # Workers find the scene in files of their own, in the order that it has there.
                inputs = _inputs(scene, placed, settings, ordered=client is None)
                del scene
            if settings.ids == PER_VIEW:
                with watch.stage("associate"):
                    inputs = _associate(inputs, device, progress)
            run.claim(settings.places(inputs.class_names, inputs.pictured))
            fitted = _learn(inputs, settings, client, watch, progress)
            assessment = _assess(fitted, inputs, watch, progress)
        codes, evidence = fitted.code_rows_, fitted.evidence()
        spreads = settings.graph if assessment.calibration.unknown > UNKNOWN_SHARE else None
        settings = replace(settings, graph=spreads, learner_settings=getattr(fitted, "settings", None))
        del fitted  # Its votes take as much memory as all that follows.
        with watch.stage("refine"):
            names = inputs.class_names
            if settings.graph:
                codes = CSRRows.from_dense(propagate(graph_of(inputs.scene), codes.dense(len(names)), evidence))
            result = Segmentation.unfiltered(inputs.scene, codes, names, settings.refine, evidence)
            result = result.filtered(inputs.scene, settings.refine)
            del codes
        drawn: dict[str, Drawn] = {}
        if settings.refine.carve:
            with watch.stage("carve"):
                asked = {view.name for view in inputs.pictured}
                asked |= {check.name for check in shown_views(assessment.checks or ())}
                look = partial(look_and_draw, inputs.scene, result, asked, drawn, device)
                result = result.carved_by(inputs.scene, inputs.looked_at, look, device)
                del look  # It holds probabilities that are no longer needed once they are calibrated.
        with watch.stage("pictures"):
            left = [view for view in inputs.pictured if view.name not in drawn]
            drawn |= {one.view.name: one for one in draw_views(inputs.scene, result, left, device=device)}
        with watch.stage("refine"):
            result = result.calibrated(assessment.calibration.temperature)
            result = inputs.objects.with_tree(result) if inputs.objects else result
        with ExitStack() as writing:
            behind = writing.enter_context(writing_behind())
            report = write_run(run, inputs, assessment, result, drawn, settings, watch, behind, progress)
            with watch.stage("export"):  # what is left of it
                writing.close()
        write_json(run.folder / "report.json", report.as_dict())
    return report.as_dict()


def _connect(scheduler: str | None, workers: ExitStack) -> Client | None:
    """Connect to a Dask scheduler, if one is asked for, until the stack is closed."""
    if scheduler is None:
        return None
    from gsseg_core.learn.distributed.dask_cluster import connected

    return workers.enter_context(connected(scheduler))


def _look_over(scene: GaussianScene, *, ordered: bool) -> None:
    """Have a scene find, by one thread, what `_inputs` asks it for: its digest and its order, which it keeps."""
    _ = scene.digest
    if ordered:
        along_curve(scene)


def _inputs(scene: GaussianScene, placed: Placed, settings: RunSettings, *, ordered: bool) -> Inputs:
    """List the views to learn from and to draw, with classes numbered without gaps; bring the scene into an order."""
    dataset = placed.dataset
    # Ids that are a view's own are no classes; objects take their place.
    class_ids = None if settings.ids == PER_VIEW else dataset.class_ids
    dataset = dataset if class_ids is None else dataset.numbered()
    train = spread(dataset.views("train"), settings.views)
    # Views that carving looks at anyway, unless there are few.
    looked_at = spread(train, settings.refine.carve_views)
    enough = settings.refine.carve and len(looked_at) >= PICTURED_VIEWS
    pictured = spread(looked_at if enough else dataset.views("all"), PICTURED_VIEWS)
    in_order, places = in_curve_order(scene) if ordered else (scene, None)
    return Inputs(
        in_order, scene.digest, places, dataset.root, train, looked_at, pictured,
        {} if class_ids is None else dataset.class_names, class_ids, placed.as_dict(), dataset.describe_masks(),
    )  # fmt: skip


def _ids(dataset: Dataset, settings: RunSettings) -> str:
    """Find out what ids mean, from the masks if the settings do not say; refuse what the masks contradict."""
    masks = dataset.masks
    if masks is None or not masks.per_view:
        return settings.ids or GLOBAL
    if settings.ids == GLOBAL:
        raise SettingsError(
            f"{dataset.root / settings.labels}: ids are to be global; expected per-view, as {masks.format} has them"
        )
    return PER_VIEW


def _associate(inputs: Inputs, device: str, progress: Progress) -> Inputs:
    """Find which ids of the views are the same object, and number the objects."""
    from gsseg_core.objects.object_table import find_objects  # It needs SciPy, which takes a while to load.

    found = find_objects(inputs.scene, inputs.train, device=device, progress=progress)
    train = [found.relabelled(view) for view in inputs.train]
    return replace(inputs, train=train, class_names=found.class_names, objects=found)


def _learn(
    inputs: Inputs, settings: RunSettings, client: Client | None, watch: Stopwatch, progress: Progress
) -> Learner:
    """Fit the learner that the settings name to the train views."""
    with watch.stage("observe"):
        learner = make_learner(
            settings.learner, inputs.scene, max(inputs.class_names) + 1, seed=settings.seed, device=settings.device,
            memory_budget=settings.memory_budget, client=client,
        )  # fmt: skip
        learner.observe_all([view.smaller(QUALITIES[settings.quality]) for view in inputs.train], progress)
    with watch.stage("learn"):
        try:
            learner.fit(progress)
        except NoUsableViewsError as error:
            why, names = set(learner.rejected.values()), [view.camera.image for view in inputs.train]
            hint = FRAME_HINT if why == {SEES_NOTHING} else ""
            hint = mask_hint(inputs.root, settings.labels, names) if why == {NO_MASK} else hint
            raise NoUsableViewsError(f"{inputs.root}: {error}{hint}") from error
    return learner


def _assess(learner: Learner, inputs: Inputs, watch: Stopwatch, progress: Progress) -> Assessment:
    """Compare each mask with what the other views predict, where the learner can tell, and calibrate."""
    checks, checker, reliability = None, None, dict[str, Any]()
    if learner.checks_masks:
        with watch.stage("check views"):
            checker = MaskChecker(learner)
            checks = checker.check_all(progress)
            reliability["reliability"] = reliability_report(checks, inputs.class_names)
            if inputs.objects is None and (renamed := renamed_report(renamed_ids(checks), inputs.class_names)):
                reliability["renamed"] = renamed
    with watch.stage("calibrate"):
        calibration = calibrate(learner, checker, progress)
    views = {"used": len(learner.views), "rejected": learner.reject_summary(), "names": learner.rejected, **reliability}
    in_memory, in_file = learner.prepared_bytes()
    memory = {"budget": learner.memory_budget, "in_memory": in_memory, "in_file": in_file}
    return Assessment(dict(learner.views), checks, calibration, learner.history_, views, memory)


def render(
    scene_path: str | os.PathLike[str],
    data: str | os.PathLike[str],
    segmentation_path: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    split: str = "test",
    device: str = "cpu",
    align: bool = False,
    dataparser: str | os.PathLike[str] | None = None,
    progress: Progress = silent,
) -> list[Path]:
    """Render label maps of a split as `<stem>.png`, of 16 bits if ids take them, and overlays in `overlays/`.

    Returns the label maps. Those of an earlier `render` into the same folder are replaced, all of them, whatever their
    split.
    """
    scene, dataset = GaussianScene.load(scene_path), Dataset(data)
    result = Segmentation.load(segmentation_path, scene)
    ids, numbered = result.class_ids, result.numbered()
    placed = place(scene, dataset, align=align, dataparser=dataparser, device=device, progress=progress)
    views = placed.dataset.views(split)
    if not views:
        expected = "at least one to render; --split all renders every view"
        raise NoUsableViewsError(f"{data}: split {split!r} has no views; expected {expected}")
    bits = 8 if max(ids) < 255 else 16  # 255 means unknown in masks of 8 bits
    names, overlays = [view_file_name(view.name) for view in views], []
    overview, prefix = ("contact_sheet.png", "legend.png"), "overlay_"
    while any(f"{prefix}{name}" in names for name in names if name in overview):
        prefix += "overlay_"
    pictures = {name: f"overlays/{prefix * (name in overview)}{name}" for name in names}
    places = [*names, *pictures.values(), *(f"overlays/{k}" for k in overview)]
    with staged_run(out, "render", places=places, inputs=folders_of(data)) as run:
        drawn, save = draw_views(scene, numbered, views, device=device), partial(save_png, run=run.id)
        for name, (_, labels, image, _) in zip(with_progress(progress, "render", names), drawn, strict=True):
            write_mask(run.folder / name, ids[labels], bits, run.id)
            overlays.append(shrunk(image, CELL_PX))  # As the contact sheet has it; of all views, memory is for no more.
            save(run.folder / pictures[name], image)
        captions = [view.name for view in views]
        write_overview(numbered, overlays, captions, run.folder / "overlays", save, ids.tolist())
    return [Path(out) / name for name in names]
