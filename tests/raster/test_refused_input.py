"""Input that operators and observations refuse with one clear error, before a kernel takes it for places of a table."""

from __future__ import annotations

import numpy as np
import pytest
from operator_cases import make_camera, one_gaussian, random_view

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.label_evidence import LabelEvidence
from gsseg_core.errors import MaskFormatError, MaskSizeError, SceneValueError, SettingsError
from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.cpu import tiling
from gsseg_core.raster.cpu.projection import project
from gsseg_core.raster.vote_total import VoteTotal


def test_what_kernels_would_take_for_places_beyond_their_tables_is_refused():
    scene, camera = random_view(0)
    operator, labels = make_operator(scene, camera), np.full((21, 37), 2, np.int32)
    few = LabelEvidence(np.arange(2, dtype=np.int32))
    unfit = labels + np.int64(-(2**32) - 1)  # As int32, class 1.
    for mask, evidence in [(labels, few), (labels + 10**9, None), (unfit, None), (labels.astype(float), None)]:
        for use in (operator.observe, lambda *given: operator.vote(*given, VoteTotal(120, 9))):
            with pytest.raises(
                MaskFormatError, match=r"view 'view': labels are (int32|int64|float64) from .* up to .* expected"
            ):
                use(mask, evidence)
    seen = operator.observe(labels.astype(np.uint8))
    for use in (seen.vote, lambda *given: operator.vote(labels, None, *given)):
        with pytest.raises(SceneValueError, match=r"view 'view': votes are ndarray; expected a VoteTotal"):
            use(np.zeros((120, 9), np.int64))
    for total in [VoteTotal(5, 9), VoteTotal(120, 2)]:
        with pytest.raises(SceneValueError, match=r"view 'view': votes have shape .*; expected \(\d+, 3\) or more"):
            seen.vote(total)
        assert not total.dense().any()
    with pytest.raises(SceneValueError, match=r"hidden is int64 \(120,\); expected bool \(120,\)"):
        operator.without(np.zeros(120, np.int64))  # It would be taken for indices, and nothing be hidden.
    codes, seen_codes = CSRRows.from_dense(np.ones((120, 3), np.float32)), np.ones((len(operator.ids), 2), np.float32)
    for use in (lambda *given: operator.blend_rows(*given), lambda k, *given: operator.strongest(k, *given, True)):
        with pytest.raises(SceneValueError, match="codes are of class 2; expected below 1"):
            use(codes, 1)
    with pytest.raises(SceneValueError, match="a Gaussian that it shows has no codes; expected all"):
        operator.strongest(codes, 3, True, of=np.zeros(120, np.int64))
    for use in (operator.blend_seen, lambda a, b: operator.strongest(codes, 3, True, beside=a, wanted=b)):
        with pytest.raises(MaskSizeError, match=r"wanted pixels have shape \(3, 3\); expected \(21, 37\)"):
            use(seen_codes, np.ones((3, 3), bool))


@pytest.mark.parametrize(
    "weights", [np.ones((1, 1)), np.ones((6, 1)), np.ones((7, 10)), np.ones(60), np.full((6, 10), np.nan),
                np.full((6, 10), -1.0), np.full((6, 10), np.inf)],
)  # fmt: skip
def test_weights_of_other_blocks_than_the_image_has_are_refused_and_not_repeated(backend, weights):
    scene, camera = random_view(0)
    operator, labels = backend.make(scene, camera), np.zeros((21, 37), np.int32)
    with pytest.raises(SceneValueError, match=r"view 'view': weights have shape .*; expected \(6, 10\), finite, 0 or"):
        operator.observe(labels, weights=weights.astype(np.float32))
    assert operator.observe(labels, weights=np.ones((6, 10), np.float32)).weighted_areas == 21 * 37


def test_codes_of_another_scene_are_refused(backend):
    scene, camera = random_view(0)
    operator = backend.make(scene, camera)
    for shape in [(119, 3), (121, 3), (120,), (120, 3, 1)]:
        with pytest.raises(SceneValueError, match=r"codes have shape .* expected \(120, K\)"):
            operator.render(np.zeros(shape))
    labels = np.full(operator.camera.image_size[::-1], 2, np.int32)
    for count in (119, 121):
        with pytest.raises(SceneValueError, match=f"view 'view': votes are of {count} Gaussians; expected 120"):
            operator.vote(labels, None, VoteTotal(count, 3))
    with pytest.raises(SceneValueError, match=r"votes have shape \(120, 2\); expected \(120, 3\) or more"):
        operator.vote(labels, None, VoteTotal(120, 2))
    seen = operator.observe(labels)
    for shape in [(seen.ids[-1], 3), (120, 2)]:
        with pytest.raises(SceneValueError, match=rf"votes have shape .* expected \({seen.ids[-1] + 1}, 3\) or more"):
            seen.vote(VoteTotal(*shape))
    some = np.zeros((len(operator.ids) - 1, 3), np.float32)
    with pytest.raises(SceneValueError, match=f"codes are of {len(some)} Gaussians; expected {len(some) + 1}"):
        operator.blend_seen(some)
    with pytest.raises(SceneValueError, match=f"codes are of {len(some)} Gaussians; expected {len(some) + 1}"):
        operator.strongest(CSRRows.from_dense(np.ones((120, 3), np.float32)), 3, True, beside=some)
    for count, of in [(119, None), (5000, None), (3, np.arange(2))]:  # Kernels would read beyond the end.
        codes, expected = CSRRows.from_dense(np.ones((count, 3), np.float32)), 120 if of is None else 2
        with pytest.raises(SceneValueError, match=f"view 'view': codes are of {count} Gaussians; expected {expected}"):
            operator.strongest(codes, 3, True, of=of)
        if of is None:
            with pytest.raises(SceneValueError, match=f"codes are of {count} Gaussians; expected {expected}"):
                operator.blend_rows(codes, 3)


def test_images_of_another_size_are_refused(backend):
    scene, camera = random_view(0)
    operator = backend.make(scene, camera)
    for shape in [(37, 21, 2), (21, 37), (21, 36, 2)]:
        with pytest.raises(MaskSizeError, match=r"view 'view': .* expected \(21, 37, K\)"):
            operator.adjoint(np.zeros(shape))
    for shape in [(37, 21), (21, 37, 1), (21, 38)]:
        with pytest.raises(MaskSizeError, match=r"view 'view': .* expected \(21, 37\)"):
            operator.observe(np.zeros(shape, np.int32))


def test_codes_of_another_shape_than_the_observation_are_refused(backend):
    camera, scene = make_camera(20, 20), one_gaussian()
    seen = backend.make(scene, camera).observe(np.zeros((20, 20), np.int32))
    with pytest.raises(SceneValueError, match=r"expected \(1,\) and \(1,\)"):
        seen.shares(np.ones((5, 3), np.float32), np.ones(7, np.float32))


@pytest.mark.parametrize("pixel", [(0, 20), (20, 0), (-1, 3), (5, -1), (3, None), (9.5, 3), (3, 10.0)])
def test_a_pixel_outside_the_image_or_between_two_is_refused(backend, pixel):
    operator = backend.make(one_gaussian(), make_camera(20, 20))
    with pytest.raises(SettingsError, match="expected a row from 0 to 19 and a column from 0 to 19"):
        operator.weights(*pixel)


def test_a_view_with_more_entries_than_can_be_numbered_is_refused(monkeypatch):
    scene, camera = random_view(0)
    entries = len(tiling.assign(project(scene, camera), *camera.image_size).entries)
    monkeypatch.setattr(tiling, "MOST_ENTRIES", entries - 1)
    with pytest.raises(SceneValueError, match=f"touch {entries} tiles .* 37 x 21 pixels.* at most {entries - 1}$"):
        make_operator(scene, camera)


def test_an_unknown_device_is_refused():
    with pytest.raises(SettingsError, match="abacus"):
        make_operator(*random_view(0), device="abacus")
