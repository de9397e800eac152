"""How well a scene, as cameras of a dataset see it, agrees with what their photos or masks show.

A view is compared as a small square picture about its principal point, so that a camera turned about its axis by a
quarter sees the same picture turned. Edges are compared, by normalised cross correlation, since those of a photo stay
where they are in another light. Masks have no edges of light but outlines, which lie at edges of colour or depth; and
their regions have colours of their own, so the share of the rendered variance that they explain counts, too.

How much pictures of different places agree by chance depends on the scene: views of a table are much alike, those of
rooms are not. So each rendering is also compared with what the other views show, and with its own view upside down.
Only what a view scores above that counts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from PIL import Image

from gsseg_core.align.settings import AlignSettings
from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.data.view import View, spread
from gsseg_core.errors import GssegError
from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.constants import NEAR
from gsseg_core.raster.depth import colours_and_depth
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.several_at_once import several_at_once

LUMINANCE = np.array([0.299, 0.587, 0.114], np.float32)  # of RGB, ITU-R BT.601
EDGE_PX = 3  # px of a picture along the border of its image whose edges are not compared
_REACH = 4  # px to either side that are weighed by the filter, a Gaussian of 1 px standard deviation
_BLUR = np.exp(-0.5 * np.arange(-_REACH, _REACH + 1, dtype=np.float32) ** 2)  # its weights
_BLUR /= _BLUR.sum()
_SLOPE = np.arange(-_REACH, _REACH + 1, dtype=np.float32) * _BLUR  # of a blurred picture, a px
_WIDEST = 1e4  # tangent of half the field of view; a camera that claims more is broken
_CUT = 0.01  # share of what cameras look at that may be too near to be drawn; of scenes of a usual size it is none
ROUNDED = 0.5  # standard deviations of Gaussians that float32 may move them by; from there on labels get worse
_LABELS = 5  # of a mask whose outlines tell where it belongs
_NEAREST = 1e-3  # depth in scene units below which logarithms are not taken


class Rendered(NamedTuple):
    """A scene as a square camera sees it."""

    edges: np.ndarray  # (2, S, S) float32: of the luminance, and of colours and depth together
    colours: np.ndarray  # (S, S, 3) float32

    def turned(self, quarters: int) -> Rendered:
        """Turn the camera clockwise about its axis, by quarters of a turn."""
        edges = np.rot90(self.edges, quarters, (1, 2))
        return Rendered(edges, np.rot90(self.colours, quarters))


@dataclass(frozen=True, eq=False)
class Shown:
    """What a view shows, to be compared with a rendering."""

    camera: Camera  # of the view, square, of S x S px with the principal point in the middle
    seen: np.ndarray  # (S, S) bool: pixels that lie in the view
    edges: np.ndarray  # (S, S) float32: edges of the photo, or outlines of the mask
    labels: np.ndarray | None = None  # (S, S) int32: regions of the mask, negative where unknown; not of a photo

    @property
    def telling(self) -> bool:
        """Whether it tells of its place: outlines of a few small things lie upon edges by chance as often as not."""
        return self.labels is None or len(np.unique(self.labels)) >= _LABELS

    def score(self, rendered: Rendered) -> float:
        """Compare with a rendering: 0 to 1."""
        edges = rendered.edges[0 if self.labels is None else 1]
        score: float = max(_correlation(edges[self.seen], self.edges[self.seen]), 0.0)
        if self.labels is None:
            return score
        known = self.seen & (self.labels >= 0)
        return (score + math.sqrt(_explained(rendered.colours[known], self.labels[known]))) / 2

    def upside_down(self) -> Shown:
        """Turn what it shows by half a turn."""
        labels = None if self.labels is None else np.rot90(self.labels, 2)
        return replace(self, seen=np.rot90(self.seen, 2), edges=np.rot90(self.edges, 2), labels=labels)


@dataclass(frozen=True)
class Agreement:
    """How well a scene agrees with some views."""

    compared: str  # with their 'photos' or their 'masks'
    views: int  # how many
    score: float  # of the views, 0 to 1
    chance: float  # of pictures that do not belong together
    agrees: bool | None  # whether cameras and scene belong together; None where that is undecided
    too_near: float = 0.0  # share of the Gaussians in the views' pictures that are too near to be drawn
    telling: bool = True  # whether views show enough to say that cameras and scene do not belong together
    misplaced: str = ""  # how masks lie beside what they show, where that was looked at; "" where they do not

    @property
    def margin(self) -> float:
        """By how much views score better than pictures that do not belong together."""
        return self.score - self.chance

    @property
    def doubt(self) -> str:
        """Say in a sentence without its stop that cameras and scene may not belong together; "" where they do."""
        if self.agrees:
            return ""
        if not self.telling:
            return f"{self.compared} with so few labels cannot show whether the cameras fit the scene"
        looks = "hardly looks" if self.agrees is None else "does not look"
        return f"the scene {looks} like the {self.compared} from these cameras"

    @property
    def nearness(self) -> str:
        """Say in a sentence without its stop that a scene is too small to be drawn whole; "" if it is not."""
        if self.too_near < _CUT:
            return ""
        return (
            f"{100 * self.too_near:.0f} % of what cameras look at is nearer to them than {NEAR} scene units, where "
            "nothing is drawn: scale scene and cameras up by the same factor, as from kilometres to metres"
        )

    def __str__(self) -> str:
        """Describe it for people."""
        return f"agreement with {self.views} {self.compared} {self.score:.2f}, by chance {self.chance:.2f}"


def far_off(rounding: float) -> str:
    """Say in a sentence without its stop that a scene is too far from its origin for float32; "" if it is not."""
    if rounding < ROUNDED:
        return ""
    return (
        f"the scene is so far from its origin that float32 moves Gaussians by up to {rounding:.2g} times their size "
        "(the median): take the same offset from Gaussians and cameras where they still are float64, as before UTM "
        "coordinates are written into the scene"
    )


@dataclass(frozen=True, eq=False)
class Pictures:
    """A scene of few Gaussians, as cameras see it; each camera's picture is rendered once."""

    few: GaussianScene  # thinned out
    device: str
    _kept: dict[bytes, Rendered] = field(default_factory=dict, init=False)

    @classmethod
    def of(cls, scene: GaussianScene, settings: AlignSettings, device: str = "cpu") -> Pictures:
        """Thin a scene out."""
        return cls(thinned(scene, settings.gaussians), device)

    def seen_by(self, camera: Camera) -> Rendered:
        """Give the picture of a camera."""
        place = camera.K.tobytes() + camera.world_to_camera.tobytes()
        if place not in self._kept:
            self._kept[place] = render(self.few, camera, self.device)
        return self._kept[place]


def look_at(views: Sequence[View], settings: AlignSettings) -> list[Shown]:
    """Read what some views show: their photos, if there are any, else their masks; those that are broken are left out.

    Views are spread evenly over those that have what is compared.
    """
    for readable, read in ((lambda view: view.image_path is not None, _photo), (lambda view: view.has_mask, _mask)):
        shown = []
        for view in spread([view for view in views if readable(view)], settings.views):
            try:
                picture = read(view, settings.picture_px)
            except GssegError:  # Learning from it reports what is wrong.
                continue
            if picture is not None:
                shown.append(picture)
        if shown:
            return shown
    return []


def agreement(pictures: Pictures, shown: Sequence[Shown], settings: AlignSettings) -> Agreement | None:
    """Compare a scene with views, at least one, each from its own camera; None if there is none."""
    if not shown:
        return None

    def compared(view: Shown) -> tuple[float, list[float]]:
        """Render a view, and score its own picture upside down, and the pictures of all views."""
        picture = pictures.seen_by(view.camera)
        return view.upside_down().score(picture), [each.score(picture) for each in shown]

    upside_down, rows = zip(*several_at_once(compared, shown, pictures.device), strict=True)
    scores, turned = np.array(rows), float(np.mean(upside_down))
    score, own = float(np.diag(scores).mean()), np.eye(len(shown), dtype=bool)
    # Of a robot that stands still all views are the same, and of an endless floor both ways up.
    chance = min(turned, float(scores[~own].mean())) if len(shown) > 1 else turned
    photos = shown[0].labels is None
    disagrees, agrees = settings.photo_margins if photos else settings.mask_margins
    too_near, telling = _too_near(pictures.few, [view.camera for view in shown]), any(view.telling for view in shown)
    found = Agreement("photos" if photos else "masks", len(shown), score, chance, None, too_near, telling)
    verdict = True if found.margin >= agrees else False if telling and found.margin < disagrees else None
    return replace(found, agrees=verdict)


def _too_near(scene: GaussianScene, cameras: Sequence[Camera]) -> float:
    """Share of the centres in the images of some cameras that are nearer than what is drawn."""
    near = inside = 0
    for camera in cameras:
        projection = camera.K @ camera.world_to_camera[:3]
        x, y, z = projection[:, :3] @ scene.means.T + projection[:, 3:]  # Pixels times depth; no division is needed.
        seen = (z > 0) & (x >= 0) & (x < camera.width * z) & (y >= 0) & (y < camera.height * z)
        near, inside = near + int((seen & (z < NEAR)).sum()), inside + int(seen.sum())
    return near / inside if inside else 0.0


def thinned(scene: GaussianScene, most: int) -> GaussianScene:
    """Draw `most` Gaussians of a scene at random, always the same, and make up for the others; fewer stay as they are.

    Of N Gaussians, each of those drawn stands for k = N / most. It covers sqrt(k) times its area, and within it lets
    through what sqrt(k) of its kind would let through one behind the other: 1 - (1 - opacity)^sqrt(k). Area alone would
    blur, and opacity alone leave holes.
    """
    if len(scene) <= most:
        return scene
    part = scene.subset(np.sort(np.random.default_rng(0).permutation(len(scene))[:most]))
    share = (len(scene) / most) ** 0.5
    opacities = 1 - (1 - part.opacities.astype(np.float64)) ** share
    below_one = np.minimum(opacities, np.nextafter(np.float32(1), np.float32(0))).astype(np.float32)
    return replace(part, scales=part.scales * np.float32(share**0.5), opacities=below_one)


def render(scene: GaussianScene, camera: Camera, device: str = "cpu") -> Rendered:
    """Render a scene for comparison with what views show."""
    image, left_over = colours_and_depth(scene, make_operator(scene, camera, device))
    colours, coverage = image[..., :3], np.maximum(1 - left_over, _NEAREST)
    light = _edges(colours @ LUMINANCE)
    depth = np.minimum(_gradient(np.log(np.maximum(image[..., 3] / coverage, _NEAREST))), 1)
    colour = np.sqrt(np.sqrt(sum(_gradient(colours[..., i]) ** 2 for i in range(3))))
    both = sum(edges / max(float(edges.std()), 1e-6) for edges in (colour, np.sqrt(depth)))
    return Rendered(np.stack([light, both]).astype(np.float32), colours)


def _photo(view: View, picture_px: int) -> Shown | None:
    photo = view.read_photo()
    if photo is None:
        return None
    window = _Window.of(view.camera, picture_px)
    light = window.cut(Image.fromarray(photo).convert("L"), Image.Resampling.BILINEAR)
    return Shown(window.camera, window.seen, _edges(light.astype(np.float32) / 255))


def _mask(view: View, picture_px: int) -> Shown | None:
    labels = replace(view, class_names=None).read_labels()  # Names say nothing of outlines, nor of a view's own ids.
    window = _Window.of(view.camera, picture_px)
    outlines = np.zeros(labels.shape, np.float32)
    outlines[1:] = labels[1:] != labels[:-1]
    outlines[:, 1:] = np.maximum(outlines[:, 1:], labels[:, 1:] != labels[:, :-1])
    if not outlines.any():  # As where nothing was found: from wherever it was seen, it would look so.
        return None
    edges = window.cut(Image.fromarray(outlines), Image.Resampling.BILINEAR)
    regions = window.cut(Image.fromarray(labels), Image.Resampling.NEAREST)
    return Shown(window.camera, window.seen, _filtered(edges, _BLUR, _BLUR), np.where(window.seen, regions, UNKNOWN))


class _Window(NamedTuple):
    """The square about the principal point that holds the whole image of a camera."""

    camera: Camera  # sees the square
    box: tuple[float, float, float, float]  # left, top, right, bottom in the image, px
    seen: np.ndarray  # (S, S) bool: pixels whose edges come from the image alone

    @classmethod
    def of(cls, camera: Camera, side: int) -> _Window:
        """Make the window of `side` x `side` px."""
        focal, principal, size = camera.K[[0, 1], [0, 1]], camera.K[:2, 2], np.array([camera.width, camera.height])
        with np.errstate(over="ignore"):
            # The tangent of half the field of view.
            reach = min(float((np.maximum(principal, size - principal) / focal).max()), _WIDEST)
        corners = principal - reach * focal, principal + reach * focal
        K = np.array([[side / 2 / reach, 0, side / 2], [0, side / 2 / reach, side / 2], [0, 0, 1]])
        centres = (np.arange(side)[:, None] + 0.5) / side * (corners[1] - corners[0]) + corners[0]  # (S, 2)
        margin = EDGE_PX * 2 * reach * focal / side
        columns, rows = ((centres > margin) & (centres < size - margin)).T
        seen = rows[:, None] & columns[None]
        window = cls(replace(camera, width=side, height=side, K=K), (*corners[0], *corners[1]), seen)
        if camera.undistortion is None:
            return window
        reached = window.cut(Image.fromarray(camera.undistortion.reached), Image.Resampling.NEAREST)
        around = sliding_window_view(np.pad(reached, EDGE_PX), (2 * EDGE_PX + 1, 2 * EDGE_PX + 1))
        return window._replace(seen=seen & around.all(axis=(2, 3)))

    def cut(self, image: Image.Image, resampling: Image.Resampling) -> np.ndarray:
        """Cut the square out of the camera's image, (S, S); black where it shows nothing."""
        size = self.camera.width, self.camera.height
        averages = resampling != Image.Resampling.NEAREST
        shrunk = max(1, int(min((self.box[2] - self.box[0]) / size[0], max(image.size)))) if averages else 1
        box = tuple(edge / shrunk for edge in self.box)
        return np.asarray(image.reduce(shrunk).transform(size, Image.Transform.EXTENT, box, resampling))


def _edges(picture: np.ndarray) -> np.ndarray:  # (S, S)
    """Edges of a picture, the square root of the gradient, so that a few strong ones are not all that counts."""
    return np.sqrt(_gradient(picture))


def _gradient(picture: np.ndarray) -> np.ndarray:  # (S, S)
    return np.hypot(_filtered(picture, _SLOPE, _BLUR), _filtered(picture, _BLUR, _SLOPE))


def _filtered(picture: np.ndarray, down: np.ndarray, across: np.ndarray) -> np.ndarray:  # (S, S), (T,), (T,)
    """Weigh the neighbours of each pixel; SciPy's filters take longer to load than all pictures that are compared."""
    columns = sliding_window_view(np.pad(picture, _REACH, "symmetric"), len(down), 0) @ down
    filtered: np.ndarray = sliding_window_view(columns, len(across), 1) @ across
    return filtered


def _correlation(first: np.ndarray, second: np.ndarray) -> float:  # (P,), (P,)
    """Normalised cross correlation, -1 to 1; 0 where one of the two is flat."""
    if not first.size:
        return 0.0
    first, second = first - first.mean(), second - second.mean()
    size = float(np.sqrt((first @ first) * (second @ second)))
    return float(first @ second) / size if size > 1e-9 else 0.0


def _explained(colours: np.ndarray, labels: np.ndarray) -> float:  # (P, 3), (P,)
    """Share of the variance of colours that lies between regions, 0 to 1."""
    _, regions, counts = np.unique(labels, return_inverse=True, return_counts=True)
    offsets = colours - (colours.mean(axis=0) if len(colours) else 0)
    total = float((offsets**2).sum())
    sums = np.stack([np.bincount(regions, offsets[:, i], len(counts)) for i in range(3)])
    return float((sums**2 / counts).sum()) / total if total > 1e-6 else 0.0
