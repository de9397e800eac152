"""Light in the demo's room: a lamp with soft shadows, and a sky that is darkened where parts are close."""

from __future__ import annotations

import numpy as np

from gsseg_core.demo.furniture import Part
from gsseg_core.demo.solids import Cone, dot
from gsseg_core.scene.spherical_harmonics import C0, basis

LAMP = np.array([-0.9, -1.1, 2.9])
LAMP_COLOR, SKY_COLOR = np.array([1.06, 1.0, 0.90]), np.array([0.96, 1.0, 1.05])

REACH = 0.25  # m; parts that are farther away do not darken a place
RAYS = 10  # to the sky from each place; half as many to the lamp


def spread(count: int) -> np.ndarray:
    """Spread directions (count, 3) of length 1 evenly, on a spiral around the sphere."""
    z, turn = (2 * np.arange(count) + 1) / count - 1, np.arange(count) * np.pi * (3 - 5**0.5)
    return np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1)


def shade(
    part: Part, parts: list[Part], points: np.ndarray, normals: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """SH coefficients (M, 4, 3) at points (M, 3), lit by the sky and a lamp that casts soft shadows, with a sheen."""
    start = points + 1e-3 * normals
    lamp = np.zeros(len(points))
    for offset in 0.2 * spread(RAYS // 2):
        towards = LAMP + offset - start
        blocked = np.any([other.hit(start, towards) < 1 for other in parts if other.label], axis=0)
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        lamp += np.maximum(dot(towards, normals), 0) * ~blocked / (RAYS // 2)
    sky = sky_share(part, parts, start, normals)
    light = (sky * (0.56 + 0.08 * normals[:, 2]))[:, None] * SKY_COLOR + 0.52 * lamp[:, None] * LAMP_COLOR
    grain = rng.normal(1, 0.02, (len(points), 1))
    color = part.look((points - part.position) @ part.rotation, normals @ part.rotation) * light * grain

    towards = (LAMP - points) / np.linalg.norm(LAMP - points, axis=1, keepdims=True)
    mirrored = 2 * dot(towards, normals)[:, None] * normals - towards
    sheen = 0.0 if part.label == 0 else 0.06 * lamp
    sh = np.zeros((len(points), 4, 3))
    sh[:, 0] = (color - 0.5) / C0
    # Of degree 1 a colour varies with the cosine to one direction; the viewer looks along -mirrored at the highlight.
    sh[:, 1:] = (-sheen * basis(mirrored, 1)[:, 1:].T / (3 * C0 * C0)).T[..., None]
    return sh


def sky_share(part: Part, parts: list[Part], start: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Share of the sky (M,) that other parts leave to points (M, 3): contacts and insides are dark."""
    # Of a cosine-weighted hemisphere: Lambert's law is in the draw.
    towards = normals + 0.97 * spread(RAYS)[:, None]
    towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
    seen = np.ones(towards.shape[:2])
    for other in parts:
        if other.label and (other is not part or (isinstance(part.solid, Cone) and part.solid.hollow)):
            near, far = other.corners.min(axis=0) - REACH, other.corners.max(axis=0) + REACH
            close = np.flatnonzero(((start > near) & (start < far)).all(axis=1))
            distance = other.hit(start[close], towards[:, close])
            seen[:, close] = np.minimum(seen[:, close], np.clip(distance / REACH, 0, 1))
    return np.asarray(seen.mean(axis=0))
