"""The engines on this machine, with jobs that die in every way there is."""

from __future__ import annotations

import functools
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future
from pathlib import Path

import doomed
import psutil
import pytest

from autoalign.batch.engine import Engine, InlineEngine, LocalEngine, cores, stream
from autoalign.batch.slot import Limits, Outcome
from autoalign.errors import EngineError

LIMITS = Limits(memory=400 * doomed.MB)


def by_job(outcomes: Iterator[Outcome[str, str]]) -> dict[str, Outcome[str, str]]:
    return {outcome.job: outcome for outcome in outcomes}


def test_every_end_is_one_casualty_and_the_neighbours_survive() -> None:
    innocents = [f"innocent {number}" for number in range(20)]
    jobs = [job for pair in zip(innocents, doomed.ENDS, strict=False) for job in pair] + innocents[len(doomed.ENDS) :]

    outcomes = by_job(LocalEngine(workers=2, limits=LIMITS).run(doomed.fall, jobs))

    assert sorted(outcomes) == sorted(jobs)
    for job in innocents:
        assert (outcomes[job].result, outcomes[job].casualty) == (f"survived {job}", None)
    for job, (cause, reason) in doomed.ENDS.items():
        casualty = outcomes[job].casualty
        assert casualty is not None
        assert (outcomes[job].result, casualty.cause, casualty.reason) == (None, cause, reason)


def test_a_job_that_hangs_is_ended_in_time() -> None:
    engine = LocalEngine(workers=1, limits=Limits(time_s=0.5))
    hung, next_one = engine.run(doomed.fall, ["hang", "next one"])

    assert hung.casualty is not None
    assert (hung.casualty.cause, hung.casualty.reason) == ("timeout", "took more than 0.5 s")
    assert 0.5 <= hung.seconds < 3
    assert next_one.result == "survived next one"


def test_a_result_that_cannot_be_sent_is_an_error_with_its_trace() -> None:
    (outcome,) = LocalEngine(workers=1).run(doomed.fall, ["unpicklable"])

    assert outcome.casualty is not None
    assert outcome.casualty.cause == "error"
    assert "pickle" in outcome.casualty.reason
    assert "Traceback" in outcome.casualty.trace


def test_messages_larger_than_a_pipe_go_through() -> None:
    job = os.urandom(3_000_001)
    (outcome,) = LocalEngine(workers=1).run(doomed.identity, [job])
    assert outcome.result == job


def test_jobs_are_read_only_a_few_ahead() -> None:
    """So that memory stays flat, however many there are."""
    read = []
    endless = (read.append(number) or number for number in iter(int, None))
    outcomes = LocalEngine(workers=2).run(doomed.identity, endless)

    for count, _ in enumerate(outcomes, 1):
        assert len(read) <= count + 2 * 2 + 2
        if count == 50:
            break
    outcomes.close()


def test_the_same_worker_takes_job_after_job() -> None:
    assert len({outcome.result for outcome in LocalEngine(workers=1).run(doomed.doze, [0.0] * 5)}) == 1


def test_a_worker_that_keeps_much_is_replaced_before_the_next_job_pays_for_it() -> None:
    engine = LocalEngine(workers=1, limits=Limits(memory=800 * doomed.MB))
    outcomes = list(engine.run(doomed.keep, [500] * 3))

    assert [outcome.casualty for outcome in outcomes] == [None] * 3
    assert len({outcome.result for outcome in outcomes}) == 3


def test_the_initializer_runs_in_the_worker() -> None:
    engine = LocalEngine(workers=1, initializer=doomed.greet)
    assert [outcome.result for outcome in engine.run(doomed.greeting, [0])] == ["good morning"]
    assert doomed.greeting(0) is None


@pytest.mark.parametrize("workers", [1, cores()])
def test_workers_times_threads_are_no_more_than_cores(workers: int) -> None:
    (outcome,) = LocalEngine(workers=workers).run(doomed.threads, [0])
    assert outcome.result is not None
    assert max(outcome.result) * workers <= cores()


def test_a_worker_that_cannot_start_is_said_once_and_stops_the_run() -> None:
    engine = LocalEngine(workers=1, initializer=doomed.refuse)
    with pytest.raises(EngineError, match="no worker can be started: the worker ended with exit code 5"):
        list(engine.run(doomed.identity, range(3)))


def test_what_cannot_be_pickled_is_a_wrong_call() -> None:
    with pytest.raises((AttributeError, TypeError), match="pickle"):
        list(LocalEngine(workers=1).run(doomed.identity, [threading.Lock()]))


@pytest.mark.parametrize("how", ["exception", "close"])
def test_whoever_stops_reading_stops_the_workers(how: str) -> None:
    outcomes = LocalEngine(workers=2).run(doomed.doze, [0.0, 1000.0, 1000.0, 1000.0])
    pid = next(outcomes).result
    assert pid is not None
    started = time.monotonic()
    if how == "close":
        outcomes.close()
    else:
        with pytest.raises(KeyboardInterrupt):
            outcomes.throw(KeyboardInterrupt)
    assert time.monotonic() - started < 5
    assert not psutil.pid_exists(pid)


COORDINATOR = """
import sys
sys.path.insert(0, sys.argv[1])
import doomed
from autoalign.batch.engine import LocalEngine
if __name__ == "__main__":
    for outcome in LocalEngine(workers=2).run(doomed.doze, [0.0] * 4 + [1000.0] * 4):
        print(outcome.result, flush=True)
"""


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_no_worker_outlives_its_coordinator(tmp_path: Path, end: signal.Signals) -> None:
    """Not even in the middle of a job, whatever the coordinator died of."""
    script = tmp_path / "coordinator.py"
    script.write_text(COORDINATOR)
    command = [sys.executable, str(script), str(Path(__file__).parent)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as coordinator:
        assert coordinator.stdout is not None
        for _ in range(4):
            assert coordinator.stdout.readline()
        family = psutil.Process(coordinator.pid).children(recursive=True)
        coordinator.send_signal(end)
        gone, alive = psutil.wait_procs(family, timeout=5)
        coordinator.wait(5)
    assert len(gone) >= 3  # the workers, and the server that they come from
    assert alive == []


def test_a_script_without_a_guard_is_told_so(tmp_path: Path) -> None:
    """Each of its workers would run the script again."""
    script = tmp_path / "careless.py"
    script.write_text("from autoalign.batch.engine import LocalEngine\nlist(LocalEngine(workers=1).run(abs, [-1]))\n")
    ended = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=60)
    assert ended.returncode == 1
    assert 'must do so under `if __name__ == "__main__":`' in ended.stderr.splitlines()[-1]


@pytest.mark.parametrize("engine", [InlineEngine(), LocalEngine(workers=2)])
def test_engines_give_the_same(engine: Engine) -> None:
    outcomes = by_job(engine.run(doomed.fall, ["error", "one", "two", "sys.exit"]))
    casualties = {job: outcome.casualty.reason for job, outcome in outcomes.items() if outcome.casualty}

    assert {job: outcome.result for job, outcome in outcomes.items()} == {
        "error": None,
        "one": "survived one",
        "two": "survived two",
        "sys.exit": None,
    }
    assert casualties == {"error": "ValueError: no such thing", "sys.exit": "SystemExit: bye"}


def test_a_part_of_a_function_is_a_function() -> None:
    power = functools.partial(pow, 2)
    assert sorted(outcome.result or 0 for outcome in LocalEngine(workers=1).run(power, range(4))) == [1, 2, 4, 8]


def test_stream_hands_out_what_comes_first() -> None:
    waiting: list[Future[int]] = []

    def submit(job: int) -> Future[int]:
        future: Future[int] = Future()
        waiting.append(future)
        if len(waiting) == 3:  # the last one of the window is done first
            future.set_result(job)
        return future

    results = stream(submit, range(3), ahead=3)
    assert next(results) == (2, waiting[2])
    waiting[0].set_result(0)
    assert next(results) == (0, waiting[0])


def test_a_machine_without_workers_is_no_engine() -> None:
    with pytest.raises(ValueError, match="at least one worker"):
        LocalEngine(workers=0)
