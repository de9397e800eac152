"""What a live session knows now: class probabilities that were learnt, and votes where nothing was."""

from __future__ import annotations

import numpy as np

from gsseg_core.csr_rows import CSRRows
from gsseg_core.learn.learner import Learner
from gsseg_core.learn.learner_state import Learnt


def current_codes(votes: Learner, learnt: Learnt | None) -> CSRRows:
    """Class probabilities of every Gaussian, (N, K) float32; a row without entries where nothing is known."""
    codes = votes.vote_rows()
    if learnt is None:
        return codes
    settled = _settled(learnt, votes.evidence())
    return codes.replaced(np.where(settled, np.arange(codes.num_rows), -1), learnt.codes)


def current_evidence(votes: Learner, learnt: Learnt | None) -> np.ndarray | None:
    """Tell by how many px each of these codes was seen, (N,) float32; None where an older state does not say."""
    evidence = votes.evidence()
    if learnt is None:
        return evidence
    return None if learnt.evidence is None else np.where(_settled(learnt, evidence), learnt.evidence, evidence)


def _settled(learnt: Learnt, evidence: np.ndarray) -> np.ndarray:
    """Tell of which Gaussians what was learnt holds, (N,) bool, be it that nothing is known; the evidence is of votes.

    What learning saw and left unknown, it saw by labels that it rejected: votes for these must not come back. Where
    other views have seen as much of a Gaussian, votes have the say again.
    """
    known = learnt.codes.known()
    return known if learnt.evidence is None else known | (learnt.evidence > evidence / 2)
