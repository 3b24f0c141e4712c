"""What a worker does with one job: read, align, write, and say in a row how it went."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

from autoalign.batch.jobs import Job
from autoalign.batch.memory import PictureMemory
from autoalign.errors import CanvasError, ImageReadError, ImageWriteError
from autoalign.files.ready import Both, Source, align_both
from autoalign.files.record import placed_record, record
from autoalign.files.remote import shown, upload
from autoalign.files.result import ResultFiles, check_in_strips, write_result
from autoalign.files.row import Row, Thumbnails
from autoalign.files.sidecar import Sidecar, transform_of, write_sidecar
from autoalign.files.write import write_bytes_atomically
from autoalign.registration.alignment import Alignment
from autoalign.views.pictures import thumbnails

NO_RECORDING = "autoalign pair --overlay: there is no recording of pictures of so many pixels"


@dataclass(frozen=True, kw_only=True)
class Task:
    """A job as it goes to a worker."""

    job: Job
    key: str
    store: str | None = None  # folder where the features of the pictures in `again` are kept
    again: frozenset[str] = frozenset()  # the inputs that come again in other jobs

    @contextmanager
    def opened(self) -> Iterator[Both]:
        """Both pictures, from the memory of this process if it has them. Raises ImageReadError."""
        job, memory = self.job, _memory()
        fixed = self._source(job.fixed, job.fixed_mask, job.options.fixed_page)
        moving = self._source(job.moving, job.moving_mask, job.options.moving_page)
        with memory.opened(fixed) as still, memory.opened(moving) as mover:
            yield Both(fixed=still, moving=mover)

    def _source(self, path: str, mask: str | None, page: int) -> Source:
        store = self.store if path in self.again else None
        return Source(path=path, mask=mask, page=page, reading=self.job.options.reading, store=store)


@dataclass(frozen=True, kw_only=True)
class Done:
    """A job as it comes back."""

    row: Row
    thumbnails: Thumbnails | None = None


@dataclass(frozen=True, kw_only=True)
class _Found:
    """Where the moving picture goes, and how that is known."""

    kept: Sidecar
    alignment: Alignment | None = None  # None where a whole sequence has decided
    advice: str = ""


def do_task(task: Task) -> Done:
    """Find out where one picture goes, unless that is known, and write what is kept of it.

    What is wrong with its files is a row as well.
    """
    job = task.job
    try:
        with task.opened() as both:
            return _done(job, both)
    except ImageReadError as error:
        return Done(row=_unread_row(job, str(error)))
    except (ImageWriteError, CanvasError, ValueError) as error:
        return Done(row=failed_row(job, str(error)))


def failed_row(job: Job, reason: str) -> Row:
    """The row of a job that could not be finished; nothing of an earlier run may pass for its result."""
    for path in job.outputs:
        path.unlink(missing_ok=True)
    return _without_result(job, reason)


def _unread_row(job: Job, reason: str) -> Row:
    """The row of a job whose pictures cannot be read. What an earlier run made of them stays: they may be gone for
    good, or behind a disk or a server that is away for now."""
    kept = any(path.exists() for path in job.outputs)
    return _without_result(job, reason, advice="the result of an earlier run was left as it is" if kept else "")


def _without_result(job: Job, reason: str, advice: str = "") -> Row:
    return Row(
        name=job.name, fixed=shown(job.fixed), moving=shown(job.moving), status="failed", reason=reason, advice=advice
    )


def _done(job: Job, both: Both) -> Done:
    if both.is_large:
        check_in_strips(job.options.drawing, job.large_output)
    found = _find(job, both)
    small = _thumbnails(both, found.kept)
    written = _write(job, found, both)
    _upload(job, written)
    return Done(row=_row(job, found, written), thumbnails=small)


@cache
def _memory() -> PictureMemory:
    """The one thing that a worker keeps from job to job; no result depends on it."""
    return PictureMemory()


def _find(job: Job, both: Both) -> _Found:
    drawn = {name: value for name, value in asdict(job.options).items() if name not in ("align", "recorded")}
    drawn |= drawn.pop("drawing") | drawn.pop("reading")
    if job.placed is not None:
        return _Found(kept=placed_record(job.placed, *both.pictures, job.options.align, drawn=drawn))
    alignment = align_both(both, job.options.align)
    kept = record(alignment, *both.pictures, drawn=drawn)
    advice = alignment.verdict.advice
    if both.is_large and _is_recorded(job, alignment):
        advice = "; ".join(filter(None, (advice, NO_RECORDING)))
    return _Found(kept=kept, alignment=alignment, advice=advice)


def _is_recorded(job: Job, alignment: Alignment) -> bool:
    wanted = job.options.recorded
    return wanted == "all" or (wanted == "failed" and alignment.status != "aligned")


def _thumbnails(both: Both, kept: Sidecar) -> Thumbnails:
    transform = None if kept.fixed_from_moving is None else both.as_seen(transform_of(kept))
    fixed, moving = (seen.copy.pixels for seen in both.seen())
    return thumbnails(fixed, moving, transform)


def _write(job: Job, found: _Found, both: Both) -> set[Path]:
    """The files of a pair. Those of an earlier run, when the pair was another, are replaced or taken away."""
    job.output.parent.mkdir(parents=True, exist_ok=True)
    written = {job.sidecar}
    if found.kept.status == "aligned":
        files = ResultFiles(aligned=job.large_output if both.is_large else job.output)
        written.update(write_result(files, both, transform_of(found.kept), job.options.drawing, overwrite=True))
    write_sidecar(job.sidecar, found.kept, overwrite=True)
    if both.whole and found.alignment and _is_recorded(job, found.alignment):
        from autoalign.views.viewer import recorded  # not above: rerun is loaded where it is asked for only

        write_bytes_atomically(job.recording, recorded(*both.whole, found.alignment), overwrite=True)
        written.add(job.recording)
    for path in job.outputs:
        if path not in written:
            path.unlink(missing_ok=True)
    return written


def _upload(job: Job, written: Iterable[Path]) -> None:
    """Put the files of a pair where they are wanted as well, the sidecar last: where it is, the others are."""
    if job.upload:
        for path in sorted(written, key=lambda path: path == job.sidecar):
            upload(path, job.upload, job.within(path))


def _row(job: Job, found: _Found, written: Iterable[Path]) -> Row:
    kept, names = found.kept, {path: job.within(path) for path in written}
    return Row(
        name=job.name,
        fixed=shown(job.fixed),
        moving=shown(job.moving),
        status=kept.status,
        reason=kept.reason,
        expected_error_px=kept.expected_error_px,
        model=kept.model,
        fixed_from_moving=kept.fixed_from_moving,
        fixed_size=kept.fixed.size,
        moving_size=kept.moving.size,
        matches=kept.stages.get("matches", 0),
        inliers=kept.stages.get("inliers", 0),
        overlap=kept.evidence.get("overlap", 0.0),
        rung=kept.stages.get("rung"),
        advice=found.advice,
        output=names.get(job.output) or names.get(job.large_output),
        sidecar=names.get(job.sidecar),
        recording=names.get(job.recording),
    )
