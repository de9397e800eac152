"""Gaussians as vertices of a 3DGS PLY: one structured array for scenes of every format."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numpy.lib.recfunctions import structured_to_unstructured

from gsseg_core.errors import ScenePropertyError
from gsseg_core.scene import spherical_harmonics

MEANS = ("x", "y", "z")
NORMALS = ("nx", "ny", "nz")
DC = ("f_dc_0", "f_dc_1", "f_dc_2")
OPACITY = ("opacity",)
SCALES = ("scale_0", "scale_1", "scale_2")
QUATS = ("rot_0", "rot_1", "rot_2", "rot_3")
GEOMETRY = MEANS + OPACITY + SCALES + QUATS  # all but colours
BLOCK = 1 << 15  # Gaussians that are packed or unpacked at a time
REST_COUNTS = tuple(3 * (d + 1) ** 2 - 3 for d in range(spherical_harmonics.MAX_DEGREE + 1))
"""How many properties f_rest_* a scene of SH degree 0, 1, 2, 3 has."""
SH_LEFT_OUT = f"SH above degree {spherical_harmonics.MAX_DEGREE} are left out"  # a remark

_MARGIN = 1e-7  # Opacities are kept so far from 0 and 1, where the logit is infinite.
_LEAST_SCALE = float(np.exp(-40))  # What half floats and bytes round to nothing is no more than this.


class ReadScene(NamedTuple):
    """What the reader of a scene format returns."""

    vertices: npt.NDArray[np.void]  # (N,): those of a 3DGS PLY, in the order of the file
    version: str = ""  # of the format, empty if it has none
    remarks: tuple[str, ...] = ()  # what was left out or converted of this file, beyond what its format loses


def rest_names(count: int) -> tuple[str, ...]:
    """Names of the first `count` properties f_rest_*."""
    return tuple(f"f_rest_{i}" for i in range(count))


def rest_of(vertices: npt.NDArray[np.void]) -> tuple[str, ...]:
    """Names of as many properties f_rest_* as vertices (N,) have."""
    return rest_names(sum(name.startswith("f_rest_") for name in vertices.dtype.names or ()))


def check_properties(vertices: npt.NDArray[np.void], needed: Iterable[str], source: str) -> None:
    """Raise `ScenePropertyError` if vertices (N,) lack a property."""
    missing = [name for name in needed if name not in (vertices.dtype.names or ())]
    if missing:
        are_points = {"opacity", "scale_0"} <= set(missing)
        hint = "; points of COLMAP or a scanner are what a scene is trained from" if are_points else ""
        raise ScenePropertyError(f"{source}: not a 3DGS scene, lacks the vertex properties {', '.join(missing)}{hint}")


def pack_vertices(
    means: npt.NDArray[np.floating],  # (N, 3)
    quats: npt.NDArray[np.floating],  # (N, 4) w, x, y, z
    log_scales: npt.NDArray[np.floating],  # (N, 3)
    logits: npt.NDArray[np.floating],  # (N,)
    dc: npt.NDArray[np.floating],  # (N, 3)
    rest: npt.NDArray[np.floating] | None = None,  # (N, (d + 1)^2 - 1, 3)
) -> npt.NDArray[np.void]:
    """Lay Gaussians out as trainers lay out a PLY, (N,) of float32; zeros for normals.

    Values are those that a PLY stores: logarithms of scales, logits of opacities, quaternions of any length. `rest` are
    the coefficients of spherical harmonics above degree 0, band after band, RGB last. What float32 cannot hold becomes
    infinite, which validation reports.
    """
    n, bands = len(means), 0 if rest is None else rest.shape[1]
    groups = (MEANS, NORMALS, DC, rest_names(3 * bands), OPACITY, SCALES, QUATS)
    names = [name for group in groups for name in group]
    table = np.zeros((n, len(names)), np.float32)
    blocks = {MEANS: means, DC: dc, OPACITY: logits[:, None], SCALES: log_scales, QUATS: quats}
    with np.errstate(over="ignore"):
        for group, values in blocks.items():
            first = names.index(group[0])
            table[:, first : first + len(group)] = values
        if rest is not None and bands:
            first = names.index("f_rest_0")
            # All of red comes first, then green, then blue.
            table[:, first : first + 3 * bands].reshape(n, 3, bands)[:] = rest.transpose(0, 2, 1)
    return table.view([(name, np.float32) for name in names])[:, 0]


def pack_in_blocks(count: int, pack: Callable[[slice], npt.NDArray[np.void]]) -> npt.NDArray[np.void]:
    """Pack Gaussians, (N,), slice after slice by `pack`, so that its arrays fit into the processor's cache."""
    first = pack(slice(0, BLOCK))
    if count <= BLOCK:
        return first
    # As plain numbers: NumPy copies records field after field.
    table = np.empty((count, first.dtype.itemsize // 4), np.float32)
    for start in range(0, count, BLOCK):
        part = pack(slice(start, start + BLOCK)) if start else first
        table[start : start + BLOCK] = part.view(np.float32).reshape(len(part), -1)
    return table.view(first.dtype)[:, 0]


def columns(vertices: npt.NDArray[np.void], names: tuple[str, ...]) -> npt.NDArray[np.float32]:  # (N,)
    """Put properties side by side, (N, len(names)): a view where they lie so in memory, else a copy."""
    with np.errstate(over="ignore"):  # doubles beyond float32 become infinite, which validation reports
        side_by_side: npt.NDArray[np.float32] = structured_to_unstructured(vertices[list(names)], dtype=np.float32)
    return side_by_side


def chosen(vertices: npt.NDArray[np.void], index: npt.NDArray[np.integer]) -> npt.NDArray[np.void]:  # (N,), (M,)
    """Take vertices, (M,), as bytes: as records, NumPy would take them field by field, in ten times the time."""
    return np.take(vertices.view(f"V{vertices.itemsize}"), index).view(vertices.dtype)


def put(vertices: npt.NDArray[np.void], names: tuple[str, ...], values: npt.NDArray[np.floating]) -> None:
    """Set properties of vertices (N,) to the columns of values (N, len(names)), in place."""
    for name, column in zip(names, values.T, strict=True):
        vertices[name] = column


def logits(opacities: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    """Logits of opacities in [0, 1], kept finite; of what is no opacity, NaN, which validation reports."""
    with np.errstate(invalid="ignore"):  # Converting a signalling NaN warns.
        given = np.asarray(opacities, np.float64)
    inside = np.clip(np.where((given >= 0) & (given <= 1), given, np.nan), _MARGIN, 1 - _MARGIN)
    return np.log(inside / (1 - inside))


def log_scales(scales: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    """Logarithms of scales, finite where one was rounded to 0; of a negative one NaN, which validation reports."""
    with np.errstate(invalid="ignore"):
        return np.log(np.where(scales == 0, _LEAST_SCALE, np.asarray(scales, np.float64)))


def dc_of(rgb: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:  # (N, 3)
    """Coefficients (N, 3) of degree 0 that show colours in [0, 1] from everywhere."""
    return (np.asarray(rgb, np.float64) - 0.5) / spherical_harmonics.C0
