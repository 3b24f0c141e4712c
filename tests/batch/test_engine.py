"""Jobs that die in every way there is: each is one casualty with its cause, and its neighbours know nothing of it."""

from __future__ import annotations

import ctypes
import functools
import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import cv2
import psutil
import pytest
import threadpoolctl

from autoalign.batch.engine import Engine, InlineEngine, LocalEngine, cores, stream
from autoalign.batch.slot import Casualty, Limits, Outcome, Slot, Terms
from autoalign.errors import EngineError

MB = 1_000_000


def square(number: int) -> int:
    return number * number


def fall(how: str) -> str:
    """A job that meets its end as it is told."""
    if how == "segfault":
        ctypes.string_at(0)
    elif how == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    elif how == "exit":
        os._exit(7)
    elif how == "hang":
        time.sleep(1000)
    elif how == "hog":
        _hog()
    elif how == "no memory":
        raise MemoryError
    elif how == "error":
        raise ValueError("no\nsuch thing")
    elif how == "sys.exit":
        sys.exit("bye")
    elif how == "unpicklable":
        return lambda: None  # type: ignore[return-value]
    return f"survived {how}"


def _hog() -> None:
    held = []
    while True:  # bytes are written to, so that they are resident
        held.append(b"x" * (10 * MB))


ENDS = {
    "segfault": ("crashed", "the worker was killed by signal 11 (segmentation fault)"),
    "killed": ("crashed", "the worker was killed by signal 9 (killed), by hand or by a system short of memory"),
    "exit": ("crashed", "the worker ended with exit code 7"),
    "hang": ("timeout", "took more than 2 s"),
    "hog": ("memory", "needed more than 0.4 GB"),
    "no memory": ("memory", "needed more memory than there is"),
    "error": ("error", "ValueError: no such thing"),
    "sys.exit": ("error", "SystemExit: bye"),
}


def by_job(outcomes: Iterator[Outcome[str, str]]) -> dict[str, Outcome[str, str]]:
    return {outcome.job: outcome for outcome in outcomes}


def test_every_end_is_one_casualty_and_the_neighbours_survive() -> None:
    engine = LocalEngine(workers=2, limits=Limits(time_s=2, memory=400 * MB))
    innocents = [f"innocent {number}" for number in range(20)]
    jobs = [job for pair in zip(innocents, ENDS, strict=False) for job in pair] + innocents[len(ENDS) :]

    outcomes = by_job(engine.run(fall, jobs))

    assert sorted(outcomes) == sorted(jobs)
    for job in innocents:
        assert outcomes[job].result == f"survived {job}"
        assert outcomes[job].casualty is None
    for job, (cause, reason) in ENDS.items():
        casualty = outcomes[job].casualty
        assert outcomes[job].result is None
        assert casualty is not None
        assert (casualty.cause, casualty.reason) == (cause, reason)
    assert 2 <= outcomes["hang"].seconds < 5


