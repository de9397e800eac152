"""Where masks lie in the images that cameras see: whether they are moved, enlarged, squeezed or mirrored.

A network is often given an image padded to a square, or the square in its middle, or a mirrored one; and where that is
not undone, its masks have the size of the image and other pixels. From cameras whose photos agree with the scene, such
masks do not: their outlines lie beside edges of colour and depth. So outlines are changed in the ways that occur, laid
upon the edges at each distance (a product of Fourier transforms), and correlated with them over all views together.
Right masks fit best as they are.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from PIL import Image

from gsseg_core.align.agreement import EDGE_PX, Pictures, Shown, look_at
from gsseg_core.align.settings import AlignSettings
from gsseg_core.data.view import View

PIXELS = "expected masks in the pixels of the images"
THOROUGH = 18  # views by which masks are called misplaced; six are enough to see whether that is worth a look
_FEWEST = 6  # of these show enough; less tells too little
LEAST = 0.65  # of the best correlation, below which masks are misplaced; right ones of six labels have 0.72 at least
_CHANCE = 0.22  # correlation that masks of something else do not reach; where right ones do not either, nothing is said
_CLEAR = 1.35  # times the median of all changes is the best correlation at least; by chance it is 1.1 to 1.2
_SAME = 0.8  # correlation of edges that are seen from one place; from different ones they have 0.6 at most
_NEAR = 0.04  # share of the picture's side by which edges may lie beside outlines, as those of shadows do
_REACH = 0.25  # share of the picture's side up to which masks are moved
_ZOOMS = (0.8, 0.9, 1.1, 1.25)


class _Change(NamedTuple):
    """What is done to masks to see whether they fit better."""

    said: str
    stretch: tuple[float, float] = (1, 1)  # about the middle, of width and height
    flips: tuple[int, ...] = ()  # axes that are turned round: 0 of rows, 1 of columns

    def of(self, outlines: np.ndarray) -> np.ndarray:  # (S, S)
        """Change outlines, (S, S) float32."""
        outlines = np.flip(outlines, self.flips)
        if self.stretch == (1, 1):
            return outlines
        middle = np.array(outlines.shape) / 2
        half = middle / self.stretch
        image = Image.fromarray(np.ascontiguousarray(outlines))
        box = (*(middle - half), *(middle + half))
        return np.asarray(image.transform(image.size, Image.Transform.EXTENT, box, Image.Resampling.BILINEAR))


_AS_IT_IS = _Change("")


class MaskFit(NamedTuple):
    """How well masks lie on what they show, by the correlation of their outlines with edges of the scene."""

    as_they_are: float
    best: float  # after a change; at least what they have as they are
    change: str  # "" where they need none, or where none is clearly better

    def __str__(self) -> str:
        """Say in a sentence without its stop how masks would fit; "" where they do."""
        if not self.change:
            return ""
        return (
            "masks do not lie on what they show: their outlines agree with edges of the scene by "
            f"{max(self.as_they_are, 0):.2f}, and by {self.best:.2f} if masks are {self.change}"
        )


def misplaced(pictures: Pictures, few: Sequence[Shown], views: Sequence[View], settings: AlignSettings) -> MaskFit:
    """See whether masks should be changed to lie on what they show.

    `few` are masks of some of the views; where these seem to lie beside it, more of the views are looked at.
    """
    seems = how_they_lie(pictures, few, fewest=1)
    if seems.as_they_are >= LEAST * seems.best:
        return seems
    return how_they_lie(pictures, masks_of(views, replace(settings, views=THOROUGH)))


def masks_of(views: Sequence[View], settings: AlignSettings) -> list[Shown]:
    """Read the masks of some views, without those of few labels."""
    shown = look_at([replace(view, image_path=None) for view in views], settings)
    return [mask for mask in shown if mask.labels is not None and mask.telling]


def how_they_lie(pictures: Pictures, shown: Sequence[Shown], fewest: int = _FEWEST) -> MaskFit:
    """Compare the masks among some views with edges of the scene; of fewer than `fewest`, nothing is found."""
    shown, seen = _from_different_places(pictures, [mask for mask in shown if mask.labels is not None and mask.telling])
    if len(shown) < max(fewest, 1):
        return MaskFit(0.0, 0.0, "")
    side = len(shown[0].edges)
    padded, reach = (side + side // 3,) * 2, int(_REACH * side)
    shifts = np.arange(-reach, reach + 1)
    edges = [np.fft.rfft2(each, padded) for each in seen]
    as_they_are, best, found, moved, every = 0.0, 0.0, _AS_IT_IS, np.zeros(2), list[float]()
    for change in _changes(shown[0].seen):
        laid = [np.fft.rfft2(_centred(change.of(view.edges), view.seen), padded) for view in shown]
        product = sum(edge * one.conj() for edge, one in zip(edges, laid, strict=True))
        scores = np.fft.irfft2(product, padded)[np.ix_(shifts, shifts)] / len(shown)
        row, column = np.unravel_index(scores.argmax(), scores.shape)
        every.append(float(scores.max()))
        if change is _AS_IT_IS:
            as_they_are = float(scores[reach, reach])
        if every[-1] > best:
            best, found, moved = every[-1], change, np.array([shifts[column], shifts[row]]) / side
    by_chance = best < max(_CHANCE, _CLEAR * float(np.median(every)))
    if by_chance or as_they_are >= LEAST * best or (found is _AS_IT_IS and np.abs(moved).max() < _NEAR):
        return MaskFit(as_they_are, best, "")
    return MaskFit(as_they_are, best, _said(found, moved))


def _from_different_places(pictures: Pictures, shown: Sequence[Shown]) -> tuple[list[Shown], list[np.ndarray]]:
    """Leave out masks from where another is, as of a robot that stands still; gives edges of the scene besides."""
    kept, edges = list[Shown](), list[np.ndarray]()
    for view in shown:
        here = _centred(pictures.seen_by(view.camera).edges[1], view.seen)
        if all(float((here * other).sum()) < _SAME for other in edges):
            kept.append(view)
            edges.append(here)
    return kept, edges


def _changes(seen: np.ndarray) -> Iterator[_Change]:  # (S, S) bool: pixels that lie in the image
    """List what masks may need."""
    yield _AS_IT_IS
    yield from (
        _Change("mirrored", flips=(1,)),
        _Change("upside down", flips=(0,)),
        _Change("turned by half", flips=(0, 1)),
    )
    yield from (
        _Change(f"{'shrunk' if zoom < 1 else 'enlarged'} to {100 * zoom:.0f} %", (zoom, zoom)) for zoom in _ZOOMS
    )
    height, width = (int(seen.any(axis=axis).sum()) + 2 * EDGE_PX for axis in (1, 0))
    longer = max(height, width)
    padded, cut = (longer / width, longer / height), (height / longer, width / longer)
    if max(padded) > 1 + _NEAR:
        yield _Change("stretched, which undoes padding the images to squares", padded)
        yield _Change("squeezed, which undoes cutting squares out of the images", cut)


def _centred(picture: np.ndarray, seen: np.ndarray) -> np.ndarray:  # (S, S), (S, S) bool
    """Subtract the mean of what is seen, and scale to unit length; 0 elsewhere."""
    centred = np.where(seen, picture - picture[seen].mean() if seen.any() else 0, 0)
    return centred / max(float(np.linalg.norm(centred)), 1e-9)


def _said(change: _Change, moved: np.ndarray) -> str:  # (2,) shares of the picture's side, right and down
    ways = ((moved[0], "right", "left"), (moved[1], "down", "up"))
    parts = [
        f"{100 * abs(share):.0f} % {way if share > 0 else back}" for share, way, back in ways if abs(share) >= _NEAR
    ]
    if not parts:
        return change.said
    return f"{change.said}{' and ' * bool(change.said)}moved by {' and '.join(parts)} (of the longer side)"
