"""`autoalign status`: how far a batch is, also while it runs, and its rows for those who analyse."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from autoalign.batch.ledger import LedgerReader
from autoalign.cli.progress import clock, tally
from autoalign.cli.terminal import FILES, GENERAL, STYLE_OF, Common, Exit, note, tell
from autoalign.files.row import Row
from autoalign.files.write import write_bytes_atomically
from autoalign.views.words import counted, number

STDOUT = Path("-")
RECENT_S = 60.0  # over which the rate of a batch that runs is taken


@dataclass(frozen=True, kw_only=True)
class Exports:
    """The rows of a batch as files."""

    json: Annotated[Path | None, Parameter(allow_leading_hyphen=True)] = None
    """write all rows as JSON, - for stdout"""
    csv: Annotated[Path | None, Parameter(allow_leading_hyphen=True)] = None
    """write all rows as CSV, - for stdout"""
    parquet: Path | None = None
    """write all rows as Parquet"""
    worst: int = 10
    """how many of those to name that need a person most"""


def status(
    out_dir: Path,
    /,
    *,
    exports: Annotated[Exports, Parameter(name="*", group=FILES)] = Exports(),
    common: Annotated[Common, Parameter(name="*", group=GENERAL)] = Common(),
) -> int:
    """Read the ledger; count, name the worst, export.

    Parameters
    ----------
    out_dir
        the --out-dir of a batch
    """
    with LedgerReader(out_dir) as ledger:
        if exports.json or exports.csv or exports.parquet:
            _export(list(ledger.rows()), exports, common)
        if not common.quiet and STDOUT not in (exports.json, exports.csv):
            _tell_state(ledger, exports.worst)
    return Exit.DONE


def _export(rows: Iterable[Row], exports: Exports, common: Common) -> None:
    from autoalign.files.export import as_csv, as_json, as_parquet  # not above: it loads pyarrow

    wanted: list[tuple[Path | None, Callable[[Iterable[Row]], bytes]]] = [
        (exports.json, as_json),
        (exports.csv, as_csv),
        (exports.parquet, as_parquet),
    ]
    for path, encode in wanted:
        if path == STDOUT:
            sys.stdout.buffer.write(encode(rows))
        elif path is not None:
            write_bytes_atomically(path, encode(rows), common.overwrite)
            note(f"wrote {path}", common)


def _tell_state(ledger: LedgerReader, worst: int) -> None:
    """The counts; while a batch runs its rate and the time left; then those that need a person most."""
    counts = ledger.counts()
    pending = counts["pending"]
    done = sum(counts.values()) - pending
    to_do = f", {pending:,} to do" if pending else ""
    tell(f"{counted(done + pending, 'pair')}: {tally(counts) or 'nothing done'}{to_do}")
    runs = ledger.runs()
    if runs and runs[-1].ended is None and pending:
        span = min(RECENT_S, max(time.time() - runs[-1].started, 1.0))
        recent = ledger.finished_since(time.time() - span)
        left = f", {clock(pending * span / recent)} left" if recent else ""
        tell(f"{recent} in the last {span:.0f} s{left}; if it does not run, the same command goes on with it")
    for row in ledger.worst(worst):
        error = "" if row.expected_error_px is None else f" ({number(row.expected_error_px)} px expected)"
        tell(f"{row.status} {row.name}{error}: {row.reason}", style=STYLE_OF[row.status])
