"""The same jobs on many machines: a slot in each thread of each Dask worker, so that no job can be a Dask worker's end.

Dask does what it is good at: who is there, who has nothing to do, who has gone. What a job may do to its process is the
business of the slot, as on one machine; so the outcomes are the same ones. This module is imported by those only who
ask for a cluster.
"""

from __future__ import annotations

import asyncio
import multiprocessing as mp
import secrets
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError, Future
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, TypeVar

from distributed import Client, WorkerPlugin, get_worker

from autoalign import __version__
from autoalign.batch.engine import stream
from autoalign.batch.slot import Casualty, Limits, Outcome, Slot, Terms
from autoalign.errors import EngineError
from autoalign.files.codec import one_line

CONNECT_S = 30.0  # a scheduler may be just about to start
IDLE_S = 60.0  # so that nothing is left on the machines of others if this process is killed
DAEMONIC = (
    "the Dask workers may have no processes of their own; start them with `dask worker --no-nanny`,"
    " or with DASK_DISTRIBUTED__WORKER__DAEMON=false in their environment"
)

J = TypeVar("J")
R = TypeVar("R")


@dataclass(frozen=True, kw_only=True)
class DaskEngine:
    """The workers of a Dask scheduler, which may come and go: one job at a time in each of their threads.

    They need this version of autoalign, and the same paths to the same files. A job whose Dask worker goes is done by
    another, and `lost` when that has happened too often. Where the scheduler goes, the run ends with EngineError.
    """

    scheduler: str  # its address, such as tcp://10.0.0.1:8786; tls:// with the certificates of Dask's configuration
    limits: Limits = field(default_factory=Limits)  # of each job
    initializer: Callable[[], None] | None = None  # called once in each worker, before its first job
    ahead: int = 1000  # jobs under way; some for every thread there may ever be, but not all of a hundred thousand

    def run(self, function: Callable[[J], R], jobs: Iterable[J]) -> Iterator[Outcome[J, R]]:
        """As `Engine.run`."""
        terms = Terms(function=function, limits=self.limits, initializer=self.initializer, idle_s=IDLE_S)
        slots = f"autoalign-{secrets.token_hex(8)}"  # of this run, which may not be the only one
        client = _connected(self.scheduler)
        try:
            client.register_plugin(_Slots(terms), slots)

            def submit(job: J) -> Future[Outcome[J, R]]:
                self._check(client)
                task = client.submit(_run_in_slot, slots, job, pure=False)  # pure: equal jobs would count as one
                # Dask's own ways to wait (as_completed, its executor) forget a task whose result was lost on the way.
                return asyncio.run_coroutine_threadsafe(_result(task), client.loop.asyncio_loop)

            for job, future in stream(submit, jobs, self.ahead):
                outcome = _outcome(job, future)
                if outcome.casualty is not None and outcome.casualty.cause == "lost":
                    self._check(client)
                yield outcome
        finally:
            with suppress(Exception):  # the scheduler may have gone, and all with it
                client.unregister_worker_plugin(slots)
            client.close(timeout=1)

    def _check(self, client: Client) -> None:
        if client.status != "running":
            raise EngineError(f"the scheduler has gone: {self.scheduler}")


class _Slots(WorkerPlugin):  # type: ignore[misc]
    """On every Dask worker of a run: as many slots as jobs were ever there at a time."""

    def __init__(self, terms: Terms[Any, Any]) -> None:
        self._terms = terms
        self._version = __version__
        self._idle: deque[Slot[Any, Any]] = deque()
        self._all: list[Slot[Any, Any]] = []

    def run(self, job: Any) -> Outcome[Any, Any]:
        """To be called by the threads of the Dask worker. Raises EngineError where no job can ever be done."""
        if mp.current_process().daemon:
            raise EngineError(DAEMONIC)
        if self._version != __version__:
            raise EngineError(f"a Dask worker has autoalign {__version__}, and not {self._version}")
        try:
            slot = self._idle.pop()
        except IndexError:
            slot = Slot(self._terms)
            self._all.append(slot)
        try:
            return slot.run(job)
        finally:
            self._idle.append(slot)

    def teardown(self, worker: object) -> None:
        """End what still runs, when the run or the Dask worker ends."""
        for slot in self._all:
            slot.stop()


def _run_in_slot(slots: str, job: Any) -> Outcome[Any, Any]:
    """What Dask calls on a worker."""
    plugin = get_worker().plugins[slots]
    assert isinstance(plugin, _Slots)
    return plugin.run(job)


async def _result(task: Any) -> Outcome[Any, Any]:
    outcome = await task
    assert isinstance(outcome, Outcome)
    return outcome


def _connected(scheduler: str) -> Client:
    try:
        return Client(scheduler, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:  # ValueError: no address at all
        raise EngineError(f"the scheduler cannot be reached ({one_line(error)}): {scheduler}") from error


def _outcome(job: J, future: Future[Outcome[J, R]]) -> Outcome[J, R]:
    try:
        return future.result()
    except EngineError:  # says what is wrong with all of them
        raise
    except (CancelledError, Exception) as error:  # Dask has many ways to say that workers or the scheduler have gone
        reason = f"the cluster has lost it ({type(error).__name__}: {one_line(error)})"
    return Outcome(job=job, result=None, casualty=Casualty(cause="lost", reason=reason), seconds=0.0)
