"""Class probabilities of a live session as they are now: those that were learnt, and votes where nothing was."""

from __future__ import annotations

import numpy as np

from gsseg_core.learn.learner import Learner
from gsseg_core.learn.learner_state import Learnt


def current_codes(votes: Learner, learnt: Learnt | None) -> np.ndarray:
    """Class probabilities of every Gaussian, (N, K) float32; a row of zeros where nothing is known."""
    codes = votes.vote_codes()
    if learnt is not None:
        known = learnt.codes.any(axis=1)
        codes[known] = np.pad(learnt.codes[known], ((0, 0), (0, codes.shape[1] - learnt.codes.shape[1])))
    return codes


def current_evidence(votes: Learner, learnt: Learnt | None) -> np.ndarray | None:
    """Tell by how many px each of these codes was seen, (N,) float32; None where an older state does not say."""
    evidence = votes.evidence()
    if learnt is None:
        return evidence
    return None if learnt.evidence is None else np.where(learnt.codes.any(axis=1), learnt.evidence, evidence)
