"""What stands in the room of the demo: parts in their places, and what they look like.

The world has its origin on the floor under the middle of the table, z up, metres.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gsseg_core.demo import textures
from gsseg_core.demo.solids import Box, Cone, Ellipsoid, Solid

CLASS_NAMES = ("background", "mug", "bowl", "book", "ball", "can", "box", "bottle", "apple", "table")

TABLE_HEIGHT = 0.72


@dataclass(frozen=True)
class Part:
    """A solid in its place: turned about its z axis, then moved."""

    label: int
    solid: Solid
    look: textures.Texture
    position: tuple[float, float, float]
    yaw: float = 0.0  # degrees

    @cached_property
    def rotation(self) -> np.ndarray:
        """(3, 3), from the solid's frame to the world."""
        c, s = np.cos(np.radians(self.yaw)), np.sin(np.radians(self.yaw))
        return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])

    @cached_property
    def corners(self) -> np.ndarray:
        """Corners (8, 3) of the bounding box in the world."""
        grid = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, 8).T
        low, high = self.solid.corners
        return (low + grid * (high - low)) @ self.rotation.T + self.position

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Distances along world rays."""
        with np.errstate(divide="ignore", invalid="ignore"):  # rays beside or along a surface
            return self.solid.hit((origins - self.position) @ self.rotation, directions @ self.rotation)

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Which world points (M, 3) are in it, (M,) bool."""
        return self.solid.contains((points - self.position) @ self.rotation)

    def sample(self, u: np.ndarray, inset: float) -> tuple[np.ndarray, np.ndarray]:
        """Surface points and normals in the world."""
        points, normals = self.solid.sample(u, inset)
        return points @ self.rotation.T + self.position, normals @ self.rotation.T


def furnish() -> list[Part]:
    """All parts: room, table, and the eight objects that stand on it, in and on each other, and touch."""
    parts: list[Part] = []

    def add(
        name: str, solid: Solid, look: textures.Texture, x: float, y: float, z: float = 0.0, yaw: float = 0.0
    ) -> None:
        """Add a part whose z is that above the table top."""
        parts.append(Part(CLASS_NAMES.index(name), solid, look, (x, y, TABLE_HEIGHT + z), yaw))

    wall = textures.papered((0.80, 0.80, 0.70), (0.73, 0.76, 0.66), (0.60, 0.68, 0.66), height=0.80)
    add("background", Box((3.0, 2.8, 0.02)), textures.tiles((0.74, 0.70, 0.63), (0.50, 0.44, 0.39), 0.35), 0, 0, -0.74)
    for x, y, yaw in ((1.5, 0, 90), (-1.5, 0, 90), (0, 1.4, 0), (0, -1.4, 0)):
        add("background", Box((3.0 if y else 2.8, 0.02, 1.4)), wall, x, y, -TABLE_HEIGHT, yaw)
    wood = textures.boards((0.63, 0.42, 0.25), 0.128)
    add("table", Box((0.96, 0.64, 0.03)), wood, 0, 0, -0.03)
    for x, y in ((-0.43, -0.27), (0.43, -0.27), (-0.43, 0.27), (0.43, 0.27)):
        add("table", Cone(0.018, 0.025, TABLE_HEIGHT - 0.03), wood, x, y, -TABLE_HEIGHT)

    cover = textures.bound((0.10, 0.33, 0.36), (0.24, 0.17, 0.006))
    add("book", Box((0.24, 0.17, 0.006)), cover, -0.15, 0.02, yaw=20)
    add("book", Box((0.23, 0.16, 0.026)), textures.pages, -0.15, 0.02, 0.006, yaw=20)
    add("book", Box((0.24, 0.17, 0.006)), cover, -0.15, 0.02, 0.032, yaw=20)

    size = (0.15, 0.065, 0.20)
    add("box", Box(size), textures.packet((0.90, 0.55, 0.18), size), 0.05, 0.20, yaw=-14)
    green, x, y = (0.12, 0.36, 0.20), 0.159, 0.163
    add("bottle", Cone(0.037, 0.037, 0.15), textures.labelled(green, 0.035, 0.120, (0.66, 0.16, 0.13)), x, y, yaw=-60)
    add("bottle", Cone(0.037, 0.014, 0.05), textures.plain(green), x, y, 0.15)
    add("bottle", Cone(0.014, 0.014, 0.04), textures.plain(green), x, y, 0.20)
    add("bottle", Cone(0.016, 0.016, 0.016), textures.plain((0.80, 0.62, 0.24)), x, y, 0.24)

    metal, x, y = textures.plain((0.74, 0.75, 0.78)), -0.010, 0.146
    printed = textures.labelled((0.78, 0.16, 0.20), 0.016, 0.075, (0.16, 0.42, 0.38))
    add("can", Cone(0.031, 0.033, 0.012), metal, x, y)
    add("can", Cone(0.033, 0.033, 0.091), printed, x, y, 0.012, yaw=20)
    add("can", Cone(0.033, 0.029, 0.012), metal, x, y, 0.103)

    cream, x, y, z = (0.90, 0.86, 0.76), -0.165, 0.045, 0.038  # on the book
    painted = textures.glazed(cream, (0.20, 0.36, 0.58), (0.062, 0.080))
    add("mug", Cone(0.040, 0.042, 0.095, hollow=True), painted, x, y, z)
    for lift, size in ((0.020, (0.034, 0.012, 0.011)), (0.068, (0.034, 0.012, 0.011)), (0.020, (0.011, 0.012, 0.059))):
        out = 0.053 if size[2] < 0.02 else 0.070  # two arms and the grip between them
        turn = np.radians(-150)
        add("mug", Box(size), textures.plain(cream), x + out * np.cos(turn), y + out * np.sin(turn), z + lift, yaw=-150)
    add("ball", Ellipsoid((0.055, 0.055, 0.055)), textures.beach_ball, -0.075, -0.099, 0.055)
    painted, x, y = textures.glazed((0.86, 0.88, 0.90), (0.16, 0.34, 0.68), (0.056, 0.030)), 0.062, -0.085
    add("bowl", Cone(0.040, 0.080, 0.060, hollow=True), painted, x, y)
    add("apple", Ellipsoid((0.038, 0.038, 0.034)), textures.ripe, x + 0.008, y + 0.006, 0.045)  # in the bowl
    add("apple", Cone(0.003, 0.003, 0.016), textures.plain((0.32, 0.22, 0.14)), x + 0.008, y + 0.006, 0.075)
    return parts
