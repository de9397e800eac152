"""The kernels of the GPU, interpreted on the CPU: they give what those of the CPU give.

`test_gpu_operator` runs these tests in a process of its own, in which numba simulates a GPU from the start.
"""

from __future__ import annotations

import dataclasses
import gc
import weakref
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from operator_cases import dense, make_camera, make_scene, random_mask, random_view
from simulated_blocks import take_turns

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.label_evidence import UNITS, LabelEvidence
from gsseg_core.data.view import View
from gsseg_core.errors import GssegError, SceneValueError
from gsseg_core.learn.em import em_gpu_kernels, em_kernels
from gsseg_core.live.living_session import LivingSession
from gsseg_core.raster.backends import make_operator, vote_total
from gsseg_core.raster.cpu import tiling
from gsseg_core.raster.depth import depths
from gsseg_core.raster.gpu import gpu_observation, gpu_operator
from gsseg_core.raster.gpu.gpu_operator import GPUOperator
from gsseg_core.raster.gpu.tensors import RowTensors
from gsseg_core.raster.observation import Observation
from gsseg_core.raster.view_operator import ViewOperator
from gsseg_core.raster.view_renderer import PixelGrid
from gsseg_core.raster.vote_total import VoteTotal
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.scene_delta import SceneDelta

take_turns()

WIDTH, HEIGHT, CLASSES = 19, 13, 6  # two tiles, one of them cut off
SCENE, CAMERA = random_view(4, 80, WIDTH, HEIGHT)
MASK = random_mask(4, WIDTH, HEIGHT)
NEAR = 4e-6
RNG = np.random.default_rng(0)


def operators() -> list[ViewOperator]:
    return [make_operator(SCENE, CAMERA, device) for device in ("cpu", "cuda")]


def some_codes() -> np.ndarray:
    return RNG.random((len(SCENE), CLASSES), np.float32) * (RNG.random((len(SCENE), CLASSES)) < 0.3)


def test_a_gpu_is_simulated() -> None:
    assert isinstance(operators()[1], GPUOperator)
    assert not torch.cuda.is_available()


@pytest.mark.parametrize("seed", range(6))
def test_weights_are_those_of_the_cpu(seed: int) -> None:
    scene, camera = random_view(seed, 100, 40, 30)
    ours, theirs = make_operator(scene, camera), make_operator(scene, camera, "cuda")
    assert set(theirs.ids) <= set(ours.ids)
    np.testing.assert_allclose(dense(theirs), dense(ours), atol=1e-6)
    footprints = dict(zip(ours.ids.tolist(), ours.footprints(), strict=True))
    expected = [footprints[i] for i in theirs.ids.tolist()]
    np.testing.assert_allclose(theirs.footprints(), expected, rtol=1e-5)


def test_gaussians_at_the_same_depth_are_blended_in_the_order_of_the_cpu() -> None:
    # In one column of the image, three to a place; those of the first place are alike but for their opacity.
    means = [[0.1, y, 2.0] for y in (0.0, 0.1, -0.1) for _ in range(3)]
    quats, scales = [[1, 0.1 * i, 0.2, 0] for i in (0, 0, 0, 1, 2, 3, 3, 2, 1)], [[0.3, 0.2, 0.1]] * 9
    scene, camera = make_scene(means, quats, scales, np.linspace(0.3, 0.9, 9)), make_camera(WIDTH, HEIGHT)
    ours, theirs = (make_operator(scene, camera, device).weights().gaussians for device in ("cpu", "cuda"))
    np.testing.assert_array_equal(theirs, ours)


@pytest.mark.parametrize("channels", [0, 3, 33])
def test_renders_are_those_of_the_cpu(channels: int) -> None:
    codes = RNG.random((len(SCENE), channels), np.float32)
    (image, left_over), found = (operator.blend(codes) for operator in operators())
    assert found.image.shape == (HEIGHT, WIDTH, channels)
    np.testing.assert_allclose(found.image, image, atol=NEAR)
    np.testing.assert_allclose(found.transmittance, left_over, atol=NEAR)


def test_a_view_without_some_gaussians_is_that_of_the_cpu() -> None:
    hidden = RNG.random(len(SCENE)) < 0.5
    ours, theirs = (dense(operator.without(hidden)) for operator in operators())
    np.testing.assert_allclose(theirs, ours, atol=1e-6)


def test_what_is_carried_back_is_that_of_the_cpu() -> None:
    residual = RNG.normal(size=(HEIGHT, WIDTH, 9)).astype(np.float32)
    ours, theirs = (operator.adjoint(residual) for operator in operators())
    np.testing.assert_allclose(theirs, ours, atol=1e-4, rtol=1e-5)


@pytest.mark.parametrize("background", [False, True])
def test_the_strongest_class_is_that_of_the_cpu(background: bool) -> None:
    codes, colors = CSRRows.from_dense(some_codes()), RNG.random((len(SCENE), 3), np.float32)
    ours, theirs = (
        operator.strongest(codes, CLASSES, background, PixelGrid(1, 4), beside=colors[operator.ids])
        for operator in operators()
    )
    np.testing.assert_array_equal(theirs.known, ours.known)
    np.testing.assert_array_equal(theirs.classes[ours.known], ours.classes[ours.known])
    assert ours.beside is not None and theirs.beside is not None
    np.testing.assert_allclose(theirs.beside.image, ours.beside.image, atol=NEAR)


@pytest.mark.parametrize("weighted", [False, True])
def test_votes_and_shares_are_those_of_the_cpu(weighted: bool) -> None:
    weights = RNG.choice(np.float32([0, 1, 4]), (-(-HEIGHT // 4), -(-WIDTH // 4))) if weighted else None
    ours, theirs = (operator.observe(MASK, weights=weights) for operator in operators())
    for name in ("ids", "start", "classes", "areas", "weighted_areas"):
        np.testing.assert_array_equal(getattr(theirs, name), getattr(ours, name), err_msg=name)
    np.testing.assert_allclose(theirs.dense(theirs.votes()), ours.dense(ours.votes()), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(theirs.votes_by_label(), ours.votes_by_label(), rtol=1e-5)
    likelihood = RNG.random((len(ours.ids), len(ours.classes)), np.float32)
    rest = RNG.random(len(ours.classes), np.float32)
    shares = [seen.shares(likelihood[seen.rows, seen.labels], rest) for seen in (ours, theirs)]
    pairs = [seen.dense(share.pairs) for seen, share in zip((ours, theirs), shares, strict=True)]
    np.testing.assert_allclose(pairs[1], pairs[0], rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(shares[1].rest, shares[0].rest, rtol=1e-4, atol=1e-3)
    assert shares[1].log_likelihood == pytest.approx(shares[0].log_likelihood, rel=1e-5)


def test_a_lifted_mask_and_the_pixels_of_a_grid_are_those_of_the_cpu() -> None:
    ours, theirs = (operator.lift(MASK) for operator in operators())
    for name in ("classes", "start", "gaussians"):
        np.testing.assert_array_equal(getattr(theirs, name), getattr(ours, name), err_msg=name)
    np.testing.assert_allclose(theirs.weights, ours.weights, rtol=1e-5, atol=1e-5)
    grid, codes = PixelGrid(1, 3), RNG.random((len(SCENE), 2), np.float32)
    images = [operator.blend_grid(codes[operator.ids], grid) for operator in operators()]
    for found, image in zip(images[1], images[0], strict=True):
        np.testing.assert_allclose(found, image, atol=NEAR)


@pytest.mark.parametrize("fits", [True, False])
def test_votes_of_many_views_are_summed_where_they_lie_and_end_on_the_cpu(
    fits: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gpu_operator, "_COPIED", 100)  # in several blocks
    if not fits:
        monkeypatch.setattr(gpu_operator, "free_memory_on", lambda device: 1)
    prototypes = (np.unique(MASK, return_inverse=True)[1].reshape(MASK.shape) - 1).astype(np.int32)
    evidence = LabelEvidence(np.arange(3, dtype=np.int32), RNG.random((prototypes.max() + 1, 3), np.float32))
    views = [(random_mask(5, WIDTH, HEIGHT, range(CLASSES)), None), (prototypes, evidence)]
    before = np.full((len(SCENE), CLASSES), 7)
    ours, theirs = (VoteTotal.from_rows(CSRRows.from_dense(before), CLASSES) for _ in range(2))
    cpu, gpu = operators()
    with vote_total(theirs, "cuda") as total:
        assert isinstance(total, torch.Tensor) == fits
        for mask, means in views:
            gpu.observe(mask, means).vote(total)
    for mask, means in views:
        cpu.observe(mask, means).vote(ours)
    np.testing.assert_allclose(theirs.dense(), ours.dense(), atol=1e-5 * UNITS)
    with vote_total(theirs, "cuda") as total:
        for mask, means in views:
            gpu.observe(mask, means).vote(total, sign=-1)
    assert (theirs.dense() == 7).all()


def test_votes_of_a_scene_that_changes_are_those_of_its_views_fused_into_the_last_one() -> None:
    turned = dataclasses.replace(CAMERA, world_to_camera=np.diag([-1.0, 1, -1, 1]) @ CAMERA.world_to_camera)
    session = LivingSession(SCENE, device="cuda")
    # The last one comes in the place of the first.
    for seed, (name, camera) in enumerate([("a", CAMERA), ("b", turned), ("c", turned), ("a", CAMERA)]):
        mask = random_mask(seed, WIDTH, HEIGHT, range(CLASSES))
        assert session.fuse(View.from_arrays(dataclasses.replace(camera, name=name), mask)) is None
    seen, seen_too = (make_operator(SCENE, camera).ids for camera in (CAMERA, turned))
    assert session.update(SceneDelta(removed=np.setdiff1d(seen, seen_too)[::3].astype(np.int64))).num_views_lifted == 1
    fresh = LivingSession(session.living, device="cuda")
    for view in session.views:
        fresh.fuse(view)
    ours, theirs = (one._live._votes.dense() for one in (fresh, session))
    assert ours.any()
    np.testing.assert_array_equal(theirs, ours)


def test_objects_alone_have_the_reasons_of_the_cpu() -> None:
    labels = RNG.integers(-1, 4, len(SCENE)).astype(np.int32)
    shown = RNG.integers(-1, 4, (HEIGHT, WIDTH)).astype(np.int32)
    limit = RNG.choice(np.float32([2, 4, np.inf]), (HEIGHT, WIDTH))
    kept, asked = RNG.random(len(SCENE), np.float32), RNG.random(len(SCENE)) < 0.5
    reasons = []
    for operator in operators():
        alone, both = operator.objects_alone(labels), np.zeros((2, len(SCENE)))
        both[0, alone.ids] = alone.reasons_to_go(depths(SCENE, CAMERA, alone.ids), shown, limit)
        both[1, alone.ids] = alone.reasons_to_stay(kept[alone.ids], asked[alone.ids], shown)
        assert (labels[alone.ids] > 0).all()
        reasons.append(both)
    assert (reasons[0] > 0).any(axis=1).all()
    np.testing.assert_allclose(reasons[1], reasons[0], rtol=1e-4, atol=1e-3)


def test_rows_are_copied_once_and_forgotten_with_the_last_of_them() -> None:
    device, codes = torch.device("cpu"), CSRRows.from_dense(some_codes())
    copy = weakref.ref(RowTensors.kept(codes, device).data)
    assert RowTensors.kept(codes, device).data is copy()
    del codes
    gc.collect()
    assert copy() is None


def test_nothing_seen_is_no_pairs() -> None:
    behind = make_scene([[0, 0, -1.0]], [[1, 0, 0, 0]], [[0.1] * 3], [0.5])
    operator = make_operator(behind, make_camera(WIDTH, HEIGHT), "cuda")
    assert not len(operator.observe(MASK).ids)
    assert (operator.transmittance() == 1).all()


@pytest.mark.parametrize("kind", ["u2", "u4", "u8", ">i4", "read-only"])
def test_labels_may_be_integers_of_any_kind(kind: str) -> None:
    mask = np.where(MASK < 0, 3, MASK)
    taken = mask.copy() if kind == "read-only" else mask.astype(kind)
    taken.setflags(write=kind != "read-only")
    operator = operators()[1]
    np.testing.assert_array_equal(operator.observe(taken).votes(), operator.observe(mask).votes())


def test_codes_and_weights_of_float64_are_taken() -> None:
    codes, weights = some_codes(), RNG.random((-(-HEIGHT // 4), -(-WIDTH // 4)))
    rows = CSRRows.from_dense(codes.astype(np.float64))
    ours, theirs = (operator.blend_rows(rows, CLASSES).image for operator in operators())
    np.testing.assert_allclose(theirs, ours, atol=NEAR)
    ours, theirs = (operator.observe(MASK, weights=weights).weighted_areas for operator in operators())
    np.testing.assert_allclose(theirs, ours, rtol=1e-12)


SOME = np.arange(2, dtype=np.int32)  # of the Gaussians
REFUSED: dict[str, Callable[[ViewOperator, CSRRows], Any]] = {
    "codes of too many classes": lambda operator, codes: operator.blend_rows(codes, CLASSES - 1),
    "strongest of too many classes": lambda operator, codes: operator.strongest(codes, CLASSES - 1, True),
    "codes of some": lambda operator, codes: operator.strongest(codes.take(SOME), CLASSES, True, of=SOME),
    "wanted of another size": lambda operator, codes: operator.strongest(codes, CLASSES, True, wanted=MASK[1:] > 0),
    "pixels of another size": lambda operator, _: operator.blend_seen(np.ones((len(operator.ids), 1)), MASK[1:] > 0),
    "labels of some": lambda operator, _: operator.objects_alone(SOME),
    "labels of more": lambda operator, _: operator.objects_alone(np.zeros(len(SCENE) + 1, np.int32)),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_the_cpu_refuses_is_refused_in_the_same_words(what: str) -> None:
    said, codes = [], CSRRows.from_dense(np.ones((len(SCENE), CLASSES), np.float32))
    for operator in operators():
        with pytest.raises(GssegError) as error:
            REFUSED[what](operator, codes)
        said.append(str(error.value))
    assert said[0] == said[1]


def test_a_view_with_more_entries_than_can_be_numbered_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tiling, "MOST_ENTRIES", 5)
    with pytest.raises(SceneValueError, match=f"tiles of a view of {WIDTH} x {HEIGHT} pixels.* expected at most 5$"):
        make_operator(SCENE, CAMERA, "cuda")


def test_sums_may_be_larger_than_64_bits_hold() -> None:
    # As of 4 megapixels of one of 500 labels that are explained by chance alone, in a thousandth of the pixels.
    units = torch.tensor([(1 << 58) + 1] * 96)
    by_label = gpu_observation._px_by_label(units, torch.zeros(96, dtype=torch.int64), 2)
    np.testing.assert_array_equal(by_label, [96 * 2.0**34, 0])
    np.testing.assert_array_equal(em_gpu_kernels._in_px(units[:, None, None]), [[96 * 2.0**34]])


# Steps of EM


@pytest.mark.parametrize("grey", [False, True])
def test_edges_of_the_scene_are_those_of_the_cpu(grey: bool) -> None:
    colors = np.zeros_like(SCENE.sh) if grey else RNG.random(SCENE.sh.shape, np.float32)
    scene = GaussianScene.from_arrays(SCENE.means, SCENE.quats, SCENE.scales, SCENE.opacities, colors)
    ours, theirs = (
        kernels.scene_edges(make_operator(scene, CAMERA, device), scene, MASK, max(HEIGHT, WIDTH))
        for kernels, device in ((em_kernels, "cpu"), (em_gpu_kernels, "cuda"))
    )
    assert ours.any() != grey
    np.testing.assert_allclose(theirs, ours, atol=1e-4)


def by_label(seen: Observation, values: np.ndarray) -> np.ndarray:
    return np.asarray(seen.dense(np.asarray(values)))


@pytest.fixture(scope="module")
def step() -> dict[str, dict[str, np.ndarray]]:
    """All that EM does with the pairs of a view, on each device."""
    rng = np.random.default_rng(1)
    codes = CSRRows.from_dense(some_codes()).normalised()
    gradient = rng.integers(1 << 30, 1 << 40, len(codes.data))
    prior = rng.random(len(codes.data), np.float32)
    weights = rng.random((CLASSES, len(np.unique(MASK)) - 1), np.float32)
    by_class = np.ascontiguousarray(weights.T)
    votes = CSRRows.from_dense(rng.integers(0, int(100 * UNITS), (len(SCENE), CLASSES)))
    found = {}
    for name, kernels, operator in zip(("ours", "theirs"), (em_kernels, em_gpu_kernels), operators(), strict=True):
        seen = operator.observe(MASK)
        evidence = LabelEvidence(np.arange(len(seen.classes), dtype=np.int32))
        # No view votes for more than all of them.
        all_votes = votes.with_data(votes.data + int(300 * UNITS))
        pairs, here, total = (
            kernels.pairs_of(seen),
            kernels.put(codes, "cuda"),
            kernels.put(all_votes, "cuda"),
        )
        said = kernels.pair_likelihood(here, pairs, by_class)
        shares = kernels.shares(seen, here, pairs, by_class).pairs
        added = here.with_data(kernels.zeros(here, np.int64))
        kernels.accumulate(added, pairs, by_class, shares)
        stepped = kernels.rows_like(here, pairs.ids)
        kernels.m_step_without_view(
            here, kernels.put(gradient, "cuda"), kernels.put(prior, "cuda"), pairs, by_class, shares, stepped
        )
        found[name] = {
            "likelihood": by_label(seen, kernels.returned(said)),
            "gradient": kernels.returned(added.data) / 2.0**24,
            "without": kernels.returned(stepped.data),
            "classes": kernels.returned(stepped.indices).view(np.uint32),
            "put": kernels.returned(here.with_rows(pairs.ids, stepped).data),
            "confusion": kernels.confusion_counts(stepped, pairs, shares, CLASSES, len(seen.classes)),
            "again": by_label(
                seen, kernels.returned(kernels.pair_likelihood(stepped, kernels.by_row(pairs), by_class))
            ),
            "others": kernels.leave_one_out_counts(total, seen, np.ones(CLASSES, bool), evidence, 4.0),
            "others at most": kernels.leave_one_out_counts(total, seen, np.ones(CLASSES, bool), evidence, 1.0, 0.5),
        }
        kernels.subtract_votes(total, seen, evidence.votes)
        found[name]["subtracted"] = kernels.returned(total.data) / UNITS
    return found


@pytest.mark.parametrize(
    "what",
    ["likelihood", "gradient", "without", "classes", "put", "confusion", "again", "others", "others at most",
     "subtracted"],
)  # fmt: skip
def test_steps_are_those_of_the_cpu(step: dict[str, dict[str, np.ndarray]], what: str) -> None:
    assert step["ours"][what].any()
    np.testing.assert_allclose(step["theirs"][what], step["ours"][what], rtol=2e-4, atol=1e-4)
