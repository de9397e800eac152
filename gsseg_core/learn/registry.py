"""The table of learners, which the command line, the node, the report and error messages use."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any, NamedTuple

from gsseg_core.errors import SettingsError

if TYPE_CHECKING:
    from distributed import Client

    from gsseg_core.learn.learner import Learner
    from gsseg_core.scene.gaussian_scene import GaussianScene


class Entry(NamedTuple):
    """The classes of a learner as "module:class", imported only when the learner is made."""

    learner: str  # a subclass of `gsseg_core.learn.learner.Learner`
    distributed: str = ""  # its variant for a Dask cluster, with the client as first argument; "" if there is none


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
    """Return the names of the learners that can run on many machines because they sum over views."""
    return [name for name, entry in LEARNERS.items() if entry.distributed]


def check_learner(name: str, scheduler: str | None = None) -> None:
    """Raise `SettingsError` if there is no such learner, or if it cannot use a scheduler that is given."""
    if name not in LEARNERS:
        raise SettingsError(f"learner is {name!r}; expected one of {', '.join(LEARNERS)}")
    if scheduler is not None and not LEARNERS[name].distributed:
        raise SettingsError(
            f"scheduler {scheduler}: the learner {name} takes one view after the other, each at the class "
            "probabilities that the one before it left, so there is nothing to share out; expected one of "
            f"{', '.join(distributed_learners())}"
        )


def check_seed(seed: int) -> None:
    """Raise `SettingsError` if the seed is negative, which random generators do not accept."""
    if seed < 0:
        raise SettingsError(f"seed is {seed}; expected at least 0")


def make_learner(
    name: str, scene: GaussianScene, num_classes: int, *,
    max_steps: int | None = None, seed: int = 0, client: Client | None = None, **where: Any,
) -> Learner:  # fmt: skip
    """Make one of `LEARNERS` by its name, with default settings; `SettingsError` if there is no such learner.

    `max_steps` and `seed` go to `Learner.default_settings`, `where` (`device` and `memory_budget`) to `Learner`. With a
    `client`, a learner that can be distributed runs on the workers of its Dask cluster.
    """
    check_learner(name)
    distributed = LEARNERS[name].distributed if client is not None else ""
    module, kind = (distributed or LEARNERS[name].learner).split(":")
    make = getattr(importlib.import_module(module), kind)
    first = (client,) if distributed else ()
    return make(*first, scene, num_classes, *make.default_settings(max_steps, seed), **where)
