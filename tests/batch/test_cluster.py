"""The engine of many machines, on a cluster that is this machine."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import Any

import dask
import doomed
import psutil
import pytest
from distributed import LocalCluster

from autoalign.batch import cluster as engine_module
from autoalign.batch.cluster import DaskEngine
from autoalign.batch.engine import Engine, LocalEngine
from autoalign.batch.slot import Limits
from autoalign.errors import EngineError


def cluster(workers: int, *, processes: bool = True) -> LocalCluster:
    """In processes that are not daemonic, or in this one."""
    with dask.config.set({"distributed.worker.daemon": False}):
        return LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=processes,
            protocol="tcp://",
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",  # None would be the one port that everybody takes
        )


@pytest.fixture(scope="module")
def scheduler() -> Iterator[str]:
    with cluster(2) as there:
        yield there.scheduler_address


def fates(engine: Engine, jobs: list[str]) -> dict[str, Any]:
    """What became of each job, times aside."""
    outcomes = list(engine.run(doomed.fall, jobs))
    assert len(outcomes) == len(jobs)
    return {o.job: (o.result, o.casualty and (o.casualty.cause, o.casualty.reason)) for o in outcomes}


def test_outcomes_are_those_of_the_engine_on_one_machine(scheduler: str) -> None:
    limits = Limits(memory=400 * doomed.MB)
    jobs = [f"innocent {number}" for number in range(20)]
    jobs[2:2] = doomed.ENDS

    far = fates(DaskEngine(scheduler=scheduler, limits=limits), jobs)

    assert far == fates(LocalEngine(workers=2, limits=limits), jobs)
    assert {job: far[job][1] for job in doomed.ENDS} == doomed.ENDS


def test_equal_jobs_are_two_jobs(scheduler: str) -> None:
    assert [outcome.result for outcome in DaskEngine(scheduler=scheduler).run(doomed.identity, [7, 7, 7])] == [7, 7, 7]


def test_jobs_are_read_only_so_far_ahead(scheduler: str) -> None:
    read: list[int] = []
    endless = (read.append(0) or 0 for _ in iter(int, None))
    outcomes = DaskEngine(scheduler=scheduler, ahead=5).run(doomed.identity, endless)

    for count, _ in enumerate(outcomes, 1):
        assert len(read) <= count + 5
        if count == 30:
            break
    outcomes.close()  # type: ignore[attr-defined]


def test_whoever_stops_reading_stops_the_slots(scheduler: str) -> None:
    outcomes = DaskEngine(scheduler=scheduler, ahead=1).run(doomed.doze, [0.0, 1000.0])
    pid = next(outcomes).result
    assert pid is not None
    outcomes.close()  # type: ignore[attr-defined]

    deadline = time.monotonic() + 10
    while psutil.pid_exists(pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not psutil.pid_exists(pid)
    # The threads of the Dask workers are free again.
    assert [outcome.result for outcome in DaskEngine(scheduler=scheduler).run(doomed.identity, [1])] == [1]


def test_a_worker_of_another_version_does_nothing(scheduler: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine_module, "__version__", "0.0.1")
    with pytest.raises(EngineError, match=r"a Dask worker has autoalign .* and not 0\.0\.1"):
        list(DaskEngine(scheduler=scheduler).run(doomed.identity, [1]))


def test_the_end_of_the_scheduler_is_the_end_of_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """With what it was doing; the ledger knows what that was."""
    monkeypatch.setattr(engine_module, "CONNECT_S", 1.0)
    there = cluster(1, processes=False)
    outcomes = DaskEngine(scheduler=there.scheduler_address, ahead=1).run(doomed.doze, [0.0] + [1000.0] * 3)
    pid = next(outcomes).result
    assert pid is not None
    closing = threading.Timer(1.0, there.close)
    closing.start()
    with pytest.raises(EngineError, match="the scheduler has gone: tcp://"):
        list(outcomes)
    closing.join()
    assert not psutil.pid_exists(pid)


def test_a_scheduler_that_is_not_there_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine_module, "CONNECT_S", 0.2)
    with pytest.raises(EngineError, match=r"cannot be reached .*: tcp://127\.0\.0\.1:9"):
        list(DaskEngine(scheduler="tcp://127.0.0.1:9").run(doomed.identity, [1]))
