"""Tasks of a Dask worker in a distributed run (`dask_learners.py`): it keeps some of the views and sums over them.

A task does not change its inputs, so that it can be run again.
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

ONLY_VOTES = EMSettings(errors=False)  # uses masks unchanged, as votes do

_BUSY = threading.Lock()


class NotHereError(Exception):
    """Raised if a worker has no scene, or another scene, at the path."""


class Shard(EMLearner):
    """Some of the views in prepared form; pickling leaves out the prepared data, which the views can restore."""

    possible: np.ndarray  # (K,) bool: ids that are classes by the views of all workers

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for pickling, without the prepared views."""
        return {**self.__dict__, "_prepared": self._prepared.emptied()}

    def __sizeof__(self) -> int:
        """Return the bytes in use, for Dask's memory management."""
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
    """Return the scene without the vertex properties that no learner needs: all but the colours of degree 0."""
    return replace(scene, vertices=repack_fields(scene.vertices[list(DC)]))


def prepare(
    scene: GaussianScene, views: Sequence[View], num_classes: int, settings: EMSettings | None,
    where: dict[str, Any],
) -> Shard:  # fmt: skip
    """Prepare views for EM with `settings`, or for votes if None; `where` is the learner's device and memory budget."""
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
    """Sum the votes of the wanted views; also return the reason for rejection of each view, or ""."""
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
    """Call a method of `EMLearner` for the views of a shard, as `EMLearner._over_views` does for all views."""
    usable = (as_compiled_for(array) if isinstance(array, CSRRows) else array for array in arrays)
    with _all_threads():
        shard.possible = possible
        return work(shard, *usable, by_view, lambda: None)


def hand_on(value: Any) -> Any:
    """Return the value unchanged: run on another worker, this copies the value to it."""
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
    """Run one task at a time, with as many threads as the worker was started with."""
    from distributed import get_worker

    with _BUSY:
        most: int = numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]
        numba.set_num_threads(min(get_worker().state.nthreads, most))
        yield


def as_compiled_for(rows: CSRRows) -> CSRRows:
    """Make arrays contiguous and writable, else kernels would be compiled again for read-only ones from the network."""
    return CSRRows(*(np.require(array, requirements=["C", "W"]) for array in rows))
