"""The rasteriser once more, as the formulas read: dense float64 NumPy, one Gaussian after the other over all pixels."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene


class NaiveView(NamedTuple):
    """W of one view.

    Attributes
    ----------
    weights : (H * W, N) float64
    transmittance : (H * W,) float64
        What each ray has left over.
    slack : (H * W,) float64
        How far off a weight may be in lower precision, because some alpha is as good as 1/255 or some transmittance as
        good as that with which a ray ends, so that rounding decides whether it counts. 0 in most pixels.
    """

    weights: np.ndarray
    transmittance: np.ndarray
    slack: np.ndarray


def naive_view(scene: GaussianScene, camera: Camera, lifts: bool = False, rounding: float = 1e-4) -> NaiveView:
    """Blend a scene into a view; `rounding` is the relative error up to which a threshold is a matter of luck.

    Rays that lift a mask end at the Gaussian that leaves less than a tenth of them, which takes what is left.
    """
    weights = np.zeros((camera.height * camera.width, len(scene)))
    transmittance, slack = np.ones(len(weights)), np.zeros(len(weights))
    for i, alpha in _alphas(scene, camera, scene.opacities):
        going_on = transmittance >= 1e-4
        doubtful = going_on & (np.abs(alpha * 255 - 1) < rounding)
        slack[doubtful] += (transmittance * alpha)[doubtful]
        alpha[(alpha < 1 / 255) | ~going_on] = 0.0
        weights[:, i] = alpha * transmittance
        transmittance *= 1 - alpha
        doubtful = (alpha > 0) & (np.abs(transmittance / (0.1 if lifts else 1e-4) - 1) < rounding)
        slack[doubtful] += transmittance[doubtful]
        if lifts:
            ends = transmittance < 0.1
            weights[ends, i] += transmittance[ends]
            transmittance[ends] = 0
    return NaiveView(weights, transmittance, slack)


def _alphas(
    scene: GaussianScene,
    camera: Camera,
    opacities: np.ndarray,  # (N,)
) -> Iterator[tuple[int, np.ndarray]]:
    """Give each Gaussian that is drawn and its alpha in all pixels, (P,), nearest first."""
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1)
    centres = scene.means.astype(np.float64) @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    for i in np.argsort(centres[:, 2], kind="stable"):
        if centres[i, 2] >= 0.01:
            yield i, _alpha(scene, camera, i, centres[i], pixels, opacities[i])


def _alpha(
    scene: GaussianScene,
    camera: Camera,
    i: int,
    centre: np.ndarray,  # (3,) in the camera's frame
    pixels: np.ndarray,  # (P, 2) px
    opacity: float,
) -> np.ndarray:
    covariance = projected_covariance(scene, camera, i, centre)
    x, y, z = centre
    offset = pixels - [camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy]
    squared = np.einsum("pa,ab,pb->p", offset, np.linalg.inv(covariance), offset)
    return np.minimum(0.99, np.float64(opacity) * np.exp(-squared / 2))


def projected_covariance(
    scene: GaussianScene,
    camera: Camera,
    i: int,
    centre: np.ndarray,  # (3,) in the camera's frame
) -> np.ndarray:
    """Covariance of a Gaussian on the image, (2, 2) px^2: J R Sigma R^T J^T + 0.3 I."""
    axes = Rotation.from_quat(np.roll(scene.quats[i].astype(np.float64), -1)).as_matrix()
    sigma = axes @ np.diag(scene.scales[i].astype(np.float64) ** 2) @ axes.T

    # The pinhole is linearised at the centre, moved sideways into the image widened by 15 % on every side.
    z = centre[2]
    margin = 0.15 * np.array([camera.width, camera.height])
    u, v = np.clip(
        [camera.fx * centre[0] / z + camera.cx, camera.fy * centre[1] / z + camera.cy],
        -margin,
        np.array([camera.width, camera.height]) + margin,
    )
    x, y = (u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z
    jacobian = np.array([[camera.fx / z, 0, -camera.fx * x / z**2], [0, camera.fy / z, -camera.fy * y / z**2]])
    to_image = jacobian @ camera.world_to_camera[:3, :3]
    return to_image @ sigma @ to_image.T + 0.3 * np.eye(2)
