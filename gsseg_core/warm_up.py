"""Compiles the kernels, or loads them from the cache, before the first view needs them."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Any

import numpy as np
from numba.core import event

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.soft_masks import quantise
from gsseg_core.data.view import View
from gsseg_core.export.pictures import overlay, palette
from gsseg_core.kernels import kernel_cache
from gsseg_core.learn.em.boundary_alignment import align_boundaries
from gsseg_core.learn.em.em_learner import EMLearner, EMSettings
from gsseg_core.learn.mask_reliability import compare_mask
from gsseg_core.learn.vote_learner import VoteLearner
from gsseg_core.learn.vote_resolution import resolved_votes
from gsseg_core.objects import association_kernels, move_kernels, tree_kernels
from gsseg_core.objects.clicks import merge_tree
from gsseg_core.objects.heaviest import heaviest
from gsseg_core.objects.hulls import hull_faces, rectangles_around
from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.cpu.occlusion import ray_ends
from gsseg_core.raster.depth import surface
from gsseg_core.raster.view_renderer import PixelGrid
from gsseg_core.raster.vote_total import VoteTotal
from gsseg_core.refine.label_propagation import propagate
from gsseg_core.refine.settings import PAPER
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.harmonics_kernel import seen_colors
from gsseg_core.scene.spherical_harmonics import basis
from gsseg_core.segmentation import Segmentation
from gsseg_core.spatial.kd_tree import Tree
from gsseg_core.spatial.neighbour_graph import graph_of
from gsseg_core.spatial.row_order import in_curve_order

FIRST_RUN = "compiling kernels, about a minute on two cores; only the first run after installing does this"
EVERY_RUN = (
    "compiling kernels, about a minute on two cores, as in every run: they cannot be kept; " + kernel_cache.REMEDY
)
NOT_KEPT = f"some kernels could not be kept, is the disk full? Every run compiles them; {kernel_cache.REMEDY}"

SIDE = 72  # Gaussians on a side of the square; trees of fewer than 4,096 are built by one thread

_warm: set[str] = set()  # the devices for which all kernels are there


class _FirstCompilation(event.Listener):
    def __init__(self, say: Callable[[str], object]) -> None:
        self._say, self._said = say, False

    def on_start(self, begun: event.Event) -> None:
        if not self._said:
            self._said = True
            self._say(FIRST_RUN if kernel_cache.FOLDER else EVERY_RUN)

    def on_end(self, ended: event.Event) -> None:
        pass


def warm_up(device: str = "cpu", say: Callable[[str], object] = lambda text: None) -> None:
    """Take some thousand Gaussians through everything that segmenting does, so that all its kernels are there.

    That takes a third of a second when they are in the cache, and about a minute on two cores at the first time after
    an installation; then `say` is told, and a second process compiles beside this one. It is told, too, if some could
    not be kept. In a process that is warm, nothing is done.
    """
    if device in _warm:
        return
    beside: list[subprocess.Popen[bytes]] = []

    def begin(text: str) -> None:
        say(text)
        beside.extend(_start_beside())

    try:
        with telling(begin):
            _learn_something(device)
            for process in beside:
                process.wait()
            refine_something(device)
    finally:
        for process in beside:
            with process:
                process.kill()
    if kernel_cache.INCOMPLETE:
        say(NOT_KEPT)
    _warm.add(device)


def telling(say: Callable[[str], object]) -> AbstractContextManager[object]:
    """Within the context, `say` once that kernels are being compiled: at the first that is not in the cache."""
    return event.install_listener("numba:compile", _FirstCompilation(say))


def _start_beside() -> Iterator[subprocess.Popen[bytes]]:
    """Start the process that compiles what needs nothing learnt, for this one to find in the cache."""
    is_python = os.path.basename(sys.executable or "").startswith("python")  # And no program that has it built in.
    if kernel_cache.FOLDER and is_python:
        # Where this process finds its modules, and nowhere else: not in the folder in which the user happens to be.
        work = f"import sys; sys.path[:] = {sys.path}; from gsseg_core.warm_up import refine_beside as f; f()"
        with contextlib.suppress(OSError):
            quiet: Any = dict.fromkeys(("stdout", "stderr"), subprocess.DEVNULL)
            yield subprocess.Popen([sys.executable, "-I", "-c", work], stdin=subprocess.PIPE, **quiet)


def refine_beside() -> None:
    """Do `refine_something` in a process of its own, which ends when whoever holds its standard input does."""

    def end_with_parent() -> None:
        os.read(0, 1)
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
    refine_something()


def _square() -> tuple[GaussianScene, Camera, np.ndarray]:
    """Scene, camera and labels (32, 32) of a square whose left and right half are of two classes."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(-1.5, 1.5, SIDE), np.linspace(-1.5, 1.5, SIDE)))
    means, ones, light = np.stack([x, y, 4 + 0.1 * x], axis=1), np.ones(len(x)), np.where(x < 0, -1.0, 1.0)
    quats, sh = np.tile([1.0, 0, 0, 0], (len(x), 1)), np.tile(light[:, None, None], (1, 1, 3))
    scene = GaussianScene.from_arrays(means, quats, np.full((len(x), 3), 0.05), 0.9 * ones, sh)
    # The square is larger than the image: edges are only where the classes meet, and so the outline is moved there.
    K = np.array([[48.0, 0, 16], [0, 48, 16], [0, 0, 1]])
    labels = np.repeat(np.arange(2, dtype=np.int32), 16)[None].repeat(32, 0)
    return scene, Camera("warm_up", 32, 32, K, np.eye(4)), labels


def _learn_something(device: str) -> None:
    scene, camera, labels = _square()
    view = View.from_arrays(camera, labels)
    passing = VoteLearner(scene, 2, device=device, memory_budget=0)
    passing.observe(view)
    passing.fit()
    learner = EMLearner(scene, 2, EMSettings(max_steps=2), device=device)
    learner.observe(view)
    # Another view like it, and one whose regions these contradict.
    learner.observe(View.from_arrays(replace(camera, name="again"), labels))
    learner.observe(View.from_arrays(replace(camera, name="wrong"), 1 - labels))
    learner.fit()
    learner.predict_without(view)
    compare_mask(view, labels, 2)
    learner.evidence()
    # What only some learners, live maps and programs ask of a view; here, as the process beside has more to compile.
    operator = make_operator(scene, camera)
    operator.adjoint(np.ones((*labels.shape, 1), np.float32))
    operator.weights()
    ray_ends(scene, camera, labels)
    seen = operator.lift(labels)
    heaviest(seen.start, seen.weights, 0.8)
    surface(scene, operator, PixelGrid(0, 2))  # as for larger views


def refine_something(device: str = "cpu") -> None:
    """Do all with a small scene that needs nothing learnt: align boundaries, spread labels, refine, carve, render."""
    scene, camera, labels = _square()
    # Long enough an outline, as few pixels of it tell too little for it to be moved.
    wide, true = (np.pad(np.ones((48 - 2 * margin, 48 - 2 * margin), np.int32), margin) for margin in (8, 10))
    edges = sum(np.abs(np.diff(true, axis=axis, prepend=0)) for axis in (0, 1))
    align_boundaries(wide, 3 * np.asarray(edges, np.float32), EMSettings.edge_px)  # The region's outline moves.
    merge_tree(labels[..., None])  # as for points in a view
    association_kernels.call_all()  # as for ids of each view's own
    move_kernels.call_all()
    tree_kernels.call_all()  # as for parts of objects
    share = np.clip(0.5 + scene.means[:, 0], 0.05, 0.95)  # Unsure in the middle, where neighbours decide.
    codes = np.stack([1 - share, share], axis=1).astype(np.float32)
    propagate(graph_of(scene), codes, np.zeros(len(codes)))
    Tree.build(scene.means[:1])  # of few Gaussians, by one thread
    result = Segmentation.from_codes(scene, codes, {0: "left", 1: "right"}, PAPER).carved(scene, [camera])
    operator = make_operator(scene, camera, device)
    result.calibrated(2.0).render(operator)
    hull_faces(np.eye(4, 3))  # as for boxes
    rectangles_around(np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0]]))
    operator.render(scene.colors(camera.center))
    overlay(np.zeros((*labels.shape, 3), np.uint8), labels, palette(2))
    in_curve_order(scene)
    # What only some inputs need: soft masks, partial ones, and colours that are not of a PLY.
    quantise(np.stack([labels == 0, labels == 1]).astype(np.float32))
    CSRRows.from_dense(np.eye(2))  # as for their votes
    rows = CSRRows.from_dense(codes)
    rows.united(rows.in_columns(rows.indices))  # as for parts of objects
    votes, own = CSRRows.from_dense(np.array([[-1, 1]])), np.zeros(1, np.int64)
    resolved_votes(votes, np.ones(2, bool))
    # Votes that are saved, loaded, merged, carried over to another scene, and given to other objects.
    moved = votes.plus(votes).replaced(own, votes).take(own).in_columns(votes.indices)
    VoteTotal.from_rows(moved, 2).dense()
    seen_colors(basis(np.eye(3), 3), scene.means, np.arange(3, dtype=np.int32), np.zeros(3, np.float32), 0)
