"""A `LivingScene` in the npz of a saved state: ids, groups and their frames, and geometry without colours."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from gsseg_core.errors import GssegError
from gsseg_core.files.input_files import UnfitError
from gsseg_core.files.json_files import whole_number
from gsseg_core.files.npz_files import NpzArrays
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.living_scene import LivingScene
from gsseg_core.scene.scene_delta import MAX_ID, read_similarity, similarity_entry
from gsseg_core.scene.vertices import MEANS, OPACITY, QUATS, SCALES, columns, pack_vertices

_GEOMETRY = MEANS + OPACITY + SCALES + QUATS


def arrays(living: LivingScene) -> dict[str, npt.NDArray[Any]]:
    """Arrays of a scene: what `read` needs of it, besides its frames."""
    return {"ids": living.ids, "groups": living.groups, "geometry": columns(living.local.vertices, _GEOMETRY)}


def frame_entries(living: LivingScene) -> list[dict[str, Any]]:
    """Frames of its groups, for a JSON header."""
    return [{"group": group, **similarity_entry(frame)} for group, frame in living.frames.items()]


def read(file: NpzArrays, header: dict[str, Any]) -> LivingScene | None:
    """Read a scene, colourless, if an npz holds one; `UnfitError` if what is there is none."""
    if "geometry" not in file.names:
        return None
    geometry = file.expect("geometry", np.float32, (None, len(_GEOMETRY)))
    ids, groups = (file.expect(name, np.int64, (len(geometry),)) for name in ("ids", "groups"))
    if ids.min(initial=0) < 0 or len(np.unique(ids)) < len(ids):
        raise UnfitError("array ids holds negative numbers, or some twice; expected another from 0 for each Gaussian")
    try:
        frames = {
            whole_number(entry["group"], "group of a frame", 0, MAX_ID): read_similarity(entry)
            for entry in header["frames"]
        }
        if not np.isin(groups, list(frames)).all():
            raise UnfitError(f"array groups holds other groups than the {len(frames)} of its frames; expected those")
        return LivingScene.placed(_colourless(geometry), ids, groups, frames)
    except GssegError as error:
        raise UnfitError(f"its scene is unusable ({error}); expected Gaussians, and a similarity per group") from error


def without_colours(living: LivingScene) -> LivingScene:
    """Drop the colours of a scene: its votes stay the same, bit for bit, and it takes a fifth of the memory."""
    local = _colourless(columns(living.local.vertices, _GEOMETRY))
    return LivingScene.placed(local, living.ids, living.groups, living.frames)


def _colourless(geometry: npt.NDArray[np.float32]) -> GaussianScene:
    means, logits, scales, quats = geometry[:, :3], geometry[:, 3], geometry[:, 4:7], geometry[:, 7:]
    black = np.zeros((len(geometry), 3), np.float32)
    return GaussianScene.from_vertices(pack_vertices(means, quats, scales, logits, black), None)
