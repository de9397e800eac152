"""Sessions through sequences of requests, as they come: nothing that is refused changes anything, and counts agree."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_scenes import NAMES, balls_on_a_table, clean_views

from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.data.view import View
from gsseg_core.errors import GssegError
from gsseg_core.live.living_session import LivingSession
from gsseg_core.live.per_view_session import PerViewSession
from gsseg_core.live.results import Rejection
from gsseg_core.live.session import LiveSession
from gsseg_core.refine.settings import PAPER, UNREFINED, RefineSettings
from gsseg_core.scene.scene_delta import SceneDelta
from gsseg_core.spatial.row_order import along_curve

SCENE, _ = balls_on_a_table()
VIEWS = clean_views(5)
STEPS = 14

Request = Callable[[], object]


def of_one_label(view: View, label: int) -> View:
    return View.from_arrays(view.camera, np.full((view.camera.height, view.camera.width), label))


def away(view: View) -> View:
    """A view like it that sees nothing of the scene."""
    pose = view.camera.world_to_camera.copy()
    pose[0, 3] += 1e4
    return replace(view, camera=replace(view.camera, name=f"{view.name} away", world_to_camera=pose))


def requests(session: LiveSession, draw: random.Random, folder: Path) -> dict[str, Request]:
    """What may be asked of a session next, by what it is."""
    view, state = draw.choice(VIEWS), folder / f"{draw.randrange(2)}.npz"
    settings = draw.choice([UNREFINED, RefineSettings(), PAPER])
    made: dict[str, Request] = {
        "fuse": lambda: session.fuse(view),
        "fuse one label": lambda: session.fuse(of_one_label(view, draw.choice([UNKNOWN, 0, 3, 5, 7]))),
        "fuse what sees nothing": lambda: session.fuse(away(of_one_label(view, draw.choice([1, 5, 9])))),
        "learn": lambda: session.learn(draw.choice(["votes", "em"]), max_steps=2),
        "segment": lambda: session.segmentation(settings),
        "save": lambda: session.save(state),
        "load": lambda: session.load(state),
        "reset": lambda: session.reset(),
    }
    if isinstance(session, PerViewSession):
        made["repair"] = lambda: session.repair()
        return made
    made["name"] = lambda: session.number_classes({1: draw.choice([NAMES[1], "cup"]), 5: "table"})
    if isinstance(session, LivingSession):
        removed = np.array([draw.choice(session.living.ids.tolist())])
        made["change the scene"] = lambda: session.update(SceneDelta(removed=removed))
        made["merge"] = lambda: session.merge([state])
    return made


def everything(session: LiveSession) -> list[object]:
    codes = session.codes().tobytes() if session.has_codes else None
    views, names = list(session._live.views.items()), (dict(session._classes.names), session.class_names)
    return [session._live._votes.dense().tobytes(), codes, names, views, session.num_fused, session.learnt, session.era]


def assert_counts_agree(session: LiveSession) -> None:
    assert session.num_views <= min(session.num_fused, session.max_views)
    assert session._live._votes.order is along_curve(session.scene), "votes of neighbours are together"
    if session.has_codes:
        codes = session.codes()
        assert codes.shape == (len(session.scene), len(session.class_names))
        total = codes.sum(axis=1)
        assert (np.isclose(total, 1, atol=1e-4) | (total == 0)).all() and codes.min() >= 0


@pytest.mark.parametrize("seed", range(30))
@pytest.mark.parametrize("kind", [LiveSession, LivingSession, PerViewSession])
def test_nothing_that_is_refused_changes_anything_and_counts_agree(
    kind: type[LiveSession], seed: int, tmp_path: Path
) -> None:
    draw = random.Random(seed)
    names = None if kind is PerViewSession else draw.choice([None, NAMES, {**NAMES, 7: "chair"}])
    session = kind(SCENE, names, max_views=draw.choice([1, 3, 200]), max_classes=draw.choice([4, 6, 256]))
    done: list[str] = []
    for _ in range(STEPS):
        made = requests(session, draw, tmp_path)
        what = draw.choice([*made, "fuse", "fuse"])
        done.append(what)
        before = everything(session)
        try:
            answer = made[what]()
        except GssegError as error:
            answer = error
        repairs = kind is PerViewSession and what == "learn"  # That comes first, and stays.
        if isinstance(answer, GssegError | Rejection) and not repairs:
            assert everything(session) == before, f"{done} was refused: {answer}"
        assert_counts_agree(session)
