"""3DGS PLYs, and relatives that would be misread as such: of Mip-Splatting, of 2DGS, and with colours as bytes."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import numpy as np
import numpy.typing as npt

from gsseg_core.errors import SceneValueError
from gsseg_core.scene.ply import is_ply, read_vertices
from gsseg_core.scene.vertices import (
    DC,
    OPACITY,
    REST_COUNTS,
    SCALES,
    SH_LEFT_OUT,
    ReadScene,
    check_properties,
    columns,
    dc_of,
    rest_names,
)

_RGB = ("red", "green", "blue")
_FILTER = "filter_3D"
_DEGREE_4 = rest_names(3 * (5**2 - 1))
_FLATNESS = float(np.log(1e-3))  # Thin enough to be a disc, and thick enough for float32.


def read_3dgs(path: Path, within: Path | None = None) -> ReadScene:
    """Read a 3DGS PLY; one with colours as bytes instead of SH, as nerfstudio exports it if asked to, counts as one.

    Of SH of degree 4, which some trainers learn, those up to degree 3 are read.
    """
    vertices = read_vertices(path, within)
    names = vertices.dtype.names or ()
    if set(_DEGREE_4).issubset(names):
        kept = np.arange(len(_DEGREE_4)).reshape(3, -1)[:, : REST_COUNTS[-1] // 3].ravel()  # All of red comes first.
        moved = {name: vertices[_DEGREE_4[i]] for name, i in zip(rest_names(REST_COUNTS[-1]), kept, strict=True)}
        return ReadScene(_with(vertices, moved, set(_DEGREE_4) - set(moved)), remarks=(SH_LEFT_OUT,))
    if DC[0] in names or OPACITY[0] not in names or not set(_RGB).issubset(names):
        return ReadScene(vertices)
    dc = dc_of(columns(vertices, _RGB) / 255)
    return ReadScene(_with(vertices, dict(zip(DC, dc.T, strict=True))), remarks=("colours in 8 bits instead of SH",))


def is_mip_splatting(head: bytes) -> bool:
    """Whether a file begins with the header of a PLY of Mip-Splatting whose 3D filter is not fused."""
    return b"filter_3D" in _properties(head)


def read_mip_splatting(path: Path, within: Path | None = None) -> ReadScene:
    """Read a PLY of Mip-Splatting, with the 3D smoothing filter fused into scales and opacities.

    A Gaussian of scales s and a filter of size f is that of scales sqrt(s^2 + f^2), its opacity multiplied by
    sqrt(prod s^2 / prod (s^2 + f^2)): equation 9 of Yu et al., Mip-Splatting, CVPR 2024. The property `filter_3D` is
    left out, so that it is not fused twice.
    """
    vertices = read_vertices(path, within)
    check_properties(vertices, (*SCALES, *OPACITY, _FILTER), str(path))
    size = vertices[_FILTER].astype(np.float64)[:, None]
    if not (size >= 0).all():
        raise SceneValueError(f"{path}: {_FILTER} holds values that are NaN or negative; expected sizes of at least 0")
    with np.errstate(all="ignore"):  # What is NaN or infinite is reported by the scene.
        logs = columns(vertices, SCALES).astype(np.float64)
        grown = np.logaddexp(2 * logs, 2 * np.log(size)) / 2
        opacity = np.exp(-np.logaddexp(0, -vertices[OPACITY[0]].astype(np.float64)) + (logs - grown).sum(axis=1))
        logit = np.log(opacity) - np.log1p(-opacity)
    # Where nothing is smoothed, the logit of an opacity near 1 stays as exact as it was.
    logit = np.where(size[:, 0] > 0, logit, vertices[OPACITY[0]])
    changed = {**dict(zip(SCALES, grown.T, strict=True)), OPACITY[0]: logit}
    fused = _with(vertices, changed, without={_FILTER})
    return ReadScene(fused, remarks=("filter_3D is fused into scales and opacities",))


def is_2dgs(head: bytes) -> bool:
    """Whether a file begins with the header of a PLY of 2DGS, whose Gaussians are discs: they have two scales."""
    properties = _properties(head)
    return {b"scale_0", b"scale_1", b"rot_3"}.issubset(properties) and b"scale_2" not in properties


def read_2dgs(path: Path, within: Path | None = None) -> ReadScene:
    """Read a PLY of 2DGS; the third scale, along the normal, is a thousandth of the smaller of the two."""
    vertices = read_vertices(path, within)
    check_properties(vertices, SCALES[:2], str(path))
    thin = np.minimum(vertices[SCALES[0]], vertices[SCALES[1]]) + _FLATNESS
    return ReadScene(_with(vertices, {SCALES[2]: thin}), remarks=("discs, made a thousandth as thick as wide",))


def _properties(head: bytes) -> set[bytes]:
    """Names of the properties in the header of a PLY; none if it is no PLY."""
    if not is_ply(head):
        return set()
    lines = head.partition(b"end_header")[0].splitlines()
    return {line.split()[-1] for line in lines if line.startswith(b"property ")}


def _with(
    vertices: npt.NDArray[np.void],  # (N,)
    changed: dict[str, npt.NDArray[np.floating]],  # (N,)
    without: Collection[str] = (),
) -> npt.NDArray[np.void]:
    """Copy vertices with properties replaced or added as float32, and some left out."""
    kept = [(name, vertices.dtype[name]) for name in vertices.dtype.names or () if name not in without]
    added = [(name, np.dtype(np.float32)) for name in changed if name not in (vertices.dtype.names or ())]
    out = np.empty(len(vertices), [*kept, *added])
    for name in out.dtype.names or ():
        out[name] = changed[name] if name in changed else vertices[name]
    return out
