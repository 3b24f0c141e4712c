"""`autoalign watch`: pictures aligned as they arrive in a folder."""

from __future__ import annotations

import signal
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from autoalign.batch.arrivals import Arrivals, hints
from autoalign.batch.engine import Engine
from autoalign.batch.jobs import Job, JobOptions, Recorded
from autoalign.batch.ledger import Ledger
from autoalign.batch.run import PlanOptions, carry_out, feature_store, planned
from autoalign.batch.sources import Selection, onto_reference
from autoalign.batch.telling import Telling, next_turn, write_reports
from autoalign.cli.progress import tally
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
from autoalign.cli.terminal import ALIGNMENT, FILES, GENERAL, STYLE_OF, Common, Exit, complain, note, tell
from autoalign.errors import ImageReadError, ImageWriteError
from autoalign.files.read import ReadOptions
from autoalign.files.remote import check_upload
from autoalign.registration.alignment import AlignOptions
from autoalign.registration.drawing import Drawing
from autoalign.views.words import counted

UNSETTLED_S = 0.5  # between looks while a file is still being written


@dataclass(frozen=True, kw_only=True)
class WatchFiles:
    """What arrives where, and where it goes."""

    reference: Path
    """picture that all that arrive go onto"""
    out_dir: Path
    """folder for the results; there the same command finds what it has done already"""
    save_rrd: Recorded = "none"
    """also record pairs for `autoalign view`: those that are not aligned, or all"""
    rescan: float = 10.0
    """seconds between two looks at the folder where the system tells of nothing, as on network disks"""
    until_idle: float | None = None
    """seconds without a new picture after which it ends; otherwise Ctrl-C ends it"""


def watch(
    folder: Path,
    /,
    *,
    files: Annotated[WatchFiles, Parameter(name="*", group=FILES)],
    selection: Annotated[Selection, Parameter(name="*", group=FILES)] = Selection(),
    drawing: Annotated[Drawing, Parameter(name="*", group=FILES)] = Drawing(),
    reading: Annotated[ReadOptions, Parameter(name="*", group=FILES)] = ReadOptions(),
    running: Annotated[Running, Parameter(name="*", group=RUNNING)] = Running(),
    options: Annotated[AlignOptions, Parameter(name="*", group=ALIGNMENT)] = AlignOptions(),
    common: Annotated[Common, Parameter(name="*", group=GENERAL)] = Common(),
) -> int:
    """Take what arrives, align it, look again.

    Parameters
    ----------
    folder
        where pictures arrive
    """
    if not folder.is_dir():
        raise ImageReadError(f"is no folder: {folder}")
    check_reference(files.reference, reading)
    if running.upload:
        check_upload(running.upload)  # a URL that is none should not be found out at night
    make_folder(files.out_dir)
    wanted = JobOptions(align=options, drawing=drawing, reading=reading, recorded=files.save_rrd)
    about = {"watched": str(folder)} | in_words(files, selection, drawing, reading, running, options)
    engine, counts = engine_of(running), Counter[str]()
    with Ledger(files.out_dir) as ledger, feature_store(files.out_dir, running.cache) as store:
        telling = Telling(partial(write_reports, files.out_dir, ledger, about))
        with _until_told():
            ledger.begin_run(about)
            note(f"watching {folder}; Ctrl-C ends it", common)
            for names in _arriving(folder, selection, files, telling.due_s):
                if names:
                    telling.expect()
                    jobs = onto_reference(folder, names, files.reference, files.out_dir, wanted)
                    counts.update(_align(for_running(jobs, running), files, ledger, engine, store, common))
                telling.keep_up()
        reports = telling.finish()
    upload_reports(reports, running)
    if not common.quiet:
        tell(f"{counted(counts.total(), 'pair')}: {tally(counts)}" if counts else "nothing new arrived")
    return Exit.DONE if set(counts) <= {"aligned"} else Exit.NOT_ALIGNED


def _arriving(
    folder: Path, selection: Selection, files: WatchFiles, patience_s: Callable[[], float]
) -> Iterator[list[str]]:
    """The names of the pictures that each look at the folder finds to have become whole, which may be none.

    There is a look whenever something may have come, and for the caller's sake after `patience_s` at the latest.
    """
    arrivals = Arrivals(folder, selection, without=files.out_dir)
    idle_since = time.monotonic()
    with hints(folder, arrivals, recursive=selection.recursive) as hint:
        while True:
            hint.clear()  # before the look: what comes during it is seen at the next one
            begun = time.monotonic()
            names = arrivals.take()
            next_look = next_turn(begun, time.monotonic())
            yield names
            if names:
                idle_since = time.monotonic()
            waiting, idle_s = arrivals.waiting(), time.monotonic() - idle_since
            if files.until_idle is not None and not waiting and idle_s > files.until_idle:
                return
            rest_s = UNSETTLED_S if waiting or files.until_idle is not None else files.rescan
            hint.wait(min(rest_s, patience_s()))
            time.sleep(max(0.0, next_look - time.monotonic()))


def _align(
    jobs: Sequence[Job], files: WatchFiles, ledger: Ledger, engine: Engine, store: Path, common: Common
) -> Iterator[str]:
    """The statuses of what has arrived, a line for each."""
    wishes = PlanOptions(overwrite=common.overwrite, more=True, again=frozenset([str(files.reference)]))
    try:
        plan = planned(jobs, files.out_dir, ledger, store, wishes)
    except ImageWriteError as error:  # a file in the way of one is no reason to leave the others unwatched
        complain(str(error))
        return
    for row in carry_out(plan, ledger, engine):
        if not common.quiet:
            tell(f"{row.status} {row.name}: {row.reason}", style=STYLE_OF[row.status])
        yield row.status


@contextmanager
def _until_told() -> Iterator[None]:
    """Until Ctrl-C, or the system asks to end: for a watch both are a good end."""

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    except KeyboardInterrupt:
        pass
    finally:
        signal.signal(signal.SIGTERM, before)
