"""Rejected regions: connected pixels of one label that the votes of all other views contradict.

Most errors of a segmenter are local: a blob of clutter, an object with the id of another one, or a whole bad frame. The
confusion matrix of a view is the same for all pixels and does not model them. So each *region* of a mask, connected
pixels of one label, is tested against the votes of all other views. Its label is rejected if these votes give enough of
the region to one class and almost nothing to the class of the label. Since rejected labels may themselves have
contradicted others, each one is tested again by the remaining votes. The pixels of a rejected region still belong
together: the region becomes a new word of the view's vocabulary, and the confusion matrix learns which class it means.
docs/method.md has the reasons.
"""

from __future__ import annotations

import numpy as np

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.label_evidence import LabelEvidence
from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.data.soft_masks import SeenLabels
from gsseg_core.kernels.compiler import called_by_kernels, kernel
from gsseg_core.learn.em.pair_kernels import kernels_on
from gsseg_core.raster.observation import Observation

SMALLEST = 64  # px; smaller regions of one label are tested together

CLAIMED = 0.2
"""Share of a region, by weight, that the other views must give to a single class before its label is rejected."""

RIVALLED = 2.0
"""Factor on the required share `least` when the label is compared with the strongest class of the other views."""

MOST = 500  # only this many of the largest regions of a mask are split; the rest of each label is tested together


def split_regions(seen: SeenLabels) -> SeenLabels:
    """Split a plain mask into regions; each gets its own label, with evidence for the same class as before."""
    if seen.evidence is not None or not (seen.labels >= 0).any():
        return seen
    connected, first, area = connected_pixels(seen.labels)
    label = seen.labels.ravel()[first]
    alone = np.zeros(len(area), bool)
    alone[np.argsort(-area, kind="stable")[:MOST]] = True
    alone &= area >= SMALLEST
    classes, position = np.unique(label, return_inverse=True)
    # Split regions get a number each; the others share the number of their class.
    regions = np.unique(np.where(alone, len(classes) + np.arange(len(area)), position), return_inverse=True)[1]
    mass = np.zeros((int(regions.max()) + 1, len(classes)), np.float32)
    mass[regions, position] = 1
    labels = np.append(regions, UNKNOWN).astype(np.int32)[connected]
    return SeenLabels(labels, LabelEvidence(classes.astype(np.int32), mass))


def find_rejected(
    votes: CSRRows, observation: Observation, possible: np.ndarray, least: float, device: str = "cpu",
    doubted: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """Find the labels of a view that the votes of all other views contradict, (L,) bool; none if evidence is uncertain.

    The votes of the other views give each class some weight under a label. They contradict the label if its own class
    has less than

    - the share `least` of the weight of all classes, or
    - `RIVALLED` times `least` of the weight of the strongest class. This share is larger because a single other class
      is stronger evidence against a label than an even mixture of many.

    A label is kept if no class has more than the share `CLAIMED` of the view's own votes for it. A Gaussian counts for
    no more px than the other views saw of it, because what they see through gaps is weak evidence, of many classes.

    If `doubted` labels are given, (L,) bool, only they can be rejected, and `votes` must not include their votes. The
    other parameters are those of `leave_one_out_counts`, with the votes on the device.
    """
    evidence = observation.evidence
    if not evidence.is_certain:
        return np.zeros(len(observation.classes), bool)
    voted_with = evidence if doubted is None else evidence.without_names(doubted)
    counts = kernels_on(device).leave_one_out_counts(votes, observation, possible, voted_with, most=1.0)
    label = np.arange(len(evidence.informative))
    covered, rival = counts.sum(axis=0), counts.max(axis=0)
    enough = rival > CLAIMED * observation.votes_by_label()
    rejected: np.ndarray = enough & (counts[evidence.named(), label] < least * np.maximum(covered, RIVALLED * rival))
    return rejected if doubted is None else rejected & doubted


@kernel
def connected_pixels(labels: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # (H, W) int32
    """Find the 4-connected components of equal labels, numbered in the order of their first pixels.

    Returns the component of each pixel, (H, W) int32, `UNKNOWN` (-1) where the label is negative; and for each
    component its first pixel, as a flat index (row-major), and its number of pixels, (R,) int64 each. Runs of equal
    pixels are joined to runs of the row above.
    """
    (height, width), connected = labels.shape, np.empty(labels.shape, np.int32)
    # One entry per run; there are at most as many runs as pixels.
    parent, begin, runs = np.empty(labels.size, np.int32), np.empty(labels.size, np.int32), 0
    for y in range(height):
        for x in range(width):
            if labels[y, x] < 0:
                connected[y, x] = -1
                continue
            joined = x > 0 and labels[y, x] == labels[y, x - 1]
            if not joined:
                parent[runs], begin[runs] = runs, y * width + x
                runs += 1
            connected[y, x] = run = runs - 1
            # Join once per stretch of columns in which both rows have this label.
            if y > 0 and labels[y, x] == labels[y - 1, x] and not (joined and labels[y - 1, x - 1] == labels[y, x]):
                one, two = _root(parent, run), _root(parent, connected[y - 1, x])
                parent[max(one, two)] = min(one, two)
    number, first, count = np.empty(runs, np.int32), np.empty(runs, np.int64), 0
    for run in range(runs):
        root = _root(parent, run)
        if root == run:
            number[run], first[count] = count, begin[run]
            count += 1
        else:
            number[run] = number[root]
    area, pixels = np.zeros(count, np.int64), connected.ravel()
    for p in range(pixels.shape[0]):
        if pixels[p] >= 0:
            pixels[p] = number[pixels[p]]
            area[pixels[p]] += 1
    return connected, first[:count].copy(), area


@called_by_kernels
def _root(parent: np.ndarray, i: int) -> int:
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i
