"""What a live session knows now: class probabilities that were learnt, votes where nothing was, and what they make."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gsseg_core.csr_rows import CSRRows
from gsseg_core.learn.learner import Learner
from gsseg_core.learn.learner_state import Learnt
from gsseg_core.progress import Stopwatch
from gsseg_core.refine.settings import RefineSettings
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import Segmentation


@dataclass(frozen=True, eq=False)
class Known:
    """What a session knows at one moment, copied, so that it can be segmented while the session goes on."""

    scene: GaussianScene
    codes: CSRRows  # (N, K) float32
    evidence: np.ndarray | None  # (N,) float32, px; None where it is not known, or not asked for
    class_names: Mapping[int, str]
    cameras: Sequence[Camera]  # by which objects are carved
    temperature: float

    def segmentation(self, settings: RefineSettings, device: str, watch: Stopwatch) -> Segmentation:
        """Refine the class probabilities, label every Gaussian, and calibrate; `watch` gets the seconds of each."""
        with watch.stage("knn"):
            result = Segmentation.unfiltered(self.scene, self.codes, self.class_names, settings, self.evidence)
        if settings.filter:
            with watch.stage("filter"):
                result = result.filtered(self.scene, settings)
        if settings.carve:
            with watch.stage("carve"):
                result = result.carved(self.scene, self.cameras, device, settings.carve_views)
        return result.calibrated(self.temperature)


def current_codes(votes: Learner, learnt: Learnt | None) -> CSRRows:
    """Class probabilities of every Gaussian, (N, K) float32; a row without entries where nothing is known."""
    codes = votes.vote_rows()
    if learnt is None:
        return codes
    return codes.replaced(np.where(learnt.codes.known(), np.arange(codes.num_rows), -1), learnt.codes)


def current_evidence(votes: Learner, learnt: Learnt | None) -> np.ndarray | None:
    """Tell by how many px each of these codes was seen, (N,) float32; None where an older state does not say."""
    evidence = votes.evidence()
    if learnt is None:
        return evidence
    return None if learnt.evidence is None else np.where(learnt.codes.known(), learnt.evidence, evidence)
