"""Calibration: the temperature of what was learnt, fitted to masks that it has not learnt from.

No truth is needed. The masks of a few views, spread evenly, are predicted by `Learner.predict_without`: from all other
views by `em` and `votes`; by `gradient` from the codes as they are, which have seen the mask, though one view of many
moves them little.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from gsseg_core.data.view import spread
from gsseg_core.learn.learner import Learner
from gsseg_core.learn.mask_reliability import MaskChecker
from gsseg_core.learn.temperature import VIEWS, fit_temperature
from gsseg_core.progress import Progress, silent, with_progress


class Calibration(NamedTuple):
    """A fitted temperature, and from what."""

    temperature: float  # for `Segmentation.calibrated`
    views: int  # whose masks it was fitted to
    pixels: int  # of these
    unknown: float  # share of their labelled pixels, as far as sampled, of which little is predicted; 1 if none was
    held_out: bool  # whether the masks were predicted without learning from them

    def as_dict(self) -> dict[str, Any]:
        """Give it as `report.json` does."""
        return {**self._asdict(), "temperature": round(self.temperature, 4), "unknown": round(self.unknown, 4)}


def calibrate(learner: Learner, checker: MaskChecker | None = None, progress: Progress = silent) -> Calibration:
    """Fit the temperature of a learner's codes, after `fit`; nothing of it changes.

    A checker of this learner may be at hand: what it has rendered is not rendered again.
    """
    views, checker = spread(list(learner.views.values()), VIEWS), checker or MaskChecker(learner)
    samples = [checker.sample(view) for view in with_progress(progress, "calibrate", views)]
    pixels = sum(len(sample.seen) for sample in samples)
    unknown = 1 - pixels / max(pixels + sum(sample.unknown for sample in samples), 1)
    return Calibration(fit_temperature(samples), len(views), pixels, unknown, learner.leaves_out)
