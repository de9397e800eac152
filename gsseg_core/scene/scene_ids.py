"""Stable 64-bit ids of Gaussians, in two columns of the vertices of a PLY, whose numbers have 32 bits at most."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from gsseg_core.errors import SceneDeltaError, SceneValueError
from gsseg_core.scene.vertices import rest_of

LOW, HIGH = "id_low", "id_high"  # properties uint of a vertex: the lower and the upper half of its id


def read_ids(vertices: npt.NDArray[np.void], source: str) -> npt.NDArray[np.int64] | None:
    """Ids of Gaussians, (N,) int64; None where a scene has none.

    Raises `SceneValueError` where ids are no whole numbers from 0 below 2^63, or one is there twice.
    """
    names = vertices.dtype.names or ()
    if LOW not in names or HIGH not in names:
        return None
    halves = vertices[LOW], vertices[HIGH]
    if not all(half.dtype.kind in "iu" and half.min(initial=0) >= 0 for half in halves):
        raise SceneValueError(f"{source}: {LOW} and {HIGH} are not ids; expected two uint, the halves of each id")
    low, high = (half.astype(np.int64) for half in halves)
    ids: npt.NDArray[np.int64] = (high << 32) | low
    if ids.min(initial=0) < 0 or len(np.unique(ids)) < len(ids):
        raise SceneValueError(f"{source}: ids are negative, or some are there twice; expected another for each vertex")
    return ids


def with_ids(
    vertices: npt.NDArray[np.void],  # (N,)
    added: npt.NDArray[np.void] | None,  # (M,)
    ids: npt.NDArray[np.int64],  # (N + M,)
) -> npt.NDArray[np.void]:
    """Vertices with their ids, those that are added behind; properties that those lack are 0.

    Raises `SceneDeltaError` where what is added has colours of a higher degree than the scene has room for.
    """
    names = list(vertices.dtype.names or ())
    kinds: list[tuple[str, Any]] = [(name, vertices.dtype[name]) for name in names if name not in (LOW, HIGH)]
    out = np.zeros(len(ids), [*kinds, (LOW, np.uint32), (HIGH, np.uint32)])
    if added is not None:
        given = added.dtype.names or ()
        if beyond := [name for name in given if name.startswith("f_rest_") and name not in names]:
            raise SceneDeltaError(
                f"scene delta: added Gaussians have {len(beyond)} coefficients of SH more than the scene; expected "
                "the degree of the scene at most"
            )
        bands, room = len(rest_of(added)) // 3, len(rest_of(vertices)) // 3
        # All of red comes first, then green, then blue: where there is room for more bands, the latter begin later.
        places = {f"f_rest_{i}": f"f_rest_{i // bands * room + i % bands}" for i in range(3 * bands)}
        for name in set(given) & {name for name, _ in kinds}:
            out[places.get(name, name)][len(vertices) :] = added[name]
    for name, _ in kinds:
        out[name][: len(vertices)] = vertices[name]
    out[LOW], out[HIGH] = ids & 0xFFFFFFFF, ids >> 32
    return out
