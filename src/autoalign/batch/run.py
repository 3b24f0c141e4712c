"""The coordinator of a batch: what is not done yet is done, kept as it comes, and told."""

from __future__ import annotations

import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from autoalign.batch.engine import Engine, LocalEngine
from autoalign.batch.jobs import Job, key, place, readable
from autoalign.batch.ledger import Entry, Ledger
from autoalign.batch.slot import Outcome
from autoalign.batch.work import Done, Task, do_task, failed_row
from autoalign.errors import ImageWriteError
from autoalign.files.remote import is_url, shown
from autoalign.files.row import Row
from autoalign.files.write import TEMPORARY

STORE_NAME = ".autoalign-features"
REQUESTS = 16  # at a time


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What a batch has to do."""

    tasks: tuple[Task, ...]  # that are not done yet, in the order of the jobs
    done: int  # jobs that need not be done again


def align_batch(jobs: Iterable[Job], engine: Engine | None = None) -> Iterator[Row]:
    """Do jobs, by default in as many processes as there are cores, and yield their rows as they come, in any order.

    Each aligned pair leaves its picture, and each that could be tried its sidecar, in the job's `out_dir`; files of an
    earlier time are replaced. No ledger is kept. Whatever happens to a job is a row. Raises EngineError if there is
    nowhere to run.
    """
    tasks = (Task(job=job, key="") for job in jobs)
    for outcome in (engine or LocalEngine()).run(do_task, tasks):
        yield _done(outcome).row


@contextmanager
def feature_store(out_dir: Path, cache: Path | None) -> Iterator[Path]:
    """The folder for the features of pictures that come again: `cache`, or one that is gone when the batch is done.

    If the block is left early it stays, and the next run finds it.
    """
    store = (cache or out_dir / STORE_NAME).absolute()  # workers may be in another folder
    store.mkdir(parents=True, exist_ok=True)
    yield store
    if not cache:
        shutil.rmtree(store, ignore_errors=True)


def by_key(jobs: Sequence[Job], hash_of: Callable[[str], str]) -> dict[str, Job]:
    """The jobs by their keys. Raises ValueError if two would write the same file, or one of them an input."""
    inputs = {path for job in jobs for path in job.inputs}
    taken = {place(path): path for path in inputs}
    for path, count in Counter(path for job in jobs for path in job.places).items():
        if count > 1:
            raise ValueError(f"two pictures of the batch have the same name, and would both be written to: {path}")
        if path in taken:
            raise ValueError(f"is an input, and a result would overwrite it: {shown(taken[path])}")
    known = cache(readable(hash_of))  # a reference is asked for as often as there are pictures
    with ThreadPoolExecutor(REQUESTS) as pool:
        pool.map(known, filter(is_url, inputs))  # an answer from far away takes its time
    return {key(job, known): job for job in jobs}


@dataclass(frozen=True, kw_only=True)
class PlanOptions:
    """What is done again, and what is kept in memory for it."""

    retry: bool = False  # do again what failed
    overwrite: bool = False  # replace files that are no results of this batch
    more: bool = False  # the jobs come on top of those that the ledger has
    again: frozenset[str] | None = None  # inputs whose features are kept; None: those that come in more jobs than one


def planned(
    jobs: Sequence[Job], out_dir: Path, ledger: Ledger, store: Path, options: PlanOptions | None = None
) -> Plan:
    """Enter the jobs into the ledger, and find those that it does not know to be done.

    A job is done again if its inputs, its options or the version have changed, if its result is no longer there, or,
    with `retry`, if it failed. Raises as `by_key` does, and ImageWriteError if a file is in the way that is no result
    of this batch, unless `overwrite`.
    """
    options = options or PlanOptions()
    keyed = by_key(jobs, ledger.hash_of)
    names = [job.name for job in jobs]
    known = ledger.known(names)
    if not options.overwrite:
        _check_strangers(job for job in jobs if job.name not in known)
    entries = (
        Entry(key=of, name=job.name, fixed=shown(job.fixed), moving=shown(job.moving)) for of, job in keyed.items()
    )
    ledger.plan(entries, more=options.more)
    rows = ledger.rows_of(names)
    undone = [row.name for row in rows if _is_gone(row, out_dir) or (options.retry and row.status == "failed")]
    ledger.reopen(undone)
    done = {row.name for row in rows}.difference(undone)
    # Of a job that is new nobody can have left anything, and to list a folder takes longer the more is in it.
    _sweep({os.path.dirname(os.path.join(job.out_dir, job.name)) for job in jobs if job.name in known})
    uses = Counter(path for job in jobs for path in job.inputs)
    again = options.again or frozenset(path for path, count in uses.items() if count > 1)
    tasks = tuple(
        Task(job=job, key=of, store=str(store), again=again.intersection(job.inputs))
        for of, job in keyed.items()
        if job.name not in done
    )
    return Plan(tasks=tasks, done=len(done))


def carry_out(
    plan: Plan,
    ledger: Ledger,
    engine: Engine,
    *,
    fail_fast: bool = False,
    function: Callable[[Task], Done] = do_task,
) -> Iterator[Row]:
    """Do what is to be done, and yield each row once the ledger has it. What an engine loses stays to be done.

    With `fail_fast` no further than the first row that failed; `function` is what workers call. Raises EngineError if
    there is nowhere to run.
    """
    for outcome in engine.run(function, plan.tasks):
        if outcome.casualty is not None and outcome.casualty.cause == "lost":
            continue
        done = _done(outcome)
        ledger.keep(outcome.job.key, done.row, done.thumbnails, seconds=outcome.seconds)
        yield done.row
        if fail_fast and done.row.status == "failed":
            return


def _done(outcome: Outcome[Task, Done]) -> Done:
    """What came back from a worker, or the row of a job that was its end."""
    if outcome.result is not None:
        return outcome.result
    assert outcome.casualty is not None
    return Done(row=failed_row(outcome.job.job, outcome.casualty.reason))


def _is_gone(row: Row, out_dir: Path) -> bool:
    """Whether somebody took a result away."""
    return any(path and not (out_dir / path).exists() for path in (row.output, row.sidecar, row.recording))


def _check_strangers(jobs: Iterable[Job]) -> None:
    """Raise ImageWriteError, the path last, for a file in the way of these, of which the ledger has never heard."""
    for job in jobs:
        for path in job.places:
            if os.path.exists(path):
                raise ImageWriteError(f"exists already, and is no result of this batch: {path}")


def _sweep(folders: Iterable[str]) -> None:
    """Take away what writers that were killed left behind."""
    for folder in folders:
        for path in Path(folder).glob(TEMPORARY.format("*")):
            path.unlink(missing_ok=True)
