"""`autoalign batch`: many pairs, nobody watching."""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from autoalign.batch.chain import link_up, place
from autoalign.batch.engine import Engine
from autoalign.batch.jobs import Job, JobOptions, Recorded
from autoalign.batch.ledger import FILE_NAME as LEDGER
from autoalign.batch.ledger import Ledger, LedgerReader
from autoalign.batch.manifest import manifest_jobs
from autoalign.batch.run import PlanOptions, carry_out, feature_store, planned
from autoalign.batch.sources import Selection, in_groups, onto_reference, pictures, place_of_reference
from autoalign.batch.telling import write_reports
from autoalign.cli.progress import clock, following, tally
from autoalign.cli.running import (
    RUNNING,
    Running,
    check_reference,
    engine_of,
    for_running,
    in_words,
    make_folder,
    upload_reports,
)
from autoalign.cli.terminal import ALIGNMENT, FILES, GENERAL, STYLE_OF, Common, Exit, note, tell
from autoalign.errors import ImageReadError
from autoalign.files.read import ReadOptions, read_text
from autoalign.files.remote import shown
from autoalign.files.row import Row
from autoalign.registration.alignment import AlignOptions
from autoalign.registration.drawing import Drawing
from autoalign.registration.sequence import links
from autoalign.views.words import counted

STDIN = Path("-")
MAX_MANIFEST_BYTES = 1 << 28
TOLD = 10  # pairs that are not aligned, at the end


@dataclass(frozen=True, kw_only=True)
class BatchFiles:
    """What goes onto what, and where the results go."""

    out_dir: Path
    """folder for the results; there the same command finds what it has done already"""
    reference: str | None = None
    """picture that all others of the folder go onto; for --sequence and --pattern also first or middle"""
    sequence: bool = False
    """the pictures are a time-lapse or a stack: linked with each other, and put onto one of them without drift"""
    pattern: str | None = None
    """regular expression: names with the same text in its first bracket go together, as exposures of one view do"""
    save_rrd: Recorded = "none"
    """also record pairs for `autoalign view`: those that are not aligned, or all"""


@dataclass(frozen=True, kw_only=True)
class Again:
    """What is done, and what is done once more."""

    plan: bool = False
    """only say what would be done"""
    retry: Literal["failed"] | None = None
    """also do again what failed before"""
    fail_fast: bool = False
    """stop at the first pair that fails, as by a file that cannot be read"""


def batch(
    source: Annotated[Path, Parameter(allow_leading_hyphen=True)],
    /,
    *,
    files: Annotated[BatchFiles, Parameter(name="*", group=FILES)],
    selection: Annotated[Selection, Parameter(name="*", group=FILES)] = Selection(),
    drawing: Annotated[Drawing, Parameter(name="*", group=FILES)] = Drawing(),
    reading: Annotated[ReadOptions, Parameter(name="*", group=FILES)] = ReadOptions(),
    again: Annotated[Again, Parameter(name="*", group=RUNNING)] = Again(),
    running: Annotated[Running, Parameter(name="*", group=RUNNING)] = Running(),
    options: Annotated[AlignOptions, Parameter(name="*", group=ALIGNMENT)] = AlignOptions(),
    common: Annotated[Common, Parameter(name="*", group=GENERAL)] = Common(),
) -> int:
    """Plan, do what is not done yet, report.

    Parameters
    ----------
    source
        a folder, or a manifest: CSV with the columns fixed, moving and, if wanted, name and options; - is stdin
    """
    started = time.monotonic()
    wanted = JobOptions(align=options, drawing=drawing, reading=reading, recorded=files.save_rrd)
    jobs, reference = _jobs(source, files, selection, wanted, common)
    if not jobs:
        raise ValueError(f"holds no two pictures that go together: {source}")
    jobs = for_running(jobs, running)
    if again.plan:
        return _tell_plan(jobs, reference, files.out_dir)
    make_folder(files.out_dir)
    with Ledger(files.out_dir) as ledger, feature_store(files.out_dir, running.cache) as store:
        engine = engine_of(running)
        about = {"source": str(source)} | in_words(files, selection, drawing, reading, running, options)
        ledger.begin_run(about)
        if reference is not None:
            jobs = _placed(jobs, reference, ledger, engine, store, common)
        everything = frozenset(path for job in jobs for path in job.inputs) if running.cache else None
        wishes = PlanOptions(retry=again.retry == "failed", overwrite=common.overwrite, again=everything)
        plan = planned(jobs, files.out_dir, ledger, store, wishes)
        with following("pairs", len(plan.tasks), common.quiet) as follow:
            for row in carry_out(plan, ledger, engine, fail_fast=again.fail_fast):
                follow(row.status)
        rows = ledger.rows_of([job.name for job in jobs])
        reports = write_reports(files.out_dir, ledger, about, sequence=files.sequence, recorded=True)
    _tell_end(rows, len(jobs), plan.done, time.monotonic() - started, common)
    note(f"wrote {', '.join(map(str, reports))}", common)
    upload_reports(reports, running)
    return _exit(rows, len(jobs))


def _jobs(
    source: Path, files: BatchFiles, selection: Selection, options: JobOptions, common: Common
) -> tuple[list[Job], int | None]:
    """What the source holds; for a sequence, which is the frame that the others go onto."""
    if source != STDIN and source.is_dir():
        return _of_folder(source, files, selection, options, common)
    if source != STDIN and not source.exists():
        raise ImageReadError(f"does not exist: {source}")
    wrong = [name for name in ("reference", "sequence", "pattern") if getattr(files, name)]
    wrong += [name for name, value in asdict(selection).items() if value]
    if wrong:
        raise ValueError(f"--{wrong[0]} is for folders, and this is none: {source}")
    if source == STDIN:
        return manifest_jobs(sys.stdin.read(), "stdin", Path.cwd(), files.out_dir, options), None
    text = read_text(source, max_bytes=MAX_MANIFEST_BYTES)
    return manifest_jobs(text, str(source), source.parent.absolute(), files.out_dir, options), None


def _of_folder(
    folder: Path, files: BatchFiles, selection: Selection, options: JobOptions, common: Common
) -> tuple[list[Job], int | None]:
    names = pictures(folder, selection, without=files.out_dir)
    if files.sequence and files.pattern:
        raise ValueError("--sequence and --pattern exclude each other")
    if files.pattern:
        jobs = in_groups(folder, names, files.pattern, files.reference or "first", files.out_dir, options)
        _tell_alone(folder, names, jobs, common)
        return jobs, None
    if files.sequence:
        if files.save_rrd != "none":
            raise ValueError("--save-rrd is for pairs: a frame of a sequence rests on many")
        reference = _frame(folder, names, files.reference or "first")
        fixed = str(folder / names[reference])
        frames = [
            Job(name=name, fixed=fixed, moving=str(folder / name), out_dir=str(files.out_dir), options=options)
            for name in names
        ]
        return frames, reference
    if files.reference is None:
        raise ValueError(f"needs --reference FILE, --sequence or --pattern for a folder: {folder}")
    check_reference(Path(files.reference), options.reading)
    return onto_reference(folder, names, Path(files.reference), files.out_dir, options), None


def _tell_alone(folder: Path, names: Sequence[str], jobs: Sequence[Job], common: Common) -> None:
    """What a pattern leaves without a partner is left out, but not without a word."""
    paired = {path for job in jobs for path in (job.fixed, job.moving)}
    alone = [name for name in names if str(folder / name) not in paired]
    if alone:
        note(f"{len(alone):,} of {len(names):,} pictures have no other in their group, as: {folder / alone[0]}", common)


def _frame(folder: Path, names: Sequence[str], reference: str) -> int:
    """The number of the frame that the others go onto."""
    if reference in ("first", "middle"):
        return place_of_reference(reference, len(names))
    wanted = Path(reference).resolve()
    for number, name in enumerate(names):
        if (folder / name).resolve() == wanted:
            return number
    raise ValueError(f"is none of the frames of {folder}: {reference}")


def _tell_plan(jobs: Sequence[Job], reference: int | None, out_dir: Path) -> Exit:
    """A line for each job that would be done, and nothing done."""
    known = {}
    if (out_dir / LEDGER).exists():
        with LedgerReader(out_dir) as ledger:
            known = {row.name: row.status for row in ledger.rows_of([job.name for job in jobs])}
    for job in jobs:
        before = f" ({known[job.name]} before)" if job.name in known else ""
        print(f"{shown(job.moving)} -> {shown(job.fixed)}: {job.output}{before}")
    again = sum(job.name in known for job in jobs)
    chained = f", after {len(links(len(jobs), reference)):,} links between frames" if reference is not None else ""
    before = f"{again:,} done before, of which only those that changed are done again" if again else "none done before"
    tell(f"{counted(len(jobs), 'pair')}{chained}; {before}")
    return Exit.DONE


def _placed(
    frames: Sequence[Job], reference: int, ledger: Ledger, engine: Engine, store: Path, common: Common
) -> list[Job]:
    """Every frame where all links of the sequence together put it."""
    linked = []
    with following("links", len(links(len(frames), reference)), common.quiet) as follow:
        for one in link_up(frames, reference, ledger, engine, store):
            linked.append(one)
            follow(one.link.status)
    return place(frames, reference, linked)


def _tell_end(rows: Sequence[Row], total: int, plan_done: int, seconds: float, common: Common) -> None:
    """The counts on stdout, and on stderr what a person should look at."""
    if common.quiet:
        return
    counts = Counter(row.status for row in rows)
    left = f", {total - len(rows):,} not done" if total > len(rows) else ""
    before = f", {plan_done:,} of them done before" if plan_done else ""
    tell(f"{counted(total, 'pair')}: {tally(counts)}{left}{before} ({clock(seconds)})")
    wrong = [row for row in rows if row.status != "aligned"]
    for row in wrong[:TOLD]:
        tell(f"{row.status} {row.name}: {row.reason}", style=STYLE_OF[row.status], to_stderr=True)
    if len(wrong) > TOLD:
        tell(f"... and {len(wrong) - TOLD:,} more that are not aligned", to_stderr=True)


def _exit(rows: Sequence[Row], total: int) -> Exit:
    if any(row.status == "failed" for row in rows):
        return Exit.FILE
    return Exit.DONE if len(rows) == total and all(row.status == "aligned" for row in rows) else Exit.NOT_ALIGNED
