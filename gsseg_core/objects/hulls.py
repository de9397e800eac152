"""Convex hulls of points in space and in a plane: their faces, and the rectangles along their edges."""

from __future__ import annotations

import numpy as np

from gsseg_core.kernels.compiler import called_by_kernels, kernel

_FLAT = 1e-12  # heights that are less than this part of the largest distance are rounding


def hull_faces(points: np.ndarray) -> np.ndarray:
    """Triangles of the hull of points (M, 3) float64, M > 0: indices of their corners, (F, 3), which turn left outside.

    The hull is put together one point after the other (Kallay 1984). There are none if all points lie in one plane. How
    a side of more than three corners is cut is arbitrary.
    """
    offsets = points - points[points[:, 0].argmin()]
    distances = np.linalg.norm(offsets, axis=1)
    first, second = distances.argmin(), distances.argmax()
    normals = np.cross(offsets, offsets[second])
    third = np.linalg.norm(normals, axis=1).argmax()
    heights = offsets @ normals[third]
    fourth = np.abs(heights).argmax()
    rounding = _FLAT * distances[second]
    if abs(heights[fourth]) <= rounding * np.linalg.norm(normals[third]):
        return np.empty((0, 3), np.int64)
    if heights[fourth] < 0:
        second, third = third, second
    a, b, c, d = first, second, third, fourth
    return _grown(offsets, np.array([[a, b, c], [b, a, d], [c, b, d], [a, c, d]]), rounding)


@kernel
def _grown(points: np.ndarray, start: np.ndarray, rounding: float) -> np.ndarray:
    """Enlarge a tetrahedron (4, 3) of points (M, 3) until all are within it, but for `rounding`."""
    most = 2 * points.shape[0]  # Of M corners, a hull has 2 M - 4 triangles at most.
    faces, planes = np.empty((most, 3), np.int64), np.empty((4, most))  # normals and offsets of these
    sees, edges = np.empty(most, np.bool_), np.empty((most, 2), np.int64)
    count = 0
    for f in range(4):
        _put(faces, planes, count, points, start[f, 0], start[f, 1], start[f, 2])
        count += 1
    for p in range(points.shape[0]):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        seen = 0
        for f in range(count):
            sees[f] = planes[0, f] * x + planes[1, f] * y + planes[2, f] * z - planes[3, f] > rounding
            seen += sees[f]
        if seen == 0:
            continue
        new = _horizon(faces, sees, count, edges)
        if count - seen + new > most:  # Rounding has torn the hull.
            break
        kept = 0
        for f in range(count):
            if not sees[f]:
                for i in range(3):
                    faces[kept, i] = faces[f, i]
                for i in range(4):
                    planes[i, kept] = planes[i, f]
                kept += 1
        for e in range(new):
            _put(faces, planes, kept + e, points, edges[e, 0], edges[e, 1], p)
        count = kept + new
    return faces[:count]


@called_by_kernels
def _put(faces: np.ndarray, planes: np.ndarray, f: int, points: np.ndarray, a: int, b: int, c: int) -> None:
    """Write the triangle of three points as face `f`; one without area is seen from nowhere."""
    ux, uy, uz = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
    vx, vy, vz = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1], points[c, 2] - points[a, 2]
    x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    scale = 1 / max(np.sqrt(x * x + y * y + z * z), 1e-300)
    faces[f, 0], faces[f, 1], faces[f, 2] = a, b, c
    planes[0, f], planes[1, f], planes[2, f] = scale * x, scale * y, scale * z
    planes[3, f] = scale * (x * points[a, 0] + y * points[a, 1] + z * points[a, 2])


@called_by_kernels
def _horizon(faces: np.ndarray, sees: np.ndarray, count: int, edges: np.ndarray) -> int:
    """Write the edges of faces that are seen on whose other side is one that is not, (E, 2); how many there are."""
    found = 0
    for f in range(count):
        if sees[f]:
            for i in range(3):
                a, b = faces[f, i], faces[f, (i + 1) % 3]
                inner = False
                for g in range(count):
                    if sees[g]:
                        for j in range(3):
                            inner |= faces[g, j] == b and faces[g, (j + 1) % 3] == a
                if not inner and found < edges.shape[0]:
                    edges[found, 0], edges[found, 1] = a, b
                    found += 1
    return found


@kernel
def rectangles_around(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Put a rectangle along each edge of the convex hull of points (M, 2) float64, sorted by x and then by y, M > 1.

    Of all rectangles around the points, one of these is the smallest. Returns the directions of the edges, (E, 2), and
    how long the rectangles are along these and across, (E,) each.
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
