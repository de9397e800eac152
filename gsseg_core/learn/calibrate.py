"""Calibration: fits the temperature of learnt probabilities to masks that they were not learnt from.

It needs no ground truth. `Learner.predict_without` predicts the masks of a few views, spread evenly: `em` and `votes`
predict each from all other views. `gradient` uses its codes unchanged, which were also learnt from the mask; one view
of many has little influence on them.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from gsseg_core.data.view import spread
from gsseg_core.learn.learner import Learner
from gsseg_core.learn.mask_reliability import MaskChecker
from gsseg_core.learn.temperature import VIEWS, fit_temperature
from gsseg_core.progress import Progress, silent, with_progress


class Calibration(NamedTuple):
    """A fitted temperature, and the data to which it was fitted."""

    temperature: float  # for `Segmentation.calibrated`
    views: int  # number of views whose masks were used
    pixels: int  # number of sampled pixels
    unknown: float  # share of sampled labelled pixels that are mostly not predicted; 1 if no pixel was sampled
    held_out: bool  # whether each mask was predicted without learning from it

    def as_dict(self) -> dict[str, Any]:
        """Return the entry for `report.json`."""
        return {**self._asdict(), "temperature": round(self.temperature, 4), "unknown": round(self.unknown, 4)}


def calibrate(learner: Learner, checker: MaskChecker | None = None, progress: Progress = silent) -> Calibration:
    """Fit the temperature of a learner's codes, after `fit`; the learner does not change.

    Pass a `checker` of this learner, if there is one, to reuse what it has rendered.
    """
    views, checker = spread(list(learner.views.values()), VIEWS), checker or MaskChecker(learner)
    samples = [checker.sample(view) for view in with_progress(progress, "calibrate", views)]
    pixels = sum(len(sample.seen) for sample in samples)
    unknown = 1 - pixels / max(pixels + sum(sample.unknown for sample in samples), 1)
    return Calibration(fit_temperature(samples), len(views), pixels, unknown, learner.leaves_out)
