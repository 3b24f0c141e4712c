"""Jobs that meet their end as they are told, for the engines."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import time
from typing import Any

import cv2
import threadpoolctl

MB = 1_000_000

# What becomes of a job with each name, where 400 MB are allowed.
ENDS = {
    "segfault": ("crashed", "the worker was killed by signal 11 (segmentation fault)"),
    "killed": ("crashed", "the worker was killed by signal 9 (killed), by hand or by a system short of memory"),
    "exit": ("crashed", "the worker ended with exit code 7"),
    "hog": ("memory", "needed more than 0.4 GB"),
    "no memory": ("memory", "needed more memory than there is"),
    "error": ("error", "ValueError: no such thing"),
    "sys.exit": ("error", "SystemExit: bye"),
}


def fall(how: str) -> Any:
    """Meet that end, or none."""
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
        return lambda: None
    return f"survived {how}"


def identity(job: Any) -> Any:
    return job


def doze(seconds: float) -> int:
    """Sleep; the process that did."""
    time.sleep(seconds)
    return os.getpid()


def greeting(_: int) -> str | None:
    """What the initializer left."""
    return os.environ.get("AUTOALIGN_TEST_GREETING")


def greet() -> None:
    os.environ["AUTOALIGN_TEST_GREETING"] = "good morning"


class Unreadable:
    """A job that can be sent, and not be read."""

    def __reduce__(self) -> tuple[Any, ...]:
        return int, ("no number",)


def refuse() -> None:
    os._exit(5)


def threads(_: int) -> tuple[int, int]:
    """How many threads cv2 and the BLAS of NumPy would keep busy."""
    return cv2.getNumThreads(), max(pool["num_threads"] for pool in threadpoolctl.threadpool_info())


def keep(megabytes: int) -> int:
    """Hold so much from now on; the process that does."""
    _kept.append(b"x" * (megabytes * MB))
    return os.getpid()


_kept: list[bytes] = []


def _hog() -> None:
    held = []
    while True:  # bytes are written to, so that they are resident
        held.append(b"x" * (10 * MB))
