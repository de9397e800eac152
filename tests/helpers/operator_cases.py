"""Scenes, cameras and masks that make an operator sweat, and W as a dense matrix."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from gsseg_core.raster.constants import T_LIFTED
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene


def make_scene(means, quats, scales, opacities):
    return GaussianScene.from_arrays(means, quats, scales, opacities, np.zeros((len(means), 1, 3)))


def make_camera(width, height, world_to_camera=None):
    """Principal point off the centre, pixels not square."""
    focal = 0.8 * max(width, height, 8)
    K = [[focal, 0, 0.45 * width], [0, 1.1 * focal, 0.6 * height], [0, 0, 1]]
    return Camera("view", width, height, K, np.eye(4) if world_to_camera is None else world_to_camera)


def one_gaussian(scale=1.0):
    return make_scene([[0, 0, 1.0]], [[1, 0, 0, 0]], [[scale] * 3], [0.5])


def rigid(rng):
    motion = np.eye(4)
    motion[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    motion[:3, 3] = rng.normal(size=3)
    return motion


def moved(scene, motion):
    rotation = Rotation.from_matrix(motion[:3, :3])
    quats = np.roll((rotation * Rotation.from_quat(np.roll(scene.quats, -1, axis=1))).as_quat(), 1, axis=1)
    return make_scene(scene.means @ motion[:3, :3].T + motion[:3, 3], quats, scene.scales, scene.opacities)


def random_view(seed, n=120, width=37, height=21):
    """Scene and camera, with a share of each kind of Gaussian that is easily got wrong."""
    rng = np.random.default_rng(seed)
    camera = make_camera(width, height, rigid(rng))
    kind = rng.choice(["plain", "behind", "near", "outside", "huge", "tiny", "faint", "opaque"], n,
                      p=[0.5, 0.05, 0.05, 0.1, 0.05, 0.1, 0.05, 0.1])  # fmt: skip
    z = rng.uniform(1, 6, n)
    z[kind == "behind"] *= -1
    z[kind == "near"] = rng.uniform(-0.01, 0.05, (kind == "near").sum())
    uv = rng.uniform(-0.2, 1.2, (n, 2)) * [width, height]
    uv[kind == "outside"] = rng.choice([-2, 3], ((kind == "outside").sum(), 2)) * [width, height]
    means = np.c_[(uv - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones(n)] * z[:, None]
    scales = np.exp(rng.uniform(np.log(0.01), np.log(0.5), (n, 3)))
    scales[kind == "outside"] *= 5
    scales[kind == "huge"] = rng.uniform(5, 50, ((kind == "huge").sum(), 3))
    scales[kind == "tiny"] = 1e-4
    opacities = rng.uniform(0.02, 0.95, n)
    opacities[kind == "huge"] *= 0.1
    opacities[kind == "faint"] = rng.uniform(0.001, 0.0038, (kind == "faint").sum())
    opacities[kind == "opaque"] = rng.uniform(0.985, 0.99999, (kind == "opaque").sum())
    scene = make_scene(means, rng.normal(size=(n, 4)), scales, opacities)
    return moved(scene, np.linalg.inv(camera.world_to_camera)), camera


def random_mask(seed, width=37, height=21, ids=(0, 1, 2, 7, 60000)):
    """A few labels in blocks, noise in them, and unknown pixels."""
    rng = np.random.default_rng(seed)
    blocks = rng.integers(0, len(ids), (height // 6 + 1, width // 6 + 1)).repeat(6, axis=0).repeat(6, axis=1)
    mask = np.array(ids, np.int32)[blocks[:height, :width]]
    noise = rng.random((height, width))
    mask[noise < 0.1] = rng.choice(ids)
    mask[noise > 0.9] = -1
    return mask


def dense(operator):
    """W as the list of its entries gives it."""
    listed = operator.weights()
    full = np.zeros((operator.camera.height * operator.camera.width, operator.num_gaussians))
    np.add.at(full, (listed.pixels, listed.gaussians), listed.weights)
    return full


def lifting(operator, scene):
    """W by which masks are lifted, (P, N), and what its rays have left over, (P,): they end as `T_LIFTED` says.

    What is left of a ray is rounded after each Gaussian, as lifting does: where it meets the limit, a bit decides.
    """
    depths = scene.means @ operator.camera.world_to_camera[2, :3]
    order = np.argsort(depths, kind="stable")
    weights = dense(operator)[:, order]
    steps = np.column_stack([np.ones(len(weights)), weights]).astype(np.float32)
    left = np.subtract.accumulate(steps, axis=1).astype(float)
    before, after = left[:, :-1], left[:, 1:]
    ends = after < T_LIFTED
    full = np.zeros_like(weights)
    full[:, order] = np.where(before < T_LIFTED, 0, np.where(ends, before, weights))
    return full, np.where(ends[:, -1], 0, after[:, -1])


def spread(operator, observation, per_pair, num_labels=60001):
    """Numbers of pairs as rows of the scene and columns by label, to compare different masks."""
    full = np.zeros((operator.num_gaussians, num_labels), np.float32)
    full[observation.ids[observation.rows], observation.classes[observation.labels]] = per_pair
    return full
