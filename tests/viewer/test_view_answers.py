"""What the viewer answers to a click, and how long the answer, or an error in its place, is true."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest
from labellings import labelled
from parts_of_balls import tree_of_balls
from patience import wait_until
from small_scenes import NAMES, balls_on_a_table, clean_views, ring, write_dataset

pytest.importorskip("viser")

from viser.transforms import SO3

from gsseg_core.data.dataset import Dataset
from gsseg_core.errors import MaskFormatError
from gsseg_core.scene.camera import Camera
from gsseg_core.viewer.access import listen
from gsseg_core.viewer.clients import SERVER
from gsseg_core.viewer.corrections import disc
from gsseg_core.viewer.model import ViewModel
from gsseg_core.viewer.picking import Picked, ViewVote
from gsseg_core.viewer.viewer import Viewer

SCENE, TRUTH = balls_on_a_table()
LEARNT = labelled(TRUTH.astype(np.int32), np.eye(len(NAMES), dtype=np.float32)[TRUTH] * np.float32(0.9), dict(NAMES))
CAMERA = ring(1)[0]
((COLUMN, ROW),), _ = CAMERA.project(SCENE.means[TRUTH == 1].mean(axis=0, keepdims=True))
IN_BALL = int(np.flatnonzero(TRUTH == 1)[-1])
PORT = 18340


@pytest.fixture
def viewer() -> Iterator[Viewer]:
    model = ViewModel(SCENE, LEARNT, class_ids=tuple(NAMES), tree=tree_of_balls())
    with closing(Viewer(model, listener=listen(port=PORT), draw=SERVER)) as opened:
        yield opened


def viewed_from(camera: Camera) -> MagicMock:
    """A browser that looks from there."""
    wxyz = SO3.from_matrix(camera.world_to_camera[:3, :3].T).wxyz
    seen = MagicMock(fov=1.0, aspect=1.0, image_height=480, position=camera.center, wxyz=wxyz)
    return MagicMock(camera=seen)


def click_at(client: MagicMock, gaussian: int) -> MagicMock:
    """A click of a browser on a Gaussian."""
    eye = client.camera.position
    return MagicMock(client=client, ray_origin=eye, ray_direction=SCENE.means[gaussian] - eye)


def test_the_answer_to_a_click_follows_corrections_and_what_takes_them_back(viewer: Viewer) -> None:
    answer, state = viewer.panel.answer, viewer.state

    def tells(name: str) -> None:
        wait_until(lambda: f"<strong>{name}</strong>" in answer._answer.content, f"the answer {name}")

    state.correct(disc(CAMERA, COLUMN, ROW, 3, 2))
    changed = int(np.flatnonzero(state.objects.labels != TRUTH)[0])
    answer.show_picked(answer.ask(), Picked(changed, 0.5))
    tells(NAMES[2])
    assert not answer._parts.visible and answer._whole.visible
    state.undo()
    tells(NAMES[1])
    assert answer._parts.visible and not answer._whole.visible


def test_names_that_are_read_from_the_right_leave_numbers_beside_them_in_order() -> None:
    named = replace(LEARNT, class_names={k: "\u05db\u05d9\u05e1\u05d0 " * k for k in NAMES})
    with closing(Viewer(ViewModel(SCENE, named), listener=listen(port=PORT), draw=SERVER)) as opened:
        answer, name = opened.panel.answer, f"<bdi>{named.class_names[1]}</bdi>"
        answer.show_picked(answer.ask(), Picked(IN_BALL, 0.5), [ViewVote("view", 1, 2.5)])
        assert f"probabilities: {name} 0.90" in answer._answer.content
        assert f"<bdi>view</bdi>: {name}, 2.5 px" in answer._answer.content


def test_buttons_of_names_that_are_read_from_the_right_keep_their_numbers_and_are_found_by_composed_letters() -> None:
    named = replace(LEARNT, class_names={0: "table", 1: "\u05db\u05d9\u05e1\u05d0", 2: "Tu\u0308r", 3: "box"})
    with closing(Viewer(ViewModel(SCENE, named), listener=listen(port=PORT), draw=SERVER)) as opened:
        panel = opened.panel
        labels = {row.label: button.label for row, button in panel._rows.values()}
        assert labels[1] == f"\u2068{named.class_names[1]}\u2069  60" and labels[3] == "box  60"
        panel._search.value = "T\u00fcr"
        panel._filter()
        assert [row.label for row, button in panel._rows.values() if button.visible] == [2]


def test_probabilities_that_read_as_nothing_are_not_listed_beside_the_largest() -> None:
    shares = np.array([[0.99, 0.004, 0.006, 0.0]] * len(TRUTH), np.float32)
    with closing(
        Viewer(ViewModel(SCENE, labelled(LEARNT.labels, shares, dict(NAMES))), listener=listen(port=PORT), draw=SERVER)
    ) as opened:
        answer = opened.panel.answer
        answer.show_picked(answer.ask(), Picked(IN_BALL, 0.5))
        bdi = [f"<bdi>{NAMES[k]}</bdi>" for k in (0, 2)]
        assert f"probabilities: {bdi[0]} 0.99, {bdi[1]} 0.01</div>" in answer._answer.content


def test_an_earlier_click_says_nothing_any_more_once_a_later_one_is_answered(viewer: Viewer) -> None:
    answer = viewer.panel.answer
    first, second = answer.ask(), answer.ask()
    answer.show_picked(second, Picked(IN_BALL, 0.5))
    answer.show_picked(first, Picked(0, 0.5), [])
    assert f"Gaussian {IN_BALL}, " in answer._answer.content
    with answer.telling(None):
        viewer.state.selection("no such format")
    answer.refresh()
    assert "That did not work" in answer._answer.content and not answer._parts.visible


def test_what_was_clicked_is_told_while_the_votes_of_the_views_are_collected(viewer: Viewer) -> None:
    answer = viewer.panel.answer
    answer.show_picked(answer.ask(), Picked(IN_BALL, 0.5))
    told = answer._answer.content
    answer.show_progress("collect the votes", 1, 2)
    assert answer._answer.content.startswith(told) and "collect the votes: 1 of 2 views" in answer._answer.content
    answer.show_progress("collect the votes", 2, 2)
    assert answer._answer.content == told


def test_a_click_is_answered_without_the_views_once_a_mask_cannot_be_read(tmp_path: Path) -> None:
    data = write_dataset(tmp_path / "data")
    views = Dataset(data).views("train")
    (data / "labels" / f"{views[1].name}.png").write_bytes(b"no picture")
    client = viewed_from(CAMERA)
    with closing(Viewer(ViewModel(SCENE, LEARNT), views, listener=listen(port=PORT), draw=SERVER)) as viewer:
        for _ in range(2):
            viewer._on_click(click_at(client, IN_BALL))
            assert f"<strong>{NAMES[1]}</strong>, class 1" in viewer.panel.answer._answer.content
            assert f"{views[1].name}.png" in client.add_notification.call_args.args[1]
            assert "voted for it" not in viewer.panel.answer._answer.content


def test_a_mask_that_cannot_be_read_leaves_the_answer_to_a_later_click(
    viewer: Viewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    answer, client = viewer.panel.answer, viewed_from(CAMERA)

    def view_votes(progress: object) -> None:
        answer.show_picked(answer.ask(), Picked(0, 0.5))
        raise MaskFormatError("view1.png: no picture")

    viewer.state.views = tuple(clean_views(1))
    monkeypatch.setattr(viewer.state, "view_votes", view_votes)
    viewer._on_click(click_at(client, IN_BALL))
    assert "Gaussian 0, " in answer._answer.content and "no picture" in client.add_notification.call_args.args[1]


def test_an_error_is_told_until_somebody_does_what_works(viewer: Viewer) -> None:
    answer, client = viewer.panel.answer, viewed_from(CAMERA)
    with answer.telling(client):
        viewer.state.selection("no such format")
    with answer.telling(None):  # What the viewer sets itself is nobody's act.
        pass
    assert "That did not work" in answer._answer.content
    with answer.telling(client):
        viewer.state.undo()
    assert "Click on something" in answer._answer.content
    viewer._on_click(click_at(client, IN_BALL))
    assert f"<strong>{NAMES[1]}</strong>" in answer._answer.content


def test_classes_of_one_name_are_told_apart_by_their_ids_wherever_both_are_named() -> None:
    names = {**NAMES, 2: "ball", 3: "ball"}
    shares = np.eye(len(NAMES), dtype=np.float32)[TRUTH] * np.float32(0.5)
    shares[IN_BALL] = 0.1, 0.2, 0.4, 0.3
    model = ViewModel(SCENE, labelled(TRUTH.astype(np.int32), shares, names), class_ids=(0, 4, 7, 9))
    with closing(Viewer(model, listener=listen(port=PORT), draw=SERVER)) as viewer:
        panel, asked = viewer.panel, viewer.panel.answer.ask()
        assert panel._target.options == ("background", "red ball", "ball", "ball (9)")
        panel.answer.show_picked(asked, Picked(IN_BALL, 0.5), [ViewVote("v", k, 1.0) for k in (3, 1, 2)])
        told = panel.answer._answer.content
    assert "<bdi>ball</bdi> (7) 0.40, <bdi>ball</bdi> (9) 0.30, <bdi>red ball</bdi> 0.20" in told
    assert all(f"<bdi>{name}, 1.0 px" in told for name in ("ball</bdi> (9)", "red ball</bdi>", "ball</bdi> (7)"))
