"""Cut each object to its silhouettes: drop the Gaussians that stick out when the object is rendered alone.

In the scene, other Gaussians hide much of a Gaussian that lies across an edge. Once its object is cut out, it shows as
a fringe, and so do Gaussians that lay just under another surface. The views alone determine which these are. Let x_i be
the share of Gaussian i that its object keeps. Object k, rendered alone, covers pixel p by

    A_k(p) = 1 - T_k(p),    T_k(p) = prod over i in k of (1 - x_i alpha_i(p)).

This does not depend on the depth order, so one pass over a view computes all objects. A_k should be 1 where the view
shows k, and 0 where it shows another object that does not hide k. Each Gaussian has a reason to stay and one to go,

    stay_i = sum over p that shows k of      alpha_i(p) T_k(p) / (1 - T_k(p))
    go_i   = sum over p that shows another of alpha_i(p),   unless i lies behind the surface of the scene there.

These are the two parts of the gradient of log A_k on the object's own pixels and log T_k on the others, with alpha as
the approximation of -log(1 - alpha). x_i <- min(1, x_i stay_i / go_i) is the multiplicative step of expectation
maximisation for such sums (Shepp and Vardi 1982). Where other Gaussians of the object cover a pixel anyway, T_k is
small and there is little reason to stay. A Gaussian that alone covers some pixels of its object stays although it
sticks out. One that never sticks out, or that no view reaches, stays.
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

STEPS = 2  # updates of the shares; all move at once and so overshoot, and on held-out views five were no better
KEPT = 0.4  # a Gaussian stays with its object if its share is at least this fraction of the object's largest share
_LEAST = np.float32(0.01)  # lower limit of a share, so that it can grow again
_MEMORY = 2 << 30  # bytes of projected objects to keep between the steps; others are projected again

ENOUGH = 1 << 17  # px of a view beyond which more make little difference, see `looked_from`

T = TypeVar("T")


def looked_from(camera: Camera) -> Camera:
    """Return the camera with which carving renders a view: the same, or one of about `ENOUGH` px if the view has more.

    docs/clean_objects.md has the effect of more and fewer pixels.
    """
    scale = math.sqrt(ENOUGH / (camera.width * camera.height))
    if scale >= 1:
        return camera
    return resized_camera(camera, math.ceil(scale * camera.width), math.ceil(scale * camera.height))


class Silhouette(NamedTuple):
    """Labels and depth of a view, by which objects are cut."""

    operator: ViewOperator  # of the scene in this view
    labels: np.ndarray  # (H, W) int32: class of each pixel, negative where unknown
    depth: np.ndarray  # (H, W) float32: of the scene's surface, scene units; infinite where there is none
    stands_for: float = 1.0  # px of the original view per pixel

    @classmethod
    def of(
        cls, scene: GaussianScene, operator: ViewOperator, labels: np.ndarray, depth: np.ndarray | None = None,
        view: Camera | None = None,
    ) -> Silhouette:  # fmt: skip
        """Combine a label map (H, W) int32 with the depth of the scene, which is rendered if `depth` is None.

        Pass `view` if the operator's camera is the `looked_from` camera of that view: the pixels are then weighted to
        count as much as those of the view. Labels that do not have the camera's size raise `MaskSizeError`.
        """
        operator.camera.check_image(labels, "labels have")
        depth = surface(scene, operator).depth if depth is None else depth
        stands_for = 1.0 if view is None else view.width * view.height / labels.size
        return cls(operator, labels.astype(np.int32), depth, stands_for)

    @classmethod
    def rendered(
        cls, scene: GaussianScene, label_map: Callable[[ViewOperator], np.ndarray], device: str, camera: Camera
    ) -> Silhouette:
        """Render the silhouette of a view at its `looked_from` size; `label_map` returns the classes (H, W)."""
        operator = make_operator(scene, looked_from(camera), device)
        return cls.of(scene, operator, label_map(operator), view=camera)


def kept_shares(
    scene: GaussianScene,  # of N Gaussians
    labels: np.ndarray,  # (N,) int32; Gaussians of class 0 and below belong to no object and are ignored
    views: Iterable[T],  # of any type that `look` takes
    look: Callable[[T], Silhouette],  # returns the silhouette of a view; several threads may call it at once
    *,
    device: str = "cpu",  # on which `look` renders, and views that do not fit into memory are projected again
    steps: int = STEPS,  # at least 1
) -> np.ndarray:
    """Find the share of each Gaussian that its object should keep: (N,) float64, 0.01 to 1.

    The share is 1 if the Gaussian has no object or no view sees it stick out. The result depends neither on the order
    of the Gaussians nor on the number of threads.
    """
    labels = np.ascontiguousarray(labels, np.int32)
    go, kept = np.zeros(len(scene)), np.ones(len(scene))
    known: list[tuple[_Shown, ObjectsAlone | None]] = []  # views, with the projected objects if they fit into memory
    taken = 0
    for shown, alone, (ids, reasons) in several_at_once(partial(_look, scene, labels, look), views, device):
        fits = taken + alone.nbytes <= _MEMORY
        known.append((shown, alone if fits else None))
        taken += alone.nbytes if fits else 0
        go[ids] += reasons
    asked = np.flatnonzero(go)  # Gaussians that may go, a few per cent; all others keep the share 1
    for step in range(steps):
        shares, stay = np.ones(len(scene), np.float32), np.zeros(len(scene))
        shares[asked], is_asked = kept[asked], np.zeros(len(scene), bool)
        is_asked[asked] = True
        weigh = partial(_reasons_to_stay, scene, labels, device, shares, is_asked)
        for ids, reasons in several_at_once(weigh, known if len(asked) else (), device):
            stay[ids] += reasons
        kept[asked] = np.clip(kept[asked] * stay[asked] / go[asked], _LEAST, 1.0)
        if step == 0:
            # Smaller shares give the other Gaussians more reason to stay, so those at 1 stay at 1.
            asked = asked[kept[asked] < 1]
    return kept


def _look(
    scene: GaussianScene, labels: np.ndarray, look: Callable[[T], Silhouette], view: T
) -> tuple[_Shown, ObjectsAlone, tuple[np.ndarray, np.ndarray]]:
    """Return the labels of a view, its projected objects, and ids and weights of Gaussians with a reason to go."""
    operator, seen, depth, stands_for = look(view)
    alone = operator.objects_alone(labels)
    reasons = alone.reasons_to_go(depths(scene, operator.camera, alone.ids), seen, depth * np.float32(BEHIND))
    some = np.flatnonzero(reasons)
    return _Shown(operator.camera, seen, stands_for), alone, (alone.ids[some], stands_for * reasons[some])


def _reasons_to_stay(
    scene: GaussianScene, labels: np.ndarray, device: str, shares: np.ndarray, asked: np.ndarray,
    view: tuple[_Shown, ObjectsAlone | None],
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return the ids of the `asked` Gaussians, (N,) bool, in one view, and their reasons to stay.

    `shares` are (N,) float32; those of all other Gaussians are 1.
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
    """The part of a silhouette that is kept between the steps."""

    camera: Camera
    labels: np.ndarray  # (H, W) int32
    stands_for: float


def sticking_out(kept: np.ndarray, labels: np.ndarray) -> np.ndarray:  # (N,), (N,) int32
    """Mark the Gaussians that leave their object because of their kept shares, (N,) bool; never all of an object."""
    most = np.zeros(int(labels.max(initial=0)) + 1)
    own = labels > 0
    np.maximum.at(most, labels[own], kept[own])
    return np.asarray(own & (kept < KEPT * most[np.maximum(labels, 0)]))
