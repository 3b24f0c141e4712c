"""One slot and its worker."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import doomed
import psutil
import pytest

from autoalign.batch.slot import Limits, Slot, Terms
from autoalign.errors import EngineError


@contextmanager
def slot(function: Any, **terms: Any) -> Iterator[Slot[Any, Any]]:
    there: Slot[Any, Any] = Slot(Terms(function=function, **terms))
    try:
        yield there
    finally:
        there.stop()


def test_a_worker_killed_between_jobs_costs_no_job() -> None:
    with slot(doomed.doze) as there:
        first = there.run(0.0)
        worker = psutil.Process(first.result)
        worker.kill()
        psutil.wait_procs([worker], timeout=5)
        second = there.run(0.0)
    assert (first.casualty, second.casualty) == (None, None)
    assert first.result != second.result


def test_a_worker_with_nothing_to_do_goes_and_another_comes() -> None:
    with slot(doomed.doze, idle_s=0.2) as there:
        first = there.run(0.0).result
        deadline = time.monotonic() + 10
        while psutil.pid_exists(first) and time.monotonic() < deadline:
            time.sleep(0.05)
        assert not psutil.pid_exists(first)
        assert there.run(0.0).casualty is None


def test_a_job_that_cannot_be_read_is_an_error() -> None:
    with slot(doomed.identity) as there:
        outcome = there.run(doomed.Unreadable())
        assert there.run("next one").result == "next one"
    assert outcome.casualty is not None
    assert outcome.casualty.cause == "error"
    assert outcome.casualty.reason.startswith("ValueError: invalid literal")


def test_a_stopped_slot_stays_stopped() -> None:
    with slot(doomed.doze) as there:
        worker = there.run(0.0).result
        there.stop()
        assert not psutil.pid_exists(worker)
        with pytest.raises(EngineError, match="stopped"):
            there.run(0.0)


def test_a_slot_that_was_never_used_starts_nothing() -> None:
    children = psutil.Process().children(recursive=True)
    with slot(doomed.doze):
        pass
    assert psutil.Process().children(recursive=True) == children


def test_a_job_with_no_limit_may_take_its_time() -> None:
    with slot(doomed.doze) as there:
        outcome = there.run(0.3)
    assert outcome.casualty is None
    assert 0.3 <= outcome.seconds < 5


@pytest.mark.parametrize("wrong", [{"time_s": 0}, {"time_s": math.nan}, {"memory": 0}])
def test_limits_must_be_possible(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="limit must be over 0"):
        Limits(**wrong)
