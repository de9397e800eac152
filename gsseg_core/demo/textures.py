"""What the surfaces of the demo scene look like: wood, glaze, printed cardboard.

A texture takes points and unit normals (M, 3) in the frame of its solid, metres, and gives the colour there without
light, red, green and blue (M, 3) from 0 to 1.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

Color = tuple[float, float, float]
Texture = Callable[[np.ndarray, np.ndarray], np.ndarray]

PAPER = (0.93, 0.90, 0.82)

_GLYPHS = {
    "A": "01110 10001 10001 11111 10001 10001 10001",
    "O": "01110 10001 10001 10001 10001 10001 01110",
    "S": "01111 10000 10000 01110 00001 00001 11110",
    "T": "11111 00100 00100 00100 00100 00100 00100",
}
"""Rows of letters from the top, 5 x 7 cells."""


def plain(color: Color) -> Texture:
    """One colour all over."""
    return lambda points, _: np.full((len(points), 3), color)


def boards(color: Color, width: float) -> Texture:
    """Wooden boards along x, each of its own tone, with grain and dark seams."""

    def texture(points: np.ndarray, _: np.ndarray) -> np.ndarray:
        x, y, z = points.T
        board, across = np.divmod(y / width, 1)
        tone = 1 + 0.10 * np.sin(12.9 * board + 1)
        rings = (y + 0.35 * z) / width + 0.25 * np.sin(5 * x + 7 * board) + 0.1 * np.sin(17 * x + 3 * board)
        grain = 0.11 * np.sin(19 * rings) + 0.06 * np.sin(47 * rings + 2 * np.sin(9 * x))
        seam = 0.72 + 0.28 * np.minimum(1, np.minimum(across, 1 - across) * width / 0.006)
        return np.asarray(np.outer(tone * seam * (1 + grain), color))

    return texture


def tiles(light: Color, dark: Color, side: float) -> Texture:
    """Square tiles of two colours in turn, seen from above."""

    def texture(points: np.ndarray, _: np.ndarray) -> np.ndarray:
        odd = (np.floor(points[:, 0] / side) + np.floor(points[:, 1] / side)) % 2
        return _where(odd == 1, light, dark)

    return texture


def papered(paper: Color, stripe: Color, panel: Color, height: float) -> Texture:
    """Draw a wall: striped wallpaper above panels, which end `height` metres above the floor."""

    def texture(points: np.ndarray, _: np.ndarray) -> np.ndarray:
        along, z = points[:, 0], points[:, 2]
        colors = _where(along / 0.34 % 1 < 0.5, paper, stripe)
        colors[z < height] = panel
        colors[(z < height) & (along / 0.5 % 1 < 0.16)] *= 0.86
        colors[np.abs(z - height) < 0.035] = (0.95, 0.94, 0.90)
        return colors

    return texture


def bound(cover: Color, size: tuple[float, float, float]) -> Texture:
    """Draw the cover of a book lying on its back: a frame and a title on the upper side."""
    gold = (0.88, 0.72, 0.36)

    def texture(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        x, y = points[:, 0], points[:, 1]
        border = np.minimum(size[0] / 2 - np.abs(x), size[1] / 2 - np.abs(y))
        title = (np.abs(x - 0.045) < 0.012) & (np.abs(y) < 0.045) | (np.abs(x - 0.01) < 0.005) & (np.abs(y) < 0.03)
        golden = (np.abs(border - 0.014) < 0.003) | title
        return _where(golden & (normals[:, 2] > 0.5), gold, cover)

    return texture


def pages(points: np.ndarray, _: np.ndarray) -> np.ndarray:
    """Sheets of paper on top of each other."""
    return np.outer(0.93 + 0.07 * np.sin(points[:, 2] / 0.0014), PAPER)


def packet(color: Color, size: tuple[float, float, float]) -> Texture:
    """Draw a packet of oats, with its name and a sun on both faces, and small print at the sides."""

    def texture(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        front = np.abs(normals[:, 1]) > 0.5
        along, z = np.where(front, points[:, 0] * -np.sign(normals[:, 1]), points[:, 1]), points[:, 2]
        colors = np.full((len(points), 3), color)
        from_sun = np.hypot(along, z - 0.062)
        colors[front & (from_sun < 0.048)] = (0.98, 0.86, 0.42)
        colors[front & (from_sun < 0.031)] = (0.86, 0.30, 0.14)
        colors[z < 0.022] = (0.22, 0.36, 0.62)
        colors[front & (z > 0.128) & (z < 0.186)] = PAPER
        colors[front & written("OATS", along, z - 0.157, 0.006)] = (0.62, 0.13, 0.12)
        lines = (z > 0.05) & (z < 0.15) & (z / 0.017 % 1 < 0.45) & (np.abs(along) < size[1] / 2 - 0.012)
        colors[~front & (np.abs(normals[:, 2]) < 0.5) & lines] = PAPER
        return colors

    return texture


def labelled(color: Color, low: float, high: float, emblem: Color) -> Texture:
    """Draw a bottle or a can with a paper label around it between two heights, and its emblem on two sides."""

    def texture(points: np.ndarray, _: np.ndarray) -> np.ndarray:
        x, y, z = points.T
        around = (np.arctan2(y, x) / np.pi % 1 - 0.5) * np.pi * np.hypot(x, y)
        colors = _where((z > low) & (z < high), PAPER, color)
        from_edge = np.minimum(np.abs(z - low - 0.008), np.abs(z - high + 0.008))
        disc = np.abs(np.hypot(around, z - (low + high) / 2) - 0.008) < 0.007
        colors[(from_edge < 0.0035) | disc] = emblem
        return colors

    return texture


def glazed(color: Color, bands: Color, heights: tuple[float, ...]) -> Texture:
    """Draw a cup with painted bands around it at some heights, inside and outside."""

    def texture(points: np.ndarray, _: np.ndarray) -> np.ndarray:
        return _where(np.any([np.abs(points[:, 2] - height) < 0.005 for height in heights], axis=0), bands, color)

    return texture


def beach_ball(points: np.ndarray, _: np.ndarray) -> np.ndarray:
    """Six panels of four colours, white where they meet."""
    axis, across = np.array([0.42, -0.36, 0.83]), np.array([0.89, 0.27, -0.33])
    axis, across = axis / np.linalg.norm(axis), across - axis * (axis @ across) / (axis @ axis)
    across /= np.linalg.norm(across)
    along = points @ axis / np.linalg.norm(points, axis=1)
    turn = np.arctan2(points @ np.cross(axis, across), points @ across) / (2 * np.pi) % 1
    panels = np.array([(0.93, 0.92, 0.88), (0.86, 0.20, 0.17), (0.93, 0.92, 0.88), (0.16, 0.42, 0.72),
                       (0.93, 0.92, 0.88), (0.96, 0.76, 0.16)])  # fmt: skip
    colors = panels[np.minimum((6 * turn).astype(int), 5)]
    colors[np.abs(along) > 0.955] = (0.93, 0.92, 0.88)
    return np.asarray(colors)


def ripe(points: np.ndarray, _: np.ndarray) -> np.ndarray:
    """Draw the skin of an apple, red with a yellow cheek and streaks from pole to pole."""
    x, y, z = points.T
    turn = np.arctan2(y, x)
    cheek = np.clip(0.5 + 0.7 * np.sin(turn + 0.6) - 14 * np.abs(z) + 0.16 * np.sin(23 * turn), 0, 1)
    return np.asarray(np.array((0.76, 0.11, 0.12)) + cheek[:, None] * np.array((0.14, 0.52, 0.14)))


def written(text: str, u: np.ndarray, v: np.ndarray, cell: float) -> np.ndarray:
    """Which of the places u to the right and v upwards of a word's middle (M,) are on its letters, (M,) bool."""
    bitmap = np.zeros((7, 6 * len(text) - 1), bool)
    for i, letter in enumerate(text):
        bitmap[:, 6 * i : 6 * i + 5] = [[bit == "1" for bit in row] for row in _GLYPHS[letter].split()]
    columns, rows = np.floor(u / cell + bitmap.shape[1] / 2).astype(int), np.floor(3.5 - v / cell).astype(int)
    within = (columns >= 0) & (columns < bitmap.shape[1]) & (rows >= 0) & (rows < 7)
    marked = np.zeros(len(u), bool)
    marked[within] = bitmap[rows[within], columns[within]]
    return marked


def _where(chosen: np.ndarray, color: Color, other: Color) -> np.ndarray:
    return np.where(chosen[:, None], color, other)
