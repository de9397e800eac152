"""A trained 3DGS scene: validated, activated arrays over the PLY vertices that they came from."""

from __future__ import annotations

import hashlib
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property, reduce
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gsseg_core.errors import EmptySceneError, ScenePropertyError, SceneValueError
from gsseg_core.files.limits import LIMITS
from gsseg_core.scene import spherical_harmonics
from gsseg_core.scene.ply import write_vertices
from gsseg_core.scene.scene_formats import read_scene
from gsseg_core.scene.scene_ids import read_ids
from gsseg_core.scene.vertices import (
    BLOCK,
    DC,
    GEOMETRY,
    MEANS,
    OPACITY,
    QUATS,
    REST_COUNTS,
    SCALES,
    check_properties,
    chosen,
    columns,
    logits,
    pack_vertices,
    rest_of,
)

ACTIVATED = ("means", "quats", "scales", "opacities")  # arrays of a scene, a row for each Gaussian

_FLOAT32_MAX = float(np.finfo(np.float32).max)
# Logits and log scales beyond these change nothing that can be seen, but the activated values would leave (0, 1), or
# their squares the range of float32.
_MAX_LOGIT = 16.0
_MAX_LOG_SCALE = 40.0
_AT_ONCE = 1 << 18  # numbers that fit into the cache of a processor


@dataclass(frozen=True, eq=False)
class GaussianScene:
    """The Gaussians of a scene. Make one with `load` or `from_arrays`; every instance is valid and not empty.

    Attributes
    ----------
    means : ndarray (N, 3) float32
        Centres, in scene units.
    quats : ndarray (N, 4) float32
        Unit quaternions w, x, y, z.
    scales : ndarray (N, 3) float32
        Standard deviations along the local axes, in scene units, > 0. Limited to exp(-40)..exp(40).
    opacities : ndarray (N,) float32
        In (0, 1). Logits, which may be infinite, are limited to -16..16.
    vertices : ndarray (N,) structured
        The PLY vertices as read, all properties: what `subset` and `save` carry on exactly.
    path : pathlib.Path or None
        Where the scene was loaded from.
    """

    means: npt.NDArray[np.float32]  # (N, 3)
    quats: npt.NDArray[np.float32]  # (N, 4)
    scales: npt.NDArray[np.float32]  # (N, 3)
    opacities: npt.NDArray[np.float32]  # (N,)
    vertices: npt.NDArray[np.void] = field(repr=False)  # (N,)
    path: Path | None = None

    @classmethod
    def load(cls, path: str | os.PathLike[str], within: Path | None = None) -> GaussianScene:
        """Load a scene of any of `gsseg_core.scene.scene_formats.SCENE_FORMATS`; Gaussian i is record i of the file.

        A 3DGS PLY has SH degree 0 to 4, of which those above 3 are left out, is ascii or binary, float or double, with
        properties in any order. With `within`, the file must lie below that folder, links followed.

        Raises
        ------
        SceneFileError
            The file is missing, truncated, or of no known format.
        ScenePropertyError
            Properties of 3DGS are missing or are lists.
        SceneValueError
            Values are NaN or infinite, but for logits of opacities 0 and 1 and the logarithm of a scale of 0, or
            quaternions are zero.
        EmptySceneError
            There is no Gaussian.
        PathNotAllowedError
            The file lies outside `within`.
        """
        path = Path(path)
        return cls.from_vertices(read_scene(path, within).vertices, path)

    @classmethod
    def from_arrays(
        cls,
        means: npt.ArrayLike,
        quats: npt.ArrayLike,
        scales: npt.ArrayLike,
        opacities: npt.ArrayLike,
        sh: npt.ArrayLike,
    ) -> GaussianScene:
        """Build a scene from activated values; it equals what `load` reads back after `save`.

        Parameters
        ----------
        means : array (N, 3)
            Centres.
        quats : array (N, 4)
            Quaternions w, x, y, z, of any length but zero.
        scales : array (N, 3)
            Standard deviations, > 0.
        opacities : array (N,)
            In [0, 1]; kept 1e-7 away from the ends, where the logit of the PLY is infinite.
        sh : array (N, (d + 1)^2, 3)
            Coefficients of spherical harmonics of degree d = 0..3, RGB last.

        Raises
        ------
        SceneValueError
            Shapes disagree, or values are out of range, NaN or infinite.
        EmptySceneError
            There is no Gaussian.
        """
        given = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "sh": sh}
        arrays = {name: np.asarray(values, np.float64) for name, values in given.items()}
        n = len(np.atleast_1d(arrays["means"]))
        shapes: dict[str, list[tuple[int, ...]]] = {
            "means": [(n, 3)], "quats": [(n, 4)], "scales": [(n, 3)], "opacities": [(n,)],
            "sh": [(n, (d + 1) ** 2, 3) for d in range(spherical_harmonics.MAX_DEGREE + 1)],
        }  # fmt: skip
        for name, array in arrays.items():
            if array.shape not in shapes[name]:
                expected = " or ".join(map(str, shapes[name]))
                raise SceneValueError(f"scene: {name} has shape {array.shape}; expected {expected}")
        if not (arrays["scales"] > 0).all():
            raise SceneValueError("scene: scales hold values that are NaN or not positive; expected all > 0")
        if not ((arrays["opacities"] >= 0) & (arrays["opacities"] <= 1)).all():
            raise SceneValueError("scene: opacities hold values that are NaN or outside [0, 1]")

        dc, rest = arrays["sh"][:, 0], arrays["sh"][:, 1:]
        opacities, log_scales = logits(arrays["opacities"]), np.log(arrays["scales"])
        vertices = pack_vertices(arrays["means"], arrays["quats"], log_scales, opacities, dc, rest)
        return cls.from_vertices(vertices, None)

    @classmethod
    def from_vertices(cls, vertices: npt.NDArray[np.void], path: Path | None) -> GaussianScene:
        """Build a scene from the vertices of a PLY, validated and activated; raises what `load` raises of values."""
        source = "scene" if path is None else str(path)
        sh_names = _sh_names(vertices, source)
        if len(vertices) == 0:
            raise EmptySceneError(f"{source}: holds no Gaussian (0 vertices); expected at least one")
        if not _all_within(vertices, min(_FLOAT32_MAX, LIMITS.max_value)):
            most, finite = LIMITS.max_value, _FLOAT32_MAX
            for names, what, low, high in (
                # Converters from bytes write logits of opacities 0 and 1, and the logarithm of a scale of 0.
                (OPACITY, "opacities", -np.inf, np.inf), (SCALES, "scales", -np.inf, finite),
                (QUATS, "rotations", -finite, finite), (MEANS, "positions", -most, most),
                (sh_names, "SH coefficients", -most, most),
            ):  # fmt: skip
                _check_within(columns(vertices, names), what, source, low, high)
        means, quats, scales, opacities = _activated(vertices)
        zero = np.flatnonzero(np.isnan(quats[:, 0]))
        if zero.size:
            raise SceneValueError(
                f"{source}: {zero.size} of {len(vertices)} Gaussians have a rotation quaternion of zero "
                f"(first at index {zero[0]}); expected quaternions of non-zero length"
            )
        return cls(means, quats, scales, opacities, vertices, path)

    def __len__(self) -> int:
        """Count the Gaussians."""
        return len(self.means)

    def save(self, path: str | os.PathLike[str], run: str | None = None) -> None:
        """Write a binary little-endian 3DGS PLY with all properties that were read, atomically (`WriteError`).

        `run` is the id of the run that it belongs to, for a comment in the file.
        """
        write_vertices(path, self.vertices, run)

    def subset(self, index: npt.NDArray[Any]) -> GaussianScene:
        """Pick Gaussians by a boolean mask (N,) or by integer indices.

        Raises
        ------
        EmptySceneError
            Nothing is picked.
        IndexError
            The mask is of another length, or there is no such Gaussian.
        """
        picked = np.arange(len(self))[index].reshape(-1)
        if picked.size == 0:
            raise EmptySceneError(f"{self.path or 'scene'}: none of its {len(self)} Gaussians is in the subset")
        arrays: dict[str, Any] = {name: getattr(self, name)[picked] for name in ACTIVATED}
        return replace(self, **arrays, vertices=chosen(self.vertices, picked))

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return REST_COUNTS.index(len(rest_of(self.vertices)))

    @cached_property
    def ids(self) -> npt.NDArray[np.int64] | None:
        """Ids that stay while the scene changes, (N,) int64; None if its file has none, see docs/living_map.md.

        Raises `SceneValueError` where those of the file are no ids.
        """
        return read_ids(self.vertices, str(self.path or "scene"))

    @cached_property
    def sh(self) -> npt.NDArray[np.float32]:
        """Coefficients of spherical harmonics, (N, (d + 1)^2, 3) float32, band after band, RGB last."""
        sh = np.empty((len(self), (self.sh_degree + 1) ** 2, 3), np.float32)
        sh[:, 0] = self._coefficients[:, :3]
        sh[:, 1:] = self._coefficients[:, 3:].reshape(len(self), 3, -1).transpose(0, 2, 1)
        return sh

    @cached_property
    def _coefficients(self) -> npt.NDArray[np.float32]:
        """Coefficients as they lie in a PLY, (N, 3 B): of degree 0, then all others of red, of green, and of blue."""
        return columns(self.vertices, DC + rest_of(self.vertices))

    @cached_property
    def log_opacities(self) -> npt.NDArray[np.float32]:
        """Logarithm of the opacities to base 2, (N,) float32, in which alphas are computed; of 0 it is -inf."""
        with np.errstate(divide="ignore"):
            return np.log2(self.opacities, dtype=np.float64).astype(np.float32)

    @cached_property
    def digest(self) -> str:
        """SHA-256 (hex) of the geometry: positions, opacities, scales and rotations as stored, not colours."""
        digest = hashlib.sha256()
        for start in range(0, len(self), BLOCK):
            geometry = columns(self.vertices[start : start + BLOCK], GEOMETRY)
            digest.update(np.ascontiguousarray(geometry, "<f4").data)
        return digest.hexdigest()

    @cached_property
    def rounding(self) -> float:
        """By how much float32 moves centres at most, in standard deviations of their Gaussians: the median of all."""
        # Column by column: the same along axis 1 takes four times as long.
        far, large = (reduce(np.maximum, np.abs(rows).T) for rows in (self.means, self.scales))
        return float(np.median(np.spacing(far) / 2 / large))

    def colors(
        self, camera_center: npt.ArrayLike | None = None, ids: npt.NDArray[np.integer] | None = None
    ) -> npt.NDArray[np.float32]:  # (3,), (M,)
        """Evaluate the colours (N, 3), RGB float32 in [0, 1], seen from `camera_center`; of degree 0 only if None.

        With `ids`, only those of some Gaussians: (M, 3). Raises `SceneValueError` where these, or the center, are none.
        """
        from gsseg_core.scene.harmonics_kernel import seen_colors  # It loads numba, which reading scenes does without.

        ids = np.arange(len(self)) if ids is None else np.asarray(ids)
        degree, center = (0, np.zeros(3)) if camera_center is None else (self.sh_degree, np.asarray(camera_center))
        fits = ids.dtype.kind in "iu" and ids.ndim == 1 and center.shape == (3,)
        if not (fits and ids.min(initial=0) >= 0 and ids.max(initial=0) < len(self)):
            found = f"ids are {ids.dtype} of shape {ids.shape} up to {ids.max(initial=0)}, center of {center.shape}"
            raise SceneValueError(f"{self.path or 'scene'}: {found}; expected integers (M,) below {len(self)}, (3,)")
        return seen_colors(self._coefficients, self.means, ids.astype(np.int32), center.astype(np.float32), degree)


def _sh_names(vertices: npt.NDArray[np.void], source: str) -> tuple[str, ...]:
    """Names of the SH properties, after making sure that all properties of 3DGS are there."""
    check_properties(vertices, MEANS + DC + OPACITY + SCALES + QUATS, source)
    rest = rest_of(vertices)
    count = len(rest)
    if count not in REST_COUNTS or not set(vertices.dtype.names or ()).issuperset(rest):
        expected = ", ".join(map(str, REST_COUNTS))
        raise ScenePropertyError(
            f"{source}: has {count} properties f_rest_*; expected {expected} (SH degree 0, 1, 2, 3), numbered from 0"
        )
    return DC + rest


def _all_within(vertices: npt.NDArray[np.void], most: float) -> bool:  # (N,)
    """Whether vertices are floats side by side of which none is larger than `most`."""
    plain = [(name, np.float32) for name in vertices.dtype.names or ()]
    if not vertices.flags.c_contiguous or vertices.dtype != np.dtype(plain):
        return False
    values = vertices.view(np.float32)
    blocks = (values[start : start + _AT_ONCE] for start in range(0, len(values), _AT_ONCE))
    return all(block.min() >= -most and block.max() <= most for block in blocks)


def _activated(vertices: npt.NDArray[np.void]) -> tuple[npt.NDArray[np.float32], ...]:  # (N,)
    """Means (N, 3), unit quaternions (N, 4), NaN where they are zero, scales (N, 3) and opacities (N,) of vertices."""
    means, quats, scales, opacities = (np.empty((len(vertices), size), np.float32) for size in (3, 4, 3, 1))

    def activate(start: int) -> None:
        part = slice(start, start + BLOCK)
        some = vertices[part]
        means[part] = columns(some, MEANS)
        stored = columns(some, QUATS).astype(np.float64)
        w, x, y, z = stored.T
        with np.errstate(invalid="ignore"):
            quats[part] = stored / np.sqrt(w * w + x * x + y * y + z * z)[:, None]
        scales[part] = np.exp(np.clip(columns(some, SCALES), -_MAX_LOG_SCALE, _MAX_LOG_SCALE))
        opacities[part] = np.reciprocal(1 + np.exp(-np.clip(columns(some, OPACITY), -_MAX_LOGIT, _MAX_LOGIT)))

    # Two cores wait for memory less than one does; a block's values stay in the cache.
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(activate, range(0, len(vertices), BLOCK)))
    return means, quats, scales, opacities[:, 0]


def _check_within(
    values: npt.NDArray[np.float32],  # (N, C)
    what: str, source: str, low: float, high: float
) -> None:  # fmt: skip
    if values.size and not (values.min() >= low and values.max() <= high):
        bad = np.flatnonzero(~((values >= low) & (values <= high)).all(axis=1))
        raise SceneValueError(
            f"{source}: {bad.size} of {len(values)} Gaussians have NaN, infinite or too large {what} "
            f"(first at index {bad[0]}); expected finite numbers, at most {min(high, _FLOAT32_MAX):.3g} in size (limit "
            "max_value); splat-transform's --filter-nan leaves out Gaussians that are NaN or infinite"
        )
