"""How the work of many pairs is gone about: what `batch` and `watch` have in common."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from cyclopts import Group

from autoalign.batch.engine import Engine, LocalEngine
from autoalign.batch.jobs import Job, rooted
from autoalign.batch.slot import Limits
from autoalign.errors import EngineError, ImageWriteError
from autoalign.files.large import opened_picture
from autoalign.files.read import ReadOptions
from autoalign.files.remote import check_upload, upload

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
    upload: str | None = None
    """URL (s3://, gs://, az://, abfss:// or file://) below which all that is written is put as well"""


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


def for_running(jobs: Sequence[Job], running: Running) -> list[Job]:
    """The jobs as they are to be run. Raises ValueError for a URL that nothing can be put below."""
    if running.upload:
        check_upload(running.upload)
        jobs = [replace(job, upload=running.upload) for job in jobs]
    return [rooted(job) for job in jobs] if running.scheduler else list(jobs)


def upload_reports(reports: Iterable[Path], running: Running) -> None:
    """Put the reports where the results are put as well, if anywhere. Raises ImageWriteError."""
    if running.upload:
        for report in reports:
            upload(report, running.upload, report.name)


def check_reference(path: Path, reading: ReadOptions) -> None:
    """Raises ImageReadError for a picture that no pair can be aligned onto: better now than once for each."""
    with opened_picture(path, reading):
        pass


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
                told[f"--{field.name.replace('_', '-')}"] = _in_words(value)
    return told


def _in_words(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return ", ".join(value) if isinstance(value, tuple) else str(value)
