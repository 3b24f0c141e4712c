"""What a batch says of itself to people: the report and the recording, made from its ledger."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from autoalign.batch.ledger import LedgerReader
from autoalign.files.row import Row, Thumbnails
from autoalign.views.report import write_report

REPORT = "report.html"


def write_reports(out_dir: Path, ledger: LedgerReader, about: Mapping[str, str], *, sequence: bool) -> Path:
    """Write the report of all that the ledger knows into the folder of the results, and say where it is.

    Raises ImageWriteError if it cannot be written.
    """
    report = out_dir / REPORT
    write_report(report, out_dir.absolute().name, _illustrated(ledger), about, sequence=sequence, overwrite=True)
    return report


def _illustrated(ledger: LedgerReader) -> Iterator[tuple[Row, Thumbnails | None]]:
    for row in ledger.rows():
        yield row, ledger.thumbnails(row.name)
