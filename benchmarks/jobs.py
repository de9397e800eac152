"""What children are asked to do; each function answers with what JSON can hold."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import numba as nb
import numpy as np
from first_rasteriser import first_lift, to_splats
from lift_rate import count_work, fma_peak
from machine import asked_anew, once, peak_memory, timed
from room import Room
from stages import measure_stages
from workloads import RoomSize, make_room, split, true_labels, write_room

from gsseg_core import pipeline
from gsseg_core.data.dataset import Dataset
from gsseg_core.data.view import View, spread
from gsseg_core.freed_memory import keep_freed_memory
from gsseg_core.learn.em.em_learner import EMLearner, EMSettings
from gsseg_core.learn.learner import Learner
from gsseg_core.learn.vote_learner import VoteLearner
from gsseg_core.metrics import Evaluation
from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.constants import T_LIFTED, T_MIN
from gsseg_core.raster.cpu.lifting import Lifted
from gsseg_core.raster.cpu.projection import project
from gsseg_core.raster.cpu.tiling import assign
from gsseg_core.raster.vote_total import VoteTotal
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import Segmentation
from gsseg_core.warm_up import warm_up

DENSER, FAINTER = 2.2, 0.6
"""Factors of scales and opacities that bring the room to about 106 pairs per pixel, as one view of that size had."""


def room(folder: str, size: dict[str, int], wrong: bool = False) -> float:
    """Write a room; the seconds that it took."""
    return once(lambda: write_room(Path(folder), RoomSize(**size), wrong=wrong))


def stages(folder: str, runs: int, sampled: int) -> dict[str, list[float]]:
    """Time each stage on a dataset."""
    keep_freed_memory()  # as the command and the node do
    warm_up()
    return measure_stages(Path(folder), runs, sampled)


def command(folder: str, labels: str, out: str) -> dict[str, Any]:
    """Do what `gsseg segment` does; seconds per stage, steps of EM, and peak memory."""
    report = pipeline.segment(Path(folder) / "scene.ply", folder, out, labels=labels)
    return {"seconds": report["seconds"], "steps": len(report["objective"]), "peak": peak_memory()}


def grow(folder: str, views: int, steps: int) -> dict[str, float]:
    """Learn and segment at one point of a growth curve."""
    warm_up()
    before = peak_memory()
    start = time.perf_counter()
    scene, data = GaussianScene.load(Path(folder) / "scene.ply"), Dataset(folder)
    loaded = time.perf_counter()
    learner = EMLearner(scene, data.num_classes, EMSettings(max_steps=steps, tolerance=0.0))
    for view in spread(data.views("train"), views):
        learner.observe(view)
    observed = time.perf_counter()
    learner.fit()
    learnt = time.perf_counter()
    Segmentation.from_codes(scene, learner.codes_, data.class_names, evidence=learner.evidence())
    end = time.perf_counter()
    return {
        "load": loaded - start,
        "observe": observed - loaded,
        "EM steps": learnt - observed,
        "segment": end - learnt,
        "whole": end - start,
        "memory": peak_memory() - before,
    }


def lift(folder: str, views: int, runs: int) -> dict[str, Any]:
    """Rate of the lift on some views, and of the first rasteriser on the same, beside the peak."""
    warm_up()
    scene, data = GaussianScene.load(Path(folder) / "scene.ply"), Dataset(folder)
    rows = [_lift_view(scene, view, runs) for view in spread(data.views("train"), views)]
    return {"views": rows, "fma_peak": fma_peak(), "threads": nb.get_num_threads()}


def dense_lift(size: dict[str, int], runs: int) -> dict[str, Any]:
    """Rate of the lift where Gaussians overlap as much as in the view on which the bar was set."""
    warm_up()
    dense = RoomSize(**size)
    built = make_room(dense)
    thin = built.scene
    scene = GaussianScene.from_arrays(
        thin.means, thin.quats, DENSER * thin.scales, np.clip(FAINTER * thin.opacities, 0.006, 0.995), thin.sh
    )
    fuller = Room(scene, built.truth, built.cameras)
    masks = [View.from_arrays(camera, true_labels(fuller, camera, dense.classes)) for camera in fuller.cameras]
    return {"views": [_lift_view(scene, view, runs) for view in masks], "pixels": dense.width * dense.height}


def _lift_view(scene: GaussianScene, view: View, runs: int) -> dict[str, Any]:
    camera, mask = view.camera, view.read_labels()
    projected, operator = project(scene, camera), make_operator(scene, camera)
    tiles, splats = assign(projected, camera.width, camera.height), to_splats(projected)
    observation = operator.observe(mask)
    work, whole = (
        count_work(projected, tiles, camera.width, camera.height, mask, least) for least in (T_LIFTED, T_MIN)
    )
    pairs = len(operator.weights().pixels)
    if abs(whole.pairs - pairs) > 1e-4 * pairs:
        raise RuntimeError(f"view '{view.name}': counted {whole.pairs} pairs; the operator has {pairs}")
    many = len(observation.classes)
    local = np.where(mask >= 0, np.searchsorted(observation.classes, mask), -1).astype(np.int32)

    def first() -> np.ndarray:
        return first_lift(splats, tiles, local, many)

    total = VoteTotal(len(scene), int(mask.max()) + 1)
    votes = np.zeros((len(scene), many), np.float32)
    votes[observation.ids] = observation.dense(observation.votes())
    difference = float(np.abs(first() - votes[operator.ids]).sum() / votes.sum())
    if difference > 1e-4:
        raise RuntimeError(f"view '{view.name}': sums of the first rasteriser differ by {difference:.2g} of all")
    return {
        "pairs": pairs,
        "evaluations": work.evaluations,
        "flops": work.flops,
        "instructions": work.instructions,
        "difference": difference,
        "sums": timed(lambda: Lifted.of(tiles, mask), runs),
        "lift": timed(lambda: operator.vote(mask, None, total), runs),
        "observe": timed(lambda: operator.observe(mask), runs),
        "all": timed(lambda: make_operator(scene, camera).vote(mask, None, total), runs),
        "first": timed(first, runs),
    }


def torch_loop(size: dict[str, int], epochs: int) -> dict[str, Any]:
    """Time the loop in PyTorch, and our learners, on the same small room and views."""
    import torch
    from plain_torch import PlainTorch

    from gsseg_core.learn.gradient_learner import GradientLearner, GradientSettings

    warm_up()
    torch.set_num_threads(os.cpu_count() or 1)
    small = RoomSize(**size)
    scene, views, tests = small_room(small)
    settings = GradientSettings(epochs=epochs)
    plain = PlainTorch(scene, small.classes, settings)
    seconds = {"PyTorch": once(lambda: plain.learn([v.camera for v in views], [v.read_labels() for v in views]))}
    codes = {"PyTorch": torch.softmax(plain.logits, dim=1).detach().numpy()}
    learners: dict[str, Learner] = {
        "gradient": GradientLearner(scene, small.classes, settings),
        "em": EMLearner(scene, small.classes),
        "votes": VoteLearner(scene, small.classes),
    }
    learners["gradient"].observe(views[0])
    learners["gradient"].retract(views[0].name)
    for name, learner in learners.items():
        seconds[name] = once(lambda: (list(map(learner.observe, views)), learner.fit()))  # noqa: B023 - at once
        codes[name] = learner.codes_
    scores = {name: score(scene, tests, code) for name, code in codes.items()}
    return {"seconds": seconds, "mIoU": scores, "steps": epochs * len(views)}


def torch_step(folder: str) -> dict[str, float]:
    """One step of the loop in PyTorch at full size, and one of EM over the same view."""
    from plain_torch import PlainTorch

    warm_up()
    scene, data = GaussianScene.load(Path(folder) / "scene.ply"), Dataset(folder)
    view = data.views("train")[0]
    plain, mask = PlainTorch(scene, data.num_classes), view.read_labels()
    ours = make_operator(scene, view.camera).observe(mask)
    said = np.full(len(ours.labels), 1 / data.num_classes, np.float32)
    rest = np.ones(len(ours.classes), np.float32)
    return {
        "PyTorch": once(lambda: plain.step(view.camera, mask)),
        "ours": min(timed(asked_anew(ours, said, rest), 3)),
    }


def small_room(size: RoomSize) -> tuple[GaussianScene, list[View], list[View]]:
    """Build a room in memory: scene, views to learn from, test views."""
    built = make_room(size)
    views = [
        [View.from_arrays(camera, true_labels(built, camera, size.classes)) for camera in cameras]
        for cameras in split(built.cameras, size.tests)
    ]
    return built.scene, views[0], views[1]


def flashsplat(folder: str, labels: str, biases: list[float]) -> dict[str, Any]:
    """FlashSplat's rule on our operator, beside our learners: seconds of learning, and scores of the test views."""
    warm_up()
    scene, data = GaussianScene.load(Path(folder) / "scene.ply"), Dataset(folder, labels)
    views, tests = data.views("train"), Dataset(folder).views("test")
    seconds, scores = {}, {}
    for name, learner in {
        "votes": VoteLearner(scene, data.num_classes),
        "em": EMLearner(scene, data.num_classes),
    }.items():
        seconds[name] = once(lambda: (list(map(learner.observe, views)), learner.fit()))  # noqa: B023 - at once
        scores[name] = score(scene, tests, learner.codes_)
        if name == "votes":
            for bias in biases:
                rule = f"FlashSplat, bias {bias:g}"
                seconds[rule] = seconds["votes"] + once(lambda: hard_votes(learner.codes_, bias))  # noqa: B023
                scores[rule] = score(scene, tests, hard_votes(learner.codes_, bias))
    return {"seconds": seconds, "mIoU": scores}


def hard_votes(
    codes: np.ndarray,  # (N, K) votes, each row divided by its sum
    bias: float,
) -> np.ndarray:
    """FlashSplat's rule (Shen et al. 2024): the largest of the normalised sums, a bias being added to the background's.

    Gaussians that no view saw have no sums; they stay rows of zeros.
    """
    biased = codes.copy()
    biased[:, 0] += bias
    hard = np.zeros_like(codes)
    hard[np.arange(len(codes)), biased.argmax(axis=1)] = 1.0
    return hard * (codes.max(axis=1, keepdims=True) > 0)


def score(scene: GaussianScene, tests: list[View], codes: np.ndarray) -> float:
    """Mean IoU of label maps rendered from codes (N, K), without refinement, against the masks of test views."""
    evaluation = Evaluation()
    for view in tests:
        image, left_over = make_operator(scene, view.camera).blend(codes)
        image[..., 0] += left_over
        evaluation.add(view.read_labels(), image.argmax(axis=2), view.name)
    return float(evaluation.mean_iou)
