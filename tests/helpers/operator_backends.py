"""Every implementation of the view operator, and how exactly each keeps the laws; tests run over all that are there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import plain_gsplat
from naive_rasteriser import NaiveView, naive_gsplat_view, naive_view

from gsseg_core.errors import SettingsError
from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.gsplat_backend import GsplatOperator, load_gsplat
from gsseg_core.raster.view_operator import ViewOperator
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene


@dataclass(frozen=True)
class Backend:
    """An implementation and what float32 costs it, where no threshold is in doubt.

    Attributes
    ----------
    name : str
    make : callable
        The operator of a scene and a camera.
    naive : callable
        Its naive twin; takes `rounding` too.
    weight : float
        Error of a weight.
    sum : float
        Relative error of a sum of weights.
    exact : bool
        Whether adjoints are the same bit for bit, in any order of the Gaussians. Renders always are.
    last_one_counts : bool
        Whether the Gaussian that brings a ray below 1e-4 is counted.
    """

    name: str
    make: Callable[[GaussianScene, Camera], ViewOperator]
    naive: Callable[..., NaiveView]
    weight: float
    sum: float
    exact: bool
    last_one_counts: bool


def _plain(scene: GaussianScene, camera: Camera) -> ViewOperator:
    return GsplatOperator(scene, camera, "cpu", plain_gsplat)


def _cuda(scene: GaussianScene, camera: Camera) -> ViewOperator:
    return make_operator(scene, camera, "cuda")


CPU = Backend("cpu", make_operator, naive_view, 3e-6, 4e-6, True, True)
# The same wiring as on a GPU, around plain PyTorch.
PLAIN = Backend("plain", _plain, naive_gsplat_view, 3e-5, 4e-5, False, False)
# The backward pass of gsplat finds the transmittance along a ray from its end, 1 - (1 - T): for T near 1e-4, float32
# leaves three digits and a half.
CUDA = Backend("cuda", _cuda, naive_gsplat_view, 2e-4, 1e-3, False, False)

BACKENDS = {backend.name: backend for backend in (CPU, PLAIN, CUDA)}


def why_missing(name: str) -> str:
    """Say why a backend cannot run on this machine; empty if it can."""
    try:
        if name == "cuda":
            load_gsplat("cuda")
    except SettingsError as error:
        return str(error)
    return ""
