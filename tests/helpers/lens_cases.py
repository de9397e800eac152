"""One plausible lens of every model, and what COLMAP makes of it."""

from __future__ import annotations

import numpy as np
import pycolmap

from gsseg_core.scene.lens import MODELS_BY_NAME, Lens

WIDTH, HEIGHT = 320, 240
COEFFICIENTS: dict[str, tuple[float, ...]] = {
    "SIMPLE_RADIAL": (-0.15,),
    "RADIAL": (-0.2, 0.05),
    "OPENCV": (-0.25, 0.06, 0.002, -0.003),
    "FULL_OPENCV": (0.2, -0.05, 0.001, 0.002, 0.01, 0.4, 0.02, 0.001),
    "SIMPLE_FISHEYE": (),
    "FISHEYE": (),
    "SIMPLE_RADIAL_FISHEYE": (0.03,),
    "RADIAL_FISHEYE": (0.03, -0.004),
    "OPENCV_FISHEYE": (0.05, -0.01, 0.003, -0.0005),
    "THIN_PRISM_FISHEYE": (0.03, -0.01, 0.001, 0.0005, 0.002, -0.0002, 0.001, -0.001),
    "EQUIRECTANGULAR": (),
}
"""Of all models that are no pinhole, in the order of COLMAP, which is that of `LENS_MODELS`."""


def colmap_params(name: str) -> list[float]:
    """All parameters of a lens in COLMAP's order."""
    names = pycolmap.Camera.create_from_model_name(1, name, 1.0, WIDTH, HEIGHT).params_info.replace(" ", "").split(",")
    if name == "EQUIRECTANGULAR":
        return [WIDTH, HEIGHT]
    focal = [150.0] if "f" in names else [150.0, 160.0]
    return [*focal, WIDTH / 2 + 3, HEIGHT / 2 - 2, *COEFFICIENTS[name]]


def lens(name: str) -> Lens:
    """The lens as gsseg has it."""
    if name == "EQUIRECTANGULAR":
        return Lens(MODELS_BY_NAME[name], WIDTH, HEIGHT)
    params, coefficients = colmap_params(name), COEFFICIENTS[name]
    *focal, cx, cy = params[: len(params) - len(coefficients)]
    return Lens(MODELS_BY_NAME[name], WIDTH, HEIGHT, (focal[0], focal[-1]), (cx, cy), coefficients)


def colmap_camera(name: str) -> pycolmap.Camera:
    """The lens as COLMAP has it."""
    return pycolmap.Camera(camera_id=1, model=name, width=WIDTH, height=HEIGHT, params=colmap_params(name))


def rays_within(angle: float, count: int = 300, seed: int = 0) -> np.ndarray:
    """Unit rays (count, 3) that are at most so many radians off the forward direction."""
    rng = np.random.default_rng(seed)
    off, turn = rng.uniform(0, angle, count), rng.uniform(0, 2 * np.pi, count)
    return np.stack([np.sin(off) * np.cos(turn), np.sin(off) * np.sin(turn), np.cos(off)], axis=1)
