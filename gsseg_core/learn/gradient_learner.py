"""The paper's learner: minimises the cross-entropy between rendered codes and masks with Adam."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from gsseg_core.csr_rows import CSRRows
from gsseg_core.errors import SettingsError
from gsseg_core.learn.all_or_nothing import fits_whole
from gsseg_core.learn.learner import Learner, Progress, silent
from gsseg_core.learn.vote_resolution import is_resolved
from gsseg_core.raster.observation import Observation
from gsseg_core.scene.gaussian_scene import GaussianScene


@dataclass(frozen=True)
class GradientSettings:
    """Settings of `GradientLearner`.

    Attributes
    ----------
    rate : float
        Initial rate of Adam, per step, in units of the codes.
    final_rate : float
        Rate at the last step; the rate decays exponentially.
    epochs : int
        Number of passes over all views.
    seed : int
        Random seed of the order of the views.
    """

    rate: float = 0.05
    final_rate: float = 0.005
    epochs: int = 10
    seed: int = 0

    def __post_init__(self) -> None:
        """Validate."""
        whole = isinstance(self.epochs, int | np.integer)
        if not whole or self.epochs < 1 or not 0 < self.final_rate <= self.rate < np.inf:
            raise SettingsError(
                f"gradient: epochs is {self.epochs}, rate {self.rate}, final_rate {self.final_rate}; "
                "expected at least one epoch, a whole number, and 0 < final_rate <= rate, finite"
            )
        if not isinstance(self.seed, int | np.integer) or self.seed < 0:
            raise SettingsError(f"gradient: seed is {self.seed}; expected a whole number from 0")


class GradientLearner(Learner):
    """2D-guided 3D Gaussian segmentation as published (Lan et al. 2023), equation by equation.

    - Rendering (its eq. 2): o_hat = sum_i o_i alpha_i prod_{j<i} (1 - alpha_j), the view operator.
    - Loss of one class (eq. 3): L_i = -1/N sum_n M_i^n log M_bar_i^n over the N pixels with a label.
    - Loss of one view and of all (eq. 4): CES = 1/K sum_i L_i, and the mean of CES over the L views.

    Where the paper is silent, we chose:

    - The softmax of the codes is taken before blending. So rendered codes are probabilities up to the remaining
      transmittance, which counts as class 0. (The paper takes the softmax in its clustering step, and mentions
      rendered probabilities.)
    - All codes start at zero, the "initial state of uniform distribution across all categories" of its section 3.2.
    - Adam starts with rate 0.05, which decays exponentially to a tenth. Each step uses one view; ten epochs go through
      all views in random order.
    - Rays end at surfaces, as for all learning from masks (`T_LIFTED` in `gsseg_core.raster.constants`).
    - Pixels with an unknown label count neither in the sum nor in N.
    - For a soft or partial mask, rendered codes are weighted by the plausibility of each class given the pixel's label
      (see `gsseg_core.data.label_evidence`): -log sum_k pl(k) M_bar_k. With one class per label this is eq. 3.

    Attributes
    ----------
    history_ : list of float
        After `fit`: mean loss over the steps of each epoch.
    """

    def __init__(
        self, scene: GaussianScene, num_classes: int, settings: GradientSettings | None = None, *,
        device: str = "cpu", memory_budget: int | None = None,
    ) -> None:  # fmt: skip
        super().__init__(scene, num_classes, device=device, memory_budget=memory_budget)
        self.settings = settings or GradientSettings()

    @classmethod
    def default_settings(cls, max_steps: int | None, seed: int) -> tuple[GradientSettings]:
        """Return the default settings, with `max_steps` as number of epochs if given, and the seed."""
        return (GradientSettings(epochs=GradientSettings.epochs if max_steps is None else max_steps, seed=seed),)

    @property
    def loss(self) -> float:
        """Mean cross-entropy of the last epoch, summed over the classes (K times CES), in nats per labelled pixel."""
        return self.history_[-1] * self.num_classes if self.history_ else float("nan")

    @fits_whole
    def fit(self, progress: Progress = silent) -> GradientLearner:
        """Run all epochs."""
        settings = self.settings
        self._require_views()
        self.observed_ = is_resolved(self._votes.rows(), self._possible())
        codes = torch.zeros((len(self.scene), self.num_classes), requires_grad=True)
        steps, adam, rate = settings.epochs * len(self.views), _Adam(codes), settings.rate
        decay = (settings.final_rate / settings.rate) ** (1 / max(steps - 1, 1))
        rng = np.random.default_rng(settings.seed)
        names = list(self.views)
        self.history_ = history = []
        for epoch in range(settings.epochs):
            losses = []
            order = [names[i] for i in rng.permutation(len(names))]
            for done, name in enumerate(order):
                progress("gradient", epoch * len(names) + done, steps)
                probabilities = torch.softmax(codes, dim=1)
                loss, gradient = cross_entropy(probabilities.detach().numpy(), self.observation(name))
                adam.step(*torch.autograd.grad(probabilities, codes, torch.from_numpy(gradient)), rate)
                rate *= decay
                losses.append(float(loss))
            history.append(float(np.mean(losses)))
        progress("gradient", steps, steps)
        learnt: np.ndarray = torch.softmax(codes, dim=1).detach().numpy()
        learnt[~self.observed_] = 0.0
        self.code_rows_ = CSRRows.from_dense(learnt)
        self._finish()
        return self


class _Adam:
    """Adam with bit for bit the steps of `torch.optim.Adam`, which would first load a compiler for 4 s."""

    def __init__(self, codes: torch.Tensor) -> None:
        self._codes, self._steps = codes, 0
        self._mean, self._square = torch.zeros_like(codes), torch.zeros_like(codes)

    @torch.no_grad()
    def step(self, gradient: torch.Tensor, rate: float) -> None:
        self._steps += 1
        self._mean.lerp_(gradient, 1 - 0.9)
        self._square.mul_(0.999).addcmul_(gradient, gradient, value=1 - 0.999)
        scale = (self._square.sqrt() / (1 - 0.999**self._steps) ** 0.5).add_(1e-8)
        self._codes.addcdiv_(self._mean, scale, value=-(rate / (1 - 0.9**self._steps)))


def cross_entropy(probabilities: np.ndarray, observation: Observation) -> tuple[np.float32, np.ndarray]:  # (N, K)
    """Return CES of one view (eq. 3 and 4) and its gradient W^T dL/dO by the probabilities, (N, K) float32.

    In each pixel, loss and gradient depend only on the class that the mask has there.
    """
    gradient, scale = np.zeros_like(probabilities), 1.0 / (observation.num_pixels * probabilities.shape[1])
    if observation.evidence.mass is None:
        where = observation.places
        shares = observation.shares(probabilities[where], (observation.classes == 0).astype(np.float32))
        gradient[where] = -scale * shares.pairs
    else:
        plausible = observation.evidence.plausibility(probabilities.shape[1])
        likelihood = (probabilities[observation.ids] @ plausible.T)[observation.rows, observation.labels]
        shares = observation.shares(likelihood, plausible[:, 0])
        gradient[observation.ids] = observation.dense(-scale * shares.pairs) @ plausible
    return np.float32(-scale * shares.log_likelihood), gradient
