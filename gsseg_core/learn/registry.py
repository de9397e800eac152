"""The table of learners: from it come the command line's choices, the node's, the report's and the errors' lists."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any, NamedTuple

from gsseg_core.errors import SettingsError

if TYPE_CHECKING:
    from distributed import Client

    from gsseg_core.learn.learner import Learner
    from gsseg_core.scene.gaussian_scene import GaussianScene


class Entry(NamedTuple):
    """Where the classes of a learner are, as "module:class": they are imported when one is made."""

    learner: str  # a subclass of `gsseg_core.learn.learner.Learner`
    distributed: str = ""  # the same on the workers of a Dask cluster, which it takes first; "" if it cannot be


LEARNERS = {
    "em": Entry("gsseg_core.learn.em.em_learner:EMLearner", "gsseg_core.learn.distributed.dask_learners:DistributedEM"),
    "votes": Entry(
        "gsseg_core.learn.vote_learner:VoteLearner", "gsseg_core.learn.distributed.dask_learners:DistributedVotes"
    ),
    "gradient": Entry("gsseg_core.learn.gradient_learner:GradientLearner"),
}
"""Every learner by its name; the first is the default."""

DEFAULT = next(iter(LEARNERS))


def distributed_learners() -> list[str]:
    """Names of the learners that sum over views, and so can do it on many machines."""
    return [name for name, entry in LEARNERS.items() if entry.distributed]


def check_learner(name: str, scheduler: str | None = None) -> None:
    """Raise `SettingsError` if there is no such learner, or it cannot learn on the workers of this scheduler."""
    if name not in LEARNERS:
        raise SettingsError(f"learner is {name!r}; expected one of {', '.join(LEARNERS)}")
    if scheduler is not None and not LEARNERS[name].distributed:
        raise SettingsError(
            f"scheduler {scheduler}: the learner {name} takes one view after the other, each at the class "
            "probabilities that the one before it left, so there is nothing to share out; expected one of "
            f"{', '.join(distributed_learners())}"
        )


def check_seed(seed: int) -> None:
    """Raise `SettingsError` if random numbers cannot begin with it."""
    if seed < 0:
        raise SettingsError(f"seed is {seed}; expected at least 0")


def make_learner(
    name: str, scene: GaussianScene, num_classes: int, *,
    max_steps: int | None = None, seed: int = 0, client: Client | None = None, **where: Any,
) -> Learner:  # fmt: skip
    """Make one of `LEARNERS` by its name, with its default settings; `SettingsError` if there is no such learner.

    `max_steps` and `seed` are as `Learner.default_settings` takes them, `where` is `device` and `memory_budget` as
    `Learner` does. With a `client`, the workers of its Dask cluster learn, if the learner can be distributed.
    """
    check_learner(name)
    distributed = LEARNERS[name].distributed if client is not None else ""
    module, kind = (distributed or LEARNERS[name].learner).split(":")
    make = getattr(importlib.import_module(module), kind)
    first = (client,) if distributed else ()
    return make(*first, scene, num_classes, *make.default_settings(max_steps, seed), **where)
