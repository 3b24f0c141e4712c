"""What a worker does with one job: read, align, write, and say in a row how it went."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path

from autoalign.batch.jobs import Job
from autoalign.batch.memory import PictureMemory, Ready
from autoalign.errors import CanvasError, ImageReadError, ImageWriteError
from autoalign.files.read import LoadedPicture
from autoalign.files.record import record
from autoalign.files.result import ResultFiles, write_result
from autoalign.files.row import Row, Thumbnails
from autoalign.files.sidecar import as_shown, write_sidecar
from autoalign.files.write import write_bytes_atomically
from autoalign.registration.align import align
from autoalign.registration.alignment import Alignment
from autoalign.views.pictures import thumbnails


@dataclass(frozen=True, kw_only=True)
class Task:
    """A job as it goes to a worker."""

    job: Job
    key: str
    store: str | None = None  # folder where the features of pictures that come again are kept
    again: frozenset[str] = frozenset()  # the inputs that come again in other jobs


@dataclass(frozen=True, kw_only=True)
class Done:
    """A job as it comes back."""

    row: Row
    thumbnails: Thumbnails | None = None


def align_task(task: Task) -> Done:
    """Align one pair and write what is kept of it; what is wrong with its files is a row as well."""
    job = task.job
    try:
        fixed = _ready(task, job.fixed, job.fixed_mask)
        moving = _ready(task, job.moving, job.moving_mask)
        alignment = align(fixed.prepared, moving.prepared, job.options.align)
        row = _write(job, alignment, fixed.loaded, moving.loaded)
    except (ImageReadError, ImageWriteError, CanvasError, ValueError) as error:
        return Done(row=failed_row(job, str(error)))
    transform = None if alignment.status == "rejected" else alignment.fixed_from_moving
    return Done(row=row, thumbnails=thumbnails(fixed.loaded.pixels, moving.loaded.pixels, transform))


def failed_row(job: Job, reason: str) -> Row:
    """The row of a job that could not be tried or finished; nothing of an earlier run may pass for its result."""
    for path in (job.output, job.sidecar, job.recording):
        path.unlink(missing_ok=True)
    return Row(name=job.name, fixed=job.fixed, moving=job.moving, status="failed", reason=reason)


def _ready(task: Task, path: str, mask: str | None) -> Ready:
    return _memory().ready(path, mask, task.store if path in task.again else None)


@cache
def _memory() -> PictureMemory:
    """The one thing that a worker keeps from job to job; no result depends on it."""
    return PictureMemory()


def _write(job: Job, alignment: Alignment, fixed: LoadedPicture, moving: LoadedPicture) -> Row:
    """The files of a pair, and its row. They replace those of an earlier run, whose pair has changed since."""
    job.output.parent.mkdir(parents=True, exist_ok=True)
    aligned = alignment.status == "aligned"
    if aligned:
        transform = alignment.fixed_from_moving
        write_result(ResultFiles(aligned=job.output), fixed, moving, transform, job.options.drawing, overwrite=True)
    else:
        job.output.unlink(missing_ok=True)
    kept = record(alignment, fixed, moving, drawn=asdict(job.options.drawing))
    write_sidecar(job.sidecar, kept, overwrite=True)
    recorded = job.options.recorded == "all" or (job.options.recorded == "failed" and not aligned)
    if recorded:
        _record(job, alignment, fixed, moving)
    else:
        job.recording.unlink(missing_ok=True)
    return replace(
        _row(job, alignment),
        output=_inside(job.output, job) if aligned else None,
        sidecar=_inside(job.sidecar, job),
        recording=_inside(job.recording, job) if recorded else None,
    )


def _record(job: Job, alignment: Alignment, fixed: LoadedPicture, moving: LoadedPicture) -> None:
    from autoalign.views.viewer import recorded  # not above: rerun is loaded where recordings are asked for only

    write_bytes_atomically(job.recording, recorded(fixed, moving, alignment), overwrite=True)


def _row(job: Job, alignment: Alignment) -> Row:
    return Row(
        name=job.name,
        fixed=job.fixed,
        moving=job.moving,
        status=alignment.status,
        reason=alignment.reason,
        expected_error_px=alignment.expected_error_px,
        model=alignment.model,
        fixed_from_moving=None if alignment.status == "rejected" else as_shown(alignment.fixed_from_moving),
        fixed_size=alignment.fixed_size,
        moving_size=alignment.moving_size,
        matches=alignment.matches,
        inliers=alignment.inliers,
        overlap=alignment.overlap,
        rung=alignment.best.rung,
        advice=alignment.verdict.advice,
    )


def _inside(path: Path, job: Job) -> str:
    """The path relative to the batch's folder, with slashes."""
    return path.relative_to(job.out_dir).as_posix()
