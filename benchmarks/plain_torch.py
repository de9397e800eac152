"""The paper's learner as one would write it in PyTorch: every step renders the view anew, and autograd does the rest.

Project all Gaussians, sort them by depth, and tile by tile blend those that reach it, densely, with tensor operations;
cross-entropy against the mask; Adam on the codes. It has the loss, rates and schedule of `GradientLearner`. Two things
are done in its favour: geometry takes no gradients, since only codes are learnt, and the backward pass is run tile by
tile, which bounds its memory.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch

from gsseg_core.learn.gradient_learner import GradientSettings
from gsseg_core.raster.constants import T_LIFTED, T_MIN
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene

TILE = 32
"""Side of a tile in px: larger than a rasteriser's, since every tile costs some twenty calls into PyTorch."""


class Splats(NamedTuple):
    """Gaussians on the image, nearest first."""

    ids: torch.Tensor  # (M,)
    centres: torch.Tensor  # (M, 2) px
    conics: torch.Tensor  # (M, 3)
    opacities: torch.Tensor  # (M,)
    reaches: torch.Tensor  # (M, 2) px


class Blend(NamedTuple):
    """The weights of one tile."""

    rows: slice
    columns: slice
    ids: torch.Tensor  # (G,)
    weights: torch.Tensor  # (P, G)
    left_over: torch.Tensor  # (P,)


class PlainTorch:
    """Scene, codes and optimiser."""

    def __init__(self, scene: GaussianScene, num_classes: int, settings: GradientSettings | None = None) -> None:
        self.settings = settings or GradientSettings()
        arrays = (scene.means, scene.scales, scene.quats, scene.opacities)
        self.means, self.scales, self.quats, self.opacities = (torch.from_numpy(array.copy()) for array in arrays)
        self.logits = torch.zeros((len(scene), num_classes), requires_grad=True)
        self.optimiser = torch.optim.Adam([self.logits], lr=self.settings.rate)

    def learn(self, cameras: Sequence[Camera], masks: Sequence[np.ndarray]) -> np.ndarray:
        """Run all epochs; returns codes (N, K) float32."""
        settings = self.settings
        steps = settings.epochs * len(cameras)
        decay = (settings.final_rate / settings.rate) ** (1 / max(steps - 1, 1))
        schedule = torch.optim.lr_scheduler.ExponentialLR(self.optimiser, decay)
        rng = np.random.default_rng(settings.seed)
        for _ in range(settings.epochs):
            for i in rng.permutation(len(cameras)):
                self.step(cameras[i], masks[i])
                schedule.step()
        return torch.softmax(self.logits, dim=1).detach().numpy()

    def step(
        self,
        camera: Camera,
        mask: np.ndarray,  # (H, W), negative = unknown
    ) -> float:
        """Render one view and step; returns the loss."""
        labels = torch.from_numpy(mask.astype(np.int64))
        self.optimiser.zero_grad()
        codes = torch.softmax(self.logits, dim=1)
        inner = codes.detach().requires_grad_()
        scale, total = 1 / (int((labels >= 0).sum()) * codes.shape[1]), 0.0
        for tile in self.blend(camera, lifts=True):
            image = self.render_tile(tile, inner)
            seen = labels[tile.rows, tile.columns].flatten()
            right = image[seen >= 0].gather(1, seen[seen >= 0, None])
            loss = -scale * torch.log(right.clamp_min(1e-30)).sum()
            if loss.requires_grad:
                loss.backward()
            total += float(loss.detach())
        if inner.grad is not None:
            codes.backward(inner.grad)
        self.optimiser.step()
        return total

    def render(self, camera: Camera, codes: torch.Tensor) -> np.ndarray:
        """Render codes (N, K), with the transmittance left over in class 0: (H, W, K)."""
        out = np.empty((camera.height, camera.width, codes.shape[1]), np.float32)
        for tile in self.blend(camera):
            place = out[tile.rows, tile.columns]
            place[:] = self.render_tile(tile, codes).detach().numpy().reshape(place.shape)
        return out

    @staticmethod
    def render_tile(tile: Blend, codes: torch.Tensor) -> torch.Tensor:
        """Blend codes (N, K) into a tile: (P, K)."""
        image = tile.weights @ codes[tile.ids]
        return image + torch.nn.functional.pad(tile.left_over[:, None], (0, codes.shape[1] - 1))

    @torch.no_grad()
    def blend(self, camera: Camera, lifts: bool = False) -> Iterator[Blend]:
        """Weights of every tile; rays that lift a mask end early, at a Gaussian that takes what is left."""
        splats = self.project(camera)
        for top in range(0, camera.height, TILE):
            for left in range(0, camera.width, TILE):
                bottom, right = min(top + TILE, camera.height), min(left + TILE, camera.width)
                (u, v), (reach_x, reach_y) = splats.centres.T, splats.reaches.T
                near = (u + reach_x > left) & (u - reach_x < right) & (v + reach_y > top) & (v - reach_y < bottom)
                mine = near.nonzero()[:, 0]
                rows, columns = torch.meshgrid(
                    torch.arange(top, bottom) + 0.5, torch.arange(left, right) + 0.5, indexing="ij"
                )
                dx, dy = columns.reshape(-1, 1) - u[mine], rows.reshape(-1, 1) - v[mine]
                a, b, c = splats.conics[mine].T
                alpha = splats.opacities[mine] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
                alpha = torch.where(alpha < 1 / 255, 0.0, alpha.clamp_max(0.99))
                after = torch.cumprod(1 - alpha, dim=1)
                before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], dim=1)[:, : len(mine)]
                weights = torch.where(before < (T_LIFTED if lifts else T_MIN), 0.0, alpha * before)
                if lifts:
                    ends = (before >= T_LIFTED) & (after[:, : len(mine)] < T_LIFTED)
                    weights = torch.where(ends, before, weights)
                yield Blend(slice(top, bottom), slice(left, right), splats.ids[mine], weights, 1 - weights.sum(dim=1))

    def project(self, camera: Camera) -> Splats:
        """Project and sort what may be visible."""
        pose = torch.from_numpy(camera.world_to_camera).float()
        rotation, fx, fy = pose[:3, :3], camera.fx, camera.fy
        x, y, z = (self.means @ rotation.T + pose[:3, 3]).T
        front = (z > 0.01) & (self.opacities >= 1 / 255)
        ids = front.nonzero()[:, 0]
        ids = ids[torch.argsort(z[ids])]
        x, y, z = x[ids], y[ids], z[ids]
        centres = torch.stack([fx * x / z + camera.cx, fy * y / z + camera.cy], dim=1)
        # The linearisation is held within the image widened by 15 % on every side, as trainers do.
        margin_x, margin_y = 0.15 * camera.width / fx, 0.15 * camera.height / fy
        tx = (x / z).clamp(-camera.cx / fx - margin_x, (camera.width - camera.cx) / fx + margin_x)
        ty = (y / z).clamp(-camera.cy / fy - margin_y, (camera.height - camera.cy) / fy + margin_y)
        zero = torch.zeros_like(z)
        jacobian = torch.stack(
            [torch.stack([fx / z, zero, -fx * tx / z], 1), torch.stack([zero, fy / z, -fy * ty / z], 1)], 1
        )
        half = jacobian @ rotation @ (_rotations(self.quats[ids]) * self.scales[ids, None])
        covariance = half @ half.mT + 0.3 * torch.eye(2)
        conics = torch.linalg.inv(covariance)[:, [0, 0, 1], [0, 1, 1]]
        cut = (2 * (math.log(255) + torch.log(self.opacities[ids]))).clamp_min(0)
        reaches = torch.sqrt(cut[:, None] * covariance[:, [0, 1], [0, 1]]) + 0.01
        return Splats(ids, centres, conics, self.opacities[ids], reaches)


def _rotations(quats: torch.Tensor) -> torch.Tensor:
    """Matrices (M, 3, 3) of unit quaternions (M, 4) w, x, y, z."""
    w, x, y, z = quats.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)
