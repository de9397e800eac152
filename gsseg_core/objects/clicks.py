"""Clicks in a view become a mask: the region around each that outlives all others while regions merge.

The view is rendered and cut into cells. Each is a region at first, with mean features mu: colours and normals, which
are the shortest axes of the Gaussians, turned to the camera. Of all regions that share a border, those two merge for
which

    |A| |B| / (|A| + |B|) |mu_A - mu_B|^2 / length of their border

is least: what the piecewise constant Mumford-Shah energy loses by it, for each unit of border that it saves, so that a
rising price of borders runs through all scales, from cells to the whole view (Koepfler, Lopez & Morel 1994). An object
stands out from what is around it: its region is there from a low price to a high one. So the region of a click is the
one around it whose price at its end is the largest multiple of that at its birth. No size, colour or threshold is set.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.errors import NoUsableViewsError, SettingsError
from gsseg_core.kernels.compiler import kernel
from gsseg_core.raster.backends import make_operator
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.quaternions import rotations

CELLS = 160  # along the longer side of the view, at most
FEATURE_WEIGHTS = (1.0, 0.3)  # of colour and normal, each divided by its standard deviation over the view
LEAST, MOST = 0.002, 0.7  # shares of the view: a smaller region is noise, and a larger one no object
Pixel = tuple[int, int]  # row and column


class MergeTree(NamedTuple):
    """Regions as they merge, n cells first and then one region per merge; the last is everything."""

    parent: np.ndarray  # (2 n - 1,) int64: what a region merges into; itself for the last
    price: np.ndarray  # (2 n - 1,) float64: of a unit of border when it came into being, never falling; 0 for cells
    size: np.ndarray  # (2 n - 1,) int64: cells


def click_labels(
    scene: GaussianScene, camera: Camera, inside: Sequence[Pixel], outside: Sequence[Pixel] = (), *, device: str = "cpu"
) -> np.ndarray:
    """Make labels for `gsseg_core.objects.pick.pick_mask` of clicks in a view, (H, W) int32.

    They are 1 for the object, 0 for what is not it, and -1 in the cells around it. Each pixel `inside`, at least one,
    adds the region around it; no region holds one that is `outside`.

    Raises `SettingsError` where there is no such pixel, no click inside, or a pixel is clicked as both, and
    `NoUsableViewsError` where a click inside shows no Gaussian.
    """
    # As tuples, which sets can hold: of JSON they are lists, of NumPy rows.
    inside, outside = ([camera.checked_pixel(*click) for click in clicks] for clicks in (inside, outside))
    if not inside or set(inside) & set(outside):
        raise SettingsError(
            f"clicks: {len(inside)} inside, {len(set(inside) & set(outside))} of them outside too; expected at least "
            "one inside, and none that is both"
        )
    from scipy import ndimage  # Loaded here: whoever only warms up does without.

    features, covered = _features(scene, camera, device)
    for row, column in inside:
        if covered[row, column] <= 0:
            raise NoUsableViewsError(
                f"view '{camera.name}': no Gaussian is seen at row {row}, column {column}; "
                "expected a click on something"
            )
    side = -(-max(camera.width, camera.height) // CELLS)
    shape = -(-camera.height // side), -(-camera.width // side)
    cell_of = (np.arange(camera.height) // side)[:, None] * shape[1] + np.arange(camera.width) // side
    count = np.bincount(cell_of.ravel())
    means = [np.bincount(cell_of.ravel(), feature.ravel()) / count for feature in np.moveaxis(features, 2, 0)]
    tree = merge_tree(np.stack(means, axis=1).reshape(*shape, -1))
    hit, without = ([int(cell_of[row, column]) for row, column in clicks] for clicks in (inside, outside))
    region = np.any([_members(tree, longest_lived(tree, cell, without)) for cell in hit], axis=0)
    region[without] = False
    region = region.reshape(shape)
    # Blended edges are regions of their own for long, so that a region tends to end before its object does.
    labels = np.where(region, 1, np.where(ndimage.binary_dilation(region), UNKNOWN, 0)).astype(np.int32).ravel()
    labels[without] = 0
    out: np.ndarray = labels[cell_of]
    for value, clicks in ((1, inside), (0, outside)):
        for row, column in clicks:
            out[row, column] = value
    return out


def longest_lived(tree: MergeTree, cell: int, without: Sequence[int] = ()) -> int:
    """Find the region around a cell, and not around some others, that lives over the largest ratio of prices."""
    others = {region for other in without if other != cell for region in _ancestors(tree, other)}
    chain = [region for region in _ancestors(tree, cell) if region not in others]
    few, most = min(LEAST * tree.size[-1], int(tree.size[chain[-1]])), MOST * tree.size[-1]
    floor = 1e-6 * tree.price[-1]  # painted areas of one colour merge for nothing
    born, gone = (np.maximum(tree.price[at], floor) for at in (chain, tree.parent[chain]))
    fits = (tree.size[chain] >= few) & ((tree.size[chain] <= most) | (len(chain) == 1))
    return int(chain[int(np.where(fits, gone / np.maximum(born, 1e-300), 0).argmax())])


def merge_tree(features: np.ndarray) -> MergeTree:
    """Merge the cells of a grid (h, w, D) of features, at the least price first, until one region is left."""
    height, width = features.shape[:2]
    return MergeTree(*_merge(np.ascontiguousarray(features.reshape(height * width, -1), np.float64), height, width))


@kernel
def _price(means: np.ndarray, size: np.ndarray, a: int, b: int, border: int) -> float:
    distance = 0.0
    for d in range(means.shape[1]):
        distance += (means[a, d] - means[b, d]) ** 2
    return size[a] * size[b] / (size[a] + size[b]) * distance / border


@kernel
def _twice_as_long(values: np.ndarray) -> np.ndarray:  # (E,) int64
    longer = np.empty(2 * values.shape[0], np.int64)
    for e in range(values.shape[0]):
        longer[e] = values[e]
    return longer


@kernel
def _merge(cells: np.ndarray, height: int, width: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Merge; a region's neighbours are listed by the names that they had when it came into being.

    Loops stand where NumPy would append and assign: with the texts of its errors, that takes twice as long to compile.
    """
    n = height * width
    means, size = np.empty((2 * n - 1, cells.shape[1])), np.ones(2 * n - 1, np.int64)
    for i in range(n):
        for d in range(cells.shape[1]):
            means[i, d] = cells[i, d]
    parent, price = np.arange(2 * n - 1), np.zeros(2 * n - 1)
    current = np.arange(2 * n - 1)  # the region of today that holds each one, up to shortcuts
    start, stop = np.zeros(2 * n - 1, np.int64), np.zeros(2 * n - 1, np.int64)
    near, borders = np.empty(16 * n, np.int64), np.empty(16 * n, np.int64)  # grow as they must
    length, used = np.zeros(2 * n - 1, np.int64), 0
    waiting = [(0.0, 0, 0)]
    waiting.pop()
    for i in range(n):
        row, column = i // width, i % width
        start[i] = used
        for dr, dc in ((0, 1), (1, 0), (0, -1), (-1, 0)):
            if 0 <= row + dr < height and 0 <= column + dc < width:
                j = i + dr * width + dc
                near[used], borders[used] = j, 1
                used += 1
                if j > i:
                    heapq.heappush(waiting, (_price(means, size, i, j, borders[used - 1]), i, j))
        stop[i] = used
    highest = 0.0
    for new in range(n, 2 * n - 1):
        least, a, b = heapq.heappop(waiting)
        while parent[a] != a or parent[b] != b:  # one of them is part of a larger region by now
            least, a, b = heapq.heappop(waiting)
        highest = max(highest, least)
        price[new], size[new] = highest, size[a] + size[b]
        for d in range(means.shape[1]):
            means[new, d] = (size[a] * means[a, d] + size[b] * means[b, d]) / size[new]
        parent[a] = parent[b] = current[a] = current[b] = new
        most = stop[a] - start[a] + stop[b] - start[b]
        if used + most > near.shape[0]:
            near, borders = _twice_as_long(near), _twice_as_long(borders)
        start[new] = used
        for old in (a, b):
            for e in range(start[old], stop[old]):
                other = near[e]
                while current[other] != other:
                    current[other] = current[current[other]]
                    other = current[other]
                if other == new:
                    continue
                if length[other] == 0:
                    near[used] = other
                    used += 1
                length[other] += borders[e]
        stop[new] = used
        for e in range(start[new], used):
            other = near[e]
            borders[e], length[other] = length[other], 0
            heapq.heappush(waiting, (_price(means, size, other, new, borders[e]), other, new))
    return parent, price, size


def _features(scene: GaussianScene, camera: Camera, device: str) -> tuple[np.ndarray, np.ndarray]:
    """Blend colours and normals into a view, weighted, (H, W, 6); and how much of each pixel they cover."""
    turns = rotations(scene.quats.astype(np.float64))
    normals = turns[np.arange(len(scene)), :, scene.scales.argmin(axis=1)]
    normals *= -np.sign((normals * (scene.means - camera.center)).sum(axis=1, keepdims=True))
    # Square roots: a step between dark tones looks as large as one between bright ones.
    carried = np.concatenate([np.sqrt(scene.colors(camera.center)), normals], axis=1)
    image, left_over = make_operator(scene, camera, device).blend(carried.astype(np.float32))
    for k, weight in enumerate(FEATURE_WEIGHTS):
        part = image[..., 3 * k : 3 * k + 3]
        deviation = float(np.sqrt(part.reshape(-1, 3).var(axis=0).sum()))
        part *= weight / max(deviation, 1e-12)
    return image, 1 - left_over


def _ancestors(tree: MergeTree, cell: int) -> list[int]:
    chain = [cell]
    while tree.parent[chain[-1]] != chain[-1]:
        chain.append(int(tree.parent[chain[-1]]))
    return chain


def _members(tree: MergeTree, region: int) -> np.ndarray:
    """Mark the cells of a region, (n,) bool."""
    part = np.zeros(len(tree.parent), bool)
    part[region] = True
    for below in range(region - 1, -1, -1):  # parents have larger numbers
        part[below] |= part[tree.parent[below]]
    return part[: (len(part) + 1) // 2]
