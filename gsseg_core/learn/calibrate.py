"""The temperature of what was learnt, fitted to masks that the codes have not learnt from (see `calibration`).

No truth is needed. Of a few views, spread evenly, the mask is predicted from all other views:

- `em`: by one more step without the summand of the view, as for its reliability;
- `votes`: by the votes of the others, exactly, since votes can be taken back;
- `gradient`: by the codes as they are. They have seen the mask, but one view of many moves them little.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from gsseg_core.data.view import View, spread
from gsseg_core.learn.em.em_learner import EMLearner
from gsseg_core.learn.learner import UNITS, Learner, Progress, silent
from gsseg_core.learn.mask_reliability import OtherViews
from gsseg_core.learn.temperature import VIEWS, Sample, fit_temperature, sample_pixels
from gsseg_core.learn.vote_learner import VoteLearner
from gsseg_core.raster.backends import make_operator


class Calibration(NamedTuple):
    """What was found.

    Attributes
    ----------
    temperature : float
        For `Segmentation.calibrated`.
    views : int
        Whose masks it was fitted to.
    pixels : int
        Of these.
    held_out : bool
        Whether the masks were predicted without learning from them.
    """

    temperature: float
    views: int
    pixels: int
    held_out: bool

    def as_dict(self) -> dict[str, Any]:
        """Give it as `report.json` does."""
        return {**self._asdict(), "temperature": round(self.temperature, 4)}


def calibrate(learner: Learner, others: OtherViews | None = None, progress: Progress = silent) -> Calibration:
    """Fit the temperature of a learner's codes.

    Parameters
    ----------
    learner : Learner
        After `fit`. Nothing of it changes.
    others : OtherViews, optional
        What the other views say, if that is at hand; only for `EMLearner`. What its checks have rendered is not
        rendered again.
    progress : callable, optional
        Told of every view.
    """
    views = spread(list(learner.views.values()), VIEWS)
    if others is None and isinstance(learner, EMLearner):
        others = OtherViews(learner, progress)
    samples = []
    for done, view in enumerate(views):
        progress("calibrate", done, len(views))
        samples.append(_sample(learner, others, view))
    progress("calibrate", len(views), len(views))
    held_out = others is not None or isinstance(learner, VoteLearner)
    return Calibration(fit_temperature(samples), len(views), sum(len(sample.seen) for sample in samples), held_out)


def _sample(learner: Learner, others: OtherViews | None, view: View) -> Sample:
    if others is not None:
        return others.sample(view)
    codes = votes_without(learner, view.name) if isinstance(learner, VoteLearner) else learner.codes_
    image, left_over = make_operator(learner.scene, view.camera, learner.device).blend(codes)
    if codes[:, 0].any():
        image[..., 0] += left_over
    return sample_pixels(image, view.read_labels())


def votes_without(learner: Learner, name: str) -> np.ndarray:
    """Votes of all views but one as probabilities, (N, K) float32; a row of zeros where no other saw the Gaussian."""
    observation = learner.observation(name)
    observation.vote(learner._votes, UNITS, -1)
    try:
        return learner.vote_codes()
    finally:
        observation.vote(learner._votes, UNITS)
