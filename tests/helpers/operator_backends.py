"""Every implementation of the view operator; tests run over all that are there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from gsseg_core.errors import SettingsError
from gsseg_core.raster.backends import make_operator
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
    weight : float
        Error of a weight.
    sum : float
        Relative error of a sum of weights.
    """

    name: str
    make: Callable[[GaussianScene, Camera], ViewOperator]
    weight: float
    sum: float


def _cuda(scene: GaussianScene, camera: Camera) -> ViewOperator:
    return make_operator(scene, camera, "cuda")


CPU = Backend("cpu", make_operator, 3e-6, 4e-6)
CUDA = Backend("cuda", _cuda, 3e-6, 4e-6)

BACKENDS = {backend.name: backend for backend in (CPU, CUDA)}


def why_missing(name: str) -> str:
    """Say why a backend cannot run on this machine; empty if it can."""
    if name == "cpu":
        return ""
    from gsseg_core.raster.gpu.device import find_gpu

    try:
        find_gpu(name)
    except SettingsError as error:
        return str(error)
    return ""
