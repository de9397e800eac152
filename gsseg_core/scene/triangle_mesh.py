"""Triangle meshes, and OBJ files of them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gsseg_core.files.atomic import write_atomically

LONE = "# gsseg\n"  # first line of an OBJ that belongs to no run


class TriangleMesh(NamedTuple):
    """A mesh whose triangles are counter-clockwise, seen from outside."""

    points: npt.NDArray[np.float32]  # (V, 3) float32: in scene units and axes
    triangles: npt.NDArray[np.int32]  # (T, 3) int32: indices of points
    convex: bool = False  # whether it is its own convex hull

    def save(self, path: str | os.PathLike[str], run: str | None = None) -> None:
        """Write an OBJ, atomically (`WriteError`); `run` is the id of the run that it belongs to, for a comment."""
        with write_atomically(path) as temporary:
            self.write(temporary, run)

    def write(self, path: Path, run: str | None = None) -> None:
        """Write an OBJ into a temporary file."""
        with open(path, "w", encoding="ascii") as file:
            file.write(LONE if run is None else f"# gsseg_run {run}\n")
            np.savetxt(file, self.points, "v %.9g %.9g %.9g")
            np.savetxt(file, self.triangles + 1, "f %d %d %d")
