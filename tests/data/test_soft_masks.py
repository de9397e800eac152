"""Soft and partial masks as such: what is rounded, what a label means, and what bad files get."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from small_scenes import HEIGHT, NAMES, NUM_CLASSES, WIDTH, ring, write_dataset

from gsseg_core.data.dataset import Dataset
from gsseg_core.data.label_images import UNKNOWN, write_mask
from gsseg_core.data.soft_masks import (
    MOST_PROTOTYPES,
    STEPS,
    PackedMask,
    SeenLabels,
    _rounded,
    combine_detections,
    quantise,
    restrict,
)
from gsseg_core.data.view import View
from gsseg_core.errors import GssegError, MaskFormatError, MaskSizeError, SupervisesFileError, UnknownLabelError

CAMERA = ring(1)[0]


def random_probabilities(
    seed: int, classes: int = 5, size: tuple[int, int] = (12, 9), sharp: float = 4.0
) -> np.ndarray:
    """Probabilities (C, H, W) float32 of a segmenter that is sure of some pixels and not of others."""
    rng = np.random.default_rng(seed)
    scores = np.exp(sharp * rng.normal(size=(classes, *size)) * rng.random(size))
    out = scores / scores.sum(axis=0)
    out[:, rng.random(size) < 0.1] *= 0.3
    return out.astype(np.float32)


def said(seen: SeenLabels, num_classes: int) -> np.ndarray:
    """Mass of each class in each pixel, (K, H, W); NaN where the mask says nothing."""
    if seen.evidence is None:
        table = np.eye(num_classes, dtype=np.float32)
    else:
        table = np.zeros((len(seen.evidence.mass), num_classes), np.float32)
        table[:, seen.evidence.classes] = seen.evidence.mass
    return np.where(seen.labels >= 0, np.moveaxis(table[seen.labels], -1, 0), np.nan)


def slow_rounded(probabilities: np.ndarray, steps: int) -> np.ndarray:  # (K,) of one pixel
    scaled = probabilities.astype(np.float32) * steps
    parts = np.rint(scaled) if np.rint(scaled).sum() <= steps else np.floor(scaled)
    first = scaled.argmax()
    if parts[first] > 0 and ((parts == parts[first]) & (scaled < scaled[first] - np.float32(0.01))).any():
        parts = np.floor(scaled)
        parts[first] = min(np.ceil(scaled[first]), steps - np.delete(parts, first).sum())
    return parts


@pytest.mark.parametrize("steps", STEPS)
@pytest.mark.parametrize("classes", [0, 1, 2, 5])
def test_the_kernel_that_rounds_does_what_its_slow_twin_does(steps: int, classes: int) -> None:
    values = np.random.default_rng(steps).dirichlet(np.ones(classes + 1), 500)[:, :classes].astype(np.float32)
    values[::3] = np.rint(20 * values[::3]) / 20  # Equal ones among them.
    values[::7] *= np.float32(1.01)  # As images of 8 bits may have them.
    expected = [slow_rounded(pixel, steps) for pixel in values] if classes else np.empty((500, 0))
    parts = _rounded(values, steps)
    np.testing.assert_array_equal(parts, expected)
    assert parts.sum(axis=1).max(initial=0) <= steps


@given(st.integers(0, 10_000), st.integers(1, 6), st.sampled_from([0.5, 4.0, 40.0]))
def test_no_probability_changes_by_as_much_as_one_step(seed: int, classes: int, sharp: float) -> None:
    probabilities = random_probabilities(seed, classes, sharp=sharp)
    seen = quantise(probabilities)
    rounded = said(seen, classes)
    known = seen.labels >= 0
    assert np.abs(rounded - probabilities)[:, known].max(initial=0) < 1 / STEPS[0]
    assert probabilities[:, ~known].max(initial=0) <= 0.5 / STEPS[0], "only what rounds to nothing is unknown"
    assert rounded[:, known].sum(axis=0).max(initial=0) <= 1
    assert len(np.unique(seen.labels[known])) <= MOST_PROTOTYPES
    # What is likeliest stays so, if it rounds to anything.
    first = probabilities.argmax(axis=0)
    second = np.partition(np.vstack([probabilities, np.zeros_like(probabilities)]), -2, axis=0)[-2]
    clear = known & (probabilities.max(axis=0) > second + 0.001) & (probabilities.max(axis=0) > 0.51 / STEPS[0])
    np.testing.assert_array_equal(rounded.argmax(axis=0)[clear], first[clear])


def test_too_many_prototypes_are_rounded_more_coarsely_and_never_lost() -> None:
    probabilities = random_probabilities(3, 8, (80, 90), sharp=1.5)
    seen = quantise(probabilities)
    assert seen.evidence is not None and len(seen.evidence.mass) <= MOST_PROTOTYPES
    steps = [s for s in STEPS if np.allclose(seen.evidence.mass * s, np.rint(seen.evidence.mass * s))][-1]
    known = seen.labels >= 0
    assert steps < STEPS[0] and np.abs(said(seen, 8) - probabilities)[:, known].max() < 1 / steps
    assert known.mean() > 0.5


@given(st.integers(0, 10_000))
def test_a_sure_segmenter_gives_the_plain_mask(seed: int) -> None:
    labels = np.random.default_rng(seed).integers(-1, 5, (7, 8))
    probabilities = (np.arange(5)[:, None, None] == labels).astype(np.float16)
    seen = quantise(probabilities)
    assert seen.evidence is None
    np.testing.assert_array_equal(seen.labels, labels)


@given(st.integers(0, 10_000))
def test_the_order_of_the_classes_does_not_matter(seed: int) -> None:
    probabilities, ids = random_probabilities(seed), np.array([4, 0, 9, 2, 7])
    order = np.random.default_rng(seed).permutation(5)
    one, two = quantise(probabilities, ids), quantise(probabilities[order], ids[order])
    assert one.evidence is not None and two.evidence is not None
    np.testing.assert_array_equal(one.labels, two.labels)
    np.testing.assert_array_equal(one.evidence.mass, two.evidence.mass)
    np.testing.assert_array_equal(one.evidence.classes, two.evidence.classes)


@given(st.integers(0, 10_000), st.integers(0, 31))
def test_plausibility_and_votes_are_those_of_the_definition(seed: int, looked_for: int) -> None:
    """Twin: pl(c) = m_c + r [c in A] and m_c - r [c in S], written out pixel by pixel."""
    supervised = [k for k in range(5) if looked_for >> k & 1]
    probabilities = random_probabilities(seed)[supervised or slice(None)]
    seen = quantise(probabilities, supervised or None)
    if seen.evidence is None:
        return
    evidence, num_classes = seen.evidence, 6
    plausible, votes = evidence.plausibility(num_classes), evidence.votes.dense(num_classes)
    for label, mass in enumerate(evidence.mass):
        rest = 1 - float(mass.sum())
        for k in range(num_classes):
            m = float(mass[evidence.classes == k].sum())
            free = k not in supervised if supervised else True
            assert plausible[label, k] == pytest.approx(m + rest * free, abs=1e-6)
            assert votes[label, k] == pytest.approx(m - rest * (bool(supervised) and k in supervised), abs=1e-6)


def test_what_was_not_looked_for_gets_neither_votes_nor_doubt() -> None:
    seen = restrict(np.array([[0, 2, UNKNOWN]]), [2, 3])
    assert seen.evidence is not None
    np.testing.assert_array_equal(seen.evidence.votes.dense(5), [[0, 0, -1, -1, 0], [0, 0, 1, 0, 0]])
    np.testing.assert_array_equal(seen.evidence.plausibility(5), [[1, 1, 0, 0, 1], [0, 0, 1, 0, 0]])
    np.testing.assert_array_equal(seen.named(), [[UNKNOWN, 2, UNKNOWN]])


def test_one_detector_says_its_class_or_not_its_class() -> None:
    seen = combine_detections({3: np.array([[0.0, 0.25, 1.0]], np.float32)})
    assert seen.evidence is not None
    np.testing.assert_allclose(seen.evidence.votes.dense(5)[seen.labels[0], 3], [-1, -0.5, 1])
    np.testing.assert_allclose(seen.evidence.plausibility(5)[seen.labels[0], 0], [1, 0.75, 0])


def test_detectors_that_contradict_each_other_are_weighed_by_their_odds() -> None:
    seen = combine_detections({1: np.array([[0.8, 1.0, 1.0]]), 2: np.array([[0.7, 0.0, 1.0]])})
    expected = np.array([[0.24, 0.14], [1, 0], [0.5, 0.5]]) / [[0.44], [1], [1]]
    assert np.abs(said(seen, 3)[1:, 0].T - expected).max() < 1 / STEPS[0]


def test_pixels_marked_as_unknown_are_no_evidence_at_all() -> None:
    probabilities, unknown = random_probabilities(1), np.zeros((12, 9), bool)
    unknown[2:5, 3:] = True
    for classes in (None, range(5)):
        assert (quantise(probabilities, classes, unknown=unknown).labels[unknown] == UNKNOWN).all()


def test_packing_keeps_everything() -> None:
    seen = quantise(random_probabilities(5), range(1, 6))
    packed = PackedMask(seen)
    np.testing.assert_array_equal(packed.unpack().labels, seen.labels)
    assert packed.unpack().evidence is seen.evidence and packed.largest == 5


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (lambda p: p * np.nan, MaskFormatError, "values are NaN"),
        (lambda p: p - 0.5, MaskFormatError, "values are from -0.5"),
        (lambda p: p * 2, MaskFormatError, "values are from|sum to"),
        (lambda p: np.concatenate([p, p]), MaskFormatError, "sum to 2.000; expected at most 1"),
        (lambda p: (p * 255).astype(np.uint8), MaskFormatError, "uint8"),
        (lambda p: p[0], MaskFormatError, r"of shape \(48, 64\); expected"),
        (lambda p: p[:, :-1], MaskSizeError, "64 x 47 pixels; expected 64 x 48"),
    ],
)
def test_unusable_probabilities_get_one_clear_error(change: object, error: type[GssegError], message: str) -> None:
    good = np.zeros((NUM_CLASSES, HEIGHT, WIDTH), np.float32)
    good[1] = 1
    with pytest.raises(error, match=f"view 'view0'.*({message})"):
        View.from_probabilities(CAMERA, change(good))  # type: ignore[operator]


def test_unusable_classes_get_one_clear_error() -> None:
    good = np.full((2, HEIGHT, WIDTH), 0.5, np.float32)
    for classes in ([1], [1, 1], [1, -2], [1, 70_000], [0.5, 1.5]):
        with pytest.raises(UnknownLabelError, match="view 'view0': classes are"):
            View.from_probabilities(CAMERA, good, classes)  # type: ignore[arg-type]
    with pytest.raises(UnknownLabelError, match="holds the labels 7; expected ids"):
        View.from_probabilities(CAMERA, good, [1, 7], class_names=NAMES)
    with pytest.raises(UnknownLabelError, match="labels 3; expected those that it supervises"):
        View.from_arrays(CAMERA, np.full((HEIGHT, WIDTH), 3), supervised=[1])
    with pytest.raises(MaskFormatError, match="no detections"):
        View.from_detections(CAMERA, {})
    with pytest.raises(MaskFormatError, match="class 1 is int64"):
        View.from_detections(CAMERA, {1: np.ones((HEIGHT, WIDTH), np.int64)})
    with pytest.raises(MaskSizeError, match="class 2 is 63 x 48"):
        View.from_detections(CAMERA, {1: np.ones((HEIGHT, WIDTH), bool), 2: np.ones((HEIGHT, WIDTH - 1), bool)})


# Files


def dataset_with(folder: Path, write: object) -> View:
    """The first view of a dataset whose first mask is replaced by what is written."""
    write_dataset(folder)
    (folder / "labels" / "view0.png").unlink()
    write(folder / "labels")  # type: ignore[operator]
    return Dataset(folder).views("all")[0]


def test_npz_is_read_as_what_it_was_made_of(tmp_path: Path) -> None:
    probabilities = random_probabilities(0, NUM_CLASSES, (HEIGHT, WIDTH)).astype(np.float16)
    unknown = np.zeros((HEIGHT, WIDTH), bool)
    unknown[:5] = True

    def write(labels: Path) -> None:
        np.savez_compressed(labels / "view0.npz", probabilities=probabilities[1:3], classes=[2, 1], unknown=unknown)

    view = dataset_with(tmp_path, write)
    seen, expected = view.read_seen(), quantise(probabilities[1:3], [2, 1], unknown=unknown)
    np.testing.assert_array_equal(seen.labels, expected.labels)
    np.testing.assert_array_equal(seen.evidence.mass, expected.evidence.mass)  # type: ignore[union-attr]
    assert view.has_mask and view.mask_bits == 8 and view.largest_label == 2
    labels = view.read_labels()
    assert set(np.unique(labels)) <= {UNKNOWN, 1, 2} and (labels[:5] == UNKNOWN).all()


def test_images_of_detections_are_read_in_8_and_16_bits_and_float(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    chances = rng.choice([0.02, 0.3, 0.7, 0.95], (3, HEIGHT, WIDTH)).astype(np.float32)

    def write(labels: Path) -> None:
        (labels / "view0").mkdir()
        Image.fromarray((255 * chances[0]).round().astype(np.uint8)).save(labels / "view0/1.png")
        Image.fromarray((65535 * chances[1]).round().astype(np.uint16)).save(labels / "view0/2.png")
        Image.fromarray(chances[2]).save(labels / "view0/3.tif")
        Image.fromarray((chances[0] < 0.1).astype(np.uint8)).save(labels / "view0/unknown.png")

    seen = dataset_with(tmp_path, write).read_seen()
    expected = combine_detections(dict(enumerate(chances, 1)), unknown=chances[0] < 0.1)
    np.testing.assert_array_equal(seen.labels == UNKNOWN, expected.labels == UNKNOWN)
    assert np.nanmax(np.abs(said(seen, 4) - said(expected, 4))) <= 1 / STEPS[0]
    np.testing.assert_array_equal(seen.evidence.supervised, [1, 2, 3])  # type: ignore[union-attr]


def test_a_detection_that_its_tags_turn_is_refused(tmp_path: Path) -> None:
    def write(labels: Path) -> None:
        (labels / "view0").mkdir()
        Image.fromarray(np.ones((HEIGHT, WIDTH), np.float32)).save(labels / "view0/3.tif", tiffinfo={0x0112: 3})

    with pytest.raises(MaskFormatError, match=r"3\.tif: has the orientation 3 in its tags; expected 1, or none"):
        dataset_with(tmp_path, write).read_seen()


@pytest.mark.parametrize("kind", ["1", "L"])
def test_a_detection_in_which_0_is_white_is_refused_for_one_reader_has_it_inverted(tmp_path: Path, kind: str) -> None:
    def write(labels: Path) -> None:
        (labels / "view0").mkdir()
        Image.new(kind, (WIDTH, HEIGHT), 1).save(labels / "view0/3.tif", tiffinfo={0x0106: 0})

    with pytest.raises(MaskFormatError, match=r"3\.tif: is a TIFF in which 0 is white.*expected 0 to be black"):
        dataset_with(tmp_path, write).read_seen()


def test_a_detection_in_doubles_is_refused_with_what_is_read(tmp_path: Path) -> None:
    def write(labels: Path) -> None:
        (labels / "view0").mkdir()
        path = labels / "view0/3.tif"
        Image.fromarray(np.ones((HEIGHT, WIDTH), np.float32)).save(path)
        bits = b"\x02\x01\x03\x00\x01\x00\x00\x00"  # the tag of the bits of a number
        path.write_bytes(path.read_bytes().replace(bits + b"\x20", bits + b"\x40", 1))

    with pytest.raises(MaskFormatError, match=r"3\.tif: broken image .*expected .* in 8 or 16 bits, or float32"):
        dataset_with(tmp_path, write).read_seen()


def test_supervises_json_tells_what_label_images_say_something_of(tmp_path: Path) -> None:
    write_dataset(tmp_path)
    for camera in ring(6):
        write_mask(tmp_path / f"labels/{camera.name}.png", np.full((HEIGHT, WIDTH), 0), 8)
    (tmp_path / "labels/supervises.json").write_text(json.dumps({"*": [1], "view3": [2, 3]}))
    views = {view.name: view for view in Dataset(tmp_path).views("all")}
    assert views["view0"].class_ids() == {1} and views["view3"].class_ids() == {2, 3}
    assert (views["view0"].read_labels() == UNKNOWN).all(), "an absent class is no evidence for the background"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "supervises.json"),
        ("[1]", "holds a list; expected"),
        ('{"nobody": [1]}', "names the view 'nobody', which has no camera"),
        ('{"view1": []}', "expected a list of ids"),
        ('{"view1": [true]}', "expected a list of ids"),
        ('{"*": [9]}', "has the class 9; expected ids of classes.json"),
        ('{"view0": [1]}', "names view0.npz, which lists its own classes"),
    ],
)
def test_broken_supervises_json_gets_one_clear_error(tmp_path: Path, content: str, message: str) -> None:
    write_dataset(tmp_path)
    (tmp_path / "labels/view0.png").rename(tmp_path / "labels/view0.npz")
    (tmp_path / "labels/supervises.json").write_text(content)
    with pytest.raises(SupervisesFileError, match=message) as caught:
        Dataset(tmp_path)
    assert "\n" not in str(caught.value)


FULL = np.full((NUM_CLASSES, HEIGHT, WIDTH), 1 / NUM_CLASSES, np.float32)


@pytest.mark.parametrize(
    ("arrays", "error", "message"),
    [
        ({"logits": FULL}, MaskFormatError, "holds logits; expected an array 'probabilities'; labels, one for each"),
        ({"probabilities": FULL[:2]}, UnknownLabelError, "of 2 classes; expected 4"),
        ({"probabilities": FULL, "classes": np.arange(3)}, UnknownLabelError, "expected 4 ids"),
        ({"probabilities": FULL, "classes": np.arange(1, 5)}, UnknownLabelError, "labels 4"),
        ({"probabilities": FULL, "unknown": np.zeros((HEIGHT, WIDTH))}, MaskFormatError, "unknown is float64"),
        ({"probabilities": FULL, "unknown": np.zeros((3, 3), bool)}, MaskSizeError, r"unknown has shape \(3, 3\)"),
        ({"probabilities": np.array([{}])}, MaskFormatError, "expected numbers"),
    ],
)
def test_unusable_npz_gets_one_clear_error(
    tmp_path: Path, arrays: dict[str, np.ndarray], error: type[GssegError], message: str
) -> None:
    view = dataset_with(tmp_path, lambda labels: np.savez(labels / "view0.npz", **arrays))
    with pytest.raises(error, match=message) as caught:
        view.read_seen()
    assert "view0.npz" in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.6, 0.99])
def test_truncated_npz_gets_one_clear_error(tmp_path: Path, share: float) -> None:
    view = dataset_with(tmp_path, lambda labels: np.savez(labels / "view0.npz", probabilities=FULL))
    assert view.mask_path is not None
    whole = view.mask_path.read_bytes()
    view.mask_path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(
        MaskFormatError, match=r"view0\.npz: is not an npz with probabilities \(K, H, W\), or is damaged"
    ):
        view.read_seen()


def test_unusable_detections_get_one_clear_error(tmp_path: Path) -> None:
    def folder(labels: Path) -> None:
        (labels / "view0").mkdir()

    view = dataset_with(tmp_path, folder)
    path = tmp_path / "labels/view0"
    with pytest.raises(MaskFormatError, match="no detections"):
        view.read_seen()
    (path / "1.png").write_bytes(b"not an image")
    with pytest.raises(MaskFormatError, match=r"1\.png: broken image"):
        view.read_seen()
    Image.new("RGB", (WIDTH, HEIGHT)).save(path / "1.png")
    with pytest.raises(MaskFormatError, match="of kind RGB"):
        view.read_seen()
    Image.new("L", (WIDTH, HEIGHT)).save(path / "1.png")
    Image.new("L", (WIDTH, HEIGHT)).save(path / "chair.png")
    with pytest.raises(UnknownLabelError, match="named 'chair'; expected the id"):
        view.read_seen()
    (path / "chair.png").rename(path / "9.png")
    with pytest.raises(UnknownLabelError, match="labels 9; expected ids"):
        view.read_seen()
    Image.new("L", (WIDTH, HEIGHT)).save(tmp_path / "labels/view0.png")
    with pytest.raises(MaskFormatError, match=r"has view0 and view0\.png; expected one mask"):
        Dataset(tmp_path)
