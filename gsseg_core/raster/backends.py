"""The table of rasterisers by device; a new one needs its file and a line here."""

from __future__ import annotations

import importlib
import re
from contextlib import AbstractContextManager
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple

from gsseg_core.errors import SettingsError

if TYPE_CHECKING:
    from gsseg_core.raster.view_operator import ViewOperator
    from gsseg_core.raster.vote_total import VoteTotal
    from gsseg_core.scene.camera import Camera
    from gsseg_core.scene.gaussian_scene import GaussianScene


class Rasteriser(NamedTuple):
    """What renders the views on one kind of device."""

    devices: str  # regular expression of the devices' names
    described: str  # the same for readers, as in "device is 'x'; expected ..."
    module: str  # where its `view_operator(scene, camera, device)` is; loaded when first asked for
    needs: str  # what to install where the module does not find a package


RASTERISERS = [
    Rasteriser("cpu", "cpu", "gsseg_core.raster.cpu.tile_operator", "pip install gsseg"),
    Rasteriser(
        "cuda(:[0-9]+)?", "cuda (the first GPU) or cuda:1 and so on", "gsseg_core.raster.gpu.gpu_operator",
        "a CUDA build of PyTorch, and numba-cuda: pip install 'gsseg[cuda12]'",
    ),
]  # fmt: skip


def devices() -> str:
    """Describe what may be written as a device, for help texts and errors."""
    return ", ".join(rasteriser.described for rasteriser in RASTERISERS)


def rasteriser_of(device: str) -> Rasteriser:
    """Find the rasteriser of a device by its name, or raise `SettingsError`; whether the device exists shows in use."""
    for rasteriser in RASTERISERS:
        if re.fullmatch(rasteriser.devices, device):
            return rasteriser
    raise SettingsError(f"device is {device!r}; expected {devices()}")


def make_operator(scene: GaussianScene, camera: Camera, device: str = "cpu") -> ViewOperator:
    """Make the operator of a view on a device.

    Parameters
    ----------
    scene : GaussianScene
        What is seen.
    camera : Camera
        Where from.
    device : str
        'cpu'; 'cuda', the first GPU; or 'cuda:1' and so on, another one. See docs/gpu.md.

    Raises
    ------
    SettingsError
        There is no such device, or what it needs is not installed.
    SceneValueError
        The Gaussians touch more tiles of the view, of 16 x 16 px, than can be numbered: 2^31 - 1, each for each.
    """
    operator: ViewOperator = _module_of(device).view_operator(scene, camera, device)
    operator.scene = scene
    return operator


def free_memory_on(device: str) -> int:
    """Tell how many bytes are free on a GPU for views; raises as `make_operator` does."""
    return int(_module_of(device).free_memory_on(device))


def vote_total(votes: VoteTotal, device: str) -> AbstractContextManager[Any]:
    """Give a total on a device, to which `Observation.vote` adds views one after the other.

    When the context is left, it has been added to `votes`.
    """
    return _module_of(device).vote_total(votes, device)


def _module_of(device: str) -> ModuleType:
    rasteriser = rasteriser_of(device)
    try:
        return importlib.import_module(rasteriser.module)
    except ModuleNotFoundError as missing:
        if not missing.name or missing.name.startswith("gsseg_core"):
            raise
        raise SettingsError(
            f"device is {device!r}, and the package {missing.name!r} is missing; expected {rasteriser.needs}"
        ) from missing
