"""Edges of the scene in a view on a GPU: the same edges as those of `gsseg_core.learn.em.scene_edges`."""

from __future__ import annotations

import numpy as np
import torch

from gsseg_core.learn.em.scene_edges import STRONGEST, luminance, rank_of_unit, rows_and_columns_in_sample
from gsseg_core.raster.gpu.device import on_device, to_cpu
from gsseg_core.raster.gpu.gpu_operator import GPUOperator
from gsseg_core.raster.gpu.projection import tensors_of
from gsseg_core.raster.view_operator import ViewOperator
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.scene_cache import PerScene

_LIGHT: PerScene[torch.Tensor] = PerScene()


def scene_edges(operator: ViewOperator, scene: GaussianScene, labels: np.ndarray, distance: int) -> np.ndarray:
    """Compute the strength of all edges of a view, (H, W) float32, wherever the boundaries of its mask are."""
    del labels, distance
    assert isinstance(operator, GPUOperator)
    camera, device = operator.camera, operator.tiles.table.device
    light, differs = luminance(scene)
    if not differs:
        return np.zeros((camera.height, camera.width), np.float32)
    light_there = _LIGHT.of(scene, lambda: on_device(light, device), lambda known: known.device == device)
    ids, ahead = operator.tiles.ids.long(), on_device(camera.world_to_camera[2].astype(np.float32), device)
    depth = (tensors_of(scene, device).means[ids] * ahead[:3]).sum(dim=1) + ahead[3]
    # The clamp avoids division by 0; Gaussians behind the camera are not rendered.
    image, left_over = operator.blend_there(torch.stack([light_there[ids], 1 / depth.clamp_min(1e-6)], dim=1))
    # Mean over the visible Gaussians; where a ray mostly misses them, the background counts as dark and far away.
    light_edges, depth_edges = _differences(image / (1 - left_over).clamp_min(0.5))
    return to_cpu(_in_units(light_edges) + _in_units(depth_edges))


def _differences(image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:  # (2, H, W)
    """Return the length of the luminance gradient and the second differences of inverse depth, (H, W) each."""
    around = torch.nn.functional.pad(image, (1, 1, 1, 1), mode="replicate")
    middle, up, down = around[:, 1:-1, 1:-1], around[:, :-2, 1:-1], around[:, 2:, 1:-1]
    left, right = around[:, 1:-1, :-2], around[:, 1:-1, 2:]
    dy, dx = down[0] - up[0], right[0] - left[0]
    across, along = left[1] + right[1] - 2 * middle[1], up[1] + down[1] - 2 * middle[1]
    # No second differences across the image border.
    across[:, [0, -1]] = 0
    along[[0, -1]] = 0
    return torch.sqrt(dx * dx + dy * dy), across.abs() + along.abs()


def _in_units(edges: torch.Tensor) -> torch.Tensor:  # (H, W)
    rows, columns = (on_device(np.flatnonzero(of), edges.device) for of in rows_and_columns_in_sample(*edges.shape))
    some = edges[rows][:, columns].ravel()
    unit = some.kthvalue(rank_of_unit(len(some)) + 1).values
    return torch.where(unit > 0, (edges / unit).clamp_max(STRONGEST), torch.zeros_like(edges))
