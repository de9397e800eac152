"""The learners by their names: who adds one, adds it here."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from gsseg_core.errors import SettingsError
from gsseg_core.learn.em.em_learner import EMLearner, EMSettings
from gsseg_core.learn.learner import MEMORY_BUDGET, Learner
from gsseg_core.learn.vote_learner import VoteLearner
from gsseg_core.scene.gaussian_scene import GaussianScene

if TYPE_CHECKING:
    from distributed import Client

LEARNERS = ("em", "votes", "gradient")

DISTRIBUTED = ("em", "votes")
"""Learners that sum over views, and so can do it on many machines."""


def make_learner(
    name: str,
    scene: GaussianScene,
    num_classes: int,
    *,
    max_steps: int | None = None,
    seed: int = 0,
    device: str = "cpu",
    memory_budget: int = MEMORY_BUDGET,
    client: Client | None = None,
) -> Learner:
    """Make a learner by its name, with its default settings.

    Parameters
    ----------
    name : str
        One of `LEARNERS`.
    scene : GaussianScene
        N Gaussians.
    num_classes : int
        K, the background included.
    max_steps : int, optional
        Steps of EM, or epochs of the gradient learner, at most.
    seed : int
        For the gradient learner, which draws views at random.
    device : str
        Where views are rendered.
    memory_budget : int
        Bytes of prepared views to keep; of each worker, if there are any.
    client : distributed.Client, optional
        Have the workers of this Dask cluster do it.

    Raises
    ------
    SettingsError
        There is no such learner, or it cannot be distributed.
    """
    where: dict[str, Any] = {"device": device, "memory_budget": memory_budget}
    em = EMSettings(max_steps=max_steps or EMSettings.max_steps)
    if client is not None and name in DISTRIBUTED:
        from gsseg_core.learn.distributed.dask_learners import DistributedEM, DistributedVotes

        if name == "em":
            return DistributedEM(client, scene, num_classes, em, **where)
        return DistributedVotes(client, scene, num_classes, **where)
    if name == "em":
        return EMLearner(scene, num_classes, em, **where)
    if name == "votes":
        return VoteLearner(scene, num_classes, **where)
    if name == "gradient":
        # PyTorch takes seconds to import, and the other learners do without.
        from gsseg_core.learn.gradient_learner import GradientLearner, GradientSettings

        settings = GradientSettings(epochs=max_steps or GradientSettings.epochs, seed=seed)
        return GradientLearner(scene, num_classes, settings, **where)
    raise SettingsError(f"learner is {name!r}; expected one of {', '.join(LEARNERS)}")
