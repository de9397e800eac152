"""A scene that changes under a live session: votes end as if the kept views had been fused into the last one."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from small_scenes import NAMES, balls_on_a_table, clean_views

from gsseg_core.data.view import View
from gsseg_core.live.living_session import LivingSession
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.scene_delta import GroupMove, SceneDelta
from gsseg_core.scene.similarity import Similarity

SCENE, TRUTH = balls_on_a_table()
VIEWS = clean_views(8)
NONE = np.empty(0, np.int64)


def votes(session: LivingSession) -> np.ndarray:
    return session._live._votes.dense()


def refused_into(session: LivingSession) -> LivingSession:
    """Fuse all views that a session keeps into the scene that it has come to."""
    other = LivingSession(session.living, NAMES)
    for view in session.views:
        rejection = other.fuse(view)
        assert rejection is None or rejection.reason == "sees_no_Gaussian"
    return other


def motion(seed: int, far: float, scale: float) -> Similarity:
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(rng.normal(size=3) * 0.3).as_matrix()
    return Similarity(scale, turn, rng.normal(size=3) * far)


def added(ids: np.ndarray, group: int, places: np.ndarray, shift: float = 0.0) -> SceneDelta:
    part = SCENE.subset(places)
    part = GaussianScene.from_arrays(part.means + shift, part.quats, part.scales, part.opacities, part.sh)
    return SceneDelta(added=part, added_ids=ids, added_groups=np.full(len(ids), group, np.int64))


class Story:
    """A session, and what may happen to it."""

    def __init__(self) -> None:
        self.session = LivingSession(SCENE, NAMES)
        self.names, self.next_id = itertools.count(), len(SCENE)

    def fuse(self, number: int, group: int) -> None:
        groups = sorted(self.session.living.frames)
        view = VIEWS[number % len(VIEWS)]
        camera = replace(view.camera, name=f"v{number}")
        moving_with = None if group < 0 else groups[group % len(groups)]
        self.session.fuse(replace(View.from_arrays(camera, view.read_labels()), group=moving_with))

    def remove(self, seed: int) -> None:
        ids = self.session.living.ids
        rng = np.random.default_rng(seed)
        count = min(int(rng.integers(1, 60)), len(ids) - 1)
        self.session.update(SceneDelta(removed=rng.choice(ids, count, replace=False)))

    def add(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        places = rng.choice(len(SCENE), 40, replace=False)
        ids = np.arange(self.next_id, self.next_id + 40)
        self.next_id += 40
        self.session.update(added(ids, int(rng.integers(0, 4)), places, float(rng.normal() * 0.5)))

    def wall(self, seed: int) -> None:
        """What comes is so large and dense that rays end in it: later changes behind it touch nothing."""
        rng = np.random.default_rng(seed)
        flat = Rotation.random(4, random_state=seed).as_quat()[:, [3, 0, 1, 2]]
        part = GaussianScene.from_arrays(
            rng.normal(size=(4, 3)) * 0.7 + [0, 0, 0.8],
            flat,
            np.full((4, 3), 1.5),
            np.full(4, 0.999),
            np.zeros((4, 1, 3)),
        )
        ids = np.arange(self.next_id, self.next_id + 4)
        self.next_id += 4
        self.session.update(SceneDelta(added=part, added_ids=ids, added_groups=np.full(4, int(rng.integers(0, 4)))))

    def move(self, seed: int) -> None:
        rng, groups = np.random.default_rng(seed), sorted(self.session.living.frames)
        names = [view.name for view in self.session.views]
        joining = tuple(str(name) for name in rng.choice(names, min(2, len(names)), replace=False)) if names else ()
        group = int(rng.choice(groups))
        scale = float(rng.choice([1.0, 1.0, 1.25]))
        self.session.update(SceneDelta(moves=(GroupMove(group, motion(seed, 0.2, scale), joining),)))

    def together(self, seed: int) -> None:
        """A group moves, loses a Gaussian and gets one in its place, in one change."""
        living = self.session.living
        rng = np.random.default_rng(seed)
        gone = int(rng.choice(living.ids))
        place = np.array([seed % len(SCENE)])
        delta = added(np.array([gone]), int(rng.integers(0, 4)), place)
        group = int(rng.choice(sorted(living.frames)))
        self.session.update(replace(delta, removed=np.array([gone]), moves=(GroupMove(group, motion(seed, 0.1, 1.0)),)))


@settings(max_examples=25, deadline=None)
@given(
    st.lists(
        st.one_of(
            st.tuples(st.just("fuse"), st.integers(0, 11), st.integers(-1, 3)),
            st.tuples(st.sampled_from(["remove", "add", "wall", "move", "together"]), st.integers(0, 2**16)),
        ),
        min_size=3,
        max_size=14,
    )
)
def test_any_changes_between_masks_end_in_the_votes_of_the_kept_masks_fused_into_the_last_scene(
    steps: list[tuple[object, ...]],
) -> None:
    story = Story()
    for step, *numbers in steps:
        getattr(story, str(step))(*numbers)
    np.testing.assert_array_equal(votes(story.session), votes(refused_into(story.session)))
