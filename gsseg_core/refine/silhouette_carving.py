"""Cut each object to its silhouettes: drop the Gaussians that stick out of it when it stands alone.

In the scene, what is in front and beside hides a good part of a Gaussian across an edge. Cut out with its object, it
shows as a fringe, and so does what lay just under another surface. Which those are follows from the views alone. With
x the share of each Gaussian that its object keeps, object k standing alone covers pixel p by

    A_k(p) = 1 - T_k(p),    T_k(p) = prod over i in k of (1 - x_i alpha_i(p)),

which does not depend on who is in front, so all objects are made in one pass over a view. A_k should be 1 where the
view shows k, and 0 where it shows something else that does not hide it. Each Gaussian has reasons to stay, and to go,

    stay_i = sum over p that shows k of      alpha_i(p) T_k(p) / (1 - T_k(p))
    go_i   = sum over p that shows another of alpha_i(p),   unless i lies behind the surface of the scene there,

the two parts of the gradient of log A_k on its own pixels and log T_k on the others, with -log(1 - alpha) taken as
alpha. x_i <- min(1, x_i stay_i / go_i) is the multiplicative step of expectation maximisation for such sums (Shepp and
Vardi 1982). Where the object is covered by others anyway, T_k is small and there is little reason to stay; where a
Gaussian is all there is, it stays although it sticks out. One that never sticks out, or that no view reaches, stays.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from functools import partial
from typing import NamedTuple, TypeVar

import numpy as np

from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.depth import BEHIND, depths, surface
from gsseg_core.raster.objects_alone import ObjectsAlone
from gsseg_core.raster.view_operator import ViewOperator
from gsseg_core.scene.camera import Camera, resized_camera
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.several_at_once import several_at_once

STEPS = 2  # of the shares: all move at once and so overshoot; on held-out views five were no better
KEPT = 0.4  # least share with which a Gaussian stays with its object, of the largest share in that object
_LEAST = np.float32(0.01)  # of a share, so that a Gaussian may come back
_MEMORY = 2 << 30  # bytes of projected objects that are kept between the steps; others are projected anew

ENOUGH = 1 << 17  # px of a view with which it tells about as much as with more: see `looked_from`

T = TypeVar("T")


def looked_from(camera: Camera) -> Camera:
    """Make the camera that carving looks at a view from: the same, or one of about `ENOUGH` px if the view has more.

    docs/clean_objects.md has what more and fewer pixels are worth.
    """
    scale = math.sqrt(ENOUGH / (camera.width * camera.height))
    if scale >= 1:
        return camera
    return resized_camera(camera, math.ceil(scale * camera.width), math.ceil(scale * camera.height))


class Silhouette(NamedTuple):
    """What a view shows, to cut objects by."""

    operator: ViewOperator  # of the scene from there
    labels: np.ndarray  # (H, W) int32: class of each pixel, negative where unknown
    depth: np.ndarray  # (H, W) float32: of the scene's surface, scene units; infinite where there is none
    stands_for: float = 1.0  # px of the view that each of these pixels stands for

    @classmethod
    def of(
        cls, scene: GaussianScene, operator: ViewOperator, labels: np.ndarray, depth: np.ndarray | None = None,
        view: Camera | None = None,
    ) -> Silhouette:  # fmt: skip
        """Put a label map (H, W) int32 and the depth of the scene together, which is rendered unless it is at hand.

        If the operator is `looked_from` a view, its pixels count as much as those of the view. Labels that are not of
        the camera's size raise `MaskSizeError`.
        """
        operator.camera.check_image(labels, "labels have")
        depth = surface(scene, operator).depth if depth is None else depth
        stands_for = 1.0 if view is None else view.width * view.height / labels.size
        return cls(operator, labels.astype(np.int32), depth, stands_for)

    @classmethod
    def rendered(
        cls, scene: GaussianScene, label_map: Callable[[ViewOperator], np.ndarray], device: str, camera: Camera
    ) -> Silhouette:
        """Render what a view shows, from where it is `looked_from`: `label_map` gives classes (H, W) of an operator."""
        operator = make_operator(scene, looked_from(camera), device)
        return cls.of(scene, operator, label_map(operator), view=camera)


def kept_shares(
    scene: GaussianScene,  # of N Gaussians
    labels: np.ndarray,  # (N,) int32; those of class 0 and below belong to no object and are not looked at
    views: Iterable[T],  # of any kind that `look` takes
    look: Callable[[T], Silhouette],  # tells what a view shows; may be called in several threads at once
    *,
    device: str = "cpu",  # where `look` renders, and where what is beyond the memory for views is projected again
    steps: int = STEPS,  # at least 1
) -> np.ndarray:
    """Find how much of each Gaussian its object should keep: (N,) float64, 0.01 to 1.

    It is 1 where there is no object or no view says anything, and depends neither on the order of the Gaussians nor on
    the number of threads.
    """
    labels = np.ascontiguousarray(labels, np.int32)
    go, kept = np.zeros(len(scene)), np.ones(len(scene))
    known: list[tuple[_Shown, ObjectsAlone | None]] = []  # views, and the objects in them as far as memory allows
    taken = 0
    for shown, alone, (ids, reasons) in several_at_once(partial(_look, scene, labels, look), views, device):
        fits = taken + alone.nbytes <= _MEMORY
        known.append((shown, alone if fits else None))
        taken += alone.nbytes if fits else 0
        go[ids] += reasons
    asked = np.flatnonzero(go)  # a few in a hundred; all others keep all
    for step in range(steps):
        shares, stay = np.ones(len(scene), np.float32), np.zeros(len(scene))
        shares[asked], is_asked = kept[asked], np.zeros(len(scene), bool)
        is_asked[asked] = True
        speak = partial(_reasons_to_stay, scene, labels, device, shares, is_asked)
        for ids, reasons in several_at_once(speak, known if len(asked) else (), device):
            stay[ids] += reasons
        kept[asked] = np.clip(kept[asked] * stay[asked] / go[asked], _LEAST, 1.0)
        if step == 0:
            # The less is kept, the more reason there is to stay: who stays beside all others stays beside fewer.
            asked = asked[kept[asked] < 1]
    return kept


def _look(
    scene: GaussianScene, labels: np.ndarray, look: Callable[[T], Silhouette], view: T
) -> tuple[_Shown, ObjectsAlone, tuple[np.ndarray, np.ndarray]]:
    """Tell what a view shows, which objects are in it, and which Gaussians something speaks against there: how much."""
    operator, seen, depth, stands_for = look(view)
    alone = operator.objects_alone(labels)
    reasons = alone.reasons_to_go(depths(scene, operator.camera, alone.ids), seen, depth * np.float32(BEHIND))
    some = np.flatnonzero(reasons)
    return _Shown(operator.camera, seen, stands_for), alone, (alone.ids[some], stands_for * reasons[some])


def _reasons_to_stay(
    scene: GaussianScene, labels: np.ndarray, device: str, shares: np.ndarray, asked: np.ndarray,
    view: tuple[_Shown, ObjectsAlone | None],
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Weigh what speaks in one view for those that are asked for, (N,) bool: which they are, and how much.

    The others keep all: shares, (N,) float32, are 1.
    """
    shown, alone = view
    alone = alone or make_operator(scene, shown.camera, device).objects_alone(labels)
    wanted, kept = asked[alone.ids], np.ones(len(alone.ids), np.float32)
    some = np.flatnonzero(wanted)
    ids = alone.ids[some]
    if not len(ids):
        return ids, np.empty(0)
    kept[some] = shares[ids]
    return ids, shown.stands_for * alone.reasons_to_stay(kept, wanted, shown.labels)[some]


class _Shown(NamedTuple):
    """What is kept of a silhouette."""

    camera: Camera
    labels: np.ndarray  # (H, W) int32
    stands_for: float


def sticking_out(kept: np.ndarray, labels: np.ndarray) -> np.ndarray:  # (N,), (N,) int32
    """Tell by the shares that are kept which Gaussians leave their object, (N,) bool; never all of an object's."""
    most = np.zeros(int(labels.max(initial=0)) + 1)
    own = labels > 0
    np.maximum.at(most, labels[own], kept[own])
    return np.asarray(own & (kept < KEPT * most[np.maximum(labels, 0)]))
