"""Live sessions of a table with three balls whose scene changes, and what their votes are to be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation
from small_scenes import NAMES, balls_on_a_table, clean_views

from gsseg_core.live.living_session import LivingSession
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.scene_delta import SceneDelta
from gsseg_core.scene.similarity import Similarity

SCENE, TRUTH = balls_on_a_table()
VIEWS = clean_views(4)
K = len(NAMES)
FAR = Similarity(1.5, Rotation.from_rotvec([0.2, -0.1, 0.4]).as_matrix(), np.array([40.0, 3.0, -2.0]))


def session(group: int | None = None) -> LivingSession:
    fused = LivingSession(SCENE, NAMES)
    for view in VIEWS:
        assert fused.fuse(replace(view, group=group)) is None
    return fused


def votes(of: LivingSession) -> np.ndarray:
    return of._live._votes.dense()


def other_room(shift: tuple[float, float, float], group: int = 1) -> SceneDelta:
    """The whole scene once more, somewhere else."""
    copy = GaussianScene.from_arrays(SCENE.means + shift, SCENE.quats, SCENE.scales, SCENE.opacities, SCENE.sh)
    ids = np.arange(len(SCENE)) + 10**12
    return SceneDelta(added=copy, added_ids=ids, added_groups=np.full(len(SCENE), group, np.int64))


def as_refused(of: LivingSession) -> np.ndarray:
    """Votes of the kept views in the last scene, from nothing."""
    again = LivingSession(of.living, NAMES)
    for view in of.views:
        again.fuse(view)
    return votes(again)
