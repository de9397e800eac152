"""The view operator on a GPU: gsplat's CUDA kernels render, and their backward pass is the adjoint.

gsplat blends by the formulas of docs/conventions.md, but for two rules of its own; docs/gpu.md says what they change.
Projection and tiles are found once per view; a product then is one call of `rasterize_to_pixels` for each 32 channels,
an adjoint that and its backward pass with respect to the colours.
"""

from __future__ import annotations

import copy
import functools
import importlib
import math
import warnings
from collections import defaultdict
from collections.abc import Iterator
from types import ModuleType
from typing import NamedTuple

import numpy as np
import torch

from gsseg_core.csr_rows import starts
from gsseg_core.errors import SettingsError
from gsseg_core.raster.constants import ALPHA_MAX, ALPHA_MIN, BLOCK, CHANNELS, DILATION, NEAR, T_MIN, TINY
from gsseg_core.raster.observation import Observation, VoteShares
from gsseg_core.raster.view_operator import ViewOperator
from gsseg_core.raster.view_renderer import Blended
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.scene_cache import PerScene

TILE = 16  # side of the tiles that gsplat is asked for, in px


@functools.cache
def load_gsplat(device: str) -> ModuleType:
    """Import gsplat for a GPU; the first time on a machine, it compiles its kernels, which takes minutes.

    Raises
    ------
    SettingsError
        There is no such GPU, or gsplat is not installed or cannot be compiled.
    """
    with warnings.catch_warnings():  # A CUDA build of PyTorch warns where there is no driver; the error below says it.
        warnings.simplefilter("ignore")
        count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    found = f"device is {device!r}"
    if count == 0:
        raise SettingsError(
            f"{found}, but PyTorch {torch.__version__} sees no GPU; expected an NVIDIA GPU, its driver and a CUDA "
            "build of PyTorch, or the device 'cpu'"
        )
    if int(device.partition(":")[2] or 0) >= count:
        raise SettingsError(f"{found}, but PyTorch sees {count} GPUs; expected 'cuda:0' to 'cuda:{count - 1}'")
    try:
        gsplat = importlib.import_module("gsplat")
        # Its functions look for the compiled kernels at their first call; here it can be said what is missing.
        kernels = importlib.import_module("gsplat.cuda._backend")._C
    except ModuleNotFoundError as missing:
        raise SettingsError(
            f"{found}, and the package {missing.name!r} is missing; expected gsplat: pip install 'gsseg[gsplat]'"
        ) from missing
    except (ImportError, OSError, RuntimeError) as error:
        first = (str(error).splitlines() or ["no reason given"])[0]
        raise SettingsError(f"{found}, but gsplat's CUDA kernels do not compile or load: {first}") from error
    if kernels is None:
        raise SettingsError(
            f"{found}, but gsplat is not compiled and finds no CUDA toolkit; expected nvcc on the PATH, of the CUDA "
            "version that PyTorch was built for"
        )
    return gsplat


class _SceneTensors(NamedTuple):
    """A scene on a device.

    Opacities are cut off at 0.99 here, because gsplat lets alpha rise to 0.999: see docs/gpu.md.
    """

    means: torch.Tensor  # (N, 3)
    quats: torch.Tensor  # (N, 4)
    scales: torch.Tensor  # (N, 3)
    opacities: torch.Tensor  # (N,)


_KNOWN: defaultdict[str, PerScene[_SceneTensors]] = defaultdict(PerScene)


def _tensors_of(scene: GaussianScene, device: str) -> _SceneTensors:
    """Copy a scene to a device, once: its tensors are kept with it."""

    def copied() -> _SceneTensors:
        arrays = (scene.means, scene.quats, scene.scales, np.minimum(scene.opacities, ALPHA_MAX))
        return _SceneTensors(*(_tensor(array, device) for array in arrays))

    return _KNOWN[device].of(scene, copied)


def _tensor(array: np.ndarray, device: str) -> torch.Tensor:
    return torch.tensor(np.ascontiguousarray(array, np.float32), device=device)


class GsplatOperator(ViewOperator):
    """W of one view on a GPU, remade by gsplat at every product and never stored.

    Arrays go in and come out as on the CPU; what is kept of the view, about 28 bytes per visible Gaussian and 4 per
    tile that it touches, lies on the GPU. Renders are the same from run to run and in any order of the Gaussians.
    Adjoints are not quite: gsplat adds up gradients in whatever order its threads arrive, so their last bits differ.

    The scene is copied to the device, by the name that PyTorch has for it, once for all its views.
    """

    def __init__(self, scene: GaussianScene, camera: Camera, device: str, gsplat: ModuleType) -> None:
        self.camera = camera
        self.num_gaussians = len(scene)
        self.device = device
        self._gsplat = gsplat
        with torch.no_grad():
            self._project(_tensors_of(scene, device))

    def _project(self, scene: _SceneTensors) -> None:
        camera = self.camera
        # World coordinates may be large, and gsplat transforms them in float32: seen from the camera they are small.
        centre = torch.tensor(camera.center, dtype=torch.float64, device=self.device)
        rotation = np.eye(4)
        rotation[:3, :3] = camera.world_to_camera[:3, :3]
        radii, means2d, depths, conics, _ = self._gsplat.fully_fused_projection(
            (scene.means.double() - centre).float(), None, scene.quats, scene.scales,
            _tensor(rotation, self.device)[None], _tensor(camera.K, self.device)[None], camera.width, camera.height,
            eps2d=DILATION, near_plane=NEAR, radius_clip=0.0, opacities=scene.opacities,
        )  # fmt: skip
        # Where the radii are zero, gsplat leaves all else unwritten. A conic overflows only for a Gaussian so large and
        # so far askew that float32 has no number for its extent.
        visible = (radii[0] > 0).all(dim=1) & conics[0].isfinite().all(dim=1)
        rows = visible.nonzero()[:, 0]
        keys = torch.cat([scene.opacities[rows, None], conics[0, rows], means2d[0, rows], depths[0, rows, None]], dim=1)
        # By depth, and where that is the same by shape and place, so that the order in the scene matters only to twins.
        order = torch.arange(len(rows), device=self.device)
        for key in keys.unbind(dim=1):
            order = order[torch.argsort(key[order], stable=True)]
        rows = rows[order]

        self.ids = rows.cpu().numpy().astype(np.int32)
        self._means2d, self._conics = means2d[:, rows].contiguous(), conics[:, rows].contiguous()
        self._opacities = scene.opacities[None, rows].contiguous()
        columns, lines = -(-camera.width // TILE), -(-camera.height // TILE)
        if len(rows) == 0:  # gsplat's kernels are not started for nothing.
            self._offsets = torch.zeros((1, lines, columns), dtype=torch.int32, device=self.device)
            self._entries = torch.zeros(0, dtype=torch.int32, device=self.device)
            return
        # Its sort by tile and depth keeps the order of equal depths.
        _, tile_and_depth, self._entries = self._gsplat.isect_tiles(
            self._means2d, radii[:, rows].contiguous(), depths[:, rows].contiguous(), TILE, columns, lines
        )
        self._offsets = self._gsplat.isect_offset_encode(tile_and_depth, 1, columns, lines)

    @property
    def nbytes(self) -> int:
        """Memory that it holds, in bytes, most of it on the GPU."""
        held = (self._means2d, self._conics, self._opacities, self._offsets, self._entries)
        return self.ids.nbytes + sum(tensor.nbytes for tensor in held)

    def footprints(self) -> np.ndarray:
        """Sum of the alphas of each of `ids` over an endless image, (M,) float32."""
        xx, xy, yy = self._conics[0].unbind(dim=1)
        areas: np.ndarray = (self._opacities[0] * (2 * math.pi) / torch.sqrt(xx * yy - xy * xy)).cpu().numpy()
        return areas

    def rasterise(self, codes: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Blend codes (M, C) of what is visible, C from 1 to CHANNELS: image (H, W, C), and transmittance (H, W).

        The image is differentiable with respect to the codes.
        """
        height, width = self.camera.height, self.camera.width
        if len(codes) == 0:
            return codes.new_zeros((height, width, codes.shape[1])), codes.new_ones((height, width))
        image, opacity = self._gsplat.rasterize_to_pixels(
            self._means2d, self._conics, codes[None], self._opacities, width, height, TILE, self._offsets, self._entries
        )
        return image[0], 1 - opacity.detach()[0, :, :, 0]

    def _without(self, hidden: np.ndarray) -> GsplatOperator:
        other = copy.copy(self)
        other._opacities = self._opacities.masked_fill(torch.tensor(hidden, device=self.device), 0)
        return other

    def blend_seen(self, codes: np.ndarray, wanted: np.ndarray | None = None) -> Blended:
        """Blend codes (M, K) of what is visible; all pixels, whatever is wanted."""
        del wanted
        image = np.empty((self.camera.height, self.camera.width, codes.shape[1]), np.float32)
        left_over = None
        with torch.no_grad():
            for k in chunks(codes.shape[1]):
                part, left_over = self.rasterise(_tensor(codes[:, k], self.device))
                image[..., k] = part.cpu().numpy()
            if left_over is None:  # No channel at all, which gsplat cannot do.
                _, left_over = self.rasterise(torch.zeros((len(self.ids), 1), device=self.device))
        return Blended(image, left_over.cpu().numpy())

    def _adjoint(self, residual: np.ndarray) -> np.ndarray:
        out = np.zeros((self.num_gaussians, residual.shape[2]), np.float32)
        for k in chunks(residual.shape[2]):
            out[self.ids, k] = self.carry_back(_tensor(residual[..., k], self.device)).cpu().numpy()
        return out

    def carry_back(self, residual: torch.Tensor) -> torch.Tensor:
        """Carry values of pixels (H, W, C), C from 1 to CHANNELS, back to the visible Gaussians, (M, C)."""
        codes = torch.zeros((len(self.ids), residual.shape[2]), device=self.device)
        with torch.enable_grad():  # Whoever calls may have turned gradients off.
            image, _ = self.rasterise(codes.requires_grad_())
        return gradient(image, codes, residual)

    def _weights(self, pixel: tuple[int, int] | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Written in PyTorch by gsplat's rules, since it lists none."""
        height, width, columns = self.camera.height, self.camera.width, self._offsets.shape[2]
        begins = [*self._offsets.flatten().tolist(), len(self._entries)]
        wanted = range(len(begins) - 1) if pixel is None else [pixel[0] // TILE * columns + pixel[1] // TILE]
        parts = [(np.empty(0, np.int32), np.empty(0, np.int32), np.empty(0, np.float32))]
        for tile in wanted:
            top, left = tile // columns * TILE, tile % columns * TILE
            r, c = (place.ravel() for place in np.mgrid[top : min(top + TILE, height), left : min(left + TILE, width)])
            if pixel is not None:
                r, c = np.array(pixel)[:, None]
            entries = self._entries[begins[tile] : begins[tile + 1]].long()
            here = self._weights_of(entries, _tensor(np.stack([c, r], axis=1) + 0.5, self.device))
            p, e = here.nonzero(as_tuple=True)
            listed = (r * width + c)[p.cpu().numpy()].astype(np.int32)
            parts.append((listed, entries[e].cpu().numpy().astype(np.int32), here[p, e].cpu().numpy()))
        pixels, rows, weights = (np.concatenate(part) for part in zip(*parts, strict=True))
        return pixels, rows, weights

    def _weights_of(self, entries: torch.Tensor, pixels: torch.Tensor) -> torch.Tensor:
        """Weights (P, E) of a tile's entries (E,), nearest first, in pixels with these centres, (P, 2) as x and y."""
        dx, dy = (self._means2d[0, entries] - pixels[:, None]).unbind(dim=2)
        xx, xy, yy = self._conics[0, entries].unbind(dim=1)
        half_squared = 0.5 * (xx * dx * dx + yy * dy * dy) + xy * dx * dy
        alpha = self._opacities[0, entries] * torch.exp(-half_squared)
        alpha[(half_squared < 0) | (alpha < ALPHA_MIN)] = 0
        behind = torch.cumprod(1 - alpha, dim=1)
        before = torch.cat([torch.ones_like(behind[:, :1]), behind], dim=1)[:, :-1]
        return alpha * before * (behind > T_MIN)

    def _observe(self, labels: np.ndarray, weights: np.ndarray | None) -> Observation:
        return GsplatObservation(self, labels, weights)


def view_operator(scene: GaussianScene, camera: Camera, device: str) -> GsplatOperator:
    """Make the operator of a view on a GPU."""
    return GsplatOperator(scene, camera, device, load_gsplat(device))


class GsplatObservation(Observation):
    """A view and its mask on a GPU."""

    def __init__(self, operator: GsplatOperator, labels: np.ndarray, weights: np.ndarray | None) -> None:  # (H, W)
        self.name, self._operator = operator.camera.name, operator
        known = labels >= 0
        classes, self.areas = np.unique(labels[known], return_counts=True)
        self.classes = classes.astype(np.int32)
        local = np.where(known, np.searchsorted(self.classes, labels), -1)
        self._labels = torch.tensor(local, dtype=torch.int32, device=operator.device)
        votes = np.empty((len(operator.ids), len(classes)), np.float32)  # of all that is visible: W^T onehot(y)
        for k in chunks(len(classes)):
            votes[:, k] = operator.carry_back(self._one_hot(k)).cpu().numpy()
        seen = votes > 0
        visible = np.flatnonzero(seen.any(axis=1))
        self._visible = visible[np.argsort(operator.ids[visible])]
        self.ids, seen = operator.ids[self._visible], seen[self._visible]
        self.start = starts(seen.sum(axis=1))
        self.labels = seen.nonzero()[1].astype(np.int32)
        self._votes = votes[self._visible][seen]
        of_pixels = np.ones(labels.shape, np.float32)
        if weights is not None:
            of_pixels[:] = weights.repeat(BLOCK, axis=0).repeat(BLOCK, axis=1)[: labels.shape[0], : labels.shape[1]]
        self._weights = _tensor(of_pixels, operator.device)
        self.weighted_areas = np.bincount(local[known], of_pixels[known], len(classes))

    @property
    def nbytes(self) -> int:
        """Memory that it holds, in bytes, the operator's included; most of it on the GPU."""
        held = (self._visible, self.ids, self.start, self.labels, self._votes)
        on_gpu = self._labels.nbytes + self._weights.nbytes
        return self._operator.nbytes + on_gpu + sum(array.nbytes for array in held)

    def operator(self, camera: Camera, num_gaussians: int) -> GsplatOperator:
        """Give the operator that it was observed with."""
        return self._operator

    def votes(self) -> np.ndarray:
        """Weights summed by pair, (P,) float32."""
        return self._votes

    def _shares(self, likelihood: np.ndarray, rest: np.ndarray) -> VoteShares:
        rows = self._visible[self.rows]
        codes = np.zeros((len(self._operator.ids), len(rest)), np.float32)
        codes[rows, self.labels] = likelihood
        out, total, log_likelihood = np.empty_like(codes), np.zeros(len(rest)), 0.0
        for k in chunks(len(rest)):
            # A pixel's label lies in one chunk, so each chunk has all that its pixels need.
            gaussians, spare, logs = self._share(codes[:, k], rest[k], self._one_hot(k))
            out[:, k] = gaussians.cpu().numpy()
            total[k] = spare.cpu().numpy()
            log_likelihood += float(logs)
        return VoteShares(out[rows, self.labels], total, log_likelihood)

    def _share(
        self, codes: np.ndarray, rest: np.ndarray, one_hot: torch.Tensor  # (M, C), (C,), (H, W, C)
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:  # fmt: skip
        """Sum shares by Gaussian, (M, C), by what the rays had left over, (C,), and log likelihoods, of C labels."""
        device = self._operator.device
        carried = _tensor(codes, device)
        with torch.enable_grad():
            image, left_over = self._operator.rasterise(carried.requires_grad_())
        with torch.no_grad():
            labelled = one_hot.any(dim=2)
            likelihood = ((image + left_over[..., None] * _tensor(rest, device)) * one_hot).sum(dim=2)
            # A pixel that nothing explains has no share to give, at any codes; its term is held at a floor.
            inverse = torch.where(labelled & (likelihood > TINY), self._weights / likelihood, 0)
            logs = (self._weights * likelihood.clamp_min(TINY).double().log())[labelled].sum()
            residual = one_hot * inverse[..., None]
            spare = (residual * left_over[..., None]).double().sum(dim=(0, 1))
        return gradient(image, carried, residual), spare, logs

    def _one_hot(self, labels: slice) -> torch.Tensor:
        """Mark the pixels of some labels, one channel each: (H, W, C)."""
        chosen = torch.arange(labels.start, labels.stop, device=self._labels.device)
        return (self._labels[..., None] == chosen).float()


def gradient(image: torch.Tensor, codes: torch.Tensor, residual: torch.Tensor) -> torch.Tensor:
    """Carry a residual (H, W, C) back through a render of codes (M, C): the gradient of <image, residual>, (M, C)."""
    if len(codes) == 0:
        return torch.zeros_like(codes)
    (carried,) = torch.autograd.grad(image, codes, residual)
    return carried


def chunks(channels: int) -> Iterator[slice]:
    """Cut channels into slices of at most `CHANNELS`."""
    for k in range(0, channels, CHANNELS):
        yield slice(k, min(k + CHANNELS, channels))
