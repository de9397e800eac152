"""Rectangles around points in a plane: of those with a side along an edge of the points' hull, one is the smallest."""

from __future__ import annotations

import numpy as np

from gsseg_core.kernels.compiler import called_by_kernels, kernel


@kernel
def rectangles_around(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Put a rectangle along each edge of the convex hull of points (M, 2) float64, sorted by x and then by y, M > 1.

    Returns the directions of the edges, (E, 2), and how long the rectangles are along these and across, (E,) each.
    """
    corners = _hull(points)
    count = corners.shape[0]
    directions, lengths, widths = np.empty((count, 2)), np.empty(count), np.empty(count)
    for e in range(count):
        x, y = corners[(e + 1) % count] - corners[e]
        norm = np.sqrt(x * x + y * y)
        x, y = x / norm, y / norm
        first = last = x * corners[0, 0] + y * corners[0, 1]
        low = high = x * corners[0, 1] - y * corners[0, 0]
        for c in range(1, count):
            along, across = x * corners[c, 0] + y * corners[c, 1], x * corners[c, 1] - y * corners[c, 0]
            first, last = min(first, along), max(last, along)
            low, high = min(low, across), max(high, across)
        directions[e, 0], directions[e, 1] = x, y
        lengths[e], widths[e] = last - first, high - low
    return directions, lengths, widths


@called_by_kernels
def _hull(points: np.ndarray) -> np.ndarray:
    """Find the corners (H, 2) of the convex hull of sorted points, around it: the monotone chain of Andrew (1979)."""
    count, n = points.shape[0], 0
    corners = np.empty((2 * count, 2))
    for i in range(count):  # along one side
        while n > 1 and not _turns_left(corners[n - 2], corners[n - 1], points[i]):
            n -= 1
        corners[n] = points[i]
        n += 1
    least = n
    for i in range(count - 2, -1, -1):  # and back along the other
        while n > least and not _turns_left(corners[n - 2], corners[n - 1], points[i]):
            n -= 1
        corners[n] = points[i]
        n += 1
    return corners[: n - 1]  # The first one came again.


@called_by_kernels
def _turns_left(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> bool:  # (2,) each
    return bool((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]) > 0)
