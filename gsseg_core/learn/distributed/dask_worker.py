"""Tasks of a Dask worker in a distributed run (`dask_learners.py`): it holds some of the views and sums over them.

A task leaves its inputs as they are, so that it can be run again.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numba
import numpy as np
from numpy.lib.recfunctions import repack_fields

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.view import View
from gsseg_core.errors import GssegError
from gsseg_core.learn.em.em_learner import EMLearner, EMSettings, OverViews
from gsseg_core.learn.usable_views import UnusableViewError
from gsseg_core.raster.vote_total import VoteTotal
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.vertices import DC
from gsseg_core.spatial.row_order import along_curve

ONLY_VOTES = EMSettings(errors=False)  # what is wrong with a mask does not matter to votes

_BUSY = threading.Lock()


class NotHereError(Exception):
    """A worker does not have the scene under that path, or has another one there."""


class Shard(EMLearner):
    """Some of the views, prepared. Sent elsewhere or spilled to disk, it takes along only what they are prepared of."""

    possible: np.ndarray  # (K,) bool: ids that are classes by the views of all workers

    def __getstate__(self) -> dict[str, Any]:
        """Leave the prepared views behind."""
        return {**self.__dict__, "_prepared": self._prepared.emptied()}

    def __sizeof__(self) -> int:
        """Tell Dask how much memory is in use."""
        return self._prepared.nbytes[0]

    def _possible(self) -> np.ndarray:
        return self.possible


def load(path: str, digest: str) -> GaussianScene:
    """Load the geometry of a scene from a file of the worker; `NotHereError` if it has another digest."""
    try:
        scene = GaussianScene.load(path)
    except GssegError as error:
        raise NotHereError(path) from error
    if scene.digest != digest:
        raise NotHereError(path)
    return geometry(scene)


def geometry(scene: GaussianScene) -> GaussianScene:
    """Leave out of the vertices what no learner needs: all but the colours of degree 0."""
    return replace(scene, vertices=repack_fields(scene.vertices[list(DC)]))


def prepare(
    scene: GaussianScene, views: Sequence[View], num_classes: int, settings: EMSettings | None,
    where: dict[str, Any],
) -> Shard:  # fmt: skip
    """Prepare views, by settings or, without, for votes; `where` is the learner's device and memory budget."""
    shard = Shard(scene, num_classes, settings or ONLY_VOTES, **where)
    shard._votes = VoteTotal(0, num_classes)
    with _all_threads():
        for view in views:
            view, opened = shard._opened(view)
            if isinstance(opened, UnusableViewError):
                shard.rejected[view.name] = str(opened)
            else:
                shard._prepared.keep(view.name, opened)
                shard.views[view.name] = view
    return shard


def sum_votes(shard: Shard, wanted: dict[str, Any]) -> OverViews:
    """Count votes; beside them, why a view was rejected, or ""."""
    votes = VoteTotal(len(shard.scene), shard.num_classes, along_curve(shard.scene))
    with _all_threads():
        for name in wanted:
            if name in shard.views:
                shard.observation(name).vote(votes)
    return votes.rows(), {name: shard.rejected.get(name, "") for name in wanted}


def go_over(
    work: Callable[..., OverViews], possible: np.ndarray, shard: Shard, by_view: dict[str, Any],
    *arrays: CSRRows | np.ndarray,
) -> OverViews:  # fmt: skip
    """Have a method of `EMLearner` go over the views of a shard, as `EMLearner._over_views` does over all."""
    usable = (as_compiled_for(array) if isinstance(array, CSRRows) else array for array in arrays)
    with _all_threads():
        shard.possible = possible
        return work(shard, *usable, by_view, lambda: None)


def hand_on(value: Any) -> Any:
    """Have a worker keep what another one has."""
    return value


def add(one: OverViews, two: OverViews) -> OverViews:
    """Add two sums over different views."""
    if isinstance(one[0], CSRRows):
        total: Any = as_compiled_for(one[0]).plus(as_compiled_for(two[0]))
    else:
        total = None if one[0] is None else one[0] + two[0]
    return total, {**one[1], **two[1]}


@contextmanager
def _all_threads() -> Iterator[None]:
    """One task at a time, with as many threads as the worker was started with."""
    from distributed import get_worker

    with _BUSY:
        most: int = numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]
        numba.set_num_threads(min(get_worker().state.nthreads, most))
        yield


def as_compiled_for(rows: CSRRows) -> CSRRows:
    """Kernels would be compiled once more for arrays that cannot be written to, as those from the network may be."""
    return CSRRows(*(np.require(array, requirements=["C", "W"]) for array in rows))
