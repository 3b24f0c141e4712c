"""Where the jobs of a batch run: in workers on this machine, or, to look inside, in this very process."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from queue import SimpleQueue
from typing import Protocol, TypeVar

from autoalign.batch.slot import Limits, Outcome, Slot, Terms, attempt

AHEAD = 2  # jobs under way per worker: one that runs, and one that waits so that the worker need not

J = TypeVar("J")
R = TypeVar("R")


class Engine(Protocol):
    """Does jobs, and survives them."""

    def run(self, function: Callable[[J], R], jobs: Iterable[J]) -> Iterator[Outcome[J, R]]:
        """One outcome for each job, as they come, in any order.

        `function` must be importable by name, jobs and results picklable. `jobs` is read in the caller's thread, a few
        per worker ahead, so that a hundred thousand take no more memory than ten; while it makes the caller wait for
        its next job, no outcome is handed out. Whoever stops reading (an exception, Ctrl-C, `close`) stops the workers.
        Raises EngineError if there is nowhere to run.
        """
        ...


@dataclass(frozen=True, kw_only=True)
class LocalEngine:
    """Worker processes on this machine: a job that crashes, hangs or swells takes none but its own worker along."""

    workers: int | None = None  # None: as many as there are cores
    limits: Limits = field(default_factory=Limits)  # of each job
    initializer: Callable[[], None] | None = None  # called once in each worker, before its first job

    def __post_init__(self) -> None:
        if self.workers is not None and self.workers < 1:
            raise ValueError(f"there must be at least one worker, not {self.workers}")

    def run(self, function: Callable[[J], R], jobs: Iterable[J]) -> Iterator[Outcome[J, R]]:
        """As `Engine.run`. A worker is started when there is a job for it."""
        workers = self.workers or cores()
        terms = Terms(
            function=function,
            limits=self.limits,
            threads=max(1, cores() // workers),
            initializer=self.initializer,
        )
        slots = [Slot(terms) for _ in range(workers)]
        idle: SimpleQueue[Slot[J, R]] = SimpleQueue()
        for slot in slots:
            idle.put(slot)

        def run_somewhere(job: J) -> Outcome[J, R]:
            slot = idle.get()
            try:
                return slot.run(job)
            finally:
                idle.put(slot)

        with ThreadPoolExecutor(workers) as threads:  # they do nothing but wait for their workers
            try:
                for _, future in stream(lambda job: threads.submit(run_somewhere, job), jobs, AHEAD * workers):
                    yield future.result()
            finally:
                threads.shutdown(wait=False, cancel_futures=True)
                for slot in slots:
                    slot.stop()


@dataclass(frozen=True, kw_only=True)
class InlineEngine:
    """This process, one job after the other, for debuggers and profilers. Nothing is limited, a crash is a crash."""

    def run(self, function: Callable[[J], R], jobs: Iterable[J]) -> Iterator[Outcome[J, R]]:
        """As `Engine.run`, in order."""
        for job in jobs:
            started = time.monotonic()
            result, casualty = attempt(function, job)
            yield Outcome(job=job, result=result, casualty=casualty, seconds=time.monotonic() - started)


def stream(submit: Callable[[J], Future[R]], jobs: Iterable[J], ahead: int) -> Iterator[tuple[J, Future[R]]]:
    """Submit the jobs, never more than `ahead` at a time, and yield each with its future once that is done."""
    done: SimpleQueue[Future[R]] = SimpleQueue()
    under_way: dict[Future[R], J] = {}
    for job in jobs:
        future = submit(job)
        under_way[future] = job
        future.add_done_callback(done.put)
        while len(under_way) >= ahead or not done.empty():
            future = done.get()
            yield under_way.pop(future), future
    while under_way:
        future = done.get()
        yield under_way.pop(future), future


def cores() -> int:
    """How many cores this process may keep busy: those it is bound to, fewer where a container has a smaller share."""
    bound_to = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    with suppress(OSError, ValueError):  # no such file, or no number but "max", where there is no share
        quota_us, period_us = map(int, Path("/sys/fs/cgroup/cpu.max").read_text().split())
        return max(1, min(bound_to, quota_us // period_us))
    return bound_to
