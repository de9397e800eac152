"""PlayCanvas SOG, version 2: lossless images in a zip, a pixel for each Gaussian, in the order given.

The format does not ask for the order that it is named after. Its other writers sort the Gaussians, which makes images a
little smaller, but labels in the order of the scene no longer fit.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.sog import PER_ROW

LARGEST_PALETTE = 1 << 16  # entries of the palette of harmonics; a scene of no more Gaussians loses nothing by it
_COARSE, _STEPS = 256, 2  # clusters that the palette is divided into, and steps of k-means
_AT_ONCE = 1 << 12
_SAMPLE = 1 << 20  # values, about, that a code book is fitted to


def write_sog(path: Path, scene: GaussianScene, run: str | None) -> None:
    """Write a scene as SOG, all in one file; the id of a run is in `asset.gsseg_run`."""
    images: dict[str, npt.NDArray[np.uint8]] = {}
    asset = {"generator": "gsseg", **({} if run is None else {"gsseg_run": run})}
    meta: dict[str, Any] = {"version": 2, "asset": asset, "count": len(scene)}

    def put(part: str, files: dict[str, npt.NDArray[np.uint8]], **numbers: object) -> None:
        images.update(files)
        meta[part] = {**numbers, "files": list(files)}

    logs = np.sign(scene.means) * np.log1p(np.abs(scene.means).astype(np.float64))
    low, high = logs.min(axis=0), logs.max(axis=0)
    steps = np.rint((logs - low) / np.where(high > low, high - low, 1) * 65535).astype(np.uint16)
    halves = {"means_l.webp": _pixels(steps & 255), "means_u.webp": _pixels(steps >> 8)}
    put("means", halves, mins=low.tolist(), maxs=high.tolist())
    book, codes = _coded(np.log(scene.scales))
    put("scales", {"scales.webp": _pixels(codes)}, codebook=book)
    put("quats", {"quats.webp": _pixels(_smallest_three(scene.quats))})
    book, codes = _coded(scene.sh[:, 0])
    alpha = np.rint(scene.opacities * 255).clip(1, 254)  # so that its logit is finite
    put("sh0", {"sh0.webp": _pixels(np.concatenate([codes, alpha[:, None]], axis=1))}, codebook=book)
    terms = scene.sh.shape[1] - 1
    if terms:
        palette, index = _palette(np.ascontiguousarray(scene.sh[:, 1:].reshape(len(scene), -1)))
        book, codes = _coded(palette)
        rows = np.zeros((-(-len(palette) // PER_ROW) * PER_ROW, 3 * terms), np.uint8)
        rows[: len(palette)] = codes
        files = {
            "shN_centroids.webp": rows.reshape(-1, PER_ROW * terms, 3),
            "shN_labels.webp": _pixels(np.stack([index & 255, index >> 8], axis=1)),
        }
        put("shN", files, count=len(palette), bands=scene.sh_degree, codebook=book)
    with zipfile.ZipFile(path, "w") as archive:
        # By a name alone, zipfile takes the time of now, which on a machine without a clock is too early for it.
        archive.writestr(zipfile.ZipInfo("meta.json"), json.dumps(meta))
        for name, image in images.items():
            content = io.BytesIO()
            Image.fromarray(image).save(content, "WEBP", lossless=True, exact=True, quality=50, method=2)
            archive.writestr(zipfile.ZipInfo(name), content.getvalue())


def _pixels(values: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:  # (N, C), whole numbers below 256
    """Lay values out as an image (H, W, 4), row by row; alpha is 255 where it is not given."""
    width = 4 * math.ceil(math.sqrt(len(values)) / 4)
    height = 4 * math.ceil(len(values) / width / 4)
    image = np.zeros((height * width, 4), np.uint8)
    image[:, 3] = 255
    image[: len(values), : values.shape[1]] = values
    return image.reshape(height, width, 4)


def _coded(values: npt.NDArray[np.float32]) -> tuple[list[float], npt.NDArray[np.uint8]]:  # (M, C)
    """Fit a code book of 256 values, and find the nearest for each value: Lloyd's quantiser, (256,) and (M, C).

    It starts from quantiles and even steps: quantiles alone would have too few codes for the few large values, even
    steps too few for the many small ones.
    """
    # Whole rows: every third number of all would be those of one axis, or of one colour.
    seen = np.sort(values[:: max(1, values.size // _SAMPLE)], axis=None).astype(np.float64)
    even = np.linspace(values.min(), values.max(), 128)
    book = np.sort(np.concatenate([np.quantile(seen, np.linspace(0, 1, 128)), even]))
    for _ in range(12):
        cells = np.searchsorted((book[1:] + book[:-1]) / 2, seen)
        count = np.bincount(cells, minlength=256)
        book = np.where(count > 0, np.bincount(cells, seen, 256) / np.maximum(count, 1), book)
    codes = np.searchsorted((book[1:] + book[:-1]) / 2, values).astype(np.uint8)
    return book.astype(np.float32).tolist(), codes


def _smallest_three(quats: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:  # (N, 4) w, x, y, z, unit
    """Code quaternions, (N, 4): the three smallest components, and 252 + the index of the largest, which they imply."""
    largest = np.abs(quats).argmax(axis=1)[:, None]
    signed = quats * np.where(np.take_along_axis(quats, largest, axis=1) < 0, -1, 1)
    others = signed[np.arange(4) != largest].reshape(-1, 3)
    coded = np.rint((others * math.sqrt(0.5) + 0.5) * 255).clip(0, 255)
    return np.concatenate([coded, 252 + largest], axis=1).astype(np.uint8)


def _palette(values: npt.NDArray[np.float32]) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int64]]:  # (N, D)
    """Choose entries (K, D) that stand for all values, and the index of the one for each, (N,).

    K-means of two levels: a few coarse clusters, and in each of them as many entries as fit its size. That compares
    each value with some hundreds of entries, not with tens of thousands.
    """
    if len(values) <= LARGEST_PALETTE:
        return values, np.arange(len(values))
    rng = np.random.default_rng(0)
    _, coarse = _k_means(values, _COARSE, rng)
    order = np.argsort(coarse, kind="stable")
    entries, index, total = [], np.empty(len(values), np.int64), 0
    for own in np.split(order, np.cumsum(np.bincount(coarse, minlength=_COARSE))[:-1]):
        if len(own):
            fine, nearest = _k_means(values[own], 1 + len(own) * (LARGEST_PALETTE - _COARSE) // len(values), rng)
            index[own] = total + nearest
            entries.append(fine)
            total += len(fine)
    return np.concatenate(entries), index


def _k_means(
    values: npt.NDArray[np.float32],  # (M, D)
    count: int,
    rng: np.random.Generator,
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int64]]:
    """Lloyd's k-means from at most `count` entries drawn at random: (K, D), and the nearest of each value, (M,)."""
    if count >= len(values):
        return values, np.arange(len(values))
    entries = values[rng.choice(len(values), count, replace=False)]
    # Where many values are the same, as zeros are, all would be compared with the same entry again and again.
    _, first = np.unique(entries.view(f"V{entries.itemsize * entries.shape[1]}"), return_index=True)
    entries, count = entries[np.sort(first)], len(first)
    for step in range(_STEPS):
        # Where entries go, a sample of the values tells well enough, if there are many for each entry.
        sample = values if step == _STEPS - 1 else values[rng.permutation(len(values))[: max(count * 64, 1 << 14)]]
        index = _nearest(entries, sample)
        order, number = np.argsort(index, kind="stable"), np.bincount(index, minlength=count)
        filled = np.flatnonzero(number)
        starts = np.concatenate([[0], np.cumsum(number[filled])[:-1]])
        entries[filled] = np.add.reduceat(sample[order], starts) / number[filled, None]
    return entries, _nearest(entries, values)


def _nearest(entries: npt.NDArray[np.float32], values: npt.NDArray[np.float32]) -> npt.NDArray[np.int64]:
    """Index (M,) of the entry (K, D) that is nearest to each value (M, D)."""
    half = 0.5 * (entries * entries).sum(axis=1)
    parts = [
        (half - values[first : first + _AT_ONCE] @ entries.T).argmin(axis=1)
        for first in range(0, len(values), _AT_ONCE)
    ]
    return np.concatenate(parts)
