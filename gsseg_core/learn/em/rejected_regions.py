"""Rejected regions: connected pixels of one label that the votes of all other views contradict.

Most errors of a segmenter sit in one place: a blob of clutter, an object under another's id, a whole bad frame. The
confusion matrix of a view, the same all over it, does not model them. So each *region* of a mask, connected pixels of
one label, is tested against the votes of all other views. Where they give enough of it to one class, and next to
nothing to that of its label, the label is rejected. What is rejected has no say against others: each is tested once
more, by the votes that are left. The pixels still belong together, so the region becomes a word of its own in the
view's vocabulary, of which the confusion matrix tells what it means. docs/method.md has the reasons.
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

SMALLEST = 64  # regions of fewer px are not split: all of one label are tested as one

CLAIMED = 0.2
"""Share of a region, by weight, that the other views must give to one class for it to be rejected."""

RIVALLED = 2.0
"""Where one other class has a region by the votes of the other views, this many times the share is asked for."""

MOST = 500  # regions of a mask that are split at most, the largest; what is left of each label is tested as one


def split_regions(seen: SeenLabels) -> SeenLabels:
    """Split a plain mask into regions, each a label of its own with evidence for the same class as before."""
    if seen.evidence is not None or not (seen.labels >= 0).any():
        return seen
    connected, first, area = connected_pixels(seen.labels)
    label = seen.labels.ravel()[first]
    alone = np.zeros(len(area), bool)
    alone[np.argsort(-area, kind="stable")[:MOST]] = True
    alone &= area >= SMALLEST
    classes, position = np.unique(label, return_inverse=True)
    # Those that stand alone keep a number each; the others have that of their class.
    regions = np.unique(np.where(alone, len(classes) + np.arange(len(area)), position), return_inverse=True)[1]
    mass = np.zeros((int(regions.max()) + 1, len(classes)), np.float32)
    mass[regions, position] = 1
    labels = np.append(regions, UNKNOWN).astype(np.int32)[connected]
    return SeenLabels(labels, LabelEvidence(classes.astype(np.int32), mass))


def find_rejected(
    votes: CSRRows, observation: Observation, possible: np.ndarray, least: float, device: str = "cpu",
    doubted: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """Find the labels of a view that the votes of all other views contradict, (L,) bool; none of uncertain evidence.

    By the votes of the others, each class has some weight under a label. The label is contradicted if its own class has
    less than the share `least` of all that weight, or less than `RIVALLED` times `least` of what another class has: one
    class all over speaks more against a label than an even mixture of many. A Gaussian counts for no more px than the
    others saw of it: what shows through gaps in other views is little evidence, and of many classes. A region of which
    they give too little to any one class is kept.

    If there are `doubted` labels, (L,) bool, only they can be rejected, and their votes are not among the votes. The
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
    """Label the 4-connected components of pixels of one label, in the order of their first pixels.

    Returns the components, (H, W) int32, `UNKNOWN` (-1) where the label is negative; and of each its first pixel,
    counted row by row, and how many it has, (R,) int64 each. Runs of equal pixels are joined to those of the row above.
    """
    (height, width), connected = labels.shape, np.empty(labels.shape, np.int32)
    # Of runs; there are at most as many as pixels.
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
            # Once for each stretch in which the two rows go along with each other.
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
