"""Votes and EM on the workers of a Dask cluster: both are sums over views, which workers can compute in parts.

Each worker has the geometry of the scene and its share of the views in prepared form. In a step it gets the codes and
the error models of its views. The workers add their sums pairwise, in a tree whose root is returned to the client. The
sums are sums of integers, so they do not depend on which worker did what: the result is bit for bit that of a single
machine.

The client also keeps the codes and error models, so that work of a lost worker can be repeated elsewhere.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import CancelledError
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.view import View
from gsseg_core.errors import GssegError, SchedulerError
from gsseg_core.learn.all_or_nothing import all_or_nothing, checkpoint
from gsseg_core.learn.distributed import dask_worker
from gsseg_core.learn.distributed.dask_cluster import PATIENCE, UNREACHABLE, check_workers, find_workers, name_of
from gsseg_core.learn.em.em_learner import EMLearner, OverViews, Tick
from gsseg_core.learn.learner import Learner, Progress, silent
from gsseg_core.learn.usable_views import UnusableViewError
from gsseg_core.learn.vote_learner import VoteLearner
from gsseg_core.raster.view_operator import ViewOperator
from gsseg_core.scene.gaussian_scene import GaussianScene

if TYPE_CHECKING:
    from distributed import Client, Future

ATTEMPTS = 5  # attempts at a sum if Dask cannot recover lost data by itself
_POLL = 0.01  # s

Done = Callable[[int], None]
"""Called repeatedly with the number of views that are done."""


class _LostError(Exception):
    """Data of a worker is lost, or must be sent in another way: start again."""


class _Share(NamedTuple):
    worker: str
    shard: Future
    views: dict[str, View]


class _OnWorkers(Learner):
    """Common base of the two learners below: it distributes views to workers, and collects sums over them."""

    def __init__(self, client: Client, scene: GaussianScene, num_classes: int, *rest: Any, **settings: Any) -> None:
        super().__init__(scene, num_classes, *rest, **settings)
        self._client = client
        self._scenes: dict[str, Future] = {}
        self._shares: list[_Share] = []
        self._dealt: tuple[dict[str, int], int] = {}, 0
        self._direct = True

    def observe(self, view: View, operator: ViewOperator | None = None) -> bool:
        """Add a view and its votes; `operator` is ignored, since workers make their own."""
        self.observe_all([view])
        return view.name not in self.rejected

    def observe_all(self, views: Sequence[View], progress: Progress = silent) -> None:
        """Add views and their votes; after an error in one of them nothing has changed."""
        # Hold the masks: if a file changes, later retraction or preparation must still use the mask that voted.
        named = {view.name: view.held() for view in views}
        if named:
            votes, why = self._sum(dask_worker.sum_votes, named, lambda done: progress("observe", done, len(named)))
            copies = {name: getattr(self, name).copy() for name in ("_votes", "views", "rejected")}
            with all_or_nothing(checkpoint(self, **copies)):
                self._votes.add_rows(dask_worker.as_compiled_for(votes))
                for name, view in named.items():
                    self._add(view, UnusableViewError(why[name]) if why[name] else None)
        progress("observe", len(named), len(named))

    def _sum(
        self, task: Callable[..., OverViews], views: Mapping[str, View], report: Done,
        by_view: Mapping[str, Any] | None = None, *values: Any,
    ) -> OverViews:  # fmt: skip
        """Sum the results of a task over these views; raises the error of a view that fails.

        Raises `SchedulerError` if the scheduler or all workers are lost, or if results are lost `ATTEMPTS` times.
        """
        for _ in range(ATTEMPTS):
            used: list[Future] = []
            try:
                return self._try_to_sum(used, task, views, report, by_view or {}, values)
            except (_LostError, CancelledError):
                self._shares = []
            finally:
                # Also if `report` raised to stop the work: Dask then does not start pending tasks.
                for future in used:
                    future.release()
        raise SchedulerError(f"{name_of(self._client)}: lost results {ATTEMPTS} times; expected workers that stay")

    def _try_to_sum(
        self, used: list[Future], task: Callable[..., OverViews], views: Mapping[str, View], report: Done,
        by_view: Mapping[str, Any], values: Sequence[Any],
    ) -> OverViews:  # fmt: skip
        shares = self._deal(views, report)
        copies = [self._send(value, [share.worker for share in shares]) for value in values]
        used += [future for copy in copies for future in copy.values()]
        parts = []
        for share in shares:
            wanted = {name: by_view.get(name) for name in share.views if name in views}
            parts.append(self._submit(share.worker, task, share.shard, wanted, *(c[share.worker] for c in copies)))
        used += parts
        sums = deque(parts)
        while len(sums) > 1:  # Workers drop intermediate sums as soon as they are added.
            sums.append(self._client.submit(dask_worker.add, sums.popleft(), sums.popleft(), pure=False))
        used += sums
        sizes = {part.key: len(share.views) for part, share in zip(parts, shares, strict=True)}
        self._wait(used, lambda: report(sum(sizes[part.key] for part in parts if part.done())))
        for future in used:
            self._check(future)
        return self._client.gather(sums[0], direct=self._direct)

    def _deal(self, views: Mapping[str, View], report: Done) -> list[_Share]:
        """Let every worker prepare its share of the views, unless the workers already have them."""
        held = {name: view for share in self._shares for name, view in share.views.items()}
        workers = find_workers(self._client)
        if self._dealt == (workers, self.num_classes) and all(held.get(n) is view for n, view in views.items()):
            return self._shares
        check_workers(self._client, workers.keys() - self._dealt[0].keys())
        self._place_scene(workers, report)
        where = {"device": self.device, "memory_budget": self.memory_budget}
        settings = self.num_classes, getattr(self, "settings", None), where
        names, threads = list(views), np.cumsum([0, *workers.values()])
        cuts = np.rint(threads * len(names) / threads[-1]).astype(int)
        self._shares, self._dealt = [], (workers, self.num_classes)
        for worker, first, last in zip(workers, cuts, cuts[1:], strict=False):
            if first < last:
                part = {name: views[name] for name in names[first:last]}
                shard = self._submit(worker, dask_worker.prepare, self._scenes[worker], list(part.values()), *settings)
                self._shares.append(_Share(worker, shard, part))
        return self._shares

    def _place_scene(self, workers: Mapping[str, int], report: Done) -> None:
        """Give each worker the scene: from the worker's own file if it is the same scene, else sent from here."""
        self._scenes = {w: f for w, f in self._scenes.items() if w in workers and f.status == "finished"}
        absent = [worker for worker in workers if worker not in self._scenes]
        if self.scene.path is not None and absent:
            path = str(self.scene.path.resolve())
            tried = {worker: self._submit(worker, dask_worker.load, path, self.scene.digest) for worker in absent}
            self._wait(tried.values(), lambda: report(0))
            self._scenes |= {worker: future for worker, future in tried.items() if future.status == "finished"}
            absent = [worker for worker in absent if worker not in self._scenes]
        if absent:
            self._scenes |= self._send(dask_worker.geometry(self.scene), absent)

    def _submit(self, worker: str, task: Callable[..., Any], *inputs: Any) -> Future:
        """Run a task on this worker, or on another one if it is lost."""
        import dask

        # Masks and error models of a share may exceed the 10 MB above which Dask warns.
        with dask.config.set({"distributed.admin.large-graph-warning-threshold": "1 TB"}):
            return self._client.submit(task, *inputs, workers=[worker], allow_other_workers=True, pure=False)

    def _send(self, value: Any, workers: list[str]) -> dict[str, Future]:
        """Send a value to each of these workers: from here to the first, and from there along a tree."""
        try:
            # In a list, since Dask would send each element of a tuple separately.
            copies: list[Future] = self._client.scatter(
                [value], workers[:1], direct=self._direct, hash=False, timeout=PATIENCE
            )
        except UNREACHABLE as error:
            self._direct = False  # Perhaps only the scheduler can reach the workers.
            raise _LostError from error
        except (AssertionError, LookupError, ValueError) as error:
            # Dask's scheduler raises one of these if it loses the worker at this moment.
            raise _LostError from error
        # Not by Dask's broadcast, which may wait for ever for a lost worker.
        for i, worker in enumerate(workers[1:]):
            copies.append(self._submit(worker, dask_worker.hand_on, copies[i // 2]))
        return dict(zip(workers, copies, strict=True))

    def _check(self, future: Future) -> None:
        if future.status == "error":
            error = future.exception()
            if isinstance(error, GssegError):
                raise error
            raise SchedulerError(
                f"{name_of(self._client)}: a worker failed with {type(error).__name__} ({error}); its log says more"
            ) from error
        if future.status != "finished":
            raise _LostError

    def _wait(self, futures: Iterable[Future], report: Callable[[], None]) -> None:
        looked = time.monotonic()
        while any(future.status == "pending" for future in futures):
            report()
            time.sleep(_POLL)
            if time.monotonic() - looked > 1:
                find_workers(self._client)
                looked = time.monotonic()


class DistributedVotes(_OnWorkers, VoteLearner):
    """`VoteLearner` on the workers of a Dask cluster: `DistributedVotes(client, scene, num_classes)`.

    Workers that find the same scene under its path load it from there; to others it is sent. `memory_budget` is that of
    each worker. Views are best added together, by `observe_all`.
    """


class DistributedEM(_OnWorkers, EMLearner):
    """`EMLearner` on the workers of a Dask cluster: `DistributedEM(client, scene, num_classes, settings)`.

    `memory_budget` is that of each worker. Views are best added together, by `observe_all`.
    """

    checks_masks = False  # checking would prepare all views on this machine

    def _over_views(
        self, work: Callable[..., OverViews], by_view: Mapping[str, Any], tick: Tick, *arrays: CSRRows | np.ndarray
    ) -> OverViews:
        views = {name: self.views[name] for name in by_view}
        task = partial(dask_worker.go_over, work, self._possible())  # A worker may lack the views that name a class.
        return self._sum(task, views, lambda done: tick(), by_view, *arrays)
