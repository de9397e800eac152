"""What `segmentation.npz` holds, read and checked; `gsseg_core.segmentation` makes the result of it, and writes it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.object_tree import ObjectTree
from gsseg_core.errors import StateFileError
from gsseg_core.files.input_files import UnfitError
from gsseg_core.files.npz_files import NpzArrays, check_shares, class_names_of, open_npz, temperature_of
from gsseg_core.text import clipped

UNOBSERVED, REMOVED = -1, -2
"""Labels of Gaussians of which nothing is known, and of those that the filter or carving took out."""

FORMAT = "gsseg-segmentation-1"


def read_segmentation(path: Path, digest: str, num_gaussians: int) -> dict[str, Any]:
    """Read the file of a segmentation of the scene with this digest: arrays, names and the like, by `Segmentation`'s.

    Raises `StateFileError` where it is missing or damaged, or holds what no segmentation holds; `StateMismatchError`
    where it belongs to another scene.
    """
    if os.path.isfile(path / "segmentation.npz"):  # Path asks the same, and raises where it may not look.
        raise StateFileError(f"{path}: is a folder; expected a segmentation.npz; type {path / 'segmentation.npz'}")
    with open_npz(path, "a segmentation.npz", (FORMAT,), digest) as (file, header):
        names, temperature = class_names_of(header), temperature_of(header)
        if 0 not in names:
            raise UnfitError(f"class_names lack 0, the background; found {clipped(list(names))}")
        n, k = num_gaussians, len(names)
        labels = file.expect("labels", np.int32, (n,))
        shares = _expect_rows(file, "probabilities", (n, k))
        clustered = file.expect("clustered", bool, (n,))
        learnt = _expect_rows(file, "learnt", (int(clustered.sum()), k))
        unknown_ids = np.setdiff1d(labels, [REMOVED, UNOBSERVED, *names])
        if unknown_ids.size:
            raise UnfitError(
                f"array labels holds {clipped(unknown_ids[:9].tolist())}; expected ids of its {k} classes, or "
                f"{UNOBSERVED} (unobserved) or {REMOVED} (removed)"
            )
        if "class_ids" in file.names and file.expect("class_ids", np.int32, (k,)).tolist() != list(names):
            raise UnfitError("array class_ids holds other ids than class_names of its header; expected the same")
        check_shares("probabilities", shares)
        check_shares("learnt", learnt)
        return {
            "labels": labels, "shares": shares, "class_names": names, "clustered": clustered, "learnt": learnt,
            "temperature": temperature, "tree": ObjectTree.read(file, header, n, k),
        }  # fmt: skip


def _expect_rows(file: NpzArrays, name: str, shape: tuple[int, int]) -> CSRRows:
    """Read probabilities as `arrays_of_rows` has written them: with their zeros, or without where these are many."""
    expect = file.expect_sparse if f"{name}_counts" in file.names else file.expect_rows
    return expect(name, np.float32, shape)
