"""Shapes of annotations and how they are painted into a label image.

Coordinates are those of `docs/conventions.md`: pixel (column c, row r) covers [c, c + 1) x [r, r + 1), and is inside
where its centre is. (Pillow's and OpenCV's polygons take all pixels that their outline touches, half a pixel more on
each side.)
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.data.mask_formats.rle import runs_to_mask
from gsseg_core.errors import MaskFormatError, MaskSizeError
from gsseg_core.files.json_files import kind_of
from gsseg_core.files.limits import LIMITS, MAX_LABEL
from gsseg_core.scene.camera import Camera
from gsseg_core.text import clipped

T = TypeVar("T", bound=np.generic)

_AT_ONCE = 2**18  # crossings of rows and edges that are worked on at a time
_FEW = 2**16  # crossings that a polygon may have in an image of any size
_RING_PIXELS = 2**16  # pixels that are filled in the time that any polygon takes by itself, however small
_INSIDE = 0.9  # share of a shape that lies in another one, from which on it is a part of that


class Part(NamedTuple):
    """Pixels inside of a shape, within a rectangle of the image that has all of them."""

    top: int
    left: int
    inside: npt.NDArray[np.bool_]  # (h, w)


class Region(Protocol):
    """What a shape covers."""

    def parts(self, width: int, height: int) -> Iterator[Part]:
        """Give the pixels that it covers of an image of this size, which may be in several parts."""


@dataclass(frozen=True, eq=False)
class Polygons:
    """Polygons, each with the pixels inside of it by the even-odd rule; messages begin with `where` they stand."""

    rings: list[npt.NDArray[np.float64]]  # each (P, 2): x, y
    where: str

    @classmethod
    def of(cls, value: object, where: str) -> Polygons:
        """Read one polygon as JSON has it: [[x, y], ...] or [x, y, x, y, ...].

        Raises `MaskFormatError` where it is none, or has NaN or coordinates that no image has.
        """
        try:
            points = np.array(value, np.float64)
            ring = points.reshape(-1, 2) if points.ndim == 1 else points
        except (TypeError, ValueError, OverflowError):
            ring = np.zeros((0, 0))
        if not isinstance(value, list) or ring.ndim != 2 or (ring.shape[1] != 2 and ring.size + len(value)):
            found = f"a list of {len(value)}" if isinstance(value, list) else kind_of(value)
            raise MaskFormatError(f"{where}: has {found}; expected the points of a polygon, x and y of each")
        ring = ring.reshape(-1, 2)
        if len(odd := ring[~(np.abs(ring) <= LIMITS.max_value).all(axis=1)]):
            raise MaskFormatError(
                f"{where}: a polygon has the point ({odd[0, 0]:g}, {odd[0, 1]:g}); expected pixels of an image"
            )
        return cls([ring], where)

    def parts(self, width: int, height: int) -> Iterator[Part]:
        """See `Region`."""
        rings = [ring for ring in self.rings if len(ring)]
        together = rings and len(rings) * _RING_PIXELS >= width * height
        for some in [rings] if together else [[ring] for ring in rings]:
            yield from self._filled(_Edges.of(some, width, height), width, height)

    def _filled(self, edges: _Edges, width: int, height: int) -> Iterator[Part]:
        """Fill polygons: a row is inside of each from every odd crossing with its edges to the next crossing."""
        count = np.bincount(edges.ring, edges.end - edges.first)
        if count.max() > max(4 * width * height, _FEW):
            raise MaskFormatError(
                f"{self.where}: a polygon of {(edges.ring == count.argmax()).sum():,} points crosses the rows of the "
                f"image {count.max():,.0f} times; expected an outline of something in {width} x {height} pixels"
            )
        (left, top), (right, bottom) = edges.low.min(axis=1).tolist(), edges.high.max(axis=1).tolist()
        if right <= left or bottom <= top:
            return
        dtype = np.min_scalar_type(-2 * len(count))
        # How many polygons each pixel is in; before the sum, how many begin less how many end there.
        depth = np.zeros((bottom - top) * (right - left) + 1, dtype)
        for ring, row, column in edges.crossings():
            row, column = np.divmod(np.sort((ring * height + row) * (width + 1) + column), width + 1)
            pixel = (row % height - top) * (right - left) + column - left
            np.add.at(depth, pixel[::2], dtype.type(1))
            np.subtract.at(depth, pixel[1::2], dtype.type(1))
        np.cumsum(depth, dtype=dtype, out=depth)
        yield Part(top, left, depth[:-1].reshape(bottom - top, right - left) > 0)


class _Edges(NamedTuple):
    """Edges of polygons, each from a point to the next, and the rows of an image that they cross."""

    ring: npt.NDArray[np.int64]  # (E,): the polygon
    x: npt.NDArray[np.float64]  # (E,), as all of the point; centres of pixels are whole numbers
    y: npt.NDArray[np.float64]
    after: npt.NDArray[np.int64]  # the next point
    first: npt.NDArray[np.int64]  # row that is crossed
    end: npt.NDArray[np.int64]  # row behind the last one
    low: npt.NDArray[np.int64]  # (2, R): first column and row of each polygon within the image
    high: npt.NDArray[np.int64]  # (2, R): those behind the last ones

    @classmethod
    def of(cls, rings: list[npt.NDArray[np.float64]], width: int, height: int) -> _Edges:
        """Collect the edges of polygons, each of which has a point at least."""
        ends = np.cumsum([len(ring) for ring in rings])
        starts = np.concatenate([[0], ends[:-1]])
        points = np.concatenate(rings).T - 0.5
        ring, after = np.repeat(np.arange(len(rings)), ends - starts), np.arange(1, points.shape[1] + 1)
        after[ends - 1] = starts
        low, high = (
            np.clip(np.ceil(limit.reduceat(points, starts, axis=1)), 0, [[width], [height]]).astype(np.int64)
            for limit in (np.minimum, np.maximum)
        )
        high[1] = np.where(high[0] > low[0], high[1], low[1])  # One beside the image crosses none of its rows.
        x, y = points
        first, end = (
            np.clip(np.ceil(limit(y, y[after])), low[1, ring], high[1, ring]).astype(np.int64)
            for limit in (np.minimum, np.maximum)
        )
        return cls(ring, x, y, after, first, end, low, high)

    def crossings(self) -> Iterator[tuple[npt.NDArray[np.int64], ...]]:
        """Give all crossings of some rows at a time, each (C,): polygon, row, and column of the first pixel behind."""
        count = np.cumsum(np.bincount(self.first, minlength=self.end.max() + 1) - np.bincount(self.end))
        blocks = np.flatnonzero(np.diff(np.cumsum(count) // _AT_ONCE)) + 1
        for begin, end in pairwise([0, *blocks.tolist(), len(count)]):
            first = np.clip(self.first, begin, end)
            rows = np.clip(self.end, begin, end) - first
            edge = np.repeat(np.arange(len(rows)), rows)
            row = first[edge] + np.arange(len(edge)) - np.repeat(np.cumsum(rows) - rows, rows)
            after, ring = self.after[edge], self.ring[edge]
            slope = (self.x[after] - self.x[edge]) / (self.y[after] - self.y[edge])
            column = np.ceil(self.x[edge] + (row - self.y[edge]) * slope)
            yield ring, row, np.clip(column, self.low[0, ring], self.high[0, ring]).astype(np.int64)


@dataclass(frozen=True, eq=False)
class Runs:
    """A mask of a whole image as lengths of its runs, column by column."""

    lengths: npt.NDArray[np.int64]  # (R,)
    where: str

    @property
    def area(self) -> int:
        """Pixels inside."""
        return int(self.lengths[1::2].sum())

    def parts(self, width: int, height: int) -> Iterator[Part]:
        """See `Region`."""
        inside = runs_to_mask(self.lengths, width, height, self.where)
        columns = np.flatnonzero(inside.any(axis=0))
        if len(columns):  # Most masks are small: of an image with forty, that halves the time.
            yield Part(0, int(columns[0]), inside[:, columns[0] : columns[-1] + 1])


@dataclass(frozen=True, eq=False)
class Bitmap:
    """A mask of a rectangle of the image, which may stick out of it."""

    left: int
    top: int
    inside: npt.NDArray[np.bool_]  # (h, w)

    def parts(self, width: int, height: int) -> Iterator[Part]:
        """See `Region`."""
        top, left = max(self.top, 0), max(self.left, 0)
        inside = self.inside[top - self.top :, left - self.left :][: max(height - top, 0), : max(width - left, 0)]
        if inside.size:
            yield Part(top, left, inside)


class Shape(NamedTuple):
    """A region with its label, or `UNKNOWN`."""

    label: int
    region: Region


class Drawing(NamedTuple):
    """What is annotated in one image of this size: shapes, the last of them on top."""

    width: int
    height: int
    shapes: list[Shape]

    def labels(self, camera: Camera, where: str) -> npt.NDArray[np.int32]:
        """Paint the labels (H, W) of the image that a camera took, 0 where there is no shape; scaled if need be.

        Raises `MaskFormatError` where a shape is broken, or there are more shapes than labels, and `MaskSizeError`
        where the image has another shape than the camera's.
        """
        self._check_count(where)
        check_fit(self.width, self.height, camera, where)
        return scaled(paint(self.shapes, self.width, self.height), camera)

    def nested(self, camera: Camera, where: str) -> Nested:
        """Paint the labels as `paint_nested` does, scaled if need be; raises as `labels` does."""
        self._check_count(where)
        check_fit(self.width, self.height, camera, where)
        painted = paint_nested(self.shapes, self.width, self.height)
        return painted._replace(labels=scaled(painted.labels, camera))

    def covered(self, where: str) -> float:
        """Tell the share of the image that has a shape; raises `MaskFormatError` as `labels` does."""
        self._check_count(where)
        return float((paint(self.shapes, self.width, self.height) > 0).mean())

    def _check_count(self, where: str) -> None:
        if len(self.shapes) > MAX_LABEL:
            raise MaskFormatError(f"{where}: has {len(self.shapes):,} shapes; expected at most {MAX_LABEL:,} in a view")


def paint(shapes: Iterable[Shape], width: int, height: int) -> npt.NDArray[np.int32]:
    """Paint shapes into a label image (H, W), each on top of those before it."""
    labels = np.zeros((height, width), np.int32)
    for label, region in shapes:
        for top, left, inside in region.parts(width, height):
            rows, columns = inside.shape
            labels[top : top + rows, left : left + columns][inside] = label
    return labels


class Nested(NamedTuple):
    """Labels of shapes that may lie in each other."""

    labels: npt.NDArray[np.int32]  # (H, W): 0 where there is no shape
    outermost: npt.NDArray[np.int32] | None = None  # (L,): by label, that of the outermost shape it is a part of
    of_everything: bool = False  # whether the background has shapes, too, so that what has none is not known

    def known(self) -> npt.NDArray[np.int32]:
        """Return the labels, with `UNKNOWN` where shapes that were drawn of everything are missing."""
        return np.where(self.labels == 0, np.int32(UNKNOWN), self.labels) if self.of_everything else self.labels


def paint_nested(shapes: Sequence[Shape], width: int, height: int) -> Nested:
    """Paint shapes as `paint` does, of which none is larger than those before it.

    A shape is a part of another one if nine tenths of it lie there.
    """
    columns = np.zeros((width, height), np.int32)  # As runs go, which takes half the time.
    outermost = np.arange(1 + max((shape.label for shape in shapes), default=0), dtype=np.int32)
    for label, region in shapes:
        below = [np.zeros(0, np.int32)]
        for top, left, inside in region.parts(width, height):
            inside = inside.T
            painted = columns[left : left + len(inside), top : top + inside.shape[1]]
            below.append(painted[inside])
            painted[inside] = label
        count = np.bincount(outermost[np.concatenate(below)], minlength=1)
        if count[1:].max(initial=0) >= max(_INSIDE * count.sum(), 1):
            outermost[label] = 1 + count[1:].argmax()
    return Nested(np.ascontiguousarray(columns.T), outermost)


def check_fit(width: int, height: int, camera: Camera, where: str) -> None:
    """Raise `MaskSizeError` unless a mask has the size of the camera's image, or becomes it by scaling, to a pixel."""
    expected = camera.image_size
    scale = (expected[0] * expected[1] / max(width * height, 1)) ** 0.5
    if max(abs(width * scale - expected[0]), abs(height * scale - expected[1])) > 1:
        turned = width * expected[0] == height * expected[1]
        hint = "; it lies on its side: make masks of photos as they are stored, not turned as their EXIF data say"
        raise MaskSizeError(
            f"{where}: is for an image of {width} x {height} pixels; expected {expected[0]} x {expected[1]}, the "
            f"size of camera '{clipped(camera.name)}', or the same larger or smaller{hint if turned else ''}"
        )


def scaled(labels: npt.NDArray[T], camera: Camera) -> npt.NDArray[T]:
    """Scale labels, or a mask, to the size of the image that a camera took: each pixel gets the label at its centre."""
    size = camera.image_size[::-1]
    if labels.shape == size:
        return labels
    rows, columns = (((np.arange(n) + 0.5) * m / n).astype(np.int64) for n, m in zip(size, labels.shape, strict=True))
    return labels[rows[:, None], columns]
