"""Masks of an object or two, without photos: too little to say that cameras and scene do not belong together."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest

from gsseg_core.align import placing
from gsseg_core.align.agreement import Agreement, Pictures, agreement, look_at
from gsseg_core.align.conventions import Convention
from gsseg_core.align.placing import find_alignment
from gsseg_core.align.settings import AlignSettings
from gsseg_core.data.dataset import Dataset
from gsseg_core.data.view import View
from gsseg_core.errors import AlignmentError
from gsseg_core.report.findings import frame_of
from gsseg_core.scene.gaussian_scene import GaussianScene


@pytest.mark.parametrize("shown", [(1,), (2,), (3, 5), tuple(range(1, 6))])
def test_masks_of_few_labels_never_say_that_cameras_do_not_fit(demo_run: Path, shown: tuple[int, ...]) -> None:
    data, scene = Dataset(demo_run / "scene"), GaussianScene.load(demo_run / "scene/scene.ply")
    lost = np.diag([1.0, -1.0, -1.0, 1.0])
    views = []
    for view in data.views("train"):
        labels = view.read_labels()
        labels = np.where(np.isin(labels, shown), labels, 0).astype(np.int32)
        camera = replace(view.camera, world_to_camera=lost @ view.camera.world_to_camera)
        views.append(View.from_arrays(camera, labels))
    found = agreement(Pictures.of(scene, AlignSettings()), look_at(views, AlignSettings()), AlignSettings())
    assert found is not None and found.telling == (len(shown) > 3)
    assert found.agrees is (False if found.telling else None)
    if not found.telling:  # Among all conventions, one would agree by chance.
        with pytest.raises(AlignmentError, match=r"masks with so few labels .* expected photos of the views"):
            find_alignment(scene, views)


@pytest.mark.parametrize(
    ("before", "reached", "moved"), [(0.12, 0.14, False), (0.12, 0.16, True), (0.09, 0.11, None), (0.05, 0.11, True)]
)
def test_a_convention_that_masks_hardly_prefer_is_not_taken(
    demo_run: Path, before: float, reached: float, moved: bool | None
) -> None:
    views = Dataset(demo_run / "scene").views("train")
    scene = GaussianScene.load(demo_run / "scene/scene.ply")
    found = [Agreement("masks", 6, 0.1 + margin, 0.1, True if margin > 0.1 else None) for margin in (before, reached)]
    with (
        patch.object(placing, "agreement", side_effect=found),
        patch.object(placing, "find_convention", lambda *_: Convention(inverted=True)),
    ):
        if moved is None:
            with pytest.raises(AlignmentError, match="no convention of axes makes scene and masks agree"):
                find_alignment(scene, views)
        else:
            assert bool(find_alignment(scene, views).alignment.parts) == moved


def test_a_report_does_not_blame_cameras_for_masks_of_few_labels() -> None:
    found = Agreement("masks", 6, 0.21, 0.2, None, telling=False)
    (said,) = frame_of({"scene": {}, "frame": {"agreement": vars(found)}})
    assert said.startswith("masks with so few labels cannot show") and "--align" not in said
