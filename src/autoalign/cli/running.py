"""How the work of many pairs is gone about: what `batch` and `watch` have in common."""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

from cyclopts import Group

from autoalign.batch.engine import Engine, LocalEngine
from autoalign.batch.slot import Limits
from autoalign.errors import EngineError, ImageWriteError

RUNNING = Group("Running", sort_key=1.5)
GB = 1e9


@dataclass(frozen=True, kw_only=True)
class Running:
    """Where and within which bounds pairs are aligned."""

    workers: int | None = None
    """pairs at a time; by default as many as there are cores"""
    scheduler: str | None = None
    """address of a Dask scheduler, such as tcp://10.0.0.1:8786, whose workers do the work: docs/cluster.md"""
    kill_after: float = 600.0
    """seconds after which a pair is given up"""
    max_memory: float = 8.0
    """gigabytes of memory at which a pair is given up"""
    cache: Path | None = None
    """folder to keep the keypoints of all pictures in, for other batches"""


def engine_of(running: Running) -> Engine:
    """Where the work is done. Raises ValueError for options out of range, EngineError without the package for it."""
    limits = Limits(time_s=running.kill_after, memory=round(running.max_memory * GB))
    if running.scheduler:
        if running.workers is not None:
            raise ValueError("--workers is for this machine; on a cluster there are as many as Dask has threads")
        try:
            from autoalign.batch.cluster import DaskEngine  # not above: distributed takes seconds, and is an extra
        except ImportError as error:
            raise EngineError(f"--scheduler needs: pip install 'autoalign[cluster]' ({error})") from None
        return DaskEngine(scheduler=running.scheduler, limits=limits)
    return LocalEngine(workers=running.workers, limits=limits)


def make_folder(folder: Path) -> None:
    """Raises ImageWriteError if there is none and none can be made."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ImageWriteError(f"cannot be made a folder for the results ({error.strerror}): {folder}") from None


def in_words(*options: Any) -> dict[str, str]:
    """The options of these dataclasses, and of those inside, that are not as they are by default."""
    told: dict[str, str] = {}
    for option in options:
        for field in fields(option):
            value = getattr(option, field.name)
            if is_dataclass(value):
                told |= in_words(value)
            elif value != field.default:
                told[f"--{field.name.replace('_', '-')}"] = ", ".join(value) if isinstance(value, tuple) else str(value)
    return told
