"""Seconds of each stage of the work on one dataset, each apart, in the order in which the work is done."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from machine import asked_anew, drop_from_page_cache, once, timed

from gsseg_core.data.class_names import class_name
from gsseg_core.data.dataset import Dataset
from gsseg_core.data.view import View, spread
from gsseg_core.export.class_files import export_classes
from gsseg_core.learn.em.em_learner import EMLearner
from gsseg_core.learn.vote_learner import VoteLearner
from gsseg_core.live.session import LiveSession
from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.cpu.depth_sort import sort_keys
from gsseg_core.raster.cpu.projection import project
from gsseg_core.raster.cpu.tiling import assign
from gsseg_core.raster.depth import depths
from gsseg_core.raster.vote_total import VoteTotal
from gsseg_core.refine.knn_filter import cluster, statistical_filter
from gsseg_core.refine.settings import RefineSettings
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import Segmentation
from gsseg_core.spatial.neighbourhood import Neighbours

Times = dict[str, list[float]]
"""Seconds of each run of each stage, or other numbers of it."""


def measure_stages(folder: Path, runs: int, sampled: int) -> Times:
    """Time everything on a dataset; what belongs to one view is averaged over some of them."""
    path = folder / "scene.ply"
    times: Times = {"load": timed(lambda: GaussianScene.load(path), runs)}
    times["load, from disk"] = [_from_disk(path) for _ in range(runs)]
    scene, data = GaussianScene.load(path), Dataset(folder)
    chosen = spread([view for view in data.views("train") if view.has_mask], sampled)
    if not chosen:  # A scene without masks can be rendered all the same.
        chosen = [_unlabelled(view) for view in spread(data.views("all"), sampled)]
        times |= _view_stages(scene, chosen, 1, runs)
        return times
    times |= _view_stages(scene, chosen, data.num_classes, runs)
    times["fuse one mask"] = _fuse(scene, data, runs, sampled)
    times |= _learning(scene, data)
    times |= _refinement(path, data, runs)
    return times


def _from_disk(path: Path) -> float:
    drop_from_page_cache(path)
    return once(lambda: GaussianScene.load(path))


def _unlabelled(view: View) -> View:
    return View.from_arrays(view.camera, np.zeros((view.camera.height, view.camera.width), np.int32))


def _view_stages(scene: GaussianScene, views: list[View], num_classes: int, runs: int) -> Times:
    """Stages of one view: each run takes all of them, one after the other."""
    total = VoteTotal(len(scene), num_classes)
    codes = np.random.default_rng(0).dirichlet(np.ones(num_classes), len(scene)).astype(np.float32)
    stages: dict[str, list[Callable[[], object]]] = {}

    def add(name: str, job: Callable[[], object]) -> None:
        stages.setdefault(name, []).append(job)

    for view in views:
        camera, mask = view.camera, view.read_labels()
        projected, operator = project(scene, camera), make_operator(scene, camera)
        observation, depth = operator.observe(mask), depths(scene, camera, projected.ids)
        mine = codes[observation.places]
        rest = np.ones(len(observation.classes), np.float32)
        add("project and sort", lambda c=camera: project(scene, c))
        add("of this, sort", lambda d=depth: sort_keys(d.view(np.uint32)))
        add("bin", lambda p=projected, c=camera: assign(p, c.width, c.height))
        add("blend", operator.transmittance)
        add(f"render {num_classes} classes", lambda o=operator: o.render(codes))
        add("lift to votes", lambda o=operator, m=mask: o.vote(m, None, total))
        add("observe", lambda o=operator, m=mask: o.observe(m))
        add("shares", asked_anew(observation, mine, rest))
        add("adjoint, 3 channels", lambda o=operator, m=mask: o.adjoint(np.repeat(m[..., None], 3, axis=2)))
    return {name: _averaged(jobs, runs) for name, jobs in stages.items()}


def _averaged(jobs: list[Callable[[], object]], runs: int) -> list[float]:
    rows = [timed(job, runs) for job in jobs]
    return [sum(row) / len(rows) for row in zip(*rows, strict=True)]


def _fuse(scene: GaussianScene, data: Dataset, runs: int, sampled: int) -> list[float]:
    """Seconds from a mask as an array to votes that hold it, per mask, as the node does it."""
    session = LiveSession(scene, data.class_names)
    masks = [(view.camera, view.read_labels()) for view in spread(data.views("train"), sampled)]

    def fuse(turn: int) -> None:
        for camera, labels in masks:
            rejection = session.fuse(View.from_arrays(replace(camera, name=f"{camera.name} {turn}"), labels))
            assert rejection is None, rejection

    # Memory that is touched for the first time is slow, and a robot that runs has it.
    return [once(lambda turn=turn: fuse(turn)) / len(masks) for turn in range(runs + 1)][1:]


def _learning(scene: GaussianScene, data: Dataset) -> Times:
    """EM over all train views until it converges; of its steps, all between the first and the last."""
    learner = EMLearner(scene, data.num_classes)
    prepare = once(lambda: [learner.observe(view) for view in data.views("train")])
    marks: dict[int, float] = {}

    def progress(stage: str, done: int, total: int) -> None:
        if stage == "em":
            marks.setdefault(done, time.perf_counter())

    fit = once(lambda: learner.fit(progress))
    steps = len(learner.history_)
    starts = [marks[done] for done in sorted(marks) if 0 < done < steps]
    each = np.diff(starts).tolist() or [fit / steps]
    return {"read and observe all views": [prepare], "EM step": each, "EM, all steps": [fit], "EM steps": [steps]}


def _refinement(path: Path, data: Dataset, runs: int) -> Times:
    """Stages after learning, on the codes of votes."""
    settings, times = RefineSettings(), {}
    scene = GaussianScene.load(path)
    learner = VoteLearner(scene, data.num_classes)
    for view in data.views("train"):
        learner.observe(view)
    rows = learner.fit().code_rows_
    evidence, names = learner.evidence(), {k: class_name(data.class_names, k) for k in range(data.num_classes)}
    # The first call on a scene finds the neighbours; the later ones have them.
    fresh = [GaussianScene.load(path) for _ in range(runs)]

    def refine(scene: GaussianScene) -> Segmentation:
        return Segmentation.unfiltered(scene, rows, names, settings, evidence)

    times["segment, first call"] = [once(lambda s=s: refine(s)) for s in fresh]
    del fresh
    times["segment, later calls"] = timed(lambda: refine(scene), runs)
    result = refine(scene)
    known = Neighbours.among(scene.means, settings.k).look_for()
    times["neighbours"] = timed(lambda: Neighbours.among(scene.means, settings.k).look_for(), runs)
    times["KNN"] = timed(lambda: cluster(known, rows, data.num_classes, settings.beta, evidence), runs)
    times["filter"] = timed(lambda: statistical_filter(known, result.labels, settings.filter_sigmas), runs)
    with tempfile.TemporaryDirectory() as out:
        times["export one PLY per class"] = timed(lambda: export_classes(scene, result, f"{out}/classes"), runs)
        times["save segmentation.npz"] = timed(lambda: result.save(f"{out}/segmentation.npz"), runs)
    return times
