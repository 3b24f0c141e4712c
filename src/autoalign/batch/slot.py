"""One worker process that takes job after job. Whatever a job does to it becomes an outcome, and the next job finds a
new worker.

Each slot has a worker and a line to it of its own. So the death of one, even in the middle of an answer, can neither
hold up nor confuse another, as it can where workers share a queue and its locks.
"""

from __future__ import annotations

import functools
import multiprocessing as mp
import os
import pickle
import signal
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.context import BaseContext
from multiprocessing.process import BaseProcess
from typing import Any, Generic, Literal, TypeVar

import cv2
import psutil
import threadpoolctl

from autoalign.errors import EngineError
from autoalign.files.codec import one_line

POLL_S = 0.05  # how often a running job is held against its limits
START_LIMIT_S = 120.0  # to import what the job needs, from a slow network disk perhaps
START_ATTEMPTS = 3  # one may be killed by chance; what fails three times will fail for ever
FAREWELL_S = 5.0  # between the end of a worker's line and the end of its process
GB = 1e9
READY = "ready"

J = TypeVar("J")
R = TypeVar("R")
Cause = Literal["crashed", "timeout", "memory", "error", "lost"]


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What one job may take before its worker is killed; None is no limit."""

    time_s: float | None = None
    memory: int | None = None  # bytes resident in the worker, as `top` shows them

    def __post_init__(self) -> None:
        if self.time_s is not None and not self.time_s > 0:
            raise ValueError(f"the time limit must be over 0 s, not {self.time_s}")
        if self.memory is not None and self.memory <= 0:
            raise ValueError(f"the memory limit must be over 0 bytes, not {self.memory}")


@dataclass(frozen=True, kw_only=True)
class Casualty:
    """Why a job has no result."""

    cause: Cause
    reason: str  # one sentence
    trace: str = ""  # of an error, for those who look for the fault


@dataclass(frozen=True, kw_only=True)
class Outcome(Generic[J, R]):
    """What became of a job: a result, or else a casualty."""

    job: J
    result: R | None
    casualty: Casualty | None
    seconds: float  # from the handing over to the answer


@dataclass(frozen=True, kw_only=True)
class Terms(Generic[J, R]):
    """On which a worker is taken on."""

    function: Callable[[J], R]  # importable by name
    limits: Limits = field(default_factory=Limits)
    threads: int = 1  # that cv2 and BLAS may keep busy in each worker
    initializer: Callable[[], None] | None = None  # called once in each worker, before its first job
    idle_s: float | None = None  # after so long without a job a worker goes, and another comes with the next job


class Slot(Generic[J, R]):
    """A place for one worker, which is started when the first job comes and replaced when a job was its end.

    `run` is for one thread at a time, `stop` may come from any.
    """

    def __init__(self, terms: Terms[J, R]) -> None:
        self._terms = terms
        self._worker: _Worker | None = None
        self._stopped = False

    def run(self, job: J) -> Outcome[J, R]:
        """Have the job done. Raises EngineError if no worker can be started, or the slot was stopped.

        A function or a job that cannot be pickled is a wrong call, and raises what pickle raises.
        """
        worker = self._ready()
        started = time.monotonic()
        result: R | None = None
        casualty: Casualty | None
        try:
            worker.line.send(job)
            casualty = self._overrun(worker, started)
            if casualty is None:
                result, casualty = worker.line.recv()
        except (EOFError, OSError):  # OSError: it died before it had read all of the job
            casualty = worker.death()
        seconds = time.monotonic() - started
        if (casualty is not None and casualty.cause != "error") or self._swollen(worker):
            worker.end()
        return Outcome(job=job, result=result, casualty=casualty, seconds=seconds)

    def stop(self) -> None:
        """End the worker at once, and for good; a job that runs becomes a casualty. A worker holds nothing to save."""
        with _BIRTHS_AND_DEATHS:
            self._stopped = True
        if self._worker is not None:
            self._worker.kill()

    def _ready(self) -> _Worker:
        """A worker that waits for a job: the one there is, if it lives, or a new one."""
        if self._worker is not None:
            if self._worker.idle():
                return self._worker
            self._worker.end()
        for _ in range(START_ATTEMPTS):
            try:
                with _BIRTHS_AND_DEATHS:
                    if self._stopped:
                        raise EngineError("the engine was stopped")
                    worker = self._worker = _Worker(self._terms)
            except (EOFError, OSError) as error:  # the server that workers come from has ended
                reason = one_line(error)
                continue
            if worker.greets():
                return worker
            reason = worker.death().reason
        raise EngineError(
            f"no worker can be started: {reason}, and what it said before stands above"
            ' (a script that runs a batch must do so under `if __name__ == "__main__":`)'
        )

    def _overrun(self, worker: _Worker, started: float) -> Casualty | None:
        """Wait for the answer, or the worker's death; a casualty if the job went over a limit before."""
        time_s, memory = self._terms.limits.time_s, self._terms.limits.memory
        interval = None if time_s is None and memory is None else POLL_S
        while not wait((worker.line, worker.process.sentinel), interval):
            if time_s is not None and time.monotonic() - started > time_s:
                return Casualty(cause="timeout", reason=f"took more than {time_s:g} s")
            if memory is not None and worker.memory() > memory:
                return Casualty(cause="memory", reason=f"needed more than {memory / GB:.1f} GB")
        return None

    def _swollen(self, worker: _Worker) -> bool:
        """Whether the worker still holds so much that its next job might have to pay for it."""
        memory = self._terms.limits.memory
        return memory is not None and worker.memory() > memory / 2


# multiprocessing keeps one set of children for the whole process and looks after all of them at every start; a thread
# that asks for an exit code meanwhile may find it taken.
_BIRTHS_AND_DEATHS = threading.Lock()


class _Worker:
    """A process and the line to it."""

    def __init__(self, terms: Terms[Any, Any]) -> None:
        if mp.current_process().daemon:
            raise EngineError("no worker can be started by a process that is daemonic")
        context = _context(terms.function)
        self.line, far_end = context.Pipe()
        # Daemonic: it may not outlive this process, and has no children.
        self.process: BaseProcess = context.Process(target=_work, args=(far_end, terms), daemon=True)  # type: ignore[attr-defined]
        with _out_of_reach_of_ctrl_c():
            self.process.start()
        far_end.close()  # so that the worker alone holds it, and its end is heard
        self._seen = psutil.Process(self.process.pid)

    def greets(self) -> bool:
        """Whether it becomes ready for its first job."""
        try:
            return self.line.poll(START_LIMIT_S) and self.line.recv() == READY
        except (EOFError, OSError):
            return False

    def idle(self) -> bool:
        """Whether it lives and waits."""
        return not self.line.closed and not wait((self.line, self.process.sentinel), 0)

    def memory(self) -> int:
        """Bytes resident; 0 once it is gone."""
        try:
            return int(self._seen.memory_info().rss)
        except psutil.Error:
            return 0

    def death(self) -> Casualty:
        """What it died of, now that its line has ended."""
        with _BIRTHS_AND_DEATHS:
            self.process.join(FAREWELL_S)
            code = self.process.exitcode
        self.end()
        return Casualty(cause="crashed", reason=f"the worker {_last_words(code)}")

    def kill(self) -> None:
        with _BIRTHS_AND_DEATHS:
            self.process.kill()
            self.process.join()

    def end(self) -> None:
        """Kill it, if it lives, and close the line; only for the thread that may be listening to it."""
        self.kill()
        self.line.close()


def _last_words(code: int | None) -> str:
    if code is None:
        return "no longer answered"
    if code >= 0:
        return f"ended with exit code {code}"
    name = (signal.strsignal(-code) or "unknown").lower()
    hint = ", by hand or by a system short of memory" if -code == signal.SIGKILL else ""
    return f"was killed by signal {-code} ({name}){hint}"


def _context(function: Callable[..., Any]) -> BaseContext:
    """How workers come into the world: off a server that has imported what the job needs, where there is one.

    Never by a fork of this process, whose threads may hold locks; and a start from nothing costs seconds a death.
    """
    if "forkserver" not in mp.get_all_start_methods():
        return mp.get_context("spawn")
    context = mp.get_context("forkserver")
    named = function.func if isinstance(function, functools.partial) else function
    context.set_forkserver_preload(["__main__", __name__, named.__module__])  # heard by the first start only
    return context


@contextmanager
def _out_of_reach_of_ctrl_c() -> Iterator[None]:
    """What is started here never hears it: on a terminal it reaches everyone, and the coordinator decides for all.

    To ignore it is too late for a process that is still importing, and would say so in many lines.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()  # it would lift the block if it were started behind it
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _work(line: Connection, terms: Terms[Any, Any]) -> None:
    """The life of a worker."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # where it could not be kept away
    threading.Thread(target=_follow_coordinator, daemon=True).start()
    _limit_threads(terms.threads)
    if terms.initializer is not None:
        terms.initializer()
    line.send(READY)
    while line.poll(terms.idle_s):
        try:
            job = line.recv()
        except (EOFError, OSError):
            return
        except Exception as error:  # the job is none that can be had here
            _answer(line, None, _error(error))
        else:
            _answer(line, *attempt(terms.function, job))


def attempt(function: Callable[[J], R], job: J) -> tuple[R | None, Casualty | None]:
    try:
        return function(job), None
    except MemoryError:
        return None, Casualty(cause="memory", reason="needed more memory than there is", trace=traceback.format_exc())
    except BaseException as error:  # SystemExit too: the worker is not the job's to end
        return None, _error(error)


def _answer(line: Connection, result: Any, casualty: Casualty | None) -> None:
    try:
        line.send((result, casualty))  # pickles all before it sends a byte
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        line.send((None, _error(error)))


def _error(error: BaseException) -> Casualty:
    """To be called while the error is being handled."""
    reason = f"{type(error).__name__}: {one_line(error)}"
    return Casualty(cause="error", reason=reason, trace=traceback.format_exc())


def _follow_coordinator() -> None:
    """Die with the process that asked for this one, also where another one bore it, and in the middle of a job."""
    coordinator = mp.parent_process()
    assert coordinator is not None, "this is a worker"
    coordinator.join()
    os._exit(1)


def _limit_threads(threads: int) -> None:
    """For cv2 and every BLAS that is loaded, which the arrival of the job's function has done."""
    cv2.setNumThreads(threads)
    threadpoolctl.threadpool_limits(threads)
