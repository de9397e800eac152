"""Connects to a Dask cluster, and checks that its workers have this version of gsseg."""

from __future__ import annotations

import asyncio
import logging
import re
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from typing import TYPE_CHECKING

from gsseg_core.errors import SchedulerError, SettingsError

if TYPE_CHECKING:
    from distributed import Client

PATIENCE = 30.0  # s to wait for the answer of a scheduler, and for a worker if there is none
UNREACHABLE = (OSError, TimeoutError, asyncio.TimeoutError)  # raised by Dask if there is no answer


@contextmanager
def connected(address: str) -> Iterator[Client]:
    """Connect to a Dask scheduler.

    Raises `SettingsError` if Dask is not installed or the address is invalid; `SchedulerError` if no scheduler answers,
    if it has no workers, or if gsseg is missing there or has another version.
    """
    if not re.fullmatch(r"(tcp://)?([^\s:/\[\]]+|\[[^\s/\[\]]+\]):\d{1,5}", address):
        raise SettingsError(f"scheduler is {address!r}; expected an address such as tcp://host:8786")
    try:
        from distributed import Client
    except ImportError as error:
        raise SettingsError(
            f"scheduler {address}: needs Dask, which is not installed; expected: pip install 'gsseg[distributed]'"
        ) from error
    _check_scheduler(address)
    with _silenced("distributed.client"):
        try:
            client = Client(address, timeout=PATIENCE, set_as_default=False)
        except UNREACHABLE as error:
            raise _no_scheduler(address, "does not answer any more") from error
        with client:
            _check_version(f"scheduler {address}", client.run_on_scheduler(_probe()))
            check_workers(client, find_workers(client))
            yield client


@contextmanager
def _silenced(logger: str) -> Iterator[None]:
    """Silence a logger of Dask, whose messages repeat errors that are raised anyway."""
    log = logging.getLogger(logger)
    level = log.level
    log.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        log.setLevel(level)


def _check_scheduler(address: str) -> None:
    """Check that a scheduler answers at this address, because Dask's client would wait for ever if none does."""
    from distributed.core import rpc

    async def ask() -> str:
        async with rpc(address if "://" in address else f"tcp://{address}", timeout=PATIENCE) as server:
            identity: dict[str, str] = await asyncio.wait_for(server.identity(), PATIENCE)
            return identity["type"]

    answers: list[str | BaseException] = []

    def wait() -> None:
        try:
            answers.append(asyncio.run(asyncio.wait_for(ask(), PATIENCE)))
        except BaseException as error:  # Garbage parsed as a Dask message can raise anything.
            answers.append(error)

    # In a thread, since this one may have an event loop, and so that Ctrl-C does not wait.
    with _silenced("distributed.core"):
        thread = threading.Thread(target=wait, daemon=True)
        thread.start()
        thread.join(PATIENCE + 1)
    answer = answers[0] if answers else TimeoutError()
    if isinstance(answer, UNREACHABLE):
        raise _no_scheduler(address, f"does not answer within {PATIENCE:g} s") from answer
    if isinstance(answer, BaseException):
        raise _no_scheduler(address, f"what answers is no scheduler ({type(answer).__name__})") from answer
    if answer != "Scheduler":
        raise _no_scheduler(address, f"is a {answer.lower()}")


def _no_scheduler(address: str, found: str) -> SchedulerError:
    return SchedulerError(
        f"scheduler {address}: {found}; expected the address that `dask scheduler` prints, such as tcp://host:8786"
    )


def find_workers(client: Client) -> dict[str, int]:
    """Return the threads of each worker by address; `SchedulerError` if none comes or the scheduler is lost."""
    deadline = time.monotonic() + PATIENCE
    while True:
        late = time.monotonic() > deadline  # Before the query, so that a suspended process queries once more.
        try:
            workers = client.nthreads()
        except UNREACHABLE as error:
            raise SchedulerError(f"{name_of(client)}: does not answer any more; expected one that stays") from error
        if workers:
            return dict(sorted(workers.items()))
        if late:
            break
        time.sleep(0.1)
    raise SchedulerError(f"{name_of(client)}: has no workers; expected at least one, started by `dask worker ADDRESS`")


def check_workers(client: Client, workers: Iterable[str]) -> None:
    """Raise `SchedulerError` if one of these workers does not have this version of gsseg."""
    asked = list(workers)
    for worker, found in (client.run(_probe(), workers=asked, on_error="return") if asked else {}).items():
        if not isinstance(found, Exception):  # Otherwise the worker was lost just now.
            _check_version(f"{name_of(client)}: worker {worker}", found)


def _check_version(where: str, found: str | None) -> None:
    expected = version("gsseg")
    if found != expected:
        raise SchedulerError(
            f"{where} has {f'gsseg {found}' if found else 'no gsseg'}; expected gsseg {expected}, as here"
        )


def _probe() -> Callable[[], str | None]:
    # Nested, so that it is pickled as code: a worker without gsseg could not import it by name.
    def installed() -> str | None:
        from importlib.metadata import PackageNotFoundError, version

        try:
            return version("gsseg")
        except PackageNotFoundError:
            return None

    return installed


def name_of(client: Client) -> str:
    """Return the name of the scheduler for messages."""
    return f"scheduler {getattr(client.scheduler, 'address', '')}"
